//! The wall without a window: drawn at any resolution into memory.

use super::{
    context::{Gpu, GpuError},
    picture::RgbImage,
    quad::Target,
};
use crate::wall::{PixelRect, Wall};

/// An image on the GPU that can be read back.
pub struct Offscreen {
    texture: wgpu::Texture,
    view: wgpu::TextureView,
    size: [u32; 2],
}

/// About this many bytes of rows are read back at once, so that no wall needs a second full copy.
const BAND_BYTES: u32 = 16 << 20;

impl Offscreen {
    /// An image of `size`: columns, rows.
    pub fn new(gpu: &Gpu, size: [u32; 2]) -> Result<Self, GpuError> {
        Self::with_srgb_view(gpu, size, true)
    }

    /// The same, with or without the sRGB view that some surfaces lack.
    pub fn with_srgb_view(gpu: &Gpu, size: [u32; 2], has_srgb_view: bool) -> Result<Self, GpuError> {
        gpu.check_size("a picture", size)?;
        let size = size.map(|side| side.max(1));
        let format = if has_srgb_view { wgpu::TextureFormat::Rgba8UnormSrgb } else { wgpu::TextureFormat::Rgba8Unorm };
        let usage = wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC;
        let (texture, view) = gpu.texture("offscreen", size, format, usage);
        Ok(Self { texture, view, size })
    }

    /// The target for [`super::Present::draw`].
    pub fn target(&self) -> Target<'_> {
        Target { view: &self.view, format: self.texture.format(), size: self.size }
    }

    /// Waits for all submissions, and copies the image back.
    pub fn read(&self, gpu: &Gpu) -> Result<RgbImage, GpuError> {
        let mut image = RgbImage::black(self.size);
        self.read_into(gpu, &mut image, [0, 0])?;
        Ok(image)
    }

    /// The same, into a larger image at a column and a row.
    fn read_into(&self, gpu: &Gpu, image: &mut RgbImage, [left, top_of_image]: [u32; 2]) -> Result<(), GpuError> {
        let [width, height] = self.size;
        let padded_row_bytes = (4 * width).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
        let band_rows = (BAND_BYTES / padded_row_bytes).clamp(1, height);
        let band_bytes = u64::from(band_rows) * u64::from(padded_row_bytes);
        let columns = 3 * left as usize..3 * (left + width) as usize;
        let mut rgb_rows = image.rgb.chunks_exact_mut(3 * image.size[0] as usize).skip(top_of_image as usize);
        for top in (0..height).step_by(band_rows as usize) {
            let n_rows = band_rows.min(height - top);
            // A buffer for each band: none is ever mapped twice.
            let buffer = gpu.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("readback"),
                size: band_bytes,
                usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
                mapped_at_creation: false,
            });
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            encoder.copy_texture_to_buffer(
                wgpu::TexelCopyTextureInfo {
                    origin: wgpu::Origin3d { x: 0, y: top, z: 0 },
                    ..self.texture.as_image_copy()
                },
                wgpu::TexelCopyBufferInfo {
                    buffer: &buffer,
                    layout: wgpu::TexelCopyBufferLayout {
                        offset: 0,
                        bytes_per_row: Some(padded_row_bytes),
                        rows_per_image: None,
                    },
                },
                wgpu::Extent3d { width, height: n_rows, depth_or_array_layers: 1 },
            );
            gpu.queue.submit([encoder.finish()]);
            gpu.check()?;
            buffer.map_async(wgpu::MapMode::Read, .., |_outcome| {});
            gpu.wait()?;
            // A mapping that failed has no range to get.
            let bytes = buffer.get_mapped_range(..).map_err(|error| GpuError::Failed(error.to_string()))?;
            let rgba_rows = bytes.chunks_exact(padded_row_bytes as usize).take(n_rows as usize);
            for (rgba_row, rgb_row) in rgba_rows.zip(&mut rgb_rows) {
                let (rgba_pixels, _) = rgba_row.as_chunks::<4>();
                let (rgb_pixels, _) = rgb_row[columns.clone()].as_chunks_mut::<3>();
                for ([r, g, b, _], rgb_pixel) in rgba_pixels.iter().zip(rgb_pixels) {
                    *rgb_pixel = [*r, *g, *b];
                }
            }
        }
        Ok(())
    }
}

/// All of a wall's pixels: several images where one texture is too small for them.
pub struct OffscreenWall {
    parts: Vec<(PixelRect, Offscreen)>,
    size: [u32; 2],
}

impl OffscreenWall {
    /// For a wall's spanning output.
    pub fn new(gpu: &Gpu, wall: &Wall) -> Result<Self, GpuError> {
        let size = wall.output_size();
        let largest = gpu.device.limits().max_texture_dimension_2d;
        let along = |side: u32| (0..side).step_by(largest as usize).map(move |from| (from, largest.min(side - from)));
        let parts = along(size[1])
            .flat_map(|(y, height)| along(size[0]).map(move |(x, width)| PixelRect { x, y, width, height }));
        let parts =
            parts.map(|part| Ok((part, Offscreen::new(gpu, [part.width, part.height])?))).collect::<Result<_, _>>()?;
        Ok(Self { parts, size })
    }

    /// The outputs for [`super::Present::draw`].
    pub fn outputs(&self) -> Vec<(Target<'_>, PixelRect)> {
        self.parts.iter().map(|(part, offscreen)| (offscreen.target(), *part)).collect()
    }

    /// Waits for all submissions, and copies the wall's image back.
    pub fn read(&self, gpu: &Gpu) -> Result<RgbImage, GpuError> {
        let mut image = RgbImage::black(self.size);
        self.parts.iter().try_for_each(|(part, offscreen)| offscreen.read_into(gpu, &mut image, [part.x, part.y]))?;
        Ok(image)
    }
}
