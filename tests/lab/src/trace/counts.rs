//! Counts the cells and triangles that the rays of a frame meet.

use rayon::prelude::*;
use renderer::{
    intersect::{RayCost, clip, ray::Ray},
    render::scene::Scene,
};
use shared::protocol::FrameSpec;

/// Cells passed and triangles tested by the primary rays of a frame, traced one by one on the current rayon pool.
pub(super) fn cost_sum(scene: &Scene, request: &FrameSpec) -> [u64; 2] {
    let camera = scene.local(&request.camera);
    let rays = camera.rays(request.size);
    let clip = scene.clip_plane(&camera, request.appearance.clip);
    let of_row = |j: u32| {
        (0..request.size.xres()).fold([0, 0], |[n_cells, n_tests], i| {
            let ray = clip::clip_ray(clip.as_ref(), Ray::new(rays.eye, rays.direction(i, j)));
            let cost = ray.map_or(RayCost::default(), |ray| scene.grid.cost(&ray));
            [n_cells + u64::from(cost.n_cells), n_tests + u64::from(cost.n_tests)]
        })
    };
    (0..request.size.yres()).into_par_iter().map(of_row).reduce(|| [0, 0], |a, b| [a[0] + b[0], a[1] + b[1]])
}
