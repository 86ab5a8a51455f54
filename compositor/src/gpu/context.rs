//! Finds a GPU and collects its errors.

use std::sync::{Arc, Mutex, PoisonError};

/// An adapter, its device and its queue.
pub struct Gpu {
    /// Creates resources.
    pub device: wgpu::Device,
    /// Takes submissions.
    pub queue: wgpu::Queue,
    /// The connection that the adapter came from; surfaces must come from it too.
    pub(super) instance: wgpu::Instance,
    /// The chosen adapter.
    pub adapter: wgpu::Adapter,
    problem: Arc<Mutex<Option<GpuError>>>,
}

/// Why the GPU cannot draw.
#[derive(Clone, Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum GpuError {
    #[error(
        "no graphics driver found (Vulkan, Metal or Direct3D 12): a machine without a graphics card needs a software driver, \
         install mesa-vulkan-drivers (Debian, Fedora) or vulkan-swrast (Arch)"
    )]
    NoDriver,
    #[error("none of the graphics drivers can draw on this window: {0}")]
    NoDriverForWindow(String),
    #[error("WGPU_ADAPTER_NAME={wanted} matches none of the graphics adapters found: {found}")]
    NoSuchAdapter { wanted: String, found: String },
    #[error("the graphics driver cannot open the device: {0}")]
    NoDevice(String),
    #[error("cannot draw on the window: {0}")]
    NoSurface(String),
    #[error(
        "{what} of {width}×{height} pixels is too large for {adapter}, which takes {limit} a side: make it smaller"
    )]
    TooLarge { what: &'static str, width: u32, height: u32, limit: u32, adapter: String },
    #[error("{n_bytes} bytes are no frame of {size} samples, 4 bytes each")]
    NotAFrame { n_bytes: usize, size: shared::division::FrameSize },
    // The driver failed, or the device was unplugged.
    #[error("the graphics device is lost: {0}: start again")]
    Lost(String),
    // Memory ran out, or the driver or this program made an error.
    #[error("the graphics device failed: {0}")]
    Failed(String),
}

