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

/// The number of a frame's first sample, where `picture` needs several frames: any multiple of a power of two that is not less
/// than `count`, because such samples are even. The multiples must be random: samples whose numbers differ by a power of two
/// complement each other, so pictures of them are not independent, and their differences understate the errors.
pub fn first_sample(picture: u32, frame: u32, count: u32) -> u32 {
    // Steele, Lea and Flood, "Fast Splittable Pseudorandom Number Generators" (2014).
    let mut x = (u64::from(picture) << 32 | u64::from(frame)).wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    x = (x ^ x >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ x >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    (x ^ x >> 31) as u32 & !(count.next_power_of_two() - 1)
}

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
