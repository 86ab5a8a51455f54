//! The results as charts, the paper's figures 8 and 9 among them.

use std::path::Path;

use plotters::style::{BLACK, RGBColor};
use shared::division::Division;
use strum::VariantArray;

use super::results::{MeasuredRow, PredictedRow, Results};
use crate::plot::{Axis, COLORS, Figure, GREY, Mark, Plot, Series, plain, significant};

const HEIGHT: u32 = 420;

pub(super) fn draw(results: &Results, folder: &Path) -> anyhow::Result<()> {
    if !results.measured.is_empty() {
        bytes_figure(&results.measured).write(folder, "bytes-per-frame")?;
        time_figure(&results.measured, results.n_cores).write(folder, "time-per-frame")?;
    }
    let mut sizes: Vec<&str> = results.predicted.iter().map(|row| &*row.size).collect();
    sizes.dedup();
    for size in sizes {
        for (motion, is_moving) in [("still", false), ("moving", true)] {
            let is_shown = |row: &&PredictedRow| row.size == size && row.n_slow == 0 && row.is_moving == is_moving;
            let rows: Vec<_> = results.predicted.iter().filter(is_shown).collect();
            if !rows.is_empty() {
                cluster_figure(&rows, size, motion).write(folder, &format!("predicted-{size}-{motion}"))?;
            }
        }
    }
    Ok(())
}

/// A line for each division of points with a division, x and y.
fn by_division(points: &[(Division, f64, f64)]) -> Vec<Series> {
    let line = |of: Division| {
        let color = match of {
            Division::Interleaved => COLORS[0],
            Division::Tiled => COLORS[2],
            Division::Dynamic => COLORS[3],
        };
        let points = points.iter().filter(|(division, ..)| *division == of).map(|&(_, x, y)| (x, y));
        Series::line(of.to_string(), color, Mark::Disc, points)
    };
    Division::VARIANTS.iter().copied().map(line).filter(|line| !line.points.is_empty()).collect()
}

/// A plot over the number of render servers, from 0 up.
fn measured_plot(
    title: &str,
    unit: &'static str,
    rows: &[MeasuredRow],
    value: fn(&MeasuredRow) -> f64,
    bound: Option<Series>,
) -> Plot {
    let points = rows.iter().filter_map(|row| Some((row.division?, f64::from(row.n_nodes), value(row))));
    let points: Vec<_> = points.collect();
    let most = rows.iter().map(value).fold(1e-3, f64::max);
    Plot {
        title: title.to_owned(),
        x: Axis { title: "render servers", label: plain, range: None },
        y: Axis { title: unit, label: plain, range: Some(0.0..most * 1.1) },
        series: by_division(&points).into_iter().chain(bound).collect(),
    }
}

/// The paper's figure 8.
fn bytes_figure(rows: &[MeasuredRow]) -> Figure {
    let plots = vec![
        measured_plot("Received by the wall per frame", "kB", rows, |row| row.bytes_in / 1e3, None),
        measured_plot("Sent by the wall per frame", "kB", rows, |row| row.bytes_out / 1e3, None),
    ];
    Figure {
        title: "Bytes per frame".to_owned(),
        notes: vec!["median over frames; lines that coincide lie one upon another".to_owned()],
        rows: vec![(HEIGHT, plots)],
    }
}

/// The paper's figure 9.
fn time_figure(rows: &[MeasuredRow], n_cores: usize) -> Figure {
    let last = rows.iter().map(|row| f64::from(row.n_nodes)).fold(0.0, f64::max);
    let alone = rows.iter().find(|row| row.division.is_none()).map(|row| {
        let points = [0.0, last].map(|n_nodes| (n_nodes, row.frame_ms_median));
        Series::line("display alone".to_owned(), GREY, Mark::Nothing, points)
    });
    Figure {
        title: "Time per frame".to_owned(),
        notes: vec![format!("render servers of one thread; they and the wall share {n_cores} cores")],
        rows: vec![(HEIGHT, vec![measured_plot("", "ms, median", rows, |row| row.frame_ms_median, alone)])],
    }
}

