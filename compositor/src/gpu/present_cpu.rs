//! The present stage's twin on the CPU, in f64: the truth that the GPU is tested against.

use glam::DVec2;
use shared::{division::FrameSize, srgb};

use super::picture::RgbImage;
use crate::wall::{
    PixelRect, Projector, Wall,
    blend::{BlendWeight, blend_weight},
    homography::apply,
};

/// The image that [`super::Present::draw`] makes of a frame on a target of `target_size`.
///
/// `rgba` holds the frame's samples as [`super::frame_texture::FrameTexture::upload`] takes them.
pub fn present(size: FrameSize, rgba: &[u8], wall: &Wall, part: PixelRect, target_size: [u32; 2]) -> RgbImage {
    let fitted = PixelRect::fitted([part.width, part.height], target_size);
    let scale =
        DVec2::new(f64::from(part.width) / f64::from(fitted.width), f64::from(part.height) / f64::from(fitted.height));
    let [width, height] = target_size;
    let mut rgb = vec![0; 3 * width as usize * height as usize];
    for (pixel, encoded) in rgb.chunks_exact_mut(3).enumerate() {
        let [x, y] = [pixel as u32 % width, pixel as u32 / width];
        // From the pixel's centre to the spanning output, in pixels of that output.
        let from_fitted = DVec2::new(f64::from(x) - f64::from(fitted.x), f64::from(y) - f64::from(fitted.y)) + 0.5;
        let output = DVec2::new(f64::from(part.x), f64::from(part.y)) + from_fitted * scale;
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
    let Some(rect_from_raster) = projector.raster_from_rect().map(|map| map.inverse()) else { return [0; 3] };
    let rect_point_of = |output: DVec2| apply(rect_from_raster, raster_of(projector, output));
    let Some(rect_point) = rect_point_of(output) else { return [0; 3] };

    // The size of the pixel in the projector's rectangle, by finite differences of a hundredth of a pixel.
    let step = |direction: DVec2| rect_point_of(output + direction * pixel / 100.0).map(|it| (it - rect_point) * 100.0);
    let (Some(per_column), Some(per_row)) = (step(DVec2::X), step(DVec2::Y)) else { return [0; 3] };
    let extent = DVec2::new(per_column.x.hypot(per_row.x), per_column.y.hypot(per_row.y));
    let covered = (rect_point.min(1.0 - rect_point) / extent + 0.5).clamp(DVec2::ZERO, DVec2::ONE);

    let BlendWeight { weight, leak } = blend_weight(wall.neighbours(projector_idx), rect_point);
    let light_fraction = covered.x * covered.y * weight;
    let linear = frame_at(size, rgba, projector, rect_point.clamp(DVec2::ZERO, DVec2::ONE));
    std::array::from_fn(|channel| {
        let light = light_fraction * (wall.black() + (1.0 - wall.black()) * linear[channel] - leak).max(0.0);
        let drive = (light * projector.gain[channel] / (1.0 - projector.black_level)).clamp(0.0, 1.0);
        (projector.gamma.encode(drive) * 255.0).round() as u8
    })
}

/// A point of the output among a projector's pixels, which run from (0, 0) to (1, 1).
fn raster_of(projector: &Projector, output: DVec2) -> DVec2 {
    let PixelRect { x, y, width, height } = projector.output;
    (output - DVec2::new(f64::from(x), f64::from(y))) / DVec2::new(f64::from(width), f64::from(height))
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
