//! The outputs of a wall: a window on each monitor that it names, or one window for the whole wall.

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

use super::{
    painter::{Painter, ms_since},
    screen::Screen,
    session::{hotplug, screensaver::ScreensaverHold},
};
use crate::{
    farm::{Frame, stats::DisplayStats},
    gpu::{GpuError, Quad},
    overlay::{OutputContent, OutputState, OverlayModel, OverlayOutput, ProjectorRegion},
    wall::{PixelRect, Wall},
};

const CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// A picture that found no window to be drawn on is drawn again after this.
pub(super) const RETRY_INTERVAL: Duration = Duration::from_millis(100);

/// All windows of a wall, with the painter that draws on them.
///
/// A wall that names no outputs has one, whose window may be anywhere on the desktop.
pub(super) struct Outputs {
    all: Vec<Output>,
    /// Created with the first window, and kept when all are closed.
    pub(super) painter: Option<Painter>,
    pub(super) is_filling: bool,
    title: String,
    pub(super) cursor_is_visible: bool,
    /// Held while windows fill their monitors.
    screensaver: Option<ScreensaverHold>,
    checked_at: Option<Instant>,
}

/// A part of the wall, and its window.
struct Output {
    /// The name of its monitor; `None` for a window that may be on any.
    monitor: Option<String>,
    /// Its pixels within the spanning output.
    part: PixelRect,
    /// `None` while its monitor is missing.
    screen: Option<Screen>,
    /// The monitor's place on the desktop at the last check.
    geometry: Option<Geometry>,
    /// Whether its monitor was there at the last check.
    is_there: bool,
    content: OutputContent,
}

type Geometry = (PhysicalPosition<i32>, PhysicalSize<u32>);

pub(super) struct DrawResult {
    /// Times of the display's parts, without the latency, which the caller knows.
    pub(super) stats: DisplayStats,
    pub(super) overlay: OverlayOutput,
    pub(super) repaint_after: Duration,
    /// The named monitors that were drawn on.
    pub(super) monitors: Vec<String>,
    /// Whether a window that is not empty could not be drawn on.
    pub(super) is_incomplete: bool,
}

impl Outputs {
    /// The outputs of a wall, without windows yet; walls that name monitors fill them.
    pub(super) fn new(wall: &Wall, is_filling: bool) -> Self {
        let output = |monitor, part| Output {
            monitor,
            part,
            screen: None,
            geometry: None,
            is_there: false,
            content: OutputContent::Nothing,
        };
        let mut all: Vec<Output> =
            wall.monitors().into_iter().map(|(name, part)| output(Some(name.to_owned()), part)).collect();
        let is_filling = is_filling || !all.is_empty();
        if all.is_empty() {
            all.push(output(None, wall.whole_output()));
        }
        Self {
            all,
            painter: None,
            is_filling,
            title: "Raywall".to_owned(),
            cursor_is_visible: true,
            screensaver: None,
            checked_at: None,
        }
    }

