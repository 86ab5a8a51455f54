//! The outputs of a wall: a window on each monitor that it names, or one window that spans all of it.

use std::time::{Duration, Instant};

use anyhow::Context;
use glam::DVec2;
use winit::{
    dpi::{PhysicalPosition, PhysicalSize},
    event::WindowEvent,
    event_loop::ActiveEventLoop,
    monitor::MonitorHandle,
    window::{Fullscreen, Window, WindowId},
};

use super::{ms_since, painter::Painter, screen::Screen, session::hotplug};
use crate::{
    farm::{Frame, stats::DisplayStats},
    gpu::GpuError,
    overlay::{OutputContent, OutputState, OverlayModel, OverlayOutput, ProjectorRegion},
    wall::{PixelRect, Projector, Wall},
};

/// Monitors that come and go are noticed after this.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// All windows of a wall, and what draws on them.
///
/// A wall that names no outputs has one, whose window is any on the desktop.
pub(super) struct Outputs {
    all: Vec<Output>,
    /// Made with the first window, and kept when all are gone.
    painter: Option<Painter>,
    /// Whether windows fill their monitors.
    is_filling: bool,
    title: String,
    cursor_is_visible: bool,
    checked_at: Option<Instant>,
}

/// A part of the wall, and the window that shows it.
struct Output {
    /// The name of its monitor; `None` for a window that may be anywhere.
    monitor: Option<String>,
    /// Its pixels, of those of the output that spans all projectors.
    part: PixelRect,
    /// Closed while its monitor is away.
    screen: Option<Screen>,
    /// The monitor's place on the desktop at the last look.
    geometry: Option<Geometry>,
    /// Whether its monitor was there at the last look.
    is_there: bool,
    shows: OutputContent,
}

type Geometry = (PhysicalPosition<i32>, PhysicalSize<u32>);

/// What came of drawing once.
pub(super) struct DrawResult {
    /// Where the time went; without latency, which the caller knows.
    pub(super) stats: DisplayStats,
    /// What came of the overlay.
    pub(super) overlay: OverlayOutput,
    /// When the overlay wants to be drawn again by itself.
    pub(super) repaint_after: Duration,
    /// On which monitors, if the wall names them.
    pub(super) monitors: Vec<String>,
    /// Whether a window that has room for it could not be drawn on now.
    pub(super) is_incomplete: bool,
}

impl Outputs {
    /// The outputs of a wall, still without windows; walls that name monitors fill them.
    pub(super) fn new(wall: &Wall, is_filling: bool) -> Self {
        let output = |monitor, part| Output {
            monitor,
            part,
            screen: None,
            geometry: None,
            is_there: false,
            shows: OutputContent::Nothing,
        };
        let mut all: Vec<Output> =
            wall.monitors().into_iter().map(|(name, part)| output(Some(name.to_owned()), part)).collect();
        let is_filling = is_filling || !all.is_empty();
        if all.is_empty() {
            all.push(output(None, wall.whole_output()));
        }
        Self { all, painter: None, is_filling, title: "Raywall".to_owned(), cursor_is_visible: true, checked_at: None }
    }

    /// Opens windows on monitors that are there, closes those of monitors that are gone, and says whether any did.
    pub(super) fn follow_monitors(&mut self, event_loop: &ActiveEventLoop) -> anyhow::Result<bool> {
        let is_first = self.checked_at.replace(Instant::now()).is_none();
        if is_first && self.names_monitors() {
            hotplug::listen(event_loop);
        }
        let monitors: Vec<MonitorHandle> = event_loop.available_monitors().collect();
        let named = |name: &str| monitors.iter().find(|monitor| monitor.name().is_some_and(|it| it == name));
        let mut has_changed = false;
        for index in 0..self.all.len() {
            let output = &mut self.all[index];
            let monitor = output.monitor.as_deref().and_then(named);
            let is_there = monitor.is_some() || output.monitor.is_none();
            let geometry = monitor.map(|monitor| (monitor.position(), monitor.size()));
            let is_settled = is_first || (output.is_there, output.geometry) == (is_there, geometry);
            (output.is_there, output.geometry) = (is_there, geometry);
            if !is_settled && output.screen.take().is_some() {
                tracing::warn!("the monitor {} is gone or has changed", output.name());
                output.shows = OutputContent::Nothing;
                has_changed = true;
            }
            if is_first && !is_there {
                let connected = monitors.iter().filter_map(MonitorHandle::name).collect::<Vec<_>>().join(", ");
                tracing::warn!(
                    "there is no monitor {} now, only: {connected}; its part of the wall is shown when it comes \
                     (monitors that xrandr --setmonitor makes of others are not seen: name outputs, as xrandr lists \
                     them); --spanning shows the whole wall in one window",
                    output.name()
                );
            }
            // One that has just come is left to the window manager until the next look.
            if is_there && is_settled && self.all[index].screen.is_none() {
                match self.open(index, event_loop, monitor) {
                    Ok(screen) => self.all[index].screen = Some(screen),
                    // Without any window there is nothing to go on with.
                    Err(error) if self.painter.is_none() => return Err(error),
                    Err(error) => tracing::warn!("no window on {}: {error:#}", self.all[index].name()),
                }
                has_changed = true;
            }
        }
        Ok(has_changed)
    }

