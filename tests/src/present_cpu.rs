//! The present stage's twin on the CPU, in f64: the truth that the GPU is tested against.

use std::sync::Arc;

use compositor::{
    gpu::RgbImage,
    wall::{
        FallOff, Flip, Gamma, PixelRect, Projector, Wall,
        blend::{LEAST_DISTANCE, MESH_TOLERANCE, Neighbour, distances_from_edges},
        homography::apply,
        mesh::Mesh,
    },
};
use glam::{DVec2, DVec4};
use shared::{division::FrameSize, srgb};

/// The image that `Present::draw` makes of a frame on a target of `target_size`, of samples as `Present::upload` takes them.
pub(crate) fn present(size: FrameSize, rgba: &[u8], wall: &Wall, part: PixelRect, target_size: [u32; 2]) -> RgbImage {
    let fitted = PixelRect::fitted([part.width, part.height], target_size);
    let scale = part.size() / fitted.size();
    let [width, height] = target_size;
    let mut rgb = vec![0; 3 * width as usize * height as usize];
    for (pixel, encoded) in rgb.chunks_exact_mut(3).enumerate() {
        let [x, y] = [pixel as u32 % width, pixel as u32 / width];
        // From the pixel's centre to the spanning output, in pixels of that output.
        let from_fitted = DVec2::new(f64::from(x), f64::from(y)) - fitted.origin() + 0.5;
        let output = part.origin() + from_fitted * scale;
        let shown = |projector: &&Projector| part.contains_rect(&projector.output) && projector.output.contains(output);
        if let Some(projector_idx) = wall.projectors().iter().position(|projector| shown(&projector)) {
            let value = if wall.is_plain(projector_idx) {
                plain(size, rgba, &wall.projectors()[projector_idx], output)
            } else {
                corrected(size, rgba, wall, projector_idx, output, scale)
            };
            encoded.copy_from_slice(&value);
        }
    }
    RgbImage { size: target_size, rgb }
}

/// A pixel of a projector that shows its part of the frame as it is.
fn plain(size: FrameSize, rgba: &[u8], projector: &Projector, output: DVec2) -> [u8; 3] {
    let linear = frame_at(size, rgba, projector, raster_of(projector, output));
    linear.map(|light| srgb::encode(light as f32))
}

/// A pixel of a projector that is warped, overlaps others, or has a light of its own; `pixel` is its width and height in
/// pixels of the output.
fn corrected(size: FrameSize, rgba: &[u8], wall: &Wall, projector_idx: usize, output: DVec2, pixel: DVec2) -> [u8; 3] {
    let projector = &wall.projectors()[projector_idx];
    let Some(image_from_raster) = projector.raster_from_image().map(|map| map.inverse()) else { return [0; 3] };
    let image_of = |output: DVec2| apply(image_from_raster, raster_of(projector, output));
    let Some(image) = image_of(output) else { return [0; 3] };

    // The size of the pixel in the projector's image, by finite differences of a hundredth of a pixel.
    let extent = |of: &dyn Fn(DVec2) -> Option<DVec2>| {
        let here = of(output)?;
        let step = |direction: DVec2| of(output + direction * pixel / 100.0).map(|it| (it - here) * 100.0);
        let (per_column, per_row) = (step(DVec2::X)?, step(DVec2::Y)?);
        Some(DVec2::new(per_column.x.hypot(per_row.x), per_column.y.hypot(per_row.y)))
    };
    let inside = |point: DVec2, extent: DVec2| {
        (point.min(1.0 - point) / extent + 0.5).clamp(DVec2::ZERO, DVec2::ONE).element_product()
    };
    let Some(image_extent) = extent(&image_of) else { return [0; 3] };
    let mut covered = inside(image, image_extent);

    // The edges of the canvas cut a mesh, too.
    let mut rect_point = image;
    if let Some(mesh) = &projector.mesh {
        let rect_of = |output: DVec2| {
            let image = image_of(output)?.clamp(DVec2::ZERO, DVec2::ONE);
            Some(projector.canvas.rect_from_canvas(interpolated(mesh, image)))
        };
        let (Some(place), Some(extent)) = (rect_of(output), extent(&rect_of)) else { return [0; 3] };
        rect_point = place;
        covered *= inside(place, extent.max(DVec2::splat(1e-9)));
    }

    let BlendWeight { weight, leak } = blend_weight(wall.neighbours(projector_idx), rect_point);
    // Brighter places are dimmed to the darkest.
    let light_fraction = covered * weight / excess(projector.fall_off.as_ref(), upright_of(projector, output));
    let linear = frame_at(size, rgba, projector, rect_point.clamp(DVec2::ZERO, DVec2::ONE));
    std::array::from_fn(|channel| {
        let light = light_fraction * (wall.black() + (1.0 - wall.black()) * linear[channel] - leak).max(0.0);
        let drive = (light * projector.gain[channel] / (1.0 - projector.black_level)).clamp(0.0, 1.0);
        (encode(projector.gamma, drive) * 255.0).round() as u8
    })
}

