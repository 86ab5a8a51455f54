//! A virtual projection room: projects the GPU's picture for every projector back onto the canvas, through the
//! projector's true geometry and light, and compares the sum with the intended picture.
//!
//! It shares only the wall file's numbers with the code under test: it solves the geometry as linear equations, and adds
//! up light. A projector's pixel gives light like a tent two pixels wide, as through a lens, and its black's light always.
//!
//! [`surface`] has walls of any shape; [`camera`] photographs the true projectors of [`projector`], [`rig`] aligns a wall
//! with them, and [`light`] says how even its light is then. [`bent`] shows walls with meshes there.

pub(crate) mod bent;
pub(crate) mod camera;
mod geometry;
pub(crate) mod light;
pub(crate) mod projector;
pub(crate) mod rig;
pub(crate) mod surface;

use compositor::{
    gpu::{Gpu, Offscreen, Present, RgbImage},
    wall::{Flip, Gamma, Projector, Wall},
};
use glam::DVec2;
use proptest::prelude::*;

use self::projector::TrueProjector;
use crate::{
    optics::{CROOKED, FALL_OFF, shipped, uneven},
    pictures::{Frame, draw, gpu, statue_frame},
    references,
};

/// Ten levels of grey, sRGB-encoded; three at a time, because red, green and blue are independent.
const LEVELS: [[u8; 3]; 4] = [[0, 16, 40], [64, 96, 128], [160, 192, 224], [255, 0, 255]];
/// The largest seam, as a part of white, beyond the rounding to 8 bits.
const LARGEST_SEAM: f64 = 0.01;
/// The largest displacement of a part of the picture, in pixels of the projector.
const FARTHEST_PX: f64 = 0.5;

/// A wall's projectors in a dark room.
struct Room<'a> {
    wall: &'a Wall,
    projectors: Vec<SimulatedProjector<'a>>,
}

/// A projector with its true optics.
struct SimulatedProjector<'a> {
    projector: &'a Projector,
    optics: Optics<'a>,
    /// Its place: left, bottom, right, top in metres.
    place_m: [f64; 4],
    /// The larger side of one of its pixels, in metres.
    px_m: f64,
    /// The light of each value, for red, green and blue.
    light: [[f64; 256]; 3],
}

/// From metres on the canvas to columns and rows of a projector's pixels.
enum Optics<'a> {
    /// As the wall file's corners say: a homogeneous matrix, row by row.
    Corners([[f64; 3]; 3]),
    /// As it truly stands before a wall of any shape.
    Stands(&'a TrueProjector),
}

/// Light at one point, of one colour, and the largest error by rounding to 8 bits.
#[derive(Clone, Copy, Default)]
struct Light {
    sum: f64,
    rounding: f64,
}

impl<'a> Room<'a> {
    fn new(wall: &'a Wall) -> Self {
        let corners = |projector| Optics::Corners(geometry::px_from_m(projector, wall.canvas_m()));
        let new = |projector| SimulatedProjector::new(projector, wall.canvas_m(), corners(projector));
        Self { wall, projectors: wall.projectors().iter().map(new).collect() }
    }

    /// A wall whose projectors truly stand so.
    fn with(wall: &'a Wall, projectors: &'a [TrueProjector]) -> Self {
        let both = wall.projectors().iter().zip(projectors);
        let new = |(projector, stands)| SimulatedProjector::new(projector, wall.canvas_m(), Optics::Stands(stands));
        Self { wall, projectors: both.map(new).collect() }
    }

    /// The light on the canvas at a point in metres, if the projectors show their parts of `shown`.
    fn light(&self, shown: &RgbImage, point: [f64; 2]) -> [Light; 3] {
        let mut light = [Light::default(); 3];
        for simulated in &self.projectors {
            simulated.project(shown, point, &mut light);
        }
        light
    }

    /// Whether at least one projector shows the picture there.
    fn is_lit(&self, point: [f64; 2]) -> bool {
        self.projectors.iter().any(|simulated| simulated.shows(point))
    }

    /// Whether a point is at least one and a half pixels inside the lit area.
    fn is_well_within(&self, point: [f64; 2]) -> bool {
        let px_m = self.projectors.iter().filter(|simulated| simulated.shows(point)).map(|simulated| simulated.px_m);
        let Some(reach_m) = px_m.reduce(f64::max).map(|px_m| 1.5 * px_m) else { return false };
        let around =
            [[1.0, 0.0], [0.7, 0.7], [0.0, 1.0], [-0.7, 0.7], [-1.0, 0.0], [-0.7, -0.7], [0.0, -1.0], [0.7, -0.7]];
        around.iter().all(|[x, y]| self.is_lit([point[0] + x * reach_m, point[1] + y * reach_m]))
    }