    /// The longest side that a frame can have, once there has been a window.
    pub(super) fn largest_frame_side(&self) -> Option<u32> {
        self.painter.as_ref().map(|painter| painter.gpu.device.limits().max_texture_dimension_2d)
    }

    /// The time between two refreshes of the fastest monitor that shows a part of the wall, if any says.
    pub(super) fn refresh_interval(&self) -> Option<Duration> {
        let monitors = self.all.iter().filter_map(|output| output.screen.as_ref()?.window.current_monitor());
        let fastest_mhz = monitors.filter_map(|monitor| monitor.refresh_rate_millihertz()).max()?;
        (fastest_mhz > 0).then(|| Duration::from_secs_f64(1e3 / f64::from(fastest_mhz)))
    }

    /// When to look at the monitors again: never for a window that may be anywhere.
    pub(super) fn next_check_at(&self) -> Option<Instant> {
        self.checked_at.filter(|_| self.names_monitors()).map(|checked_at| checked_at + CHECK_INTERVAL)
    }

    fn names_monitors(&self) -> bool {
        self.all.iter().any(|output| output.monitor.is_some())
    }

    fn open(
        &mut self,
        index: usize,
        event_loop: &ActiveEventLoop,
        monitor: Option<&MonitorHandle>,
    ) -> anyhow::Result<Screen> {
        let PixelRect { width, height, .. } = self.all[index].part;
        let any = || event_loop.primary_monitor().or_else(|| event_loop.available_monitors().next());
        // A window that leaves room for the desktop around it, for when it does not fill its monitor.
        let room = monitor.cloned().or_else(any).map_or([1280, 720], |monitor| {
            let PhysicalSize { width, height } = monitor.size();
            [width / 5 * 4, height / 5 * 4]
        });
        let fitted = PixelRect::fitted([width, height], [room[0].min(width), room[1].min(height)]);
        let mut attributes = Window::default_attributes()
            .with_title(self.title_of(index))
            .with_inner_size(PhysicalSize::new(fitted.width, fitted.height))
            .with_min_inner_size(PhysicalSize::new(320, 180))
            .with_fullscreen(self.is_filling.then(|| Fullscreen::Borderless(monitor.cloned())));
        if let Some(monitor) = monitor {
            attributes = attributes.with_position(monitor.position());
        }
        let window = event_loop.create_window(attributes).context("no window opens")?;
        window.set_cursor_visible(self.cursor_is_visible);
        if let Some(name) = &self.all[index].monitor {
            tracing::info!("the monitor {name} shows {width}×{height} pixels of the wall");
        }
        Ok(Screen::new(window, &mut self.painter)?)
    }

    /// The monitors that are named and show nothing.
    pub(super) fn missing(&self) -> Vec<String> {
        self.all.iter().filter(|output| output.screen.is_none()).filter_map(|output| output.monitor.clone()).collect()
    }

    /// The first window, which has the panels of the overlay.
    fn lead(&self) -> Option<(usize, &Screen)> {
        self.all.iter().enumerate().find_map(|(index, output)| Some((index, output.screen.as_ref()?)))
    }

    /// Which output an event is about.
    pub(super) fn index_of(&self, id: WindowId) -> Option<usize> {
        self.all.iter().position(|output| output.screen.as_ref().is_some_and(|screen| screen.window.id() == id))
    }