/// The point of the canvas at a point of a mesh's image: Keys' kernel for a = -1/2, over control points that continue
/// beyond the edges so that quadratic functions stay what they are.
fn interpolated(mesh: &Mesh, image: DVec2) -> DVec2 {
    let points: Vec<DVec2> = mesh.points().collect();
    keys(&points, mesh.size(), image)
}

/// Between points of a lattice over the unit square, row by row from the top.
fn keys(points: &[DVec2], size: [usize; 2], image: DVec2) -> DVec2 {
    let size = size.map(|n| n as i64);
    let at = |n: i64, of: i64| -> Vec<(i64, f64)> {
        match n {
            -1 if of > 2 => vec![(0, 3.0), (1, -3.0), (2, 1.0)],
            -1 => vec![(0, 2.0), (1, -1.0)],
            n if n == of && of > 2 => vec![(of - 1, 3.0), (of - 2, -3.0), (of - 3, 1.0)],
            n if n == of => vec![(1, 2.0), (0, -1.0)],
            n => vec![(n, 1.0)],
        }
    };
    let kernel = |x: f64| match x.abs() {
        x if x < 1.0 => 1.5 * x.powi(3) - 2.5 * x.powi(2) + 1.0,
        x if x < 2.0 => -0.5 * x.powi(3) + 2.5 * x.powi(2) - 4.0 * x + 2.0,
        _ => 0.0,
    };
    let weights = |part: f64, of: i64| -> Vec<(i64, f64)> {
        let place = part * (of - 1) as f64;
        let first = (place.floor() as i64).min(of - 2) - 1;
        let one = |n: i64| at(n, of).into_iter().map(move |(index, weight)| (index, weight * kernel(place - n as f64)));
        (first..first + 4).flat_map(one).collect()
    };
    let (across, down) = (weights(image.x, size[0]), weights(image.y, size[1]));
    let point = |column: i64, row: i64| points[(row * size[0] + column) as usize];
    let row = |row: i64| across.iter().map(|(column, weight)| point(*column, row) * *weight).sum::<DVec2>();
    down.iter().map(|(index, weight)| row(*index) * *weight).sum()
}

/// A projector's light at a point of its pixels as seen on the wall, over that at its darkest control point.
fn excess(fall_off: Option<&FallOff>, upright: DVec2) -> f64 {
    let Some(fall_off) = fall_off else { return 1.0 };
    let rows: Vec<Vec<f64>> = fall_off.clone().into();
    let parts: Vec<DVec2> = rows.iter().flatten().map(|part| DVec2::splat(*part)).collect();
    let least = parts.iter().map(|part| part.x).fold(f64::INFINITY, f64::min);
    keys(&parts, [5, 5], upright.clamp(DVec2::ZERO, DVec2::ONE)).x / least
}

