//! What the ways to keep a scene take and give: bytes, time to build, and speed. Their hits must be the same.

use anyhow::{Result, ensure};
use cpu_time::{ProcessTime, ThreadTime};
use renderer::{
    grid::{GridOptions, MemoryBudget, MeshLayout, Storage},
    intersect::ray::{Hit, Ray},
    model::mesh::Mesh,
    render::tracer::{Scene, SceneOptions},
};
use serde::Serialize;
use shared::{
    camera::Camera,
    division::{Division, FrameSize},
};

use super::peers::Peer;
use crate::{
    plot::{Axis, COLORS, Figure, PEER_COLOR, Plot, Point, Series, significant},
    statistics::median,
};

/// How much is measured.
pub(super) struct Settings {
    pub(super) size: FrameSize,
    /// How often each setting takes its turn with the default; the median counts.
    pub(super) n_repeats: usize,
    /// Cells per triangle, with masks.
    pub(super) densities: Vec<f64>,
    /// The same with the uniform grids.
    pub(super) uniform_densities: Vec<f64>,
    pub(super) memory_budget: MemoryBudget,
}

/// A line of the table: one way to keep the scene, over all cameras.
#[derive(Clone, Debug, Serialize)]
pub(super) struct MemoryRow {
    storage: &'static str,
    mesh: &'static str,
    density: f64,
    macrocell_levels: u8,
    /// Packets where the structure is followed by them, else single rays.
    rays: &'static str,
    bytes_per_triangle: f64,
    /// CPU time of all threads.
    build_seconds: f64,
    cpu_ns_per_ray: f64,
    mrays_per_second: f64,
}

/// Cells per triangle of uniform grids with fewer levels of macrocells.
const FEW_LEVELS_DENSITY: f64 = 4.0;

/// One way to keep a scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Setting {
    options: GridOptions,
    /// Single rays are measured beside packets for one setting only.
    is_single: bool,
}

impl Setting {
    pub(super) fn name(&self) -> String {
        let Self { options, is_single } = self;
        let GridOptions { macrocell_levels, storage, mesh, .. } = options;
        let density = options.density.unwrap_or(GridOptions::PAPER_DENSITY);
        let rays = if *is_single && *storage == Storage::Tree { ", single rays" } else { "" };
        format!("{storage}, {mesh}, density {density}, {macrocell_levels} levels{rays}")
    }
}

impl Settings {
    /// All settings that are measured, where `chosen` is the density that a grid chooses by itself.
    pub(super) fn settings(&self, chosen: f64) -> Vec<Setting> {
        let options =
            GridOptions { density: Some(chosen), memory_budget: self.memory_budget, ..GridOptions::default() };
        let mut densities = self.densities.clone();
        if !densities.contains(&chosen) {
            densities.push(chosen);
            densities.sort_by(f64::total_cmp);
        }
        let mut settings = Vec::new();
        for mesh in [MeshLayout::Indexed, MeshLayout::Flat] {
            settings.extend(densities.iter().map(|&density| Setting {
                options: GridOptions { density: Some(density), mesh, ..options },
                is_single: false,
            }));
        }
        let single = |options: GridOptions| Setting { options, is_single: true };
        settings.push(single(options));
        for storage in [Storage::RowDisplacement, Storage::Plain] {
            for &density in &self.uniform_densities {
                settings.push(single(GridOptions { density: Some(density), storage, ..options }));
            }
            // Fewer levels change little but the time, so one density tells.
            for macrocell_levels in [2, 1, 0] {
                settings.push(single(GridOptions {
                    density: Some(FEW_LEVELS_DENSITY),
                    storage,
                    macrocell_levels,
                    ..options
                }));
            }
        }
        settings
    }
}

/// The default, which all others take turns with and must hit the same as.
pub(super) struct Baseline<'a> {
    mesh: &'a Mesh,
    cameras: Vec<Camera>,
    scene: Scene,
    hash: blake3::Hash,
    /// Nanoseconds per ray, the best seen.
    cpu_ns: f64,
}

impl<'a> Baseline<'a> {
    pub(super) fn new(mesh: &'a Mesh, cameras: Vec<Camera>, settings: &Settings) -> Self {
        let grid = GridOptions { memory_budget: settings.memory_budget, ..GridOptions::default() };
        let scene = Scene::build(mesh.clone(), &SceneOptions { grid }, &|_| ());
        let mut standard = Self { mesh, cameras, scene, hash: blake3::hash(&[]), cpu_ns: f64::INFINITY };
        let mut hasher = blake3::Hasher::new();
        standard.trace(&standard.scene, settings.size, false, Some(&mut hasher));
        standard.hash = hasher.finalize();
        let times = (0..settings.n_repeats).map(|_| standard.trace(&standard.scene, settings.size, false, None));
        standard.cpu_ns = median(times);
        standard
    }

    /// Whether there is nothing that a ray could hit.
    pub(super) fn is_empty(&self) -> bool {
        self.scene.n_triangles() == 0
    }

    /// The density that a grid chooses by itself.
    pub(super) fn chosen_density(&self) -> f64 {
        self.scene.grid().choice().density
    }

