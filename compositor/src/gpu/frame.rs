//! A frame's samples on the GPU: one texture, or pieces where the GPU's textures are too small; paired with
//! `shaders/frame.wgsl` and `shaders/frame_pieces.wgsl`.

use shared::division::FrameSize;

use super::{
    context::{Gpu, GpuError},
    quad::buffer,
};

/// Row 0 is the bottom row, and shaders read linear light. Each draw binds one filter.
pub(crate) struct FrameTexture {
    pub(super) size: FrameSize,
    cut: Cut,
    texture: wgpu::Texture,
    pub(super) bilinear: wgpu::BindGroup,
    /// The same image where pixels and samples coincide, as on a resting wall after refinement; on a software adapter in
    /// two thirds of the time.
    pub(super) nearest: wgpu::BindGroup,
}

/// The layouts of a frame's bind groups, and its samplers.
pub(super) struct FrameLayouts {
    whole: wgpu::BindGroupLayout,
    in_pieces: wgpu::BindGroupLayout,
    /// Bilinear and nearest.
    samplers: [wgpu::Sampler; 2],
}

/// How a frame is cut into pieces of one size, the layers of a texture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Cut {
    /// Columns and rows of pieces.
    n_pieces: [u32; 2],
    /// Columns and rows of samples of each piece.
    piece_size: [u32; 2],
}

/// Matches `Pieces` in `shaders/frame_pieces.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct PiecesRecord {
    frame_size: [f32; 2],
    n_pieces: [f32; 2],
}

/// Matches `SHARED_SAMPLES` in `shaders/frame_pieces.wgsl`.
const SHARED_SAMPLES: u32 = 2;

impl FrameLayouts {
    /// Each stage's source with the way to read a frame: whole, and in pieces.
    pub(super) fn sources(stage: &str) -> [String; 2] {
        [include_str!("../../../shaders/frame.wgsl"), include_str!("../../../shaders/frame_pieces.wgsl")]
            .map(|frame| format!("{frame}\n{stage}"))
    }

    pub(super) fn new(gpu: &Gpu) -> Self {
        let layout = |view_dimension, has_pieces: bool| {
            let texture = wgpu::BindingType::Texture {
                sample_type: wgpu::TextureSampleType::Float { filterable: true },
                view_dimension,
                multisampled: false,
            };
            let sampler = wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Filtering);
            let pieces = wgpu::BindingType::Buffer {
                ty: wgpu::BufferBindingType::Uniform,
                has_dynamic_offset: false,
                min_binding_size: None,
            };
            let entries: Vec<_> = (0..)
                .zip([texture, sampler, pieces])
                .take(if has_pieces { 3 } else { 2 })
                .map(|(binding, ty)| wgpu::BindGroupLayoutEntry {
                    binding,
                    visibility: wgpu::ShaderStages::FRAGMENT,
                    ty,
                    count: None,
                })
                .collect();
            gpu.device
                .create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some("frame"), entries: &entries })
        };
        let sampler = |filter| {
            gpu.device.create_sampler(&wgpu::SamplerDescriptor {
                label: Some("frame"),
                mag_filter: filter,
                min_filter: filter,
                ..Default::default()
            })
        };
        Self {
            whole: layout(wgpu::TextureViewDimension::D2, false),
            in_pieces: layout(wgpu::TextureViewDimension::D2Array, true),
            samplers: [sampler(wgpu::FilterMode::Linear), sampler(wgpu::FilterMode::Nearest)],
        }
    }

    /// The layout of each of [`FrameLayouts::sources`].
    pub(super) fn both(&self) -> [&wgpu::BindGroupLayout; 2] {
        [&self.whole, &self.in_pieces]
    }
}

