//! The lowest cost of scaling a frame to a wall: one triangle that samples one texture bilinearly, in the formats of the
//! wall's own drawing.

use compositor::gpu::{Gpu, GpuError, Offscreen};
use shared::division::FrameSize;
use wgpu::util::{DeviceExt, TextureDataOrder};

const SHADER: &str = "
@group(0) @binding(0) var frame: texture_2d<f32>;
@group(0) @binding(1) var bilinear: sampler;

struct Corner {
    @builtin(position) position: vec4f,
    @location(0) at: vec2f,
}

@vertex
fn vertex(@builtin(vertex_index) corner: u32) -> Corner {
    let at = vec2f(f32(corner & 1u), f32(corner >> 1u)) * 2.0;
    return Corner(vec4f(at * 2.0 - 1.0, 0.0, 1.0), at);
}

@fragment
fn fragment(corner: Corner) -> @location(0) vec4f {
    return textureSampleLevel(frame, bilinear, corner.at, 0.0);
}
";

pub(super) struct BareDraw {
    offscreen: Offscreen,
    pipeline: wgpu::RenderPipeline,
    frame: wgpu::BindGroup,
}

impl BareDraw {
    /// Samples as in [`compositor::gpu::Present::upload`].
    pub(super) fn new(gpu: &Gpu, wall: [u32; 2], size: FrameSize, rgba: &[u32]) -> Result<Self, GpuError> {
        let device = &gpu.device;
        let offscreen = Offscreen::new(gpu, wall)?;
        gpu.check_size("a frame", [size.xres(), size.yres()])?;
        let descriptor = wgpu::TextureDescriptor {
            label: Some("bare frame"),
            size: wgpu::Extent3d { width: size.xres(), height: size.yres(), depth_or_array_layers: 1 },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: wgpu::TextureFormat::Rgba8UnormSrgb,
            usage: wgpu::TextureUsages::TEXTURE_BINDING,
            view_formats: &[],
        };
        let (order, bytes) = (TextureDataOrder::LayerMajor, bytemuck::cast_slice(rgba));
        let texture = device.create_texture_with_data(&gpu.queue, &descriptor, order, bytes);
        let shader = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some("bare draw"),
            source: wgpu::ShaderSource::Wgsl(SHADER.into()),
        });
        let pipeline = device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some("bare draw"),
            layout: None,
            vertex: wgpu::VertexState {
                module: &shader,
                entry_point: Some("vertex"),
                compilation_options: Default::default(),
                buffers: &[],
            },
            primitive: Default::default(),
            depth_stencil: None,
            multisample: Default::default(),
            fragment: Some(wgpu::FragmentState {
                module: &shader,
                entry_point: Some("fragment"),
                compilation_options: Default::default(),
                targets: &[Some(offscreen.target().format.into())],
            }),
            multiview_mask: None,
            cache: None,
        });
        let bilinear = device.create_sampler(&wgpu::SamplerDescriptor {
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            ..Default::default()
        });
        let frame = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("bare frame"),
            layout: &pipeline.get_bind_group_layout(0),
            entries: &[
                wgpu::BindGroupEntry {
                    binding: 0,
                    resource: wgpu::BindingResource::TextureView(&texture.create_view(&Default::default())),
                },
                wgpu::BindGroupEntry { binding: 1, resource: wgpu::BindingResource::Sampler(&bilinear) },
            ],
        });
        gpu.check()?;
        Ok(Self { offscreen, pipeline, frame })
    }

    pub(super) fn draw(&self, gpu: &Gpu) -> Result<(), GpuError> {
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("bare draw"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: self.offscreen.target().view,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::BLACK), store: wgpu::StoreOp::Store },
            })],
            ..Default::default()
        });
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &self.frame, &[]);
        pass.draw(0..3, 0..1);
        drop(pass);
        gpu.queue.submit([encoder.finish()]);
        gpu.wait()
    }

    #[cfg(test)]
    pub(super) fn read(&self, gpu: &Gpu) -> Result<compositor::gpu::RgbImage, GpuError> {
        self.offscreen.read(gpu)
    }
}