    pub(super) fn resize(&mut self, index: usize, size: [u32; 2]) {
        if let Some(screen) = &mut self.all[index].screen {
            screen.resize(size);
        }
    }

    /// A point of a window, in pixels of the output that spans all projectors.
    pub(super) fn on_wall(&self, index: usize, PhysicalPosition { x, y }: PhysicalPosition<f64>) -> DVec2 {
        let Some(Output { part, screen: Some(screen), .. }) = self.all.get(index) else { return DVec2::ZERO };
        let fitted = PixelRect::fitted([part.width, part.height], screen.size());
        let from_fitted = DVec2::new(x - f64::from(fitted.x), y - f64::from(fitted.y));
        let scale = DVec2::new(
            f64::from(part.width) / f64::from(fitted.width.max(1)),
            f64::from(part.height) / f64::from(fitted.height.max(1)),
        );
        DVec2::new(f64::from(part.x), f64::from(part.y)) + from_fitted * scale
    }

    /// A point of a window in points of the overlay, if the overlay's panels are in that window.
    pub(super) fn on_overlay(&self, index: usize, at: PhysicalPosition<f64>) -> Option<egui::Pos2> {
        let (_, screen) = self.lead().filter(|(lead, _)| *lead == index)?;
        let scale = f64::from(screen.pixels_per_point());
        Some(egui::pos2((at.x / scale) as f32, (at.y / scale) as f32))
    }

    /// Lets the overlay see an event of a window, if it is the overlay's.
    pub(super) fn forward_to_overlay(&mut self, index: usize, event: &WindowEvent) {
        let is_lead = self.lead().is_some_and(|(lead, _)| lead == index);
        // Keys are held whichever window they were pressed in.
        let index = if matches!(event, WindowEvent::ModifiersChanged(_)) {
            self.lead().map(|(lead, _)| lead)
        } else {
            is_lead.then_some(index)
        };
        if let Some(screen) = index.and_then(|index| self.all[index].screen.as_mut()) {
            screen.overlay_event(event);
        }
    }

    /// Puts what is shown into the windows' titles.
    pub(super) fn set_title(&mut self, title: String) {
        self.title = title;
        for (index, output) in self.all.iter().enumerate() {
            if let Some(screen) = &output.screen {
                screen.window.set_title(&self.title_of(index));
            }
        }
    }

    fn title_of(&self, index: usize) -> String {
        match &self.all[index].monitor {
            Some(monitor) => format!("{} on {monitor}", self.title),
            None => self.title.clone(),
        }
    }

    /// The windows that there are.
    pub(super) fn windows(&self) -> impl Iterator<Item = &Window> {
        self.all.iter().filter_map(|output| output.screen.as_ref()).map(|screen| &*screen.window)
    }

    pub(super) fn is_filling(&self) -> bool {
        self.is_filling
    }

    /// Has windows fill their monitors, or no longer.
    pub(super) fn fill(&mut self, event_loop: &ActiveEventLoop, is_filling: bool) {
        self.is_filling = is_filling;
        for output in &self.all {
            let Some(screen) = &output.screen else { continue };
            let monitor = event_loop.available_monitors().find(|it| it.name().is_some() && it.name() == output.monitor);
            screen.window.set_fullscreen(is_filling.then_some(Fullscreen::Borderless(monitor)));
        }
    }

    pub(super) fn cursor_is_visible(&self) -> bool {
        self.cursor_is_visible
    }

    pub(super) fn show_cursor(&mut self, is_visible: bool) {
        if is_visible != self.cursor_is_visible {
            self.cursor_is_visible = is_visible;
            for screen in self.all.iter().filter_map(|output| output.screen.as_ref()) {
                screen.window.set_cursor_visible(is_visible);
            }
        }
    }

    /// What draws, once there was a window.
    pub(super) fn painter(&mut self) -> Option<&mut Painter> {
        self.painter.as_mut()
    }