/// A point of the output among a projector's pixels as seen on the wall, from (0, 0) upper left to (1, 1).
fn upright_of(projector: &Projector, output: DVec2) -> DVec2 {
    let mut at = raster_of(projector, output);
    match projector.flip {
        Flip::None => {}
        Flip::Horizontal => at.x = 1.0 - at.x,
        Flip::Vertical => at.y = 1.0 - at.y,
    }
    match projector.rotation.degrees() {
        0 => at,
        90 => DVec2::new(1.0 - at.y, at.x),
        180 => 1.0 - at,
        _ => DVec2::new(at.y, 1.0 - at.x),
    }
}

/// A point of the output among a projector's pixels, which run from (0, 0) to (1, 1).
fn raster_of(projector: &Projector, output: DVec2) -> DVec2 {
    (output - projector.output.origin()) / projector.output.size()
}

/// Linear light of the frame at a point of a projector's rectangle.
fn frame_at(size: FrameSize, rgba: &[u8], projector: &Projector, rect_point: DVec2) -> [f64; 3] {
    let canvas = projector.canvas.canvas_from_rect(rect_point);
    bilinear(size, rgba, canvas.x * f64::from(size.xres()), canvas.y * f64::from(size.yres()))
}

/// Linear light at a point of the frame, in samples from its lower-left corner; sample (i, j) has its centre at
/// (i + ½, j + ½), and the outermost samples continue outwards.
fn bilinear(size: FrameSize, rgba: &[u8], x: f64, y: f64) -> [f64; 3] {
    let [x, y] = [x - 0.5, y - 0.5];
    let [x_weight, y_weight] = [x - x.floor(), y - y.floor()];
    let sample = |i: f64, j: f64| {
        let i = i.clamp(0.0, f64::from(size.xres() - 1)) as usize;
        let j = j.clamp(0.0, f64::from(size.yres() - 1)) as usize;
        let first = 4 * (j * size.xres() as usize + i);
        [0, 1, 2].map(|channel| f64::from(srgb::decode(rgba[first + channel])))
    };
    let corners = [
        (sample(x.floor(), y.floor()), (1.0 - x_weight) * (1.0 - y_weight)),
        (sample(x.floor() + 1.0, y.floor()), x_weight * (1.0 - y_weight)),
        (sample(x.floor(), y.floor() + 1.0), (1.0 - x_weight) * y_weight),
        (sample(x.floor() + 1.0, y.floor() + 1.0), x_weight * y_weight),
    ];
    [0, 1, 2].map(|channel| corners.iter().map(|(linear, weight)| linear[channel] * weight).sum())
}

/// One projector's blend weight at one point of its rectangle, and the black there.
struct BlendWeight {
    /// Its part of the image's light, from 0 to 1. All projectors' weights add up to 1.
    weight: f64,
    /// The light of all projectors' black there.
    leak: f64,
}

/// The blend weight of a projector with these `neighbours`, itself first, at a point of its rectangle.
///
/// The weight is the product of the distances from the edges towards which the light fades, divided by the sum of these
/// products over all neighbours: continuous, and on a regular wall constant along an edge.
fn blend_weight(neighbours: &[Neighbour], rect_point: DVec2) -> BlendWeight {
    // Pixels that an edge of the rectangle cuts count as inside.
    let within = rect_point.clamp(DVec2::ZERO, DVec2::ONE);
    let raw_weight = |neighbour: &Neighbour| {
        let image = neighbour.image_near(within);
        let tolerance = if neighbour.mesh.is_some() { MESH_TOLERANCE } else { LEAST_DISTANCE };
        match apply(neighbour.upright_from_image, image) {
            Some(upright) if neighbour.blends => distances(neighbour, image, upright, tolerance),
            _ => 0.0,
        }
    };
    // A pixel at the edge gives its light on both sides of it.
    let leak = |neighbour: &Neighbour| {
        let Some(upright) = apply(neighbour.upright_from_image, neighbour.image_near(rect_point)) else { return 0.0 };
        let covered = (upright.min(1.0 - upright) * neighbour.upright_size + 0.5).clamp(DVec2::ZERO, DVec2::ONE);
        neighbour.black_level * excess(neighbour.fall_off.as_ref(), upright) * covered.x * covered.y
    };
    let own = neighbours.first().map_or(0.0, raw_weight);
    let all: f64 = neighbours.iter().map(raw_weight).sum();
    BlendWeight { weight: if all > 0.0 { own / all } else { 0.0 }, leak: neighbours.iter().map(leak).sum() }
}

