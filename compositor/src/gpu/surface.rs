//! The window as a target: the wall in its sRGB view, the overlay in its plain view.

use super::{
    context::{Gpu, GpuError},
    quad::Target,
};

/// A window's swapchain; it follows the window's size, and is created again when it is lost.
pub(crate) struct WallSurface {
    surface: wgpu::Surface<'static>,
    /// Creates the surface again after a loss.
    create: Create,
    config: wgpu::SurfaceConfiguration,
    wall_format: wgpu::TextureFormat,
    /// The format of [`SurfaceFrame::overlay_view`], for egui's renderer.
    pub(crate) overlay_format: wgpu::TextureFormat,
    /// Whether the swapchain has the size and state of `config`.
    is_configured: bool,
}

type Create = Box<dyn Fn() -> Result<wgpu::Surface<'static>, wgpu::CreateSurfaceError>>;

/// The image that the window shows next.
pub(crate) struct SurfaceFrame {
    /// To be presented once its draws are submitted.
    pub(crate) texture: wgpu::SurfaceTexture,
    wall_view: wgpu::TextureView,
    wall_format: wgpu::TextureFormat,
    /// For the overlay, which is drawn over the wall in encoded values.
    pub(crate) overlay_view: wgpu::TextureView,
    /// Columns and rows.
    pub(crate) size: [u32; 2],
}

impl WallSurface {
    /// A surface on the first `window`, for example an `Arc<Window>`, of `size` pixels; and the GPU that can draw on it.
    pub(crate) fn first<W>(window: W, size: [u32; 2]) -> Result<(Gpu, Self), GpuError>
    where
        W: Into<wgpu::SurfaceTarget<'static>> + Clone + 'static,
    {
        let instance = Gpu::instance();
        let create = creating(instance.clone(), window);
        let surface = create().map_err(|error| {
            // Without any driver, creating a surface fails already.
            let adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::all()));
            if adapters.is_empty() { GpuError::NoDriver } else { no_surface(&error) }
        })?;
        let gpu = pollster::block_on(Gpu::open(&instance, Some(&surface), u32::MAX))?;
        let surface = Self::configured(&gpu, surface, create, size)?;
        Ok((gpu, surface))
    }

    /// A surface on one more window, for the GPU that draws on the first.
    pub(crate) fn new<W>(gpu: &Gpu, window: W, size: [u32; 2]) -> Result<Self, GpuError>
    where
        W: Into<wgpu::SurfaceTarget<'static>> + Clone + 'static,
    {
        let create = creating(gpu.instance.clone(), window);
        let surface = create().map_err(|error| no_surface(&error))?;
        Self::configured(gpu, surface, create, size)
    }

    fn configured(
        gpu: &Gpu,
        surface: wgpu::Surface<'static>,
        create: Create,
        size: [u32; 2],
    ) -> Result<Self, GpuError> {
        let capabilities = surface.get_capabilities(&gpu.adapter);
        let is_plain_8_bit = |format: &&wgpu::TextureFormat| {
            matches!(format, wgpu::TextureFormat::Bgra8Unorm | wgpu::TextureFormat::Rgba8Unorm)
        };
        let Some(&format) = capabilities.formats.iter().find(is_plain_8_bit).or(capabilities.formats.first()) else {
            return Err(GpuError::NoSurface(format!("{} offers no format for it", gpu.name())));
        };
        let downlevel = gpu.adapter.get_downlevel_capabilities().flags;
        let has_views = downlevel.contains(wgpu::DownlevelFlags::SURFACE_VIEW_FORMATS);
        let [wall_format, overlay_format] =
            if has_views { [format.add_srgb_suffix(), format.remove_srgb_suffix()] } else { [format; 2] };
        let mut view_formats = vec![wall_format, overlay_format];
        view_formats.retain(|&view_format| view_format != format);

        // Mailbox shows the newest image without tearing, and the wall does not wait for the display.
        let present_mode = if capabilities.present_modes.contains(&wgpu::PresentMode::Mailbox) {
            wgpu::PresentMode::Mailbox
        } else {
            wgpu::PresentMode::Fifo
        };
        let config = wgpu::SurfaceConfiguration {
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT,
            format,
            color_space: wgpu::SurfaceColorSpace::Auto,
            width: size[0],
            height: size[1],
            present_mode,
            // A queued image is a late image.
            desired_maximum_frame_latency: 1,
            alpha_mode: wgpu::CompositeAlphaMode::Auto,
            view_formats,
        };
        gpu.check_size("a window", size)?;
        Ok(Self { surface, create, config, wall_format, overlay_format, is_configured: false })
    }

    /// Columns and rows of the next image.
    pub(crate) fn size(&self) -> [u32; 2] {
        [self.config.width, self.config.height]
    }

    /// Takes the window's new size; the swapchain follows with the next [`WallSurface::acquire`].
    pub(crate) fn resize(&mut self, size: [u32; 2]) {
        if size != self.size() {
            [self.config.width, self.config.height] = size;
            self.is_configured = false;
        }
    }

    /// The next image to draw on; `None` while the window is empty or hidden, or the display is late: ask again with the
    /// next event. An error if the window is larger than the GPU's textures, or the device or the window is gone.
    pub(crate) fn acquire(&mut self, gpu: &Gpu) -> Result<Option<SurfaceFrame>, GpuError> {
        if self.size().contains(&0) {
            return Ok(None);
        }
        gpu.check_size("a window", self.size())?;
        // Try a second time with a fresh swapchain; after that, wait for the next event.
        for _ in 0..2 {
            if !self.is_configured {
                self.surface.configure(&gpu.device, &self.config);
                gpu.check()?;
                self.is_configured = true;
            }
            match self.surface.get_current_texture() {
                wgpu::CurrentSurfaceTexture::Success(texture) => return Ok(Some(self.frame(texture))),
                wgpu::CurrentSurfaceTexture::Suboptimal(texture) => {
                    self.is_configured = false;
                    return Ok(Some(self.frame(texture)));
                }
                wgpu::CurrentSurfaceTexture::Timeout | wgpu::CurrentSurfaceTexture::Occluded => return Ok(None),
                wgpu::CurrentSurfaceTexture::Outdated => self.is_configured = false,
                wgpu::CurrentSurfaceTexture::Lost => {
                    gpu.check()?;
                    self.surface = (self.create)().map_err(|error| no_surface(&error))?;
                    self.is_configured = false;
                }
                wgpu::CurrentSurfaceTexture::Validation => {
                    self.is_configured = false;
                    gpu.check()?;
                }
            }
        }
        Ok(None)
    }

    fn frame(&self, texture: wgpu::SurfaceTexture) -> SurfaceFrame {
        let view = |format| {
            texture.texture.create_view(&wgpu::TextureViewDescriptor { format: Some(format), ..Default::default() })
        };
        let [wall_view, overlay_view] = [self.wall_format, self.overlay_format].map(view);
        let size = [texture.texture.width(), texture.texture.height()];
        SurfaceFrame { texture, wall_view, wall_format: self.wall_format, overlay_view, size }
    }
}

impl SurfaceFrame {
    /// The target for [`super::Present::draw`].
    pub(crate) fn target(&self) -> Target<'_> {
        Target { view: &self.wall_view, format: self.wall_format, size: self.size }
    }
}

fn creating<W>(instance: wgpu::Instance, window: W) -> Create
where
    W: Into<wgpu::SurfaceTarget<'static>> + Clone + 'static,
{
    Box::new(move || instance.create_surface(window.clone()))
}

fn no_surface(error: &wgpu::CreateSurfaceError) -> GpuError {
    GpuError::NoSurface(error.to_string())
}
