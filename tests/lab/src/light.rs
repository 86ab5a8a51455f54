//! The light of a frame's pixels, before it is encoded.

use std::time::Duration;

use renderer::render::{
    lighting::{LightSums, Lighting},
    parallel::work_off,
    scene::Scene,
};
use shared::{division::Division, protocol::FrameSpec};

/// Tiles of a frame that a thread renders at once.
const TILES_PER_PART: u32 = 4;

/// Renders a frame on the current rayon pool: what `of_pixel` makes of each pixel's sums (their block and index are its last
/// argument), row by row from the bottom, and the CPU time of all threads.
pub fn render_lights<T: Clone + Default + Send>(
    scene: &Scene,
    spec: &FrameSpec,
    of_pixel: impl Fn(&Lighting<'_>, &LightSums, (usize, usize)) -> T + Sync,
) -> (Vec<T>, Duration) {
    let share = Division::Tiled.task(0, 1).share(spec.size).expect("one machine renders any frame");
    let of_threads = work_off((0..share.count()).step_by(TILES_PER_PART as usize), |next| {
        let mut pixels = Vec::new();
        for first in std::iter::from_fn(next) {
            let tiles = first..(first + TILES_PER_PART).min(share.count());
            let places: Vec<_> = tiles.clone().flat_map(|tile| share.samples(tile).iter()).collect();
            scene.sum_lights(spec, &share, tiles, |lighting, sums, at, index| {
                pixels.push((places[index], of_pixel(lighting, sums, at)));
            });
        }
        pixels
    });
    let cpu = of_threads.iter().map(|(_, cpu)| *cpu).sum();
    let mut rows = vec![T::default(); spec.size.n_samples() as usize];
    for ((i, j), value) in of_threads.into_iter().flat_map(|(pixels, _)| pixels) {
        rows[(j * spec.size.xres() + i) as usize] = value;
    }
    (rows, cpu)
}
