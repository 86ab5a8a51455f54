//! The one texture that holds a frame's samples.

use shared::division::FrameSize;

use super::context::{Gpu, GpuError};

/// A frame's samples on the GPU, for all projectors.
pub struct FrameTexture {
    texture: wgpu::Texture,
    view: wgpu::TextureView,
    size: FrameSize,
}

impl FrameTexture {
    /// A texture for frames of one resolution.
    pub fn new(gpu: &Gpu, size: FrameSize) -> Result<Self, GpuError> {
        let extent = [size.xres(), size.yres()];
        gpu.check_size("a frame", extent)?;
        // Loads from sRGB give linear light, in which the wall is filtered and blended.
        let usage = wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST;
        let (texture, view) = gpu.texture("frame", extent, wgpu::TextureFormat::Rgba8UnormSrgb, usage);
        Ok(Self { texture, view, size })
    }

    /// The resolution.
    pub fn size(&self) -> FrameSize {
        self.size
    }

    /// The view for shaders: linear light, row 0 is the frame's bottom row.
    pub fn view(&self) -> &wgpu::TextureView {
        &self.view
    }

    /// Replaces all samples, sRGB-encoded R, G, B and one byte unused, row by row from the bottom left.
    ///
    /// The bytes are copied at once and reach the GPU with the next submission.
    pub fn upload(&self, gpu: &Gpu, rgba: &[u8]) -> Result<(), GpuError> {
        if rgba.len() as u64 != 4 * u64::from(self.size.n_samples()) {
            return Err(GpuError::NotAFrame { n_bytes: rgba.len(), size: self.size });
        }
        let layout =
            wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(4 * self.size.xres()), rows_per_image: None };
        gpu.queue.write_texture(self.texture.as_image_copy(), rgba, layout, self.texture.size());
        Ok(())
    }
}