    /// The intended light: the frame's, above the wall's black.
    fn ideal(&self, light: f64) -> f64 {
        self.wall.black() + (1.0 - self.wall.black()) * light
    }

    /// The light of all projectors' black at a point.
    fn leak(&self, point: [f64; 2]) -> f64 {
        let hit = self.projectors.iter().filter(|it| it.hits(point));
        hit.map(|it| it.projector.black_level * it.px(point).map_or(1.0, |px| it.excess(px))).sum()
    }

    /// Points spread evenly over the canvas, by Roberts' R2 sequence.
    fn points(&self, n_points: u32) -> impl Iterator<Item = [f64; 2]> {
        let [width_m, height_m] = self.wall.canvas_m();
        (0..n_points).map(move |n| {
            let part = |step: f64| (0.5 + f64::from(n) * step).fract();
            [part(0.754_877_666_246_693) * width_m, part(0.569_840_290_998_053) * height_m]
        })
    }
}

impl<'a> SimulatedProjector<'a> {
    fn new(projector: &'a Projector, [width_m, height_m]: [f64; 2], optics: Optics<'a>) -> Self {
        let canvas = projector.canvas;
        let [left, bottom] = [canvas.left * width_m, canvas.bottom * height_m];
        let [right, top] = [left + canvas.width * width_m, bottom + canvas.height * height_m];
        let [columns, rows] = projector.upright_size().map(f64::from);
        let light = projector.gain.map(|gain| {
            std::array::from_fn(|value| {
                let value = value as f64 / 255.0;
                let light = match projector.gamma {
                    Gamma::Srgb if value <= 0.04045 => value / 12.92,
                    Gamma::Srgb => ((value + 0.055) / 1.055).powf(2.4),
                    Gamma::Power(exponent) => value.powf(exponent),
                };
                // Undimmed, the channel is brighter than white by 1 / gain.
                light * (1.0 - projector.black_level) / gain
            })
        });
        let px_m = ((right - left) / columns).max((top - bottom) / rows);
        Self { projector, optics, place_m: [left, bottom, right, top], px_m, light }
    }

    fn px(&self, point: [f64; 2]) -> Option<[f64; 2]> {
        match &self.optics {
            Optics::Corners(px_from_m) => geometry::image(px_from_m, point),
            Optics::Stands(stands) => Some(stands.px(point.into()).to_array()),
        }
    }

    /// Whether its pixels, including black ones, light a point.
    fn hits(&self, point: [f64; 2]) -> bool {
        let [width, height] = [self.projector.output.width, self.projector.output.height].map(f64::from);
        // A small tolerance, so that projectors that touch leave no gap.
        self.px(point).is_some_and(|[x, y]| (-1e-6..=width + 1e-6).contains(&x) && (-1e-6..=height + 1e-6).contains(&y))
    }

    /// Whether it shows the picture at a point.
    fn shows(&self, point: [f64; 2]) -> bool {
        let [left, bottom, right, top] = self.place_m;
        let is_within =
            (left - 1e-9..=right + 1e-9).contains(&point[0]) && (bottom - 1e-9..=top + 1e-9).contains(&point[1]);
        is_within && self.hits(point)
    }

    /// The light at a place of its pixels over that at the darkest one: the polynomial through all points of the fall-off.
    fn excess(&self, px: [f64; 2]) -> f64 {
        let Some(fall_off) = &self.projector.fall_off else { return 1.0 };
        let parts: Vec<Vec<f64>> = fall_off.clone().into();
        let seen = seen_px(self.projector, px);
        let size = self.projector.upright_size().map(f64::from);
        // Lagrange's weights of five points from 0 to 1.
        let weight = |at: f64, n: usize| -> f64 {
            let others = (0..5).filter(|other| *other != n).map(|other| other as f64);
            others.map(|other| (4.0 * at - other) / (n as f64 - other)).product()
        };
        let at = |n: usize, axis: usize| weight(seen[axis] / size[axis], n);
        let light: f64 = (0..25).map(|n| parts[n / 5][n % 5] * at(n % 5, 0) * at(n / 5, 1)).sum();
        light / parts.iter().flatten().copied().fold(f64::INFINITY, f64::min)
    }

