//! Bytes, build time and speed of scene structures. All of them must hit the same triangles, but for those whose positions have
//! fewer bits.

use anyhow::{Result, ensure};
use cpu_time::{ProcessTime, ThreadTime};
use renderer::{
    grid::{GridOptions, MemoryBudget, Storage},
    intersect::ray::{Hit, Ray},
    model::mesh::Mesh,
    render::scene::Scene,
};
use serde::Serialize;
use shared::{
    camera::Camera,
    division::{Division, FrameSize},
    scene::Precision,
};

use super::peers::{self, Peer};
use crate::{
    plot::{Axis, COLORS, Figure, Mark, Plot, Point, Series, significant},
    statistics::median,
    trace::frame::trace_share,
};

pub(super) struct Settings {
    pub(super) size: FrameSize,
    /// How often each variant alternates with the default; the median counts.
    pub(super) n_repeats: usize,
    /// Cells per triangle of the tree.
    pub(super) densities: Vec<f64>,
    pub(super) uniform_densities: Vec<f64>,
    pub(super) memory_budget: MemoryBudget,
}

/// One scene structure over all cameras: a line of the table.
#[derive(Clone, Debug, Serialize)]
pub(super) struct MemoryRow {
    storage: &'static str,
    density: f64,
    macrocell_levels: u8,
    /// `packets` or `single`.
    rays: &'static str,
    /// Bits of each coordinate of a position, or `exact`.
    geometry: String,
    /// The farthest that a position may be off, in the model's units.
    largest_error: f64,
    bytes_per_triangle: f64,
    /// CPU time of all threads.
    build_seconds: f64,
    cpu_ns_per_ray: f64,
    mrays_per_second: f64,
}

/// Bits of each coordinate, beside exact positions.
const BITS: [u8; 4] = [10, 13, 16, 21];

/// Cells per triangle of uniform grids with fewer levels of macrocells.
const FEW_LEVELS_DENSITY: f64 = 4.0;

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Variant {
    options: GridOptions,
    precision: Precision,
    /// Whether rays are traced one by one; the tree is measured so with one density only.
    is_single: bool,
}

impl Variant {
    pub(super) fn name(&self) -> String {
        let Self { options, precision, is_single } = self;
        let GridOptions { macrocell_levels, storage, .. } = options;
        let density = options.density.unwrap_or(GridOptions::PAPER_DENSITY);
        let rays = if *is_single && *storage == Storage::Tree { ", single rays" } else { "" };
        format!("{storage}, density {density}, {macrocell_levels} levels, geometry {precision}{rays}")
    }
}

impl Settings {
    /// All variants; `chosen` is the density that the grid chooses.
    pub(super) fn variants(&self, chosen: f64) -> Vec<Variant> {
        let options =
            GridOptions { density: Some(chosen), memory_budget: self.memory_budget, ..GridOptions::default() };
        let mut densities = self.densities.clone();
        if !densities.contains(&chosen) {
            densities.push(chosen);
            densities.sort_by(f64::total_cmp);
        }
        let exact = |options: GridOptions| Variant { options, precision: Precision::EXACT, is_single: false };
        let packets = |&density| exact(GridOptions { density: Some(density), ..options });
        let mut variants: Vec<_> = densities.iter().map(packets).collect();
        let precisions = BITS.into_iter().flat_map(Precision::try_from);
        variants.extend(precisions.map(|precision| Variant { precision, ..exact(options) }));
        variants.push(exact(GridOptions { storage: Storage::Compact, ..options }));
        let single = |options: GridOptions| Variant { is_single: true, ..exact(options) };
        variants.push(single(options));
        for storage in [Storage::RowDisplacement, Storage::Plain] {
            for &density in &self.uniform_densities {
                variants.push(single(GridOptions { density: Some(density), storage, ..options }));
            }
            // Fewer levels change little but the time: one density is enough.
            for macrocell_levels in [2, 1, 0] {
                variants.push(single(GridOptions {
                    density: Some(FEW_LEVELS_DENSITY),
                    storage,
                    macrocell_levels,
                    ..options
                }));
            }
        }
        variants
    }
}

/// The default structure: all variants alternate with it and must hit the same.
pub(super) struct Baseline<'a> {
    mesh: &'a Mesh,
    cameras: Vec<Camera>,
    scene: Scene,
    hash: blake3::Hash,
    /// Nanoseconds per ray, the median.
    cpu_ns: f64,
}

