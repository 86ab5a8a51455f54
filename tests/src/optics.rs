//! Warped, blended and turned projectors: the GPU against its CPU twin, and the shipped walls against stored pictures.

use std::path::Path;

use compositor::{
    gpu::{Offscreen, Present},
    wall::Wall,
};

use crate::pictures::{Frame, check_reference, check_twin, draw, gpu, statue_frame};

/// A wall of `wall-config`.
pub(crate) fn shipped(name: &str) -> Wall {
    Wall::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../wall-config").join(name)).unwrap()
}

/// Two projectors that use every setting, and a third that only adds its black.
pub(crate) const CROOKED: &str = r#"
canvas_m = [2.0, 1.0]
[[projector]]
name = "upright"
pixels = [160, 120]
at_m = [0.0, 0.0]
size_m = [1.2, 1.0]
warp_px = [[6.0, 3.0], [-4.5, 7.0], [-8.0, -2.0], [3.0, -5.0]]
gamma = 1.8
black_level = 0.01
[[projector]]
name = "turned"
pixels = [120, 140]
at_m = [0.9, 0.0]
size_m = [1.1, 1.0]
rotation = 90
flip = "horizontal"
gamma = 2.4
black_level = 0.02
gain = [0.9, 1.0, 0.7]
warp_px = [[3.0, 3.0], [-2.0, 1.0], [-1.0, -3.0], [5.0, -2.0]]
[[projector]]
name = "outwards"
pixels = [80, 60]
at_m = [0.0, 0.0]
size_m = [0.3, 0.2]
rotation = 180
flip = "vertical"
warp_px = [[-3.0, -2.0], [2.0, -3.0], [4.0, 1.0], [0.0, 0.0]]
"#;

/// A quadratic function of the place: whoever interpolates finds the same.
pub(crate) const FALL_OFF: &str = "fall_off = [ \
    [0.8125, 0.925, 0.9625, 0.925, 0.8125], \
    [0.85, 0.9625, 1.0, 0.9625, 0.85], \
    [0.8125, 0.925, 0.9625, 0.925, 0.8125], \
    [0.7, 0.8125, 0.85, 0.8125, 0.7], \
    [0.5125, 0.625, 0.6625, 0.625, 0.5125], \
]";

/// [`CROOKED`] with light that falls off within two of its projectors.
pub(crate) fn uneven() -> Wall {
    let [upright, turned] = ["gamma = 1.8\n", "gamma = 2.4\n"];
    let text = [upright, turned]
        .iter()
        .fold(CROOKED.to_owned(), |text, key| text.replacen(key, &format!("{key}{FALL_OFF}\n"), 1));
    Wall::from_toml("uneven", &text).unwrap()
}

#[test]
fn crooked_walls_equal_their_cpu_twin() {
    let gpu = gpu();
    let mut present = Present::new(&gpu);
    for wall in [Wall::from_toml("crooked", CROOKED).unwrap(), uneven()] {
        for (what, frame) in Frame::all([64, 36]) {
            present.upload(&gpu, frame.size, &frame.rgba).unwrap();
            // Actual size, letterboxed, magnified, tiny; with and without the GPU's own sRGB.
            for (size, has_srgb_view) in
                [(wall.output_size(), true), ([300, 200], false), ([900, 500], true), ([1, 1], true)]
            {
                let offscreen = Offscreen::with_srgb_view(&gpu, size, has_srgb_view).unwrap();
                check_twin(&gpu, &draw(&gpu, &mut present, &wall, &offscreen), what, &frame, &wall);
            }
        }
    }
}

#[test]
fn corners_dragged_beyond_the_picture_s_edge_equal_their_cpu_twin() {
    let gpu = gpu();
    let mut present = Present::new(&gpu);
    let text = "canvas_m = [1.9, 1.0]\n[grid]\ncolumns = 2\nrows = 1\npixels = [160, 120]\noverlap = [0.2, 0.0]\n\
                [[projector]]\nname = \"row 1 column 1\"\nrotation = 180\nblack_level = 0.01\n\
                warp_px = [[0, 0], [5, -5], [3, 4], [-2, 0]]\n";
    let wall = Wall::from_toml("dragged", text).unwrap();
    let frame = Frame::gradient([64, 36]);
    present.upload(&gpu, frame.size, &frame.rgba).unwrap();
    let offscreen = Offscreen::new(&gpu, wall.output_size()).unwrap();
    check_twin(&gpu, &draw(&gpu, &mut present, &wall, &offscreen), "gradient", &frame, &wall);
}

#[test]
fn each_output_shows_its_part_of_the_wall() {
    let gpu = gpu();
    let mut present = Present::new(&gpu);
    let wall = shipped("two-monitors.toml");
    let frame = Frame::gradient([64, 36]);
    present.upload(&gpu, frame.size, &frame.rgba).unwrap();
    let whole = draw(&gpu, &mut present, &wall, &Offscreen::new(&gpu, wall.output_size()).unwrap());
    for (monitor, part) in wall.monitors() {
        let offscreen = Offscreen::new(&gpu, [part.width, part.height]).unwrap();
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        present.draw(&gpu, &mut encoder, &wall, &[(offscreen.target(), part)]);
        gpu.queue.submit([encoder.finish()]);
        let shown = offscreen.read(&gpu).unwrap();
        let differs = (0..part.height).flat_map(|y| (0..part.width).map(move |x| (x, y))).any(|(x, y)| {
            let [here, there] = [shown.pixel(x, y), whole.pixel(part.x + x, part.y + y)];
            std::iter::zip(here, there).any(|(a, b)| a.abs_diff(b) > 1)
        });
        assert!(!differs, "{monitor}");
    }
}

#[test]
fn the_largest_wall_is_drawn() {
    let gpu = gpu();
    let mut present = Present::new(&gpu);
    let limit = gpu.device.limits().max_texture_dimension_2d.min(Wall::LARGEST_SIDE);
    let text = format!(
        "canvas_m = [16.0, 0.1]\n[grid]\ncolumns = 8\nrows = 1\npixels = [{}, 12]\noverlap = [0.2, 0.0]",
        limit / 8
    );
    let wall = Wall::from_toml("long", &text).unwrap();
    let frame = Frame::gradient([512, 8]);
    present.upload(&gpu, frame.size, &frame.rgba).unwrap();
    let offscreen = Offscreen::new(&gpu, wall.output_size()).unwrap();
    check_twin(&gpu, &draw(&gpu, &mut present, &wall, &offscreen), "gradient", &frame, &wall);
}

#[test]
fn the_shipped_walls_look_as_they_did() {
    for (name, size) in
        [("blended-4x3", [768, 432]), ("lcd-5x3", [768, 260]), ("two-monitors", [768, 256]), ("laptop", [640, 360])]
    {
        let wall = shipped(&format!("{name}.toml"));
        check_reference(&format!("wall-{name}"), &statue_frame(&wall), &wall, size);
    }
}