    fn project(&self, shown: &RgbImage, point: [f64; 2], light: &mut [Light; 3]) {
        let Some([x, y]) = self.px(point) else { return };
        let output = self.projector.output;
        let [x, y] = [x - 0.5, y - 0.5];
        let tent = |at: f64| [(at.floor(), 1.0 - (at - at.floor())), (at.floor() + 1.0, at - at.floor())];
        for (column, x_weight) in tent(x) {
            for (row, y_weight) in tent(y) {
                let is_there =
                    (0.0..f64::from(output.width)).contains(&column) && (0.0..f64::from(output.height)).contains(&row);
                if !is_there {
                    continue;
                }
                let pixel = shown.pixel(output.x + column as u32, output.y + row as u32);
                let weight = x_weight * y_weight * self.excess([column + 0.5, row + 0.5]);
                for channel in 0..3 {
                    let (value, curve) = (usize::from(pixel[channel]), &self.light[channel]);
                    light[channel].sum += weight * (self.projector.black_level + curve[value]);
                    let step = (curve[(value + 1).min(255)] - curve[value]).max(curve[value] - curve[value.max(1) - 1]);
                    light[channel].rounding += weight * step / 2.0;
                }
            }
        }
    }
}

/// The way back from [`geometry::stored_px`].
fn seen_px(projector: &Projector, [x, y]: [f64; 2]) -> [f64; 2] {
    let size = [projector.output.width, projector.output.height].map(f64::from);
    let [x, y] = match projector.flip {
        Flip::None => [x, y],
        Flip::Horizontal => [size[0] - x, y],
        Flip::Vertical => [x, size[1] - y],
    };
    match projector.rotation.degrees() {
        0 => [x, y],
        90 => [size[1] - y, x],
        180 => [size[0] - x, size[1] - y],
        _ => [y, size[0] - x],
    }
}

/// Draws a frame on all of the wall's pixels by the GPU.
fn show(gpu: &Gpu, present: &mut Present, wall: &Wall, frame: &Frame) -> RgbImage {
    present.upload(gpu, frame.size, &frame.rgba).unwrap();
    draw(gpu, present, wall, &Offscreen::new(gpu, wall.output_size()).unwrap())
}