/// The product of the distances from the four edges of a neighbour's light, of which either the image's or the pixels' is
/// the nearer one; 0 outside of it by more than a tolerance.
fn distances(neighbour: &Neighbour, image: DVec2, upright: DVec2, tolerance: f64) -> f64 {
    let [from_image, from_pixels] = [image, upright].map(distances_from_edges);
    let distance = |edge: usize| {
        let by_image = if neighbour.image_edges[edge] > 0.0 { from_image[edge] } else { 1.0 };
        let fade = neighbour.raster_fades[edge];
        let by_pixels = if fade > 0.0 { from_pixels[edge] * fade } else { 1.0 };
        by_image.min(by_pixels).max(LEAST_DISTANCE)
    };
    let is_lit = from_image.min(from_pixels).cmpge(DVec4::splat(-tolerance)).all();
    if is_lit { (0..4).map(distance).product() } else { 0.0 }
}

/// The value from 0 to 1 at which a projector of this gamma gives `light`, from 0 to 1.
fn encode(gamma: Gamma, light: f64) -> f64 {
    match gamma {
        Gamma::Srgb if light <= 0.003_130_8 => 12.92 * light,
        Gamma::Srgb => 1.055 * light.powf(1.0 / 2.4) - 0.055,
        Gamma::Power(exponent) => light.powf(1.0 / exponent),
    }
}

#[test]
fn blend_weights_add_up_to_one_everywhere_and_vanish_at_inner_edges() {
    let wall = Wall::load(std::path::Path::new("../wall-config/blended-4x3.toml")).expect("a shipped wall file");
    for step in 0..10_000_u32 {
        let point = DVec2::new(f64::from(step % 100) + 0.5, f64::from(step / 100) + 0.5) / 100.0;
        let weights = (0..12).map(|index| {
            let rect_point = wall.projectors()[index].canvas.rect_from_canvas(point);
            let is_within = rect_point.cmpge(DVec2::ZERO).all() && rect_point.cmple(DVec2::ONE).all();
            if is_within { blend_weight(wall.neighbours(index), rect_point).weight } else { 0.0 }
        });
        let sum: f64 = weights.sum();
        assert!((sum - 1.0).abs() < 1e-9, "{sum} at {point}");
    }
    let at_right_edge = blend_weight(wall.neighbours(0), DVec2::new(1.0, 0.5)).weight;
    assert!(at_right_edge < 1e-3, "{at_right_edge}");
}

/// Two projectors whose rectangles share the middle fifth of a metre; a mesh without a bend has the same light.
fn side_by_side(has_mesh: bool) -> Wall {
    let text = "canvas_m = [1.8, 0.75]\n[grid]\ncolumns = 2\nrows = 1\npixels = [640, 480]\noverlap = [0.2, 0.0]\n";
    let wall = Wall::from_toml("two", text).expect("a wall");
    let bent = |projector: &Projector| {
        let corners = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]].map(DVec2::from);
        let points = corners.map(|corner| projector.canvas.canvas_from_rect(corner));
        projector.clone().with_mesh(Arc::new(Mesh::new("a.pfm".into(), [2, 2], &points).expect("a mesh")))
    };
    if has_mesh { wall.with_projectors(wall.projectors().iter().map(bent).collect()).expect("a wall") } else { wall }
}

