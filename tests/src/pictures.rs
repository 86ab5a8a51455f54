//! The GPU's pictures against the CPU twin, and against stored pictures.

use std::sync::{LazyLock, Mutex, MutexGuard, PoisonError};

use compositor::{
    gpu::{Gpu, Offscreen, OffscreenWall, Present, RgbImage},
    wall::{PixelRect, Wall},
};
use renderer::{grid::GridOptions, model::statue, render::scene::Scene};
use shared::appearance::Appearance;
use shared::camera::{Camera, CanvasPart, Shape, UpAxis};
use shared::detail::Detail;
use shared::division::{Division, FrameSize};
use shared::protocol::{FrameSpec, LightingMode, SampleRange, ShadingMode};
use shared::scene::SceneId;
use shared::srgb;

use crate::{present_cpu, random::Random, references};

/// One GPU for all tests, used by one test at a time, because a software GPU uses every core.
static GPU: LazyLock<Result<Mutex<Gpu>, String>> =
    LazyLock::new(|| Gpu::headless().map(Mutex::new).map_err(|error| error.to_string()));

pub(crate) fn gpu() -> MutexGuard<'static, Gpu> {
    match &*GPU {
        Ok(gpu) => gpu.lock().unwrap_or_else(PoisonError::into_inner),
        Err(error) => panic!("{error}"),
    }
}

/// A frame computed by a rule.
pub(crate) struct Frame {
    pub(crate) size: FrameSize,
    pub(crate) rgba: Vec<u8>,
}

impl Frame {
    /// `color` gives the sRGB bytes of sample (i, j), row j = 0 at the bottom.
    pub(crate) fn new([xres, yres]: [u32; 2], color: impl Fn(u32, u32) -> [u8; 3]) -> Self {
        let samples = (0..yres).flat_map(|j| (0..xres).map(move |i| (i, j)));
        let rgba = samples.flat_map(|(i, j)| {
            let [r, g, b] = color(i, j);
            [r, g, b, 255]
        });
        Self { size: FrameSize::new(xres, yres).unwrap(), rgba: rgba.collect() }
    }

    /// Red to the right, green upwards, blue both.
    pub(crate) fn gradient([xres, yres]: [u32; 2]) -> Self {
        let step = |position: u32, n_positions: u32| (position * 255 / (n_positions - 1).max(1)) as u8;
        Self::new([xres, yres], |i, j| [step(i, xres), step(j, yres), step(i + j, xres + yres)])
    }

    /// A checkerboard in black and white, which shows any rounded weight.
    fn checker(size: [u32; 2]) -> Self {
        Self::new(size, |i, j| if (i + j) % 2 == 0 { [0; 3] } else { [255; 3] })
    }

    /// A few coloured samples on black, four of them in the corners.
    pub(crate) fn hot_samples([xres, yres]: [u32; 2]) -> Self {
        let hot =
            [(0, 0), (xres - 1, 0), (0, yres - 1), (xres - 1, yres - 1), (xres / 2, yres / 3), (xres / 4, yres / 2)];
        Self::new([xres, yres], |i, j| match hot.iter().position(|&place| place == (i, j)) {
            Some(n) => [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [255; 3], [1, 2, 3]][n],
            None => [0; 3],
        })
    }

    /// Seeded noise of all values.
    pub(crate) fn noise(size: [u32; 2]) -> Self {
        Self::new(size, |i, j| {
            let [r, g, b, ..] = Random::new(u64::from(j) << 32 | u64::from(i)).bits().to_le_bytes();
            [r, g, b]
        })
    }