fn cluster_figure(rows: &[&PredictedRow], size: &str, motion: &str) -> Figure {
    let mut links: Vec<f64> = rows.iter().map(|row| row.mbit_per_s).collect();
    links.sort_by(f64::total_cmp);
    links.dedup();
    Figure {
        title: format!("Predicted: {size}, {motion} camera"),
        notes: Vec::new(),
        rows: vec![(HEIGHT, links.into_iter().map(|link| cluster_plot(rows, link)).collect())],
    }
}

fn cluster_plot(rows: &[&PredictedRow], mbit_per_s: f64) -> Plot {
    let rows: Vec<_> = rows.iter().copied().filter(|row| row.mbit_per_s == mbit_per_s).collect();
    let decades = |n_nodes: f64, frame_ms: f64| (n_nodes.log10(), (1e3 / frame_ms).log10());
    let points = rows.iter().map(|row| {
        let (x, y) = decades(f64::from(row.n_nodes), row.frame_ms);
        (row.division, x, y)
    });
    let mut series = by_division(&points.collect::<Vec<_>>());
    let of_dynamic: Vec<_> = rows.iter().filter(|row| row.division == Division::Dynamic).collect();
    if let (Some(first), Some(last)) = (of_dynamic.first(), of_dynamic.last()) {
        let ends = [first.n_nodes, last.n_nodes].map(f64::from);
        let bound = |name: &str, color: RGBColor, frame_ms: &dyn Fn(f64) -> f64| {
            let points = ends.map(|n_nodes| decades(n_nodes, frame_ms(n_nodes)));
            Series::line(name.to_owned(), color, Mark::Nothing, points)
        };
        let alone_ms = first.compute_ms * ends[0];
        series.push(bound("bound by compute: linear", GREY, &|n_nodes| alone_ms / n_nodes));
        series.push(bound("bound by the link", BLACK, &|_| last.link_ms));
    }
    let bound_by = |by: &str| {
        let nodes: Vec<_> =
            of_dynamic.iter().filter(|row| row.binds == by).map(|row| row.n_nodes.to_string()).collect();
        (!nodes.is_empty()).then(|| format!("{by} binds at {}", nodes.join(", ")))
    };
    let binds = ["compute", "link"].into_iter().filter_map(bound_by).collect::<Vec<_>>().join("; ");
    let link = if mbit_per_s >= 1e3 { format!("{} Gbit/s", mbit_per_s / 1e3) } else { format!("{mbit_per_s} Mbit/s") };
    Plot {
        title: format!("{link} into the wall: {binds}"),
        x: Axis { title: "one-core render servers", label: significant, range: None },
        y: Axis { title: "frames a second", label: significant, range: None },
        series,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chart_names_its_lines_axes_and_bounds() {
        let row = |n_nodes: u32, frame_ms: f64, binds: &'static str| PredictedRow {
            division: Division::Dynamic,
            n_nodes,
            n_slow: 0,
            size: "1024x512".into(),
            is_moving: false,
            mbit_per_s: 680.0,
            n_frames: 4,
            frame_ms,
            compute_ms: 120.0 / f64::from(n_nodes),
            link_ms: 18.5,
            binds,
            over_bound: 1.0,
            efficiency: 1.0,
            cpu_over_alone: 1.0,
            imbalance_median: 1.0,
            imbalance_p95: 1.0,
            bytes_in: 1.6e6,
        };
        let rows = [row(1, 121.0, "compute"), row(64, 19.0, "link")];
        let folder = tempfile::tempdir().unwrap();
        let figure = cluster_figure(&rows.iter().collect::<Vec<_>>(), "1024x512", "still");
        figure.write(folder.path(), "chart").unwrap();
        let svg = std::fs::read_to_string(folder.path().join("chart.svg")).unwrap();
        for text in
            ["680 Mbit/s", "compute binds at 1; link binds at 64", "dynamic", "bound by the link", "frames a second"]
        {
            assert!(svg.contains(text), "{text}");
        }
    }
}
