//! One window: its surface, and the overlay on it.

use std::{sync::Arc, time::Duration};

use egui_wgpu::ScreenDescriptor;
use winit::window::Window;

use super::painter::Painter;
use crate::{
    gpu::{GpuError, SurfaceFrame, WallSurface},
    overlay::{self, OverlayModel, OverlayOutput},
};

pub(super) struct Screen {
    pub(super) window: Arc<Window>,
    pub(super) surface: WallSurface,
    pub(super) egui: egui_winit::State,
    egui_renderer: egui_wgpu::Renderer,
    /// Changes of egui's textures that are not on the GPU yet.
    textures: egui::TexturesDelta,
}

impl Screen {
    /// Prepares a window for drawing; a wall's first window creates the `painter`.
    pub(super) fn new(window: Window, painter: &mut Option<Painter>) -> Result<Self, GpuError> {
        let window = Arc::new(window);
        let size = window.inner_size().into();
        let surface = match painter {
            Some(painter) => WallSurface::new(&painter.gpu, Arc::clone(&window), size)?,
            None => {
                let (gpu, surface) = WallSurface::first(Arc::clone(&window), size)?;
                *painter = Some(Painter::new(gpu));
                surface
            }
        };
        let device = &painter.as_ref().expect("created above if it was missing").gpu.device;
        let context = egui::Context::default();
        overlay::apply_style(&context);
        let largest_texture = device.limits().max_texture_dimension_2d as usize;
        let mut egui =
            egui_winit::State::new(context, egui::ViewportId::ROOT, &window, None, None, Some(largest_texture));
        // Keys come only while one of the windows has the focus, whichever it is.
        egui.egui_input_mut().focused = true;
        let egui_renderer = egui_wgpu::Renderer::new(device, surface.overlay_format, Default::default());
        Ok(Self { window, surface, egui, egui_renderer, textures: egui::TexturesDelta::default() })
    }

    /// The scale of the overlay, 1 by default.
    fn zoom(&self) -> f32 {
        overlay::zoom(self.surface.size(), self.window.scale_factor())
    }

    /// Physical pixels per point of the overlay when it is drawn next.
    pub(super) fn pixels_per_point(&self) -> f32 {
        self.zoom() * self.window.scale_factor() as f32
    }

    /// Draws the overlay over the wall. Also returns after which time it wants to be drawn again.
    pub(super) fn draw_overlay(
        &mut self,
        painter: &Painter,
        encoder: &mut wgpu::CommandEncoder,
        target: &SurfaceFrame,
        mut model: OverlayModel,
    ) -> (OverlayOutput, Duration) {
        let context = self.egui.egui_ctx().clone();
        context.set_zoom_factor(self.zoom());
        let input = self.egui.take_egui_input(&self.window);
        let mut output = OverlayOutput::default();
        // egui may run twice; only the first time sees clicks and keys.
        let full = context.run_ui(input, |ui| {
            let mut shown = overlay::show(ui, &model);
            shown.commands.splice(..0, std::mem::take(&mut output.commands));
            if let (Some(draft), Some((label, text))) = (&mut model.draft, &shown.draft) {
                (draft.label, draft.text) = (label.clone(), text.clone());
            }
            shown.draft = shown.draft.or(output.draft.take());
            output = shown;
        });
        let repaint_after =
            full.viewport_output.get(&egui::ViewportId::ROOT).map_or(Duration::MAX, |viewport| viewport.repaint_delay);
        self.egui.handle_platform_output(&self.window, full.platform_output);
        self.textures.append(full.textures_delta);
        let (device, queue) = (&painter.gpu.device, &painter.gpu.queue);
        for (id, deltas) in self.textures.set.drain() {
            for delta in &deltas {
                self.egui_renderer.update_texture(device, queue, id, delta);
            }
        }
        let triangles = context.tessellate(full.shapes, full.pixels_per_point);
        let descriptor = ScreenDescriptor { size_in_pixels: target.size, pixels_per_point: full.pixels_per_point };
        // Only paint callbacks return command buffers, and the overlay has none.
        self.egui_renderer.update_buffers(device, queue, encoder, &triangles, &descriptor);
        let pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("overlay"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &target.overlay_view,
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
        // Changes that were never drawn need no upload, and egui reports dropped ones as a mistake.
        self.textures.clear();
    }
}