impl<'a> Baseline<'a> {
    pub(super) fn new(mesh: &'a Mesh, cameras: Vec<Camera>, settings: &Settings) -> Self {
        let options = GridOptions { memory_budget: settings.memory_budget, ..GridOptions::default() };
        let scene = Scene::build(mesh.clone(), &options, &|_| ());
        let mut baseline = Self { mesh, cameras, scene, hash: blake3::hash(&[]), cpu_ns: f64::INFINITY };
        let mut hasher = blake3::Hasher::new();
        baseline.trace(&baseline.scene, settings.size, false, Some(&mut hasher));
        baseline.hash = hasher.finalize();
        let times = (0..settings.n_repeats).map(|_| baseline.trace(&baseline.scene, settings.size, false, None));
        baseline.cpu_ns = median(times);
        baseline
    }

    pub(super) fn is_empty(&self) -> bool {
        self.scene.n_triangles() == 0
    }

    pub(super) fn chosen_density(&self) -> f64 {
        self.scene.grid.figures().density
    }

    /// Measures a variant. The inner error says why it is left out; the outer one, that its hits are wrong.
    pub(super) fn measure(&self, variant: &Variant, settings: &Settings) -> Result<Result<MemoryRow, String>> {
        let Variant { options, precision, is_single } = variant;
        let mesh = self.mesh.clone().snapped(*precision);
        let started = ProcessTime::now();
        let scene = Scene::build(mesh, options, &|_| ());
        let build_seconds = started.elapsed().as_secs_f64();
        if let Some(shortage) = scene.grid.shortage() {
            return Ok(Err(shortage.to_string()));
        }
        let mut hasher = blake3::Hasher::new();
        self.trace(&scene, settings.size, *is_single, Some(&mut hasher));
        ensure!(
            *precision != Precision::EXACT || hasher.finalize() == self.hash,
            "{} hits other triangles than the default: this is a bug",
            variant.name()
        );
        // Alternates with the default, so that other load on the machine slows both alike.
        let ratios = (0..settings.n_repeats).map(|_| {
            let ours = self.trace(&scene, settings.size, *is_single, None);
            ours / self.trace(&self.scene, settings.size, false, None)
        });
        let cpu_ns_per_ray = self.cpu_ns * median(ratios);
        Ok(Ok(MemoryRow {
            storage: options.storage.into(),
            density: scene.grid.figures().density,
            macrocell_levels: options.macrocell_levels,
            rays: if *is_single { "single" } else { "packets" },
            geometry: precision.to_string(),
            largest_error: scene.mesh().largest_error(),
            bytes_per_triangle: scene.n_bytes() as f64 / scene.n_triangles() as f64,
            build_seconds,
            cpu_ns_per_ray,
            mrays_per_second: 1e3 / cpu_ns_per_ray,
        }))
    }

    /// Traces all cameras on this thread; returns nanoseconds per ray. The hits go to `hasher`.
    fn trace(&self, scene: &Scene, size: FrameSize, is_single: bool, mut hasher: Option<&mut blake3::Hasher>) -> f64 {
        let task = Division::Tiled.task(0, 1);
        let Ok(share) = task.share(size) else { return f64::NAN };
        let mut hits = vec![Hit::MISS; size.n_samples() as usize];
        let index = |(i, j): (u32, u32)| (j * size.xres() + i) as usize;
        let mut cpu = 0.0;
        for camera in &self.cameras {
            let rays = camera.rays(size);
            let started = ThreadTime::now();
            if is_single {
                for (i, j) in (0..share.count()).flat_map(|unit| share.samples(unit).iter()) {
                    hits[index((i, j))] = scene.grid.intersect(&Ray::new(rays.eye, rays.direction(i, j)));
                }
            } else {
                trace_share(scene, &rays, &share, |block, block_hits| {
                    block.samples().zip(block_hits).for_each(|(sample, &hit)| hits[index(sample)] = hit);
                });
            }
            cpu += started.elapsed().as_secs_f64();
            if let Some(hasher) = &mut hasher {
                for hit in hits.iter().map(|&hit: &Hit| scene.with_file_index(hit)) {
                    hasher.update(&hit.triangle.to_le_bytes());
                    hasher.update(&hit.t.to_bits().to_le_bytes());
                }
            }
        }
        cpu * 1e9 / (self.cameras.len() as f64 * f64::from(size.n_samples()))
    }
}

