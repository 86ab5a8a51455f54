//! A teapot in a stadium: fine detail in a small part of a large scene.

use cpu_time::ThreadTime;
use glam::{DVec3, Vec3};
use renderer::{
    grid::{Grid, GridOptions},
    intersect::ray::Ray,
    model::mesh::Mesh,
    render::scene::Scene,
};
use shared::{
    camera::Camera,
    division::{Division, FrameSize},
};

use super::{
    contenders::{Contender, Tally},
    solids,
};
use crate::trace::frame::trace_share;

/// Largest cost in the stadium, relative to the teapot alone.
const MOST_TIMES: f64 = 10.0;

/// Compares the teapot alone with the same view in a stadium a thousand times as large, of as many triangles: cells and
/// tests of single rays, and with `times` the CPU time of packets. Memory must not exceed the budget.
pub(super) fn teapot(n_rays: u64, times: bool) -> Tally {
    let teapot = solids::sphere([0.3, 1.0, -0.2], 1.0, 120);
    let mut stadium = teapot.clone();
    let seats = solids::sphere([0.0; 3], 1000.0, 120);
    let first = stadium.vertices.len() as u32;
    stadium.vertices.extend(seats.vertices);
    stadium.triangles.extend(seats.triangles.iter().map(|corners| corners.map(|vertex| vertex + first)));

    let height = (n_rays / 2).isqrt().clamp(64, 1024) as u32;
    let eye = DVec3::new(2.0, 2.0, 3.0);
    let camera = Camera::look_at(eye, DVec3::new(0.3, 1.0, -0.2), DVec3::Y, 0.6, 2.0);
    let (Ok(size), Ok(camera)) = (FrameSize::new(2 * height, height), camera) else { return Tally::default() };
    let costs = [teapot, stadium].map(|mesh| Cost::measure(mesh, &camera, size, times));
    let mut tally = Tally { n_rays: u64::from(size.n_samples()), ..Tally::default() };
    let [alone, within] = &costs;
    let ratios = [(Contender::Single, within.steps / alone.steps), (Contender::Packets, within.cpu / alone.cpu)];
    for (contender, ratio) in ratios.into_iter().take(if times { 2 } else { 1 }) {
        tally.count(contender, ratio <= MOST_TIMES, || format!("{ratio:.1} times the cost of the teapot alone"));
    }
    tally.count(Contender::Single, within.is_in_budget, || "the grid does not fit the memory budget".to_owned());
    tally
}

struct Cost {
    /// Cells and tests of all rays.
    steps: f64,
    /// Seconds for the frame in packets.
    cpu: f64,
    is_in_budget: bool,
}

impl Cost {
    fn measure(mesh: Mesh, camera: &Camera, size: FrameSize, times: bool) -> Self {
        let grid = Grid::build(mesh, &GridOptions::default(), &|_| ());
        let rays = camera.rays(size);
        let samples = (0..size.n_samples()).step_by(7).map(|sample| (sample % size.xres(), sample / size.xres()));
        let cost = |direction: Vec3| {
            let cost = grid.cost(&Ray::new(rays.eye, direction));
            f64::from(cost.n_cells + cost.n_tests)
        };
        let steps = samples.map(|(i, j)| cost(rays.direction(i, j))).sum();
        let is_in_budget = grid.shortage().is_none();
        let scene = Scene::from(grid);
        let task = Division::Tiled.task(0, 1);
        let mut cpu = f64::INFINITY;
        if let (true, Ok(share)) = (times, task.share(size)) {
            for _ in 0..9 {
                let started = ThreadTime::now();
                trace_share(&scene, &rays, &share, |_, hits| {
                    std::hint::black_box(hits);
                });
                cpu = cpu.min(started.elapsed().as_secs_f64());
            }
        }
        Self { steps, cpu, is_in_budget }
    }
}