    /// Opens windows on monitors that are there, and closes those of missing ones. Returns whether windows changed.
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
                output.content = OutputContent::Nothing;
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
            // The window manager may still move a monitor that has just come: open the window at the next check.
            if is_there && is_settled && self.all[index].screen.is_none() {
                match self.open(index, event_loop, monitor) {
                    Ok(screen) => self.all[index].screen = Some(screen),
                    // Without any window the wall cannot start.
                    Err(error) if self.painter.is_none() => return Err(error),
                    Err(error) => tracing::warn!("no window on {}: {error:#}", self.all[index].name()),
                }
                has_changed = true;
            }
        }
        if has_changed {
            self.hold_screensaver();
        }
        Ok(has_changed)
    }

    /// The refresh interval of the fastest monitor with a part of the wall, if it is known.
    pub(super) fn refresh_interval(&self) -> Option<Duration> {
        let monitors = self.all.iter().filter_map(|output| output.screen.as_ref()?.window.current_monitor());
        let fastest_mhz = monitors.filter_map(|monitor| monitor.refresh_rate_millihertz()).max()?;
        (fastest_mhz > 0).then(|| Duration::from_secs_f64(1e3 / f64::from(fastest_mhz)))
    }

    /// When to check monitors again; never if the wall names none.
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
        // A window that does not fill its monitor takes four fifths of it.
        let most = monitor.cloned().or_else(any).map_or([1280, 720], |monitor| {
            let PhysicalSize { width, height } = monitor.size();
            [width / 5 * 4, height / 5 * 4]
        });
        let fitted = PixelRect::fitted([width, height], [most[0].min(width), most[1].min(height)]);
        let mut attributes = Window::default_attributes()
            .with_title(self.title_of(index))
            .with_inner_size(PhysicalSize::new(fitted.width, fitted.height))
            .with_min_inner_size(PhysicalSize::new(320, 180))
            .with_fullscreen(self.is_filling.then(|| Fullscreen::Borderless(monitor.cloned())));
        if let Some(monitor) = monitor {
            attributes = attributes.with_position(monitor.position());
        }
        let window = event_loop.create_window(attributes).context("cannot open a window")?;
        window.set_cursor_visible(self.cursor_is_visible);
        if let Some(name) = &self.all[index].monitor {
            tracing::info!("the monitor {name} shows {width}×{height} pixels of the wall");
        }
        Ok(Screen::new(window, &mut self.painter)?)
    }

    pub(super) fn missing(&self) -> Vec<String> {
        self.all.iter().filter(|output| output.screen.is_none()).filter_map(|output| output.monitor.clone()).collect()
    }

    /// Whether a window has pixels to draw on.
    pub(super) fn is_open(&self) -> bool {
        self.all.iter().filter_map(|output| output.screen.as_ref()).any(|screen| !screen.surface.size().contains(&0))
    }

    /// The first window, which shows the overlay's panels.
    fn lead(&self) -> Option<(usize, &Screen)> {
        self.all.iter().enumerate().find_map(|(index, output)| Some((index, output.screen.as_ref()?)))
    }

    pub(super) fn index_of(&self, id: WindowId) -> Option<usize> {
        self.all.iter().position(|output| output.screen.as_ref().is_some_and(|screen| screen.window.id() == id))
    }

    pub(super) fn resize(&mut self, index: usize, size: [u32; 2]) {
        if let Some(screen) = &mut self.all[index].screen {
            screen.surface.resize(size);
        }
    }

    /// Converts a point of a window to pixels of the spanning output.
    pub(super) fn on_wall(&self, index: usize, PhysicalPosition { x, y }: PhysicalPosition<f64>) -> DVec2 {
        let Some(Output { part, screen: Some(screen), .. }) = self.all.get(index) else { return DVec2::ZERO };
        let fitted = PixelRect::fitted([part.width, part.height], screen.surface.size());
        let scale = part.size() / fitted.size().max(DVec2::ONE);
        part.origin() + (DVec2::new(x, y) - fitted.origin()) * scale
    }

    /// Converts a point of a window to points of the overlay, if that window shows the panels.
    pub(super) fn on_overlay(&self, index: usize, at: PhysicalPosition<f64>) -> Option<egui::Pos2> {
        let (_, screen) = self.lead().filter(|(lead, _)| *lead == index)?;
        let scale = f64::from(screen.pixels_per_point());
        Some(egui::pos2((at.x / scale) as f32, (at.y / scale) as f32))
    }

    /// Whether a field of the overlay has the focus, and so the keys.
    pub(super) fn field_has_focus(&self) -> bool {
        self.lead().is_some_and(|(_, screen)| screen.egui.egui_ctx().egui_wants_keyboard_input())
    }

    /// Takes the focus from the overlay's field, as a press outside the overlay does.
    pub(super) fn take_focus(&self) {
        let context = self.lead().map(|(_, screen)| screen.egui.egui_ctx());
        context.into_iter().for_each(|context| context.memory_mut(egui::Memory::stop_text_input));
    }

    /// Converts a point of the overlay's panels to pixels of the spanning output.
    pub(super) fn overlay_on_wall(&self, point: egui::Pos2) -> DVec2 {
        let Some((lead, screen)) = self.lead() else { return DVec2::ZERO };
        let scale = screen.pixels_per_point();
        self.on_wall(lead, PhysicalPosition::new((point.x * scale).into(), (point.y * scale).into()))
    }

    /// Passes an event to the overlay if it belongs to the window with the panels.
    pub(super) fn forward_to_overlay(&mut self, index: usize, event: &WindowEvent) {
        let is_lead = self.lead().is_some_and(|(lead, _)| lead == index);
        // Keys count in every window.
        let is_typed =
            matches!(event, WindowEvent::ModifiersChanged(_) | WindowEvent::KeyboardInput { .. } | WindowEvent::Ime(_));
        let index = if is_typed { self.lead().map(|(lead, _)| lead) } else { is_lead.then_some(index) };
        if let Some(screen) = index.and_then(|index| self.all[index].screen.as_mut()) {
            // Whether the overlay used the event does not matter: it was meant for it.
            let _ = screen.egui.on_window_event(&screen.window, event);
        }
    }

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

    pub(super) fn windows(&self) -> impl Iterator<Item = &Window> {
        self.all.iter().filter_map(|output| output.screen.as_ref()).map(|screen| &*screen.window)
    }

    /// Makes windows fill their monitors, or no longer.
    pub(super) fn fill(&mut self, event_loop: &ActiveEventLoop, is_filling: bool) {
        self.is_filling = is_filling;
        for output in &self.all {
            let Some(screen) = &output.screen else { continue };
            let monitor = event_loop.available_monitors().find(|it| it.name().is_some() && it.name() == output.monitor);
            screen.window.set_fullscreen(is_filling.then_some(Fullscreen::Borderless(monitor)));
        }
        self.hold_screensaver();
    }

    fn hold_screensaver(&mut self) {
        if self.is_filling != self.screensaver.is_some() {
            self.screensaver = self.is_filling.then(ScreensaverHold::new).flatten();
        }
    }

    pub(super) fn show_cursor(&mut self, is_visible: bool) {
        if is_visible != self.cursor_is_visible {
            self.cursor_is_visible = is_visible;
            for screen in self.all.iter().filter_map(|output| output.screen.as_ref()) {
                screen.window.set_cursor_visible(is_visible);
            }
        }
    }

    /// Shows `new_frame`, into which the wall may fade, or the previous one, in all windows, under the overlay.
    ///
    /// `None` if no window can be drawn on now: `new_frame` has yet to be shown.
    pub(super) fn draw(
        &mut self,
        wall: &Wall,
        new_frame: Option<(&Frame, bool)>,
        model: &OverlayModel,
    ) -> Result<Option<DrawResult>, GpuError> {
        let lead = self.lead().map(|(lead, _)| lead);
        let Some(painter) = &mut self.painter else { return Ok(None) };
        let mut targets = Vec::with_capacity(self.all.len());
        let mut is_incomplete = false;
        for (index, output) in self.all.iter_mut().enumerate() {
            let Some(screen) = &mut output.screen else { continue };
            match screen.surface.acquire(&painter.gpu)? {
                Some(target) => targets.push((index, target)),
                None => is_incomplete |= !screen.surface.size().contains(&0),
            }
        }
        if targets.is_empty() {
            return Ok(None);
        }
        let mut stats = DisplayStats::default();
        if let Some((frame, fades)) = new_frame {
            stats.upload_ms = painter.upload(frame, fades)?;
        }
        let content = if painter.is_dark {
            OutputContent::Black
        } else {
            painter.frame.map_or(OutputContent::Nothing, OutputContent::Frame)
        };
        targets.iter().for_each(|(index, _)| self.all[*index].content = content);
        let states: Vec<OutputState> = self.all.iter().map(Output::state).collect();
        // One submission for all windows, so that all show the same frame.
        let start = Instant::now();
        let mut encoder = painter.gpu.device.create_command_encoder(&Default::default());
        let wall_targets: Vec<_> =
            targets.iter().map(|(index, target)| (target.target(), self.all[*index].part)).collect();
        painter.draw(&mut encoder, wall, &wall_targets);
        let mut overlay = OverlayOutput { places: model.marks.places.clone(), ..OverlayOutput::default() };
        let mut repaint_after = Duration::MAX;
        for (index, target) in &targets {
            let Output { part, screen: Some(screen), .. } = &mut self.all[*index] else { continue };
            let mut model = if Some(*index) == lead { model.clone() } else { model.without_panels() };
            if !model.is_visible() {
                continue;
            }
            // The first window has placed the labels.
            model.marks.places.clone_from(&overlay.places);
            model.outputs = states.clone();
            model.regions = regions(wall, *part, target.size, screen.pixels_per_point());
            let (output, wanted_after) = screen.draw_overlay(painter, &mut encoder, target, model);
            repaint_after = repaint_after.min(wanted_after);
            if Some(*index) == lead {
                overlay = output;
            }
        }
        painter.gpu.queue.submit([encoder.finish()]);
        stats.draw_ms = painter.present.draw_ms(&painter.gpu).unwrap_or_else(|| ms_since(start));
        let start = Instant::now();
        let mut monitors = Vec::new();
        for (index, target) in targets {
            let Output { monitor, screen: Some(screen), .. } = &self.all[index] else { continue };
            screen.window.pre_present_notify();
            painter.gpu.queue.present(target.texture);
            monitors.extend(monitor.clone());
        }
        stats.present_ms = ms_since(start);
        painter.gpu.check()?;
        Ok(Some(DrawResult { stats, overlay, repaint_after, monitors, is_incomplete }))
    }
}

impl Output {
    fn state(&self) -> OutputState {
        let shows = if self.is_there { self.content } else { OutputContent::MonitorMissing };
        OutputState { monitor: self.monitor.clone(), shows }
    }

    fn name(&self) -> &str {
        self.monitor.as_deref().unwrap_or("of the desktop")
    }
}

/// The places of projectors in a window of `size` pixels that shows a part of the wall, in points of the overlay.
fn regions(wall: &Wall, part: PixelRect, size: [u32; 2], pixels_per_point: f32) -> Vec<ProjectorRegion> {
    let region = |quad: Quad| {
        let [left, top, right, bottom] = quad.edges.map(|edge| edge as f32 / pixels_per_point);
        let window = egui::Rect::from_min_max(egui::pos2(left, top), egui::pos2(right, bottom));
        ProjectorRegion::new(&wall.projectors()[quad.projector_idx], window)
    };
    Quad::of_part(wall, part, size).filter_map(region).collect()
}
