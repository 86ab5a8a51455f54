//! The twin of the present stage on the CPU, in f64: the truth that tests hold the GPU against.

use shared::division::FrameSize;
use shared::srgb;

use super::picture::Picture;
use crate::wall::{PixelRect, Projector, output_size};

/// What [`super::Present::draw`] shows of a frame on a target of `target_size`.
///
/// `rgba` holds the frame's samples as [`super::frame_texture::FrameTexture::upload`] takes them.
pub fn present(size: FrameSize, rgba: &[u8], projectors: &[Projector], target_size: [u32; 2]) -> Picture {
    let content = output_size(projectors);
    let wall = PixelRect::fitted(content, target_size);
    let [width, height] = target_size;
    let mut rgb = vec![0; 3 * width as usize * height as usize];
    for (pixel, encoded) in rgb.chunks_exact_mut(3).enumerate() {
        let [x, y] = [pixel as u32 % width, pixel as u32 / width];
        // From the pixel's centre to the output that spans the projectors, in pixels of that output.
        let x_output = (f64::from(x) + 0.5 - f64::from(wall.x)) * f64::from(content[0]) / f64::from(wall.width);
        let y_output = (f64::from(y) + 0.5 - f64::from(wall.y)) * f64::from(content[1]) / f64::from(wall.height);
        // Later projectors are drawn over earlier ones.
        if let Some(projector) =
            projectors.iter().rev().find(|projector| contains(projector.output, x_output, y_output))
        {
            let PixelRect { x, y, width, height } = projector.output;
            let from_left = (x_output - f64::from(x)) / f64::from(width);
            let from_top = (y_output - f64::from(y)) / f64::from(height);
            let canvas = projector.canvas;
            let canvas_x = canvas.left + from_left * canvas.width;
            let canvas_y = canvas.bottom + (1.0 - from_top) * canvas.height;
            let linear = bilinear(size, rgba, canvas_x * f64::from(size.xres()), canvas_y * f64::from(size.yres()));
            encoded.copy_from_slice(&linear.map(|light| srgb::encode(light as f32)));
        }
    }
    Picture { size: target_size, rgb }
}

fn contains(rect: PixelRect, x: f64, y: f64) -> bool {
    (0.0..f64::from(rect.width)).contains(&(x - f64::from(rect.x)))
        && (0.0..f64::from(rect.height)).contains(&(y - f64::from(rect.y)))
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