    /// Shows `new_frame`, or the frame before, in all windows, and the overlay over it.
    ///
    /// `None`: there is nothing to draw on now, and `new_frame` is still to be shown.
    pub(super) fn draw(
        &mut self,
        wall: &Wall,
        new_frame: Option<&Frame>,
        model: &OverlayModel,
    ) -> Result<Option<DrawResult>, GpuError> {
        let lead = self.lead().map(|(lead, _)| lead);
        let Some(painter) = &mut self.painter else { return Ok(None) };
        let mut targets = Vec::with_capacity(self.all.len());
        let mut is_incomplete = false;
        for (index, output) in self.all.iter_mut().enumerate() {
            let Some(screen) = &mut output.screen else { continue };
            match screen.acquire(painter)? {
                Some(target) => targets.push((index, target)),
                None => is_incomplete |= !screen.size().contains(&0),
            }
        }
        if targets.is_empty() {
            return Ok(None);
        }
        let mut stats = DisplayStats::default();
        if let Some(frame) = new_frame {
            stats.upload_ms = painter.upload(frame)?;
        }
        let shows = if painter.is_dark {
            OutputContent::Black
        } else {
            painter.frame().map_or(OutputContent::Nothing, OutputContent::Frame)
        };
        targets.iter().for_each(|(index, _)| self.all[*index].shows = shows);
        let states: Vec<OutputState> = self.all.iter().map(Output::state).collect();
        // One submission for all windows, so that none shows another frame than its neighbours.
        let start = Instant::now();
        let mut encoder = painter.gpu.device.create_command_encoder(&Default::default());
        let wall_targets: Vec<_> =
            targets.iter().map(|(index, target)| (target.target(), self.all[*index].part)).collect();
        let borrowed: Vec<_> = wall_targets.iter().map(|(target, part)| (target, *part)).collect();
        painter.draw(&mut encoder, wall, &borrowed);
        let mut overlay = OverlayOutput::default();
        let mut repaint_after = Duration::MAX;
        for (index, target) in &targets {
            let Output { part, screen: Some(screen), .. } = &mut self.all[*index] else { continue };
            let mut model = if Some(*index) == lead { model.clone() } else { model.without_panels() };
            if !model.is_visible() {
                continue;
            }
            model.outputs = states.clone();
            model.regions = regions(wall, *part, target.size(), screen.pixels_per_point());
            let (output, wanted_after) = screen.draw_overlay(painter, &mut encoder, target, &model);
            repaint_after = repaint_after.min(wanted_after);
            if Some(*index) == lead {
                overlay = output;
            }
        }
        painter.gpu.queue.submit([encoder.finish()]);
        stats.draw_ms = painter.draw_ms().unwrap_or_else(|| ms_since(start));
        let start = Instant::now();
        let mut monitors = Vec::new();
        for (index, target) in targets {
            let Output { monitor, screen: Some(screen), .. } = &self.all[index] else { continue };
            screen.present(painter, target);
            monitors.extend(monitor.clone());
        }
        stats.present_ms = ms_since(start);
        painter.gpu.check()?;
        Ok(Some(DrawResult { stats, overlay, repaint_after, monitors, is_incomplete }))
    }
}

impl Output {
    fn state(&self) -> OutputState {
        let shows = if self.is_there { self.shows } else { OutputContent::MonitorMissing };
        OutputState { monitor: self.monitor.clone(), shows }
    }

    fn name(&self) -> &str {
        self.monitor.as_deref().unwrap_or("of the desktop")
    }
}

/// Where the overlay finds the canvas in a window of `size` pixels that shows a part of the wall.
fn regions(wall: &Wall, part: PixelRect, size: [u32; 2], pixels_per_point: f32) -> Vec<ProjectorRegion> {
    let fitted = PixelRect::fitted([part.width, part.height], size);
    let [x_scale, y_scale] = [fitted.width as f32 / part.width as f32, fitted.height as f32 / part.height as f32]
        .map(|it| it / pixels_per_point);
    let origin = egui::pos2(fitted.x as f32, fitted.y as f32) / pixels_per_point;
    let shown = wall.projectors().iter().filter(|projector| part.contains_rect(&projector.output));
    let place = |projector: &Projector| {
        let PixelRect { x, y, width, height } = projector.output;
        let from = origin + egui::vec2((x - part.x) as f32 * x_scale, (y - part.y) as f32 * y_scale);
        let size = egui::vec2(width as f32 * x_scale, height as f32 * y_scale);
        ProjectorRegion::new(projector, egui::Rect::from_min_size(from, size))
    };
    shown.filter_map(place).collect()
}