impl Gpu {
    /// Connects to the system's drivers. `WGPU_BACKEND` chooses among Vulkan, Metal and Direct3D 12.
    pub fn instance() -> wgpu::Instance {
        wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle_from_env())
    }

    /// The best adapter, for work without a window.
    ///
    /// `WGPU_ADAPTER_NAME` chooses by a part of the name, `WGPU_POWER_PREF` (low, high) by power.
    pub fn headless() -> Result<Self, GpuError> {
        Self::headless_with_textures_of(u32::MAX)
    }

    /// The same, with textures of at most `largest` texels a side.
    pub fn headless_with_textures_of(largest: u32) -> Result<Self, GpuError> {
        pollster::block_on(Self::open(&Self::instance(), None, largest))
    }

    /// The best adapter that can draw on a surface, if there is one; chosen as in [`Gpu::headless`].
    pub(super) async fn open(
        instance: &wgpu::Instance,
        surface: Option<&wgpu::Surface<'_>>,
        largest_texture: u32,
    ) -> Result<Self, GpuError> {
        let adapter = choose_adapter(instance, surface).await?;
        let offered = adapter.limits();
        let required_limits = wgpu::Limits {
            max_buffer_size: offered.max_buffer_size,
            max_texture_dimension_2d: offered.max_texture_dimension_2d.min(largest_texture),
            ..wgpu::Limits::downlevel_defaults().using_resolution(offered)
        };
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("wall"),
            required_features: adapter.features() & wgpu::Features::TIMESTAMP_QUERY,
            required_limits,
            ..Default::default()
        };
        let (device, queue) =
            adapter.request_device(&descriptor).await.map_err(|error| GpuError::NoDevice(error.to_string()))?;

        let problem = Arc::new(Mutex::new(None));
        let failed = Arc::clone(&problem);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            keep_first(&failed, GpuError::Failed(one_line(&error.to_string())));
        }));
        let lost = Arc::clone(&problem);
        device.set_device_lost_callback(move |reason, message| {
            // A device that is dropped is reported as destroyed.
            if reason != wgpu::DeviceLostReason::Destroyed {
                keep_first(&lost, GpuError::Lost(one_line(&message)));
            }
        });
        Ok(Self { device, queue, instance: instance.clone(), adapter, problem })
    }

    /// The adapter's name and its interface, for example "llvmpipe (LLVM 15.0.6, 256 bits), vulkan".
    pub fn name(&self) -> String {
        let info = self.adapter.get_info();
        format!("{}, {}", info.name, info.backend)
    }

    /// The first failure of this GPU since the last call.
    ///
    /// wgpu reports failures later and elsewhere: check once a frame, and after work whose result counts.
    pub fn check(&self) -> Result<(), GpuError> {
        match self.problem.lock().unwrap_or_else(PoisonError::into_inner).take() {
            Some(problem) => Err(problem),
            None => Ok(()),
        }
    }

    /// Waits until the GPU has finished all submissions.
    pub fn wait(&self) -> Result<(), GpuError> {
        self.device
            .poll(wgpu::PollType::wait_indefinitely())
            .map_err(|error| GpuError::Failed(one_line(&error.to_string())))?;
        self.check()
    }

    /// A texture of plain pixels, and its view.
    pub(super) fn texture(
        &self,
        label: &str,
        size: [u32; 2],
        format: wgpu::TextureFormat,
        usage: wgpu::TextureUsages,
    ) -> (wgpu::Texture, wgpu::TextureView) {
        self.layered_texture(label, size, 1, format, usage)
    }

    /// The same of several layers; its view is an array if there is more than one.
    pub(super) fn layered_texture(
        &self,
        label: &str,
        [width, height]: [u32; 2],
        n_layers: u32,
        format: wgpu::TextureFormat,
        usage: wgpu::TextureUsages,
    ) -> (wgpu::Texture, wgpu::TextureView) {
        let texture = self.device.create_texture(&wgpu::TextureDescriptor {
            label: Some(label),
            size: wgpu::Extent3d { width, height, depth_or_array_layers: n_layers },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format,
            usage,
            view_formats: &[],
        });
        let view = texture.create_view(&Default::default());
        (texture, view)
    }

    /// Refuses images that no texture can hold.
    pub fn check_size(&self, what: &'static str, size: [u32; 2]) -> Result<(), GpuError> {
        let limit = self.device.limits().max_texture_dimension_2d;
        if size.iter().all(|&side| side <= limit) { Ok(()) } else { Err(self.too_large(what, size)) }
    }

    pub(super) fn too_large(&self, what: &'static str, [width, height]: [u32; 2]) -> GpuError {
        let limit = self.device.limits().max_texture_dimension_2d;
        GpuError::TooLarge { what, width, height, limit, adapter: self.adapter.get_info().name }
    }
}

fn keep_first(problem: &Mutex<Option<GpuError>>, error: GpuError) {
    let mut problem = problem.lock().unwrap_or_else(PoisonError::into_inner);
    if problem.is_some() {
        tracing::debug!("a further failure of the graphics device: {error}");
    } else {
        *problem = Some(error);
    }
}

async fn choose_adapter(
    instance: &wgpu::Instance,
    surface: Option<&wgpu::Surface<'_>>,
) -> Result<wgpu::Adapter, GpuError> {
    let named = std::env::var("WGPU_ADAPTER_NAME").ok().filter(|name| !name.is_empty());
    if let Some(wanted) = named {
        let adapters = instance.enumerate_adapters(wgpu::Backends::all()).await;
        let found: Vec<_> = adapters.iter().map(|adapter| adapter.get_info().name).collect();
        let usable = |adapter: &wgpu::Adapter| {
            adapter.get_info().name.to_lowercase().contains(&wanted.to_lowercase())
                && surface.is_none_or(|surface| adapter.is_surface_supported(surface))
        };
        return match adapters.into_iter().find(usable) {
            Some(adapter) => Ok(adapter),
            None if found.is_empty() => Err(GpuError::NoDriver),
            None => Err(GpuError::NoSuchAdapter { wanted, found: found.join("; ") }),
        };
    }
    let options = wgpu::RequestAdapterOptions {
        power_preference: wgpu::PowerPreference::from_env().unwrap_or(wgpu::PowerPreference::HighPerformance),
        compatible_surface: surface,
        ..Default::default()
    };
    match instance.request_adapter(&options).await {
        Ok(adapter) => Ok(adapter),
        Err(error) => {
            let any = instance.enumerate_adapters(wgpu::Backends::all()).await;
            if any.is_empty() { Err(GpuError::NoDriver) } else { Err(GpuError::NoDriverForWindow(error.to_string())) }
        }
    }
}

/// Joins the many lines of drivers' and validators' reports: a log line and an exit message have one.
fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}