fn linear(value: u8) -> f64 {
    let value = f64::from(value) / 255.0;
    if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// The largest seam on flat fields of ten levels, beyond rounding, and the largest rounding; both as parts of white.
fn largest_seam(gpu: &Gpu, room: &Room<'_>, n_points: u32) -> (f64, f64) {
    let wall = room.wall;
    let mut present = Present::new(gpu);
    let points: Vec<_> = room.points(n_points).filter(|&point| room.is_well_within(point)).collect();
    assert!(points.len() > n_points as usize / 2, "{} points of {n_points} are lit", points.len());
    let mut largest: (f64, f64) = (0.0, 0.0);
    for levels in LEVELS {
        let shown = show(gpu, &mut present, wall, &Frame::new([4, 4], |_, _| levels));
        for &point in &points {
            for (light, level) in std::iter::zip(room.light(&shown, point), levels) {
                let seam = (light.sum - room.ideal(linear(level))).abs() - light.rounding;
                largest = (largest.0.max(seam), largest.1.max(light.rounding));
            }
        }
    }
    largest
}

/// The largest displacement of light, in pixels of the projector there: shows single bright samples and finds the centre
/// of each one's light.
fn farthest_misplaced(gpu: &Gpu, room: &Room<'_>) -> f64 {
    let wall = room.wall;
    let mut present = Present::new(gpu);
    let [width_m, height_m] = wall.canvas_m();
    // Samples at least three pixels wide.
    let px_m = room.projectors.iter().map(|simulated| simulated.px_m).fold(0.0, f64::max);
    let side = |side_m: f64| ((side_m / (3.0 * px_m)) as u32).clamp(8, 512);
    let [xres, yres] = [side(width_m), side(height_m)];
    let step = (xres.max(yres) / 40).max(6);
    let is_bright = |i: u32, j: u32| i % step == step / 2 && j % step == step / 2;
    let shown =
        show(gpu, &mut present, wall, &Frame::new([xres, yres], |i, j| [if is_bright(i, j) { 255 } else { 0 }; 3]));
    let sample_m = [width_m / f64::from(xres), height_m / f64::from(yres)];
    let (mut farthest, mut n_found): (f64, u32) = (0.0, 0);
    for (i, j) in (0..yres).flat_map(|j| (0..xres).map(move |i| (i, j))).filter(|&(i, j)| is_bright(i, j)) {
        let centre = [(f64::from(i) + 0.5) * sample_m[0], (f64::from(j) + 0.5) * sample_m[1]];
        let offsets = || (-24..=24).map(|n| f64::from(n) / 24.0 * 1.6);
        let at = |x: f64, y: f64| [centre[0] + x * sample_m[0], centre[1] + y * sample_m[1]];
        let coarse = || (-4..=4).map(|n| f64::from(n) * 0.4);
        if !coarse().flat_map(|y| coarse().map(move |x| (x, y))).all(|(x, y)| room.is_well_within(at(x, y))) {
            continue;
        }
        let (mut sum, mut moment) = (0.0, [0.0; 2]);
        for (x, y) in offsets().flat_map(|y| offsets().map(move |x| (x, y))) {
            // In green, which no shipped wall dims.
            let light = room.light(&shown, at(x, y))[1].sum - room.ideal(0.0);
            sum += light;
            moment = [moment[0] + light * x * sample_m[0], moment[1] + light * y * sample_m[1]];
        }
        let finest_m =
            room.projectors.iter().filter(|it| it.shows(centre)).map(|it| it.px_m).fold(f64::INFINITY, f64::min);
        farthest = farthest.max((moment[0] / sum).hypot(moment[1] / sum) / finest_m);
        n_found += 1;
    }
    assert!(n_found >= 4, "{n_found} bright samples are seen whole");
    farthest
}

/// The picture on the canvas and the intended picture, within the lit area.
fn pictures(gpu: &Gpu, wall: &Wall, frame: &Frame, width: u32) -> (RgbImage, RgbImage) {
    let room = Room::new(wall);
    let shown = show(gpu, &mut Present::new(gpu), wall, frame);
    let [width_m, height_m] = wall.canvas_m();
    let size = [width, (f64::from(width) * height_m / width_m).round() as u32];
    let (mut seen, mut ideal) = (Vec::new(), Vec::new());
    for (x, y) in (0..size[1]).flat_map(|y| (0..size[0]).map(move |x| (x, y))) {
        let part = [(f64::from(x) + 0.5) / f64::from(size[0]), 1.0 - (f64::from(y) + 0.5) / f64::from(size[1])];
        let point = [part[0] * width_m, part[1] * height_m];
        let wanted = sample(frame, part).map(|light| encode(room.ideal(light)));
        let is_seen = room.is_well_within(point);
        ideal.extend(if is_seen { wanted } else { [0; 3] });
        seen.extend(if is_seen { room.light(&shown, point).map(|light| encode(light.sum)) } else { [0; 3] });
    }
    (RgbImage { size, rgb: seen }, RgbImage { size, rgb: ideal })
}

/// A frame's linear light at a point of the canvas, from (0, 0) to (1, 1), interpolated between four samples.
fn sample(frame: &Frame, [x, y]: [f64; 2]) -> [f64; 3] {
    let [xres, yres] = [frame.size.xres(), frame.size.yres()];
    let [x, y] = [x * f64::from(xres) - 0.5, y * f64::from(yres) - 0.5];
    let [x_part, y_part] = [x - x.floor(), y - y.floor()];
    std::array::from_fn(|channel| {
        let at = |i: f64, j: f64| {
            let i = i.clamp(0.0, f64::from(xres - 1)) as usize;
            let j = j.clamp(0.0, f64::from(yres - 1)) as usize;
            linear(frame.rgba[4 * (j * xres as usize + i) + channel])
        };
        let row = |j: f64| at(x.floor(), j) * (1.0 - x_part) + at(x.floor() + 1.0, j) * x_part;
        row(y.floor()) * (1.0 - y_part) + row(y.floor() + 1.0) * y_part
    })
}

/// The frame with half as many samples each way, each the mean of four.
fn halved(frame: &Frame) -> Frame {
    let [xres, yres] = [frame.size.xres() / 2, frame.size.yres() / 2];
    Frame::new([xres, yres], |i, j| {
        let part = |index: u32, n: u32| (f64::from(index) + 0.5) / f64::from(n);
        sample(frame, [part(i, xres), part(j, yres)]).map(encode)
    })
}

fn encode(light: f64) -> u8 {
    let light = light.clamp(0.0, 1.0);
    let value = if light <= 0.003_130_8 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 };
    (255.0 * value).round() as u8
}

