//! Speed and error of intersection methods: near the model, far from it, and with the model moved.

use std::ops::Range;

use anyhow::Result;
use plotters::style::RGBColor;
use renderer::model::mesh::Mesh;
use serde::Serialize;
use shared::{camera::Camera, division::FrameSize};

use super::{
    candidates::{Candidates, PlacedModel, Placement},
    measure::{self, Measurement},
    methods::Method,
    peers::{self, Peer},
};
use crate::{
    files,
    plot::{Axis, COLORS, Figure, Mark, Plot, Point, Series, power, significant, whole_decades},
};

pub(super) struct Settings {
    pub(super) size: FrameSize,
    /// Repetitions of each method; the median counts.
    pub(super) n_repeats: usize,
    /// Distances of the eye to the model: powers of ten, in sizes of the model.
    pub(super) decades: Vec<u8>,
}

impl Settings {
    pub(super) fn placements(&self) -> Vec<Placement> {
        let far = self.decades.iter().map(|&decade| Placement::EyeFar(decade));
        [Placement::Near, Placement::ModelMoved].into_iter().chain(far).collect()
    }
}

/// One method with one camera, or with all: a line of the table.
#[derive(Clone, Debug, Serialize)]
pub(super) struct KernelRow {
    camera: String,
    placement: Placement,
    method: Method,
    cpu_ns_per_ray: f64,
    depth_error_p50: f64,
    depth_error_p999: f64,
    depth_error_max: f64,
    wrong_pixels: u64,
    lost: u64,
    invented: u64,
    other_triangle: u64,
    compared: u64,
    undecided: u64,
}

impl KernelRow {
    fn new(camera: &str, placement: Placement, method: Method, measurement: &Measurement) -> Self {
        let [depth_error_p50, depth_error_p999, depth_error_max] = measurement.depth_error_quantiles();
        Self {
            camera: camera.to_owned(),
            placement,
            method,
            cpu_ns_per_ray: measurement.cpu_ns_per_ray(),
            depth_error_p50,
            depth_error_p999,
            depth_error_max,
            wrong_pixels: measurement.n_wrong(),
            lost: measurement.n_lost,
            invented: measurement.n_invented,
            other_triangle: measurement.n_other_triangle,
            compared: measurement.n_compared,
            undecided: measurement.n_undecided,
        }
    }
}

#[derive(Default)]
pub(super) struct Results {
    pub(super) rows: Vec<KernelRow>,
    /// Over all cameras, placement by placement, by method.
    pooled: Vec<(Placement, Vec<Measurement>)>,
}

impl Results {
    /// Measures one camera; the error says why that is impossible.
    pub(super) fn measure(
        &mut self,
        mesh: &Mesh,
        (name, camera): (&str, &Camera),
        placement: Placement,
        settings: &Settings,
        progress: &dyn Fn(f32),
    ) -> Result<(), String> {
        let placed = PlacedModel::new(mesh, camera, placement)?;
        let candidates = Candidates::find(mesh, &placed, settings.size)?;
        let measured = measure::measure(mesh, &placed, &candidates, settings.n_repeats, progress);
        if measured.iter().all(|measurement| measurement.n_hits() == 0) {
            return Err("the camera sees nothing of the model".to_owned());
        }
        let of_methods = Method::ALL.iter().zip(&measured);
        self.rows.extend(of_methods.map(|(&method, measurement)| KernelRow::new(name, placement, method, measurement)));
        match self.pooled.iter_mut().find(|(other, _)| *other == placement) {
            Some((_, pooled)) => pooled.iter_mut().zip(&measured).for_each(|(sum, measurement)| sum.add(measurement)),
            None => self.pooled.push((placement, measured)),
        }
        Ok(())
    }

    /// All methods at all placements, over all cameras.
    fn summary(&self) -> Vec<(Placement, Vec<KernelRow>)> {
        let rows = |(placement, measured): &(Placement, Vec<Measurement>)| {
            let of_methods = Method::ALL.into_iter().zip(measured);
            let rows = of_methods.map(|(method, measurement)| KernelRow::new("all", *placement, method, measurement));
            (*placement, rows.collect())
        };
        self.pooled.iter().map(rows).collect()
    }

    pub(super) fn figure(&self, title: String, notes: Vec<String>, peers: &[Peer]) -> Figure {
        let summary = self.summary();
        let all = || summary.iter().flat_map(|(_, rows)| rows);
        let fixed = || all().filter(|row| !matches!(row.placement, Placement::EyeFar(_)));
        let depth = whole_decades(fixed().flat_map(|row| [row.depth_error_p50, row.depth_error_max]).map(decades), 1.5);
        let mut rows = Vec::new();
        for (placement, of_placement) in &summary {
            let peers = if *placement == Placement::Near { peers } else { &[] };
            let title = match placement {
                Placement::Near => "near: model and eye in place",
                Placement::ModelMoved => "moved: model and eye 10 000 model sizes from the origin",
                Placement::EyeFar(_) => continue,
            };
            rows.push((340, vec![depth_plot(title, of_placement, peers, &depth), wrong_plot(of_placement, peers)]));
        }
        let far: Vec<_> = summary.iter().filter(|(placement, _)| matches!(placement, Placement::EyeFar(_))).collect();
        if far.len() > 1 {
            let depth = |row: &KernelRow| decades(row.depth_error_p999);
            rows.push((
                360,
                vec![
                    over_distance("CPU ns per ray", &far, significant, |row| row.cpu_ns_per_ray.log10()),
                    over_distance("relative depth error at 99.9 % of hits", &far, power, depth),
                    over_distance("wrong pixels per million", &far, none_or_power, wrong_decades),
                ],
            ));
        }
        Figure { title, notes, rows }
    }