pub(super) fn figure(title: String, notes: Vec<String>, rows: &[MemoryRow], peers: &[Peer]) -> Figure {
    let memory = Axis { title: "bytes per triangle, mesh and grid", label: significant, range: None };
    let build = Axis { title: "CPU seconds to build, all threads", label: significant, range: None };
    let of_memory = plot(rows, memory, |row| row.bytes_per_triangle, peers, |peer| peer.bytes_per_triangle);
    let of_build = plot(rows, build, |row| row.build_seconds, peers, |peer| peer.build_seconds);
    Figure { title, notes, rows: vec![(560, vec![of_memory]), (560, vec![of_build])] }
}

fn plot(
    rows: &[MemoryRow],
    x: Axis,
    value: impl Fn(&MemoryRow) -> f64,
    peers: &[Peer],
    of_peer: impl Fn(&Peer) -> Option<f64>,
) -> Plot {
    let name = |row: &MemoryRow| match (row.storage, row.rays) {
        ("masks", "single") => "masks, single rays".to_owned(),
        ("masks", _) if row.largest_error > 0.0 => "masks, positions of fewer bits".to_owned(),
        ("masks", _) => "masks".to_owned(),
        ("compact", _) => "compact".to_owned(),
        (storage, _) if row.macrocell_levels < 3 => format!("{storage}, fewer levels"),
        (storage, _) => format!("{storage}, {} levels", row.macrocell_levels),
    };
    let mut series: Vec<Series> = Vec::new();
    for row in rows {
        let name = name(row);
        let point = Point::new(value(row).log10(), row.cpu_ns_per_ray.log10());
        let is_coarse = row.storage != "masks" && row.macrocell_levels < 3;
        let label = if is_coarse {
            format!("{} levels", row.macrocell_levels)
        } else if row.largest_error > 0.0 {
            format!("{} bits, off by {:.0e}", row.geometry, row.largest_error)
        } else {
            row.density.to_string()
        };
        let point = Point { label, ..point };
        match series.iter_mut().find(|series| series.name == name) {
            Some(series) => series.points.push(point),
            None => {
                let color = match (row.storage, row.rays) {
                    ("masks", "single") => COLORS[6],
                    ("masks", _) if row.largest_error > 0.0 => COLORS[1],
                    ("masks", _) => COLORS[3],
                    ("compact", _) => COLORS[2],
                    ("plain", _) => COLORS[5],
                    _ => COLORS[0],
                };
                let mark = if is_coarse { Mark::Circle } else { Mark::Disc };
                series.push(Series { name, color, mark, is_joined: true, points: vec![point] });
            }
        }
    }
    series.extend(peers::series(peers, |peer| Some((of_peer(peer)?.log10(), peer.cpu_ns_per_ray?.log10()))));
    Plot {
        title: "labels: cells per triangle, or bits a coordinate; packets, unless a name says single rays or levels"
            .to_owned(),
        x,
        y: Axis { title: "CPU ns per ray", label: significant, range: None },
        series,
    }
    .with_front()
}

/// Compares the grid's own choice, `chosen` cells a triangle, with the fastest variant.
pub(super) fn verdict(rows: &[MemoryRow], chosen: f64) -> Option<String> {
    let exact = rows.iter().filter(|row| row.largest_error == 0.0);
    let fastest = exact.min_by(|a, b| a.cpu_ns_per_ray.total_cmp(&b.cpu_ns_per_ray))?;
    let is_chosen = |row: &&MemoryRow| {
        let is_default = row.storage == <&str>::from(Storage::default()) && row.rays == "packets";
        is_default && row.largest_error == 0.0 && row.density == chosen
    };
    let ours = rows.iter().find(is_chosen)?;
    let excess = |ours: f64, best: f64| 100.0 * (ours / best - 1.0);
    let (slower, larger) = (
        excess(ours.cpu_ns_per_ray, fastest.cpu_ns_per_ray),
        excess(ours.bytes_per_triangle, fastest.bytes_per_triangle),
    );
    Some(format!(
        "chosen: density {chosen}, within {slower:.1} % of the fastest ({}, density {}) with {larger:+.1} % of its bytes",
        fastest.storage, fastest.density
    ))
}