    pub(crate) fn all(size: [u32; 2]) -> [(&'static str, Self); 4] {
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

/// Draws the wall on `offscreen`, and reads it back.
pub(crate) fn draw(gpu: &Gpu, present: &mut Present, wall: &Wall, offscreen: &Offscreen) -> RgbImage {
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    present.draw(gpu, &mut encoder, wall, &[(offscreen.target(), wall.whole_output())]);
    gpu.queue.submit([encoder.finish()]);
    offscreen.read(gpu).unwrap()
}

/// Compares every channel of every pixel with the CPU twin's.
pub(crate) fn check_twin(gpu: &Gpu, shown: &RgbImage, what: &str, frame: &Frame, wall: &Wall) {
    let size = shown.size;
    let expected = present_cpu::present(frame.size, &frame.rgba, wall, wall.whole_output(), size);
    // The sRGB curve rounds by one step of 8 bits. Graphics cards also round the filter's weights, to 1/256 on either
    // axis, and what they filter: steps of light that are many steps of 8 bits near black. An H100 was off by 3/256.
    // A projector that fades out with a gamma of its own has many values for next to no light.
    let least_light = if gpu.adapter.get_info().device_type != wgpu::DeviceType::Cpu {
        1.0 / 64.0
    } else if (0..wall.projectors().len()).all(|index| wall.is_plain(index)) {
        0.0
    } else {
        1.0 / 1000.0
    };
    let is_near = |&(shown, expected): &(&u8, &u8)| {
        shown.abs_diff(*expected) <= 1 || (srgb::decode(*shown) - srgb::decode(*expected)).abs() < least_light
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
    let mut present = Present::new(&gpu);
    let wall = Wall::paper();
    let offscreen = Offscreen::new(&gpu, wall.output_size()).unwrap();
    for (what, frame) in Frame::all([1024, 512]) {
        present.upload(&gpu, frame.size, &frame.rgba).unwrap();
        check_twin(&gpu, &draw(&gpu, &mut present, &wall, &offscreen), what, &frame, &wall);
    }
}

#[test]
fn walls_targets_and_resolutions_of_any_shape_equal_their_cpu_twin() {
    let gpu = gpu();
    let mut present = Present::new(&gpu);
    let walls = [Wall::paper(), wall(1, 1, [640, 360]), wall(3, 5, [37, 11]), wall(7, 1, [1, 9])];
    let frame_sizes = [[1, 1], [7, 5], [1000, 3], [3, 1000], [64, 36], [1024, 512]];
    let target_sizes = [[1, 1], [640, 360], [333, 500], [500, 111], [64, 3], [16384, 2]];
    let limit = gpu.device.limits().max_texture_dimension_2d;
    let targets = target_sizes.map(|size| Offscreen::new(&gpu, size.map(|side| side.min(limit))).unwrap());
    for frame_size in frame_sizes {
        for (what, frame) in Frame::all(frame_size) {
            present.upload(&gpu, frame.size, &frame.rgba).unwrap();
            for wall in &walls {
                for target in &targets {
                    check_twin(&gpu, &draw(&gpu, &mut present, wall, target), what, &frame, wall);
                }
            }
        }
    }
}

#[test]
fn a_wall_with_a_pixel_for_each_sample_shows_samples_unchanged() {
    let gpu = gpu();
    let mut present = Present::new(&gpu);
    let wall = wall(3, 2, [111, 70]);
    let frame = Frame::noise(wall.output_size());
    present.upload(&gpu, frame.size, &frame.rgba).unwrap();
    let shown = draw(&gpu, &mut present, &wall, &Offscreen::new(&gpu, wall.output_size()).unwrap());
    let [width, height] = shown.size;
    for (i, j) in (0..height).flat_map(|j| (0..width).map(move |i| (i, j))) {
        let first = 4 * (j * width + i) as usize;
        // Row 0 of a frame is at the bottom; row 0 of a picture is at the top.
        assert_eq!(shown.pixel(i, height - 1 - j), frame.rgba[first..first + 3], "sample ({i}, {j})");
    }
}

#[test]
fn surfaces_without_an_srgb_view_show_the_same() {
    let gpu = gpu();
    let mut present = Present::new(&gpu);
    let wall = wall(2, 2, [160, 90]);
    for (what, frame) in Frame::all([97, 51]) {
        present.upload(&gpu, frame.size, &frame.rgba).unwrap();
        // Both in turn: one stage serves targets of several formats.
        for has_srgb_view in [false, true, false] {
            let offscreen = Offscreen::with_srgb_view(&gpu, [400, 300], has_srgb_view).unwrap();
            check_twin(&gpu, &draw(&gpu, &mut present, &wall, &offscreen), what, &frame, &wall);
        }
    }
}

#[test]
fn a_fade_mixes_the_light_of_both_frames_and_is_never_darker_than_either() {
    let gpu = gpu();
    let blended = "canvas_m = [4.0, 2.25]\n[grid]\ncolumns = 2\nrows = 1\npixels = [90, 70]\noverlap = [0.5, 0.0]\n";
    let walls = [wall(2, 2, [64, 36]), Wall::from_toml("blended", blended).unwrap()];
    // Of different sizes, as a coarse frame after a fine one.
    let (old, new) = (Frame::noise([128, 72]), Frame::gradient([40, 22]));
    for wall in &walls {
        let mut present = Present::new(&gpu);
        let offscreen = Offscreen::new(&gpu, wall.output_size()).unwrap();
        present.upload(&gpu, old.size, &old.rgba).unwrap();
        let first = draw(&gpu, &mut present, wall, &offscreen);
        present.fade_into(&gpu, new.size, &new.rgba).unwrap();
        assert_eq!(draw(&gpu, &mut present, wall, &offscreen).rgb, first.rgb, "a fade begins with the old frame");
        let [from, to] = [&old, &new].map(|frame| {
            present_cpu::present(frame.size, &frame.rgba, wall, wall.whole_output(), offscreen.target().size)
        });
        for part in [0.25, 0.5, 0.9] {
            present.set_fade(part);
            let shown = draw(&gpu, &mut present, wall, &offscreen);
            for (shown, (from, to)) in shown.rgb.iter().zip(from.rgb.iter().zip(&to.rgb)) {
                let light = f64::from(srgb::decode(*from)) * (1.0 - part) + f64::from(srgb::decode(*to)) * part;
                // Each frame is rounded to 8 bits before the next lies on it.
                let expected = srgb::encode(light as f32);
                assert!(shown.abs_diff(expected) <= 3, "{shown} instead of {expected}");
                assert!(shown.saturating_add(2) >= *from.min(to), "{shown} is darker than {from} and {to}");
            }
        }
        present.set_fade(1.0);
        check_twin(&gpu, &draw(&gpu, &mut present, wall, &offscreen), "the end of a fade", &new, wall);
        // Surfaces without an sRGB view mix what they show.
        let encoded = Offscreen::with_srgb_view(&gpu, wall.output_size(), false).unwrap();
        present.fade_into(&gpu, old.size, &old.rgba).unwrap();
        present.set_fade(0.5);
        let shown = draw(&gpu, &mut present, wall, &encoded);
        let is_between = |(shown, (a, b)): (&u8, (&u8, &u8))| {
            (*a.min(b)..=*a.max(b).max(&3)).contains(&shown.saturating_add(2).min(*a.max(b)))
        };
        assert!(shown.rgb.iter().zip(from.rgb.iter().zip(&to.rgb)).all(is_between));
    }
}

#[test]
fn several_targets_in_one_submission_each_show_their_wall() {
    let gpu = gpu();
    let mut present = Present::new(&gpu);
    let frame = Frame::gradient([64, 32]);
    present.upload(&gpu, frame.size, &frame.rgba).unwrap();
    let walls = [Wall::paper(), wall(2, 1, [50, 80]), wall(1, 3, [90, 20])];
    let targets = [[320, 180], [200, 100], [31, 64]].map(|size| Offscreen::new(&gpu, size).unwrap());
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    for (wall, target) in walls.iter().zip(&targets) {
        present.draw(&gpu, &mut encoder, wall, &[(target.target(), wall.whole_output())]);
    }
    gpu.queue.submit([encoder.finish()]);
    for (wall, target) in walls.iter().zip(&targets) {
        check_twin(&gpu, &target.read(&gpu).unwrap(), "gradient", &frame, wall);
    }
}

/// Frames and walls that are larger than the GPU's textures give the bits of one texture.
#[test]
fn frames_and_walls_are_cut_where_textures_are_too_small() {
    let whole = gpu();
    let small = Gpu::headless_with_textures_of(64).unwrap();
    assert_eq!(small.device.limits().max_texture_dimension_2d, 64);
    let is_software = small.adapter.get_info().device_type == wgpu::DeviceType::Cpu;
    let blended = "canvas_m = [4.0, 2.25]\n[grid]\ncolumns = 3\nrows = 2\npixels = [50, 70]\noverlap = [0.5, 0.4]\n\
                   [optics]\ngamma = 2.2\nblack_level = 0.01\n";
    let walls = [wall(3, 2, [50, 70]), wall(1, 1, [200, 30]), Wall::from_toml("blended", blended).unwrap()];
    let presents = [Present::new(&whole), Present::new(&small)];
    let [mut present_whole, mut present_small] = presents;
    // The last is the first wall's native resolution, whose samples are read one by one.
    for frame_size in [[200, 60], [65, 64], [60, 129], [113, 97], [150, 140]] {
        for (what, frame) in Frame::all(frame_size) {
            present_whole.upload(&whole, frame.size, &frame.rgba).unwrap();
            present_small.upload(&small, frame.size, &frame.rgba).unwrap();
            for wall in &walls {
                let offscreen = Offscreen::new(&whole, wall.output_size()).unwrap();
                let expected = draw(&whole, &mut present_whole, wall, &offscreen);
                let offscreen = OffscreenWall::new(&small, wall).unwrap();
                assert!(offscreen.outputs().len() > 1);
                let mut encoder = small.device.create_command_encoder(&Default::default());
                present_small.draw(&small, &mut encoder, wall, &offscreen.outputs());
                small.queue.submit([encoder.finish()]);
                let shown = offscreen.read(&small).unwrap();
                check_twin(&small, &shown, what, &frame, wall);
                let n_differ = shown.rgb.iter().zip(&expected.rgb).filter(|(a, b)| a != b).count();
                assert!(n_differ == 0 || !is_software, "{what} of {frame_size:?} samples: {n_differ} bytes differ");
            }
        }
    }
}

#[test]
fn the_wall_is_black_before_any_frame_and_without_projectors() {
    let gpu = gpu();
    let mut present = Present::new(&gpu);
    let offscreen = Offscreen::new(&gpu, [64, 36]).unwrap();
    assert!(draw(&gpu, &mut present, &Wall::paper(), &offscreen).rgb.iter().all(|&byte| byte == 0));

    let frame = Frame::checker([8, 8]);
    present.upload(&gpu, frame.size, &frame.rgba).unwrap();
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    let part = PixelRect { x: 0, y: 0, width: 0, height: 0 };
    present.draw(&gpu, &mut encoder, &Wall::paper(), &[(offscreen.target(), part)]);
    gpu.queue.submit([encoder.finish()]);
    assert!(offscreen.read(&gpu).unwrap().rgb.iter().all(|&byte| byte == 0));
}

#[test]
fn too_large_targets_and_odd_frames_are_refused_in_one_line() {
    let gpu = gpu();
    let limit = gpu.device.limits().max_texture_dimension_2d;
    let error = Offscreen::new(&gpu, [limit + 1, 4]).err().expect("wider than any texture").to_string();
    assert!(error.contains(&limit.to_string()) && !error.contains('\n'), "{error}");

    let mut present = Present::new(&gpu);
    let error = present.upload(&gpu, FrameSize::new(4, 4).unwrap(), &[0; 63]).unwrap_err().to_string();
    assert!(error.contains("63 bytes are no frame of 4x4"), "{error}");
    gpu.check().expect("nothing reached the driver");
}

#[test]
fn a_fault_on_the_gpu_is_an_error_and_no_panic() {
    let gpu = gpu();
    let buffer = gpu.device.create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: u64::MAX,
        usage: wgpu::BufferUsages::VERTEX,
        mapped_at_creation: false,
    });
    drop(buffer);
    let error = gpu.check().unwrap_err().to_string();
    assert!(error.starts_with("the graphics device failed: ") && !error.contains('\n'), "{error}");
    gpu.check().expect("a fault is reported once");
}

#[test]
fn a_lost_device_is_an_error_and_no_panic() {
    let gpu = Gpu::headless().unwrap();
    let mut present = Present::new(&gpu);
    let offscreen = Offscreen::new(&gpu, [64, 36]).unwrap();
    gpu.device.destroy();
    let frame = Frame::checker([8, 8]);
    let _ = present.upload(&gpu, frame.size, &frame.rgba);
    let mut encoder = gpu.device.create_command_encoder(&Default::default());
    let wall = Wall::paper();
    present.draw(&gpu, &mut encoder, &wall, &[(offscreen.target(), wall.whole_output())]);
    gpu.queue.submit([encoder.finish()]);
    let error = offscreen.read(&gpu).unwrap_err().to_string();
    assert!(error.starts_with("the graphics device "), "{error}");
}

#[test]
fn the_gpu_tells_how_long_a_draw_took() {
    let gpu = gpu();
    if !gpu.device.features().contains(wgpu::Features::TIMESTAMP_QUERY) {
        return;
    }
    let mut present = Present::new(&gpu);
    let frame = Frame::noise([512, 256]);
    let offscreen = Offscreen::new(&gpu, [2048, 1152]).unwrap();
    assert_eq!(present.draw_ms(&gpu), None);
    present.upload(&gpu, frame.size, &frame.rgba).unwrap();
    let start = std::time::Instant::now();
    draw(&gpu, &mut present, &Wall::paper(), &offscreen);
    let elapsed_ms = start.elapsed().as_secs_f64() * 1e3;
    let draw_ms = present.draw_ms(&gpu).expect("a time after the draw was waited for");
    assert!(draw_ms > 0.0 && draw_ms < elapsed_ms, "{draw_ms} of {elapsed_ms} ms");
}

/// Compares the GPU's picture on a target of `size` pixels with the stored one.
pub(crate) fn check_reference(name: &str, frame: &Frame, wall: &Wall, size: [u32; 2]) {
    let gpu = gpu();
    let mut present = Present::new(&gpu);
    present.upload(&gpu, frame.size, &frame.rgba).unwrap();
    let shown = draw(&gpu, &mut present, wall, &Offscreen::new(&gpu, size).unwrap());
    references::check(name, &shown);
}

/// A frame of the whole built-in model, for a wall.
pub(crate) fn statue_frame(wall: &Wall) -> Frame {
    static STATUE: LazyLock<(Shape, Scene)> = LazyLock::new(|| statue_of(statue::DEFAULT_TRIANGLES));
    frame_of(&STATUE, wall, UpAxis::Y)
}

/// Like `statue_frame`, with `n_triangles` triangles and the axis `up`.
pub(crate) fn statue_frame_of(n_triangles: u32, wall: &Wall, up: UpAxis) -> Frame {
    frame_of(&statue_of(n_triangles), wall, up)
}

fn statue_of(n_triangles: u32) -> (Shape, Scene) {
    let mesh = statue::generate(n_triangles, &|_| {}).smooth(Default::default());
    (mesh.shape(), Scene::build(mesh, &GridOptions::default(), &|_| {}))
}

fn frame_of((shape, scene): &(Shape, Scene), wall: &Wall, up: UpAxis) -> Frame {
    let camera = Camera::view_all(shape, up, wall.aspect(), CanvasPart::WHOLE);
    let size = wall.frame_size();
    let (view, rays, samples) = (ShadingMode::Shaded, LightingMode::default(), SampleRange::CENTRE);
    let scene_id = SceneId::Statue { triangles: 0, treatment: Default::default() };
    let spec = FrameSpec {
        scene: scene_id,
        camera,
        size,
        view,
        rays,
        samples,
        detail: Detail::FULL,
        appearance: Appearance::default(),
    };
    let task = Division::Interleaved.task(0, 1);
    let share = task.share(size).unwrap();
    let mut rgb = Vec::new();
    scene.render(&spec, &share, 0..share.count(), &mut rgb);
    Frame::new([size.xres(), size.yres()], |i, j| {
        let first = 3 * (j * size.xres() + i) as usize;
        [rgb[first], rgb[first + 1], rgb[first + 2]]
    })
}

#[test]
fn the_statue_on_the_wall_looks_as_it_did() {
    check_reference("wall-statue", &statue_frame(&Wall::paper()), &Wall::paper(), [1024, 576]);
}

#[test]
fn hot_samples_on_a_letterboxed_wall_look_as_they_did() {
    check_reference("hot-samples", &Frame::hot_samples([16, 8]), &wall(3, 2, [100, 80]), [480, 400]);
}

#[test]
fn a_gradient_looks_as_it_did() {
    check_reference("gradient", &Frame::gradient([64, 32]), &Wall::paper(), [512, 288]);
}