/// Checks seams and displacements of one wall.
fn check(gpu: &Gpu, name: &str, wall: &Wall, n_points: u32) {
    check_room(gpu, name, &Room::new(wall), n_points);
}

fn check_room(gpu: &Gpu, name: &str, room: &Room<'_>, n_points: u32) {
    let (seam, rounding) = largest_seam(gpu, room, n_points);
    let misplaced_px = farthest_misplaced(gpu, room);
    println!(
        "{name}: seams up to {:.3} % of white beyond the {:.3} % that 8 bits force, misplaced up to {misplaced_px:.3} pixels",
        100.0 * seam.max(0.0),
        100.0 * rounding
    );
    assert!(seam <= LARGEST_SEAM, "{name}: a seam of {seam:.4} of white");
    assert!(misplaced_px <= FARTHEST_PX, "{name}: {misplaced_px:.2} pixels out of place");
}

#[test]
fn the_shipped_walls_show_no_seam_and_no_displacement() {
    let gpu = gpu();
    for name in ["paper-4x3", "blended-4x3", "lcd-5x3", "two-monitors", "laptop"] {
        check(&gpu, name, &shipped(&format!("{name}.toml")), 10_000);
    }
    check(&gpu, "crooked", &Wall::from_toml("crooked", CROOKED).unwrap(), 10_000);
    check(&gpu, "uneven", &uneven(), 10_000);
}

#[test]
fn the_statue_in_the_room_is_the_statue() {
    let gpu = gpu();
    for name in ["paper-4x3", "blended-4x3", "lcd-5x3", "two-monitors", "laptop"] {
        let wall = shipped(&format!("{name}.toml"));
        let mut frame = statue_frame(&wall);
        // Samples of nearly a pixel's size would test the lens, not the optics.
        while 3 * frame.size.xres() > wall.output_size()[0] {
            frame = halved(&frame);
        }
        let (seen, ideal) = pictures(&gpu, &wall, &frame, 640);
        references::check_same(&format!("room-{name}"), &ideal, &seen);
    }
}

#[test]
fn black_is_lifted_no_higher_than_necessary() {
    for (wall, n_points) in
        [(shipped("blended-4x3.toml"), 40_000), (Wall::from_toml("crooked", CROOKED).unwrap(), 4000)]
    {
        let room = Room::new(&wall);
        let darkest_possible = room.points(n_points).map(|point| room.leak(point)).fold(0.0, f64::max);
        assert!((wall.black() - darkest_possible).abs() < 1e-9, "{} instead of {darkest_possible}", wall.black());
    }
    // Light that falls off is sampled.
    let wall = uneven();
    let room = Room::new(&wall);
    let darkest_possible = room.points(4000).map(|point| room.leak(point)).fold(0.0, f64::max);
    assert!((wall.black() / darkest_possible - 1.0).abs() < 0.01, "{} instead of {darkest_possible}", wall.black());
}

/// Proves that the room finds errors: otherwise the tests above might never fail.
#[test]
fn the_room_finds_errors() {
    let gpu = gpu();
    let wall = Wall::from_toml("crooked", CROOKED).unwrap();
    let shown = |wall: &Wall, frame: &Frame| show(&gpu, &mut Present::new(&gpu), wall, frame);
    let grey = Frame::new([4, 4], |_, _| [128; 3]);
    let seam_of = |pretended: &Wall| {
        let (room, picture) = (Room::new(&wall), shown(pretended, &grey));
        let points = room.points(5000).filter(|&point| room.is_well_within(point));
        let seam = |point| {
            let light = room.light(&picture, point)[1];
            (light.sum - room.ideal(linear(128))).abs() - light.rounding
        };
        points.map(seam).fold(0.0, f64::max)
    };
    let pretend = |from: &str, to: &str| Wall::from_toml("pretended", &CROOKED.replacen(from, to, 1)).unwrap();
    assert!(seam_of(&wall) < LARGEST_SEAM, "{}", seam_of(&wall));
    assert!(seam_of(&pretend("gamma = 1.8", "gamma = 1.9")) > LARGEST_SEAM);
    assert!(seam_of(&pretend("black_level = 0.02", "black_level = 0.0")) > LARGEST_SEAM);
    assert!(seam_of(&pretend("gain = [0.9, 1.0, 0.7]", "gain = [0.9, 0.95, 0.7]")) > LARGEST_SEAM);
    let fall_off = format!("gamma = 1.8\n{}\n", FALL_OFF.replace("0.625", "0.675"));
    assert!(seam_of(&pretend("gamma = 1.8\n", &fall_off)) > LARGEST_SEAM);
    assert!(seam_of(&pretend("size_m = [1.2, 1.0]", "size_m = [1.15, 1.0]")) > LARGEST_SEAM);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 6, max_shrink_iters: 20, ..ProptestConfig::default() })]

    #[test]
    fn random_walls_show_no_seam_and_no_displacement(text in random_wall()) {
        let wall = Wall::from_toml("random", &text).unwrap_or_else(|error| panic!("{error}\n{text}"));
        println!("{text}");
        check(&gpu(), "random", &wall, 4000);
    }
}

