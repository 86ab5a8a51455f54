//! The window's pixels: the wall, and the overlay over it.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use egui_wgpu::ScreenDescriptor;
use winit::{event::WindowEvent, window::Window};

use crate::{
    alignment,
    farm::Frame,
    gpu::{Gpu, GpuError, Offscreen, Picture, Present, WallSurface},
    overlay::{self, OverlayModel, OverlayOutput},
    stats::DisplayStats,
    wall::Wall,
};

/// A window, and all that draws on it.
pub(super) struct Screen {
    pub(super) window: Arc<Window>,
    gpu: Gpu,
    surface: WallSurface,
    present: Present,
    /// What is shown instead of frames, and the wall to show it with.
    pattern: Option<(Present, Wall)>,
    egui: egui_winit::State,
    egui_renderer: egui_wgpu::Renderer,
    /// What egui has not yet been able to hand to the GPU.
    textures: egui::TexturesDelta,
}

/// What came of drawing once.
pub(super) struct Drawn {
    /// Where the time went; without latency, which the caller knows.
    pub(super) stats: DisplayStats,
    /// What came of the overlay.
    pub(super) overlay: OverlayOutput,
    /// When the overlay wants to be drawn again by itself.
    pub(super) repaint_after: Duration,
}

impl Screen {
    pub(super) fn new(window: Window) -> Result<Self, GpuError> {
        let window = Arc::new(window);
        let size = window.inner_size();
        let (gpu, surface) = WallSurface::new(Arc::clone(&window), [size.width, size.height])?;
        tracing::info!("drawing with {}", gpu.name());
        let present = Present::new(&gpu);
        let context = egui::Context::default();
        overlay::apply_style(&context);
        let largest_texture = gpu.device.limits().max_texture_dimension_2d as usize;
        let egui = egui_winit::State::new(context, egui::ViewportId::ROOT, &window, None, None, Some(largest_texture));
        let egui_renderer = egui_wgpu::Renderer::new(&gpu.device, surface.overlay_format(), Default::default());
        Ok(Self {
            window,
            gpu,
            surface,
            present,
            pattern: None,
            egui,
            egui_renderer,
            textures: egui::TexturesDelta::default(),
        })
    }

    /// Columns and rows of the window.
    pub(super) fn size(&self) -> [u32; 2] {
        self.surface.size()
    }

    pub(super) fn resize(&mut self, size: [u32; 2]) {
        self.surface.resize(size);
    }

    /// Physical pixels per point of the overlay.
    pub(super) fn pixels_per_point(&self) -> f32 {
        egui_winit::pixels_per_point(self.egui.egui_ctx(), &self.window)
    }

    /// Lets the overlay see an event.
    pub(super) fn overlay_event(&mut self, event: &WindowEvent) {
        // Which events are the overlay's is decided by where it is on screen.
        let _ = self.egui.on_window_event(&self.window, event);
    }

    /// Shows the wall with `new_frame`, or with the frame before, and the overlay over it.
    ///
    /// `None`: there is nothing to draw on now, and `new_frame` is still to be shown.
    pub(super) fn draw(
        &mut self,
        wall: &Wall,
        new_frame: Option<&Frame>,
        model: &OverlayModel,
    ) -> Result<Option<Drawn>, GpuError> {
        let Some(target) = self.surface.acquire(&self.gpu)? else { return Ok(None) };
        let mut stats = DisplayStats::default();
        if let Some(frame) = new_frame {
            let start = Instant::now();
            self.present.upload(&self.gpu, frame.picture.size, bytemuck::cast_slice(&frame.rgba))?;
            stats.upload_ms = ms_since(start);
        }
        let start = Instant::now();
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        let (present, wall) = match &mut self.pattern {
            Some((present, wall)) => (present, &*wall),
            None => (&mut self.present, wall),
        };
        present.draw(&self.gpu, &mut encoder, &target.target(), wall, wall.whole_output());
        let (overlay, repaint_after) = if model.is_visible() {
            self.draw_overlay(&mut encoder, target.overlay_view(), target.size(), model)
        } else {
            (OverlayOutput::default(), Duration::MAX)
        };
        self.gpu.queue.submit([encoder.finish()]);
        stats.draw_ms = self.present.draw_ms(&self.gpu).unwrap_or_else(|| ms_since(start));
        let start = Instant::now();
        self.window.pre_present_notify();
        target.present(&self.gpu);
        stats.present_ms = ms_since(start);
        self.gpu.check()?;
        Ok(Some(Drawn { stats, overlay, repaint_after }))
    }

    /// The newest frame on the whole wall, without overlay, whatever the window's size.
    pub(super) fn picture(&mut self, wall: &Wall) -> Result<Picture, GpuError> {
        let offscreen = Offscreen::new(&self.gpu, wall.output_size())?;
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        self.present.draw(&self.gpu, &mut encoder, &offscreen.target(), wall, wall.whole_output());
        self.gpu.queue.submit([encoder.finish()]);
        offscreen.read(&self.gpu)
    }

    /// Shows a test pattern from now on, or frames again.
    pub(super) fn show_pattern(&mut self, pattern: Option<alignment::Shown>) -> Result<(), GpuError> {
        let Some(alignment::Shown { size, rgba, wall }) = pattern else {
            self.pattern = None;
            return Ok(());
        };
        let mut present = self.pattern.take().map_or_else(|| Present::new(&self.gpu), |(present, _)| present);
        present.upload(&self.gpu, size, &rgba)?;
        self.pattern = Some((present, wall));
        Ok(())
    }

    fn draw_overlay(
        &mut self,
        encoder: &mut wgpu::CommandEncoder,
        view: &wgpu::TextureView,
        size: [u32; 2],
        model: &OverlayModel,
    ) -> (OverlayOutput, Duration) {
        let context = self.egui.egui_ctx().clone();
        context.set_zoom_factor(overlay::zoom(size, self.window.scale_factor()));
        let input = self.egui.take_egui_input(&self.window);
        let mut output = OverlayOutput::default();
        let full = context.run_ui(input, |ui| output = overlay::show(ui, model));
        let repaint_after =
            full.viewport_output.get(&egui::ViewportId::ROOT).map_or(Duration::MAX, |viewport| viewport.repaint_delay);
        self.egui.handle_platform_output(&self.window, full.platform_output);
        self.textures.append(full.textures_delta);
        let (device, queue) = (&self.gpu.device, &self.gpu.queue);
        for (id, deltas) in self.textures.set.drain() {
            for delta in &deltas {
                self.egui_renderer.update_texture(device, queue, id, delta);
            }
        }
        let triangles = context.tessellate(full.shapes, full.pixels_per_point);
        let descriptor = ScreenDescriptor { size_in_pixels: size, pixels_per_point: full.pixels_per_point };
        // Only paint callbacks make command buffers of their own, and the overlay has none.
        self.egui_renderer.update_buffers(device, queue, encoder, &triangles, &descriptor);
        let pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("overlay"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Load, store: wgpu::StoreOp::Store },
            })],
            ..Default::default()
        });
        self.egui_renderer.render(&mut pass.forget_lifetime(), &triangles, &descriptor);
        for id in self.textures.free.drain() {
            self.egui_renderer.free_texture(&id);
        }
        (output, repaint_after)
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        // What was never shown needs no upload; egui would take it for a mistake.
        self.textures.clear();
    }
}

fn ms_since(start: Instant) -> f64 {
    start.elapsed().as_secs_f64() * 1e3
}