    pub(super) fn table(&self) -> Result<String> {
        files::table(&self.summary().into_iter().flat_map(|(_, rows)| rows).collect::<Vec<_>>())
    }
}

fn method_color(method: Method) -> RGBColor {
    let index = Method::ALL.iter().position(|&other| other == method);
    COLORS[index.unwrap_or(0)]
}

/// One point of each method and peer, over the time of a ray.
fn speed_plot(
    title: String,
    y: Axis,
    rows: &[KernelRow],
    point: impl Fn(&KernelRow) -> Point,
    of_peers: impl Iterator<Item = Series>,
) -> Plot {
    let series = |row: &KernelRow| Series::single(row.method.label(), method_color(row.method), Mark::Disc, point(row));
    Plot {
        title,
        x: Axis { title: "CPU ns per ray", label: significant, range: None },
        y,
        series: rows.iter().map(series).chain(of_peers).collect(),
    }
    .with_front()
}

fn depth_plot(title: &str, rows: &[KernelRow], peers: &[Peer], range: &Range<f64>) -> Plot {
    let point = |row: &KernelRow| Point {
        bar: Some(decades(row.depth_error_p50)..decades(row.depth_error_max)),
        ..Point::new(row.cpu_ns_per_ray.log10(), decades(row.depth_error_p999))
    };
    let of_peers = peers::series(peers, |peer| Some((peer.cpu_ns_per_ray?.log10(), decades(peer.depth_error_p999?))));
    let y = Axis { title: "relative depth error", label: power, range: Some(range.clone()) };
    speed_plot(title.to_owned(), y, rows, point, of_peers)
}

fn wrong_plot(rows: &[KernelRow], peers: &[Peer]) -> Plot {
    let title = format!("{} pixels compared", rows.first().map_or(0, |row| row.compared));
    let point = |row: &KernelRow| Point::new(row.cpu_ns_per_ray.log10(), wrong_decades(row));
    let of_peers =
        peers::series(peers, |peer| Some((peer.cpu_ns_per_ray?.log10(), decades_per_million(peer.wrong_per_million?))));
    let y = Axis { title: "wrong pixels per million", label: none_or_power, range: Some(NONE - 0.4..7.4) };
    speed_plot(title, y, rows, point, of_peers)
}

/// A curve of each method over the distance of the eye.
fn over_distance(
    title: &'static str,
    far: &[&(Placement, Vec<KernelRow>)],
    label: fn(f64) -> String,
    value: impl Fn(&KernelRow) -> f64,
) -> Plot {
    let series: Vec<_> = Method::ALL
        .into_iter()
        .map(|method| {
            let point = |(placement, rows): &&(Placement, Vec<KernelRow>)| {
                let Placement::EyeFar(decade) = *placement else { return None };
                let row = rows.iter().find(|row| row.method == method)?;
                Some((f64::from(decade), value(row)))
            };
            let points = far.iter().filter_map(point);
            Series::line(method.label().to_owned(), method_color(method), Mark::Disc, points)
        })
        .collect();
    let values = || series.iter().flat_map(|series| &series.points).map(|point| point.y);
    let (least, most) = values().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), y| (low.min(y), high.max(y)));
    // Less than two decades are shown at full height.
    let y = if most - least < 2.0 { least - 0.1..most + 0.1 } else { whole_decades(values(), 0.5) };
    Plot {
        title: "far: the eye moves back".to_owned(),
        x: Axis { title: "distance of the eye, in model sizes", label: power, range: None },
        y: Axis { title, label, range: Some(y.start - 0.1..y.end) },
        series,
    }
}

/// The logarithm of an error, at least the resolution of `f64`.
fn decades(error: f64) -> f64 {
    error.max(1e-17).log10()
}

/// The decade of "no wrong pixel": one below one in a million.
const NONE: f64 = -1.0;

fn decades_per_million(wrong: f64) -> f64 {
    if wrong == 0.0 { NONE } else { wrong.log10().max(0.0) }
}

fn wrong_decades(row: &KernelRow) -> f64 {
    decades_per_million(row.wrong_pixels as f64 * 1e6 / row.compared as f64)
}

fn none_or_power(decade: f64) -> String {
    match decade.round() {
        NONE => "none".to_owned(),
        decade @ 0.0..=6.0 => power(decade),
        _ => String::new(),
    }
}