/// A grid of projectors with overlaps of at least thirty pixels, or of screens with or without bezels, each with its own
/// light; overlapping projectors are warped, and some are turned.
fn random_wall() -> impl Strategy<Value = String> {
    let optics = (1.0..3.0_f64, 0.0..0.02_f64, prop::array::uniform3(0.6..=1.0_f64), 0_u32..4, 0_usize..3);
    let warp = prop::array::uniform4(prop::array::uniform2(0.0..9.0_f64));
    let projector = (optics, warp);
    let grid = (1_u32..=3, 1_u32..=2, 0_u32..3, 0.2..0.45_f64, 160_u32..280);
    (grid, prop::collection::vec(projector, 6)).prop_map(|((columns, rows, kind, shared, side), projectors)| {
        let spacing = match kind {
            0 => String::new(),
            1 => "bezel_m = [0.01, 0.02]".to_owned(),
            _ => format!("overlap = [{shared:.3}, {:.3}]", 0.65 - shared),
        };
        // Only square projectors have square pixels after a quarter turn.
        let mut text = format!(
            "canvas_m = [{columns}.0, {rows}.0]\n[grid]\ncolumns = {columns}\nrows = {rows}\npixels = [{side}, {side}]\n{spacing}\n"
        );
        for (index, ((gamma, black_level, gain, turns, flip), warp)) in projectors.iter().enumerate() {
            let (row, column) = (index as u32 / columns + 1, index as u32 % columns + 1);
            if row > rows {
                break;
            }
            let inwards = [[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]];
            let warp_px: [[f64; 2]; 4] = std::array::from_fn(|corner| {
                [0, 1].map(|axis| if kind == 2 { (warp[corner][axis] * inwards[corner][axis] * 100.0).round() / 100.0 } else { 0.0 })
            });
            text += &format!(
                "[[projector]]\nname = \"row {row} column {column}\"\ngamma = {gamma:.2}\nblack_level = {black_level:.4}\n\
                 gain = {gain:.3?}\nrotation = {}\nflip = \"{}\"\nwarp_px = {warp_px:?}\n",
                turns * 90,
                ["none", "horizontal", "vertical"][*flip]
            );
        }
        text
    })
}

#[test]
fn a_pixel_s_point_on_the_canvas_is_where_its_projector_lights_it() {
    let crooked = Wall::from_toml("crooked", CROOKED).unwrap();
    let walls = ["paper-4x3", "blended-4x3", "lcd-5x3", "two-monitors"].map(|name| shipped(&format!("{name}.toml")));
    for wall in walls.iter().chain([&crooked]) {
        let room = Room::new(wall);
        let [width_m, height_m] = wall.canvas_m();
        for simulated in &room.projectors {
            let output = simulated.projector.output;
            let corner = DVec2::new(f64::from(output.x), f64::from(output.y));
            let mut n_points = 0;
            for point @ [x_m, y_m] in room.points(2000) {
                let Some(px) = simulated.px(point).map(|px| corner + DVec2::from(px)) else { continue };
                if output.contains(px) {
                    let expected = DVec2::new(x_m / width_m, y_m / height_m);
                    let found = wall.canvas_at(px);
                    assert!((found - expected).length() < 1e-9, "{}: {found} is {expected}", simulated.projector.name);
                    n_points += 1;
                }
            }
            assert!(n_points > 10, "{}: {n_points}", simulated.projector.name);
        }
    }
}