    /// Measures a setting. Inside, why it is left out; outside, that its hits are wrong.
    pub(super) fn measure(&self, setting: &Setting, settings: &Settings) -> Result<Result<MemoryRow, String>> {
        let options = &setting.options;
        let mesh = self.mesh.clone();
        let started = ProcessTime::now();
        let scene = Scene::build(mesh, &SceneOptions { grid: *options }, &|_| ());
        let build_seconds = started.elapsed().as_secs_f64();
        if let Some(shortage) = scene.grid().shortage() {
            return Ok(Err(shortage.to_string()));
        }
        let mut hasher = blake3::Hasher::new();
        self.trace(&scene, settings.size, setting.is_single, Some(&mut hasher));
        ensure!(
            hasher.finalize() == self.hash,
            "{} hits other triangles than the default: this is a bug",
            setting.name()
        );
        // In turn with the default, so that whatever else the machine does hits both alike.
        let ratios = (0..settings.n_repeats).map(|_| {
            let ours = self.trace(&scene, settings.size, setting.is_single, None);
            ours / self.trace(&self.scene, settings.size, false, None)
        });
        let cpu_ns_per_ray = self.cpu_ns * median(ratios);
        Ok(Ok(MemoryRow {
            storage: options.storage.name(),
            mesh: options.mesh.name(),
            density: scene.grid().figures().density,
            macrocell_levels: options.macrocell_levels,
            rays: if setting.is_single { "single" } else { "packets" },
            bytes_per_triangle: scene.n_bytes() as f64 / scene.n_triangles() as f64,
            build_seconds,
            cpu_ns_per_ray,
            mrays_per_second: 1e3 / cpu_ns_per_ray,
        }))
    }

    /// All cameras on this thread: nanoseconds per ray, and the hits if there is a hasher for them.
    fn trace(&self, scene: &Scene, size: FrameSize, is_single: bool, mut hasher: Option<&mut blake3::Hasher>) -> f64 {
        let task = Division::Tiled.task(0, 1);
        let Ok(share) = task.share(size) else { return f64::NAN };
        let mut hits = vec![Hit::MISS; size.n_samples() as usize];
        let place = |(i, j): (u32, u32)| (j * size.xres() + i) as usize;
        let mut cpu = 0.0;
        for camera in &self.cameras {
            let rays = camera.rays(size);
            let started = ThreadTime::now();
            if is_single {
                for (i, j) in (0..share.count()).flat_map(|unit| share.samples(unit).iter()) {
                    hits[place((i, j))] = scene.grid().intersect(&Ray::new(rays.eye, rays.direction(i, j)));
                }
            } else {
                scene.trace(&rays, None, &share, 0..share.count(), |block, of_block| {
                    block.samples().zip(of_block).for_each(|(sample, &hit)| hits[place(sample)] = hit);
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

/// The chart.
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
        ("masks", _) => format!("masks, {} mesh", row.mesh),
        (storage, _) => format!("{storage}, {} levels", row.macrocell_levels),
    };
    let mut series: Vec<Series> = Vec::new();
    for row in rows {
        let name = name(row);
        let point =
            Point { label: row.density.to_string(), x: value(row).log10(), y: row.cpu_ns_per_ray.log10(), bar: None };
        match series.iter_mut().find(|series| series.name == name) {
            Some(series) => series.points.push(point),
            None => {
                let color = match (row.storage, row.rays, row.mesh) {
                    ("masks", "single", _) => COLORS[6],
                    ("masks", _, "indexed") => COLORS[3],
                    ("masks", ..) => COLORS[2],
                    ("plain", ..) => COLORS[5],
                    _ => COLORS[0],
                };
                let is_hollow = row.storage != "masks" && row.macrocell_levels < 3;
                series.push(Series { name, color, is_hollow, is_joined: true, points: vec![point] });
            }
        }
    }
    series.extend(peers.iter().filter_map(|peer| {
        let (x, y) = (of_peer(peer)?.log10(), peer.cpu_ns_per_ray?.log10());
        let points = vec![Point { label: String::new(), x, y, bar: None }];
        Some(Series { name: peer.name.clone(), color: PEER_COLOR, is_hollow: true, is_joined: false, points })
    }));
    Plot {
        title: "numbers at points are cells per triangle; packets unless it says single rays or levels of macrocells"
            .to_owned(),
        x,
        y: Axis { title: "CPU ns per ray", label: significant, range: None },
        series,
        has_front: true,
    }
}

/// How the grid that chooses itself, with `chosen` cells a triangle, stands among all that were measured.
pub(super) fn verdict(rows: &[MemoryRow], chosen: f64) -> Option<String> {
    let fastest = rows.iter().min_by(|a, b| a.cpu_ns_per_ray.total_cmp(&b.cpu_ns_per_ray))?;
    let is_chosen = |row: &&MemoryRow| {
        row.storage == Storage::default().name()
            && row.mesh == MeshLayout::default().name()
            && row.rays == "packets"
            && row.density == chosen
    };
    let ours = rows.iter().find(is_chosen)?;
    let excess = |ours: f64, best: f64| 100.0 * (ours / best - 1.0);
    let (slower, larger) = (
        excess(ours.cpu_ns_per_ray, fastest.cpu_ns_per_ray),
        excess(ours.bytes_per_triangle, fastest.bytes_per_triangle),
    );
    Some(format!(
        "chosen: density {chosen}, within {slower:.1} % of the fastest ({}, {} mesh, density {}) with {larger:+.1} % of its bytes",
        fastest.storage, fastest.mesh, fastest.density
    ))
}

/// For people.
pub(super) fn table(rows: &[MemoryRow]) -> String {
    let mut lines = vec![format!(
        "{:16} {:8} {:>7} {:>6} {:8} {:>10} {:>8} {:>8} {:>8}",
        "storage", "mesh", "density", "levels", "rays", "bytes/tri", "build s", "ns/ray", "Mrays/s"
    )];
    for row in rows {
        lines.push(format!(
            "{:16} {:8} {:7} {:6} {:8} {:10.1} {:8.2} {:8.0} {:8.2}",
            row.storage,
            row.mesh,
            row.density,
            row.macrocell_levels,
            row.rays,
            row.bytes_per_triangle,
            row.build_seconds,
            row.cpu_ns_per_ray,
            row.mrays_per_second
        ));
    }
    lines.join("\n")
}