/// The blend weights of both projectors at a point of the canvas; `None` where one has no light.
fn weights_at(wall: &Wall, canvas: DVec2) -> [Option<f64>; 2] {
    [0, 1].map(|index| {
        let projector = &wall.projectors()[index];
        let rect_point = projector.canvas.rect_from_canvas(canvas);
        let image = projector.image_at(rect_point);
        let raster = apply(projector.raster_from_image()?, image)?;
        let is_lit = [rect_point, image, raster].into_iter().all(|at| distances_from_edges(at).min_element() > 0.0);
        is_lit.then(|| blend_weight(wall.neighbours(index), rect_point).weight)
    })
}

#[test]
fn a_corner_dragged_in_or_out_of_the_overlap_leaves_the_blend_smooth() {
    // Upper right and lower right of the left projector, upper left and lower left of the right one.
    let corners = [(0, 1), (0, 2), (1, 0), (1, 3)];
    let drags = [[5.0, 0.0], [-5.0, 0.0], [0.0, 5.0], [0.0, -5.0], [5.0, -5.0], [-5.0, 5.0], [5.0, 5.0], [-5.0, -5.0]];
    for (has_mesh, (projector, corner), drag) in [false, true]
        .into_iter()
        .flat_map(|has_mesh| corners.into_iter().flat_map(move |corner| drags.map(|drag| (has_mesh, corner, drag))))
    {
        let mut warp_px = [[0.0; 2]; 4];
        warp_px[corner] = drag;
        let wall = side_by_side(has_mesh).with_warps(&[(projector, warp_px)]).expect("a wall");
        let what = format!("mesh {has_mesh}, projector {projector}, corner {corner}, {drag:?}");
        // Steps of a quarter of a pixel along rows; the first and last rows fade towards the dragged edge.
        let (n_steps, n_rows) = (4 * 1152, 48);
        for row in 0..n_rows {
            let y = (f64::from(row) + 0.5) / f64::from(n_rows);
            let at = |step: i32| DVec2::new((f64::from(step) + 0.5) / f64::from(n_steps), y);
            let shared: Vec<[f64; 2]> = (0..n_steps)
                .filter_map(|step| match weights_at(&wall, at(step)) {
                    [Some(left), Some(right)] => Some([left, right]),
                    _ => None,
                })
                .collect();
            assert!(shared.len() > 4 * 110, "{what}: row {row} overlaps by {} steps", shared.len());
            assert!(shared.iter().all(|[left, right]| (left + right - 1.0).abs() < 2e-3), "{what}: row {row}");
            let (first, last) = (shared[0], shared[shared.len() - 1]);
            let is_inner = (3..n_rows - 3).contains(&row);
            let least = if is_inner { 0.01 } else { 0.2 };
            assert!(first[1] < least && last[0] < least, "{what}: row {row} ends with {first:?} and {last:?}");
            if is_inner {
                let steepest = shared.windows(2).map(|pair| pair[0][0] - pair[1][0]).fold(0.0, f64::max);
                let middle = shared.iter().filter(|[left, _]| *left > 0.5).count() as f64 / shared.len() as f64;
                assert!(4.0 * steepest < 3.0 / 128.0, "{what}: row {row} falls by {steepest} in a quarter of a pixel");
                assert!((0.3..0.7).contains(&middle), "{what}: row {row} has its middle at {middle}");
            }
        }
        // Towards the upper or lower edge of its pixels, where these cut its image, its light ends softly too.
        let cuts_below = (corner == 1 || corner == 0) && drag[1] < 0.0;
        if cuts_below && !has_mesh {
            let column = |step: i32| DVec2::new(0.5, 1.0 - f64::from(step) / 4800.0);
            let own: Vec<f64> = (1..400).filter_map(|step| weights_at(&wall, column(step))[projector]).collect();
            assert!(own[0] < 0.05 && own[own.len() - 1] > 0.3, "{what}: {} to {}", own[0], own[own.len() - 1]);
        }
    }
}