impl FrameTexture {
    /// A texture for frames of a size, without samples yet.
    pub(super) fn new(gpu: &Gpu, layouts: &FrameLayouts, size: FrameSize) -> Result<Self, GpuError> {
        let (xres, yres) = size.into();
        let limits = gpu.device.limits();
        let cut = Cut::new([xres, yres], limits.max_texture_dimension_2d, limits.max_texture_array_layers)
            .ok_or_else(|| gpu.too_large("a frame", [xres, yres]))?;
        // Loads from sRGB give linear light, in which the wall is filtered and blended.
        let usage = wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST;
        let format = wgpu::TextureFormat::Rgba8UnormSrgb;
        let (texture, view) = gpu.layered_texture("frame", cut.piece_size, cut.n_layers(), format, usage);
        let record = PiecesRecord {
            frame_size: [xres, yres].map(|side| side as f32),
            n_pieces: cut.n_pieces.map(|count| count as f32),
        };
        let pieces = cut.is_cut().then(|| buffer(gpu, wgpu::BufferUsages::UNIFORM, &[record]));
        let [bilinear, nearest] = layouts.samplers.each_ref().map(|sampler| {
            let mut resources =
                vec![wgpu::BindingResource::TextureView(&view), wgpu::BindingResource::Sampler(sampler)];
            resources.extend(pieces.as_ref().map(wgpu::Buffer::as_entire_binding));
            let entries: Vec<_> =
                (0..).zip(resources).map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource }).collect();
            gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
                label: Some("frame"),
                layout: layouts.both()[usize::from(cut.is_cut())],
                entries: &entries,
            })
        });
        Ok(Self { size, cut, texture, bilinear, nearest })
    }

    /// Copies all samples, four bytes each; they reach the GPU with the next submission.
    pub(super) fn write(&self, gpu: &Gpu, rgba: &[u8]) {
        let (xres, yres) = self.size.into();
        for layer in 0..self.cut.n_layers() {
            let ([x, y], [width, height]) = self.cut.piece(layer, [xres, yres]);
            let destination = wgpu::TexelCopyTextureInfo {
                origin: wgpu::Origin3d { x: 0, y: 0, z: layer },
                ..self.texture.as_image_copy()
            };
            let layout = wgpu::TexelCopyBufferLayout {
                offset: 4 * (u64::from(y) * u64::from(xres) + u64::from(x)),
                bytes_per_row: Some(4 * xres),
                rows_per_image: None,
            };
            let extent = wgpu::Extent3d { width, height, depth_or_array_layers: 1 };
            gpu.queue.write_texture(destination, rgba, layout, extent);
        }
    }

    /// Whether shaders read it in pieces.
    pub(super) fn is_cut(&self) -> bool {
        self.cut.is_cut()
    }
}

impl Cut {
    /// For a frame of this size, where textures have at most `largest` texels a side and `most_layers` layers; `None` if
    /// these are too few.
    fn new(frame: [u32; 2], largest: u32, most_layers: u32) -> Option<Self> {
        // Small pieces waste little memory beyond the frame's edges.
        [4, 2, 1].into_iter().map(|part| Self::into_pieces(frame, largest, largest / part)).find(|cut| {
            let [across, up] = cut.n_pieces;
            across.saturating_mul(up) <= most_layers
        })
    }

    fn into_pieces(frame: [u32; 2], largest: u32, most_a_side: u32) -> Self {
        // Powers of two keep the bits of the filter's weights: see the shader.
        let side = 1 << most_a_side.max(2 * SHARED_SAMPLES).ilog2();
        let along = |n_samples: u32| match n_samples <= largest {
            true => (1, n_samples),
            false => ((n_samples - SHARED_SAMPLES).div_ceil(side - SHARED_SAMPLES), side),
        };
        let [(across, width), (up, height)] = frame.map(along);
        Self { n_pieces: [across, up], piece_size: [width, height] }
    }

    fn n_layers(self) -> u32 {
        self.n_pieces[0] * self.n_pieces[1]
    }

    fn is_cut(self) -> bool {
        self.n_layers() > 1
    }

    /// The first column and row of a layer's samples in a frame, and their numbers.
    fn piece(self, layer: u32, frame: [u32; 2]) -> ([u32; 2], [u32; 2]) {
        let index = [layer % self.n_pieces[0], layer / self.n_pieces[0]];
        let along = |axis: usize| {
            let first = index[axis] * self.piece_size[axis].saturating_sub(SHARED_SAMPLES);
            (first, self.piece_size[axis].min(frame[axis] - first))
        };
        let [(x, width), (y, height)] = [along(0), along(1)];
        ([x, y], [width, height])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_cover_every_frame_and_share_samples() {
        for frame in [[1, 1], [16_384, 4096], [16_385, 2], [38_400, 2160], [65_536, 4096], [4096, 65_536]] {
            for largest in [2048, 8192, 16_384, 32_768] {
                let cut = Cut::new(frame, largest, 256).unwrap();
                assert_eq!(cut.is_cut(), frame.iter().any(|&side| side > largest));
                assert!(cut.piece_size.iter().all(|&side| side <= largest), "{cut:?}");
                let mut end = [0, 0];
                for layer in 0..cut.n_layers() {
                    let (first, size) = cut.piece(layer, frame);
                    for axis in 0..2 {
                        assert!(first[axis] == 0 || first[axis] + SHARED_SAMPLES <= end[axis], "{cut:?}");
                        end[axis] = end[axis].max(first[axis] + size[axis]);
                    }
                }
                assert_eq!(end, frame);
            }
        }
    }

    #[test]
    fn a_cut_frame_takes_little_more_memory() {
        let cut = Cut::new([38_400, 2160], 16_384, 256).unwrap();
        assert_eq!((cut.n_pieces, cut.piece_size), ([10, 1], [4096, 2160]));
    }
}
