//! What the GPU shows, held against the CPU twin and against stored pictures.

use std::sync::{LazyLock, Mutex, MutexGuard, PoisonError};

use compositor::gpu::{Gpu, Offscreen, Picture, Present, present_cpu};
use compositor::wall::Wall;
use shared::division::FrameSize;
use shared::srgb;

/// One GPU for all tests of the binary, and one test on it at a time: a software GPU uses every core.
static GPU: LazyLock<Result<Mutex<Gpu>, String>> =
    LazyLock::new(|| Gpu::headless().map(Mutex::new).map_err(|error| error.to_string()));

fn gpu() -> MutexGuard<'static, Gpu> {
    match &*GPU {
        Ok(gpu) => gpu.lock().unwrap_or_else(PoisonError::into_inner),
        Err(error) => panic!("{error}"),
    }
}

/// A frame made by a rule.
struct Frame {
    size: FrameSize,
    rgba: Vec<u8>,
}

impl Frame {
    /// `color` gives the sRGB bytes of sample (i, j), row j = 0 at the bottom.
    fn new([xres, yres]: [u32; 2], color: impl Fn(u32, u32) -> [u8; 3]) -> Self {
        let samples = (0..yres).flat_map(|j| (0..xres).map(move |i| (i, j)));
        let rgba = samples.flat_map(|(i, j)| {
            let [r, g, b] = color(i, j);
            [r, g, b, 255]
        });
        Self { size: FrameSize::new(xres, yres).unwrap(), rgba: rgba.collect() }
    }

    /// Red to the right, green upwards, blue both.
    fn gradient([xres, yres]: [u32; 2]) -> Self {
        let step = |position: u32, n_positions: u32| (position * 255 / (n_positions - 1).max(1)) as u8;
        Self::new([xres, yres], |i, j| [step(i, xres), step(j, yres), step(i + j, xres + yres)])
    }

    /// Black and white by turns: what no rounded weight survives.
    fn checker(size: [u32; 2]) -> Self {
        Self::new(size, |i, j| if (i + j) % 2 == 0 { [0; 3] } else { [255; 3] })
    }

    /// A few coloured samples in the dark, the corners among them.
    fn hot_samples([xres, yres]: [u32; 2]) -> Self {
        let hot =
            [(0, 0), (xres - 1, 0), (0, yres - 1), (xres - 1, yres - 1), (xres / 2, yres / 3), (xres / 4, yres / 2)];
        Self::new([xres, yres], |i, j| match hot.iter().position(|&place| place == (i, j)) {
            Some(n) => [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [255; 3], [1, 2, 3]][n],
            None => [0; 3],
        })
    }

    /// Seeded noise of all values.
    fn noise(size: [u32; 2]) -> Self {
        Self::new(size, |i, j| {
            // SplitMix64's finalizer.
            let mut x = (u64::from(j) << 32 | u64::from(i)).wrapping_add(0x9e37_79b9_7f4a_7c15);
            x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            let [r, g, b, ..] = (x ^ (x >> 31)).to_le_bytes();
            [r, g, b]
        })
    }

    fn all(size: [u32; 2]) -> [(&'static str, Self); 4] {
        [
            ("gradient", Self::gradient(size)),
            ("checker", Self::checker(size)),
            ("hot samples", Self::hot_samples(size)),
            ("noise", Self::noise(size)),
        ]
    }
}

fn wall(columns: u32, rows: u32, pixels: [u32; 2]) -> Wall {
    let text = format!("canvas_m = [4.0, 2.25]\n[grid]\ncolumns = {columns}\nrows = {rows}\npixels = {pixels:?}");
    Wall::from_toml("test", &text).unwrap()
}

/// The wall as the GPU draws it on a target of `size`.
fn draw(gpu: &Gpu, present: &mut Present, wall: &Wall, size: [u32; 2]) -> Picture {
    let offscreen = Offscreen::new(gpu, size).unwrap();
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    present.draw(gpu, &mut encoder, &offscreen.target(), wall.projectors());
    gpu.queue.submit([encoder.finish()]);
    offscreen.read(gpu).unwrap()
}

/// Draws on GPU and CPU and compares every channel of every pixel.
fn check_twins(gpu: &Gpu, present: &mut Present, frame: &Frame, wall: &Wall, size: [u32; 2], what: &str) {
    present.upload(gpu, frame.size, &frame.rgba).unwrap();
    let shown = draw(gpu, present, wall, size);
    let expected = present_cpu::present(frame.size, &frame.rgba, wall.projectors(), size);
    assert_eq!(shown.size, expected.size);
    // One step of 8 bits is the sRGB curve's rounding. Graphics cards round the filter's weights as well, to 1/256 on
    // either axis: a step of light that is many steps of 8 bits beside black.
    let is_near = |&(shown, expected): &(&u8, &u8)| {
        shown.abs_diff(*expected) <= 1
            || !gpu.is_software() && (srgb::decode(*shown) - srgb::decode(*expected)).abs() < 1.0 / 128.0
    };
    if let Some(byte) = std::iter::zip(&shown.rgb, &expected.rgb).position(|pair| !is_near(&pair)) {
        let [x, y] = [byte as u32 / 3 % size[0], byte as u32 / 3 / size[0]];
        let [shown, expected] = [shown.pixel(x, y), expected.pixel(x, y)];
        let frame = frame.size;
        panic!("{what} of {frame} samples on {size:?}: pixel ({x}, {y}) is {shown:?} instead of {expected:?}");
    }
}

#[test]
fn the_paper_s_wall_equals_its_cpu_twin() {
    let gpu = gpu();
    let mut present = Present::new(&gpu, Offscreen::FORMAT);
    let wall = Wall::paper();
    for (what, frame) in Frame::all([1024, 512]) {
        check_twins(&gpu, &mut present, &frame, &wall, wall.output_size(), what);
    }
}

#[test]
fn walls_targets_and_resolutions_of_any_shape_equal_their_cpu_twin() {
    let gpu = gpu();
    let mut present = Present::new(&gpu, Offscreen::FORMAT);
    let walls =
        [Wall::paper(), wall(1, 1, [640, 360]), wall(3, 5, [37, 11]), wall(7, 1, [1, 9]), wall(1, 2, [2048, 500])];
    let frame_sizes = [[1, 1], [7, 5], [1000, 3], [3, 1000], [64, 36], [1024, 512], [2048, 1000]];
    let target_sizes = [[1, 1], [640, 360], [333, 500], [500, 111], [64, 3]];
    for wall in &walls {
        for frame_size in frame_sizes {
            for (what, frame) in Frame::all(frame_size) {
                for size in target_sizes.into_iter().chain([wall.output_size()]).filter(|size| size[0] < 4096) {
                    check_twins(&gpu, &mut present, &frame, wall, size, what);
                }
            }
        }
    }
}
