//! Shows calibration patterns in the windows of a wall.

use std::{ops::ControlFlow, time::Instant};

use anyhow::Context;
use shared::division::FrameSize;
use winit::{
    application::ApplicationHandler,
    event::{ElementState, WindowEvent},
    event_loop::{ActiveEventLoop, ControlFlow as Wake},
    keyboard::{Key, NamedKey},
    window::WindowId,
};

use super::{
    outputs::{Outputs, RETRY_INTERVAL},
    waker::Call,
};
use crate::{
    calibration::Plan,
    control::alignment::PatternImage,
    overlay::OverlayModel,
    wall::{PixelRect, Wall},
};

/// Called when the window is woken, with the pattern that is shown; returns the pattern to show, or breaks to end.
pub(crate) type OnNews<'a> = Box<dyn FnMut(u32) -> ControlFlow<(), u32> + 'a>;

/// All windows of a wall with a pattern on them.
///
/// Space and the right arrow show the next pattern, the left arrow the one before, Escape, Q and Enter end.
pub(super) struct Patterns<'a> {
    wall: &'a Wall,
    plan: &'a Plan,
    n_patterns: u32,
    on_news: OnNews<'a>,
    outputs: Outputs,
    pattern: u32,
    /// Whether the windows have yet to show the pattern.
    is_stale: bool,
    outcome: anyhow::Result<()>,
}

impl<'a> Patterns<'a> {
    pub(super) fn new(wall: &'a Wall, (plan, n_patterns): (&'a Plan, u32), on_news: OnNews<'a>) -> Self {
        let mut outputs = Outputs::new(wall, true);
        outputs.show_cursor(false);
        outputs.set_title("Patterns – Raywall".to_owned());
        Self { wall, plan, n_patterns, on_news, outputs, pattern: 0, is_stale: true, outcome: Ok(()) }
    }

    /// Why the windows closed: `Ok` if a person or the news ended them.
    pub(super) fn into_outcome(self) -> anyhow::Result<()> {
        self.outcome
    }

    fn show(&mut self, pattern: u32) {
        if pattern != self.pattern {
            tracing::info!("pattern {} of {} is on the wall", pattern + 1, self.n_patterns);
        }
        self.pattern = pattern;
        self.is_stale = true;
    }

    fn key(&mut self, event_loop: &ActiveEventLoop, key: &Key) {
        let n_patterns = self.n_patterns;
        match key.as_ref() {
            Key::Named(NamedKey::Space | NamedKey::ArrowRight) => self.show((self.pattern + 1) % n_patterns),
            Key::Named(NamedKey::ArrowLeft) => self.show((self.pattern + n_patterns - 1) % n_patterns),
            Key::Named(NamedKey::Escape | NamedKey::Enter) | Key::Character("q" | "Q") => event_loop.exit(),
            _ => {}
        }
    }

    fn follow_monitors(&mut self, event_loop: &ActiveEventLoop) {
        match self.outputs.follow_monitors(event_loop) {
            Ok(has_changed) => self.is_stale |= has_changed,
            Err(error) => self.fail(event_loop, error),
        }
    }

    fn fail(&mut self, event_loop: &ActiveEventLoop, error: anyhow::Error) {
        self.outcome = Err(error);
        event_loop.exit();
    }

    /// Draws the pattern; windows that are not ready are drawn at the next event.
    fn draw(&mut self) -> anyhow::Result<()> {
        let Some(painter) = &mut self.outputs.painter else { return Ok(()) };
        painter.show_pattern(&images(self.wall, self.plan, self.pattern)?)?;
        let drawn = self.outputs.draw(self.wall, None, &OverlayModel::default())?;
        self.is_stale = drawn.is_none_or(|drawn| drawn.is_incomplete);
        Ok(())
    }
}

/// A pattern on all outputs.
fn images(wall: &Wall, plan: &Plan, pattern: u32) -> anyhow::Result<Vec<PatternImage>> {
    let image = |part: PixelRect| {
        let size = FrameSize::new(part.width, part.height).with_context(|| {
            format!("one output would have {}×{} pixels: name the output of each projector", part.width, part.height)
        })?;
        let values = plan.draw(pattern, wall, part);
        let rows = values.chunks(part.width as usize).rev();
        let rgba = rows.flatten().flat_map(|&[red, green, blue]| [red, green, blue, 255]).collect();
        Ok(PatternImage::of_output(part, size, rgba))
    };
    wall.output_parts().into_iter().map(image).collect()
}

impl ApplicationHandler<Call> for Patterns<'_> {
    fn resumed(&mut self, event_loop: &ActiveEventLoop) {
        self.follow_monitors(event_loop);
    }

    fn user_event(&mut self, event_loop: &ActiveEventLoop, call: Call) {
        match call {
            Call::Close => event_loop.exit(),
            Call::Check | Call::Apply(_) | Call::Show(_) | Call::Prepared(..) => match (self.on_news)(self.pattern) {
                ControlFlow::Continue(pattern) if pattern != self.pattern => self.show(pattern),
                ControlFlow::Continue(_) => {}
                ControlFlow::Break(()) => event_loop.exit(),
            },
        }
    }

    fn window_event(&mut self, event_loop: &ActiveEventLoop, window: WindowId, event: WindowEvent) {
        let Some(index) = self.outputs.index_of(window) else { return };
        match event {
            WindowEvent::CloseRequested | WindowEvent::Destroyed => event_loop.exit(),
            WindowEvent::Resized(size) => {
                self.outputs.resize(index, size.into());
                self.is_stale = true;
            }
            WindowEvent::RedrawRequested | WindowEvent::Occluded(false) | WindowEvent::ScaleFactorChanged { .. } => {
                self.is_stale = true;
            }
            WindowEvent::KeyboardInput { event: key, is_synthetic: false, .. }
                if key.state == ElementState::Pressed && !key.repeat =>
            {
                self.key(event_loop, &key.logical_key);
            }
            _ => {}
        }
    }

    fn about_to_wait(&mut self, event_loop: &ActiveEventLoop) {
        if self.outputs.next_check_at().is_some_and(|check_at| check_at <= Instant::now()) {
            self.follow_monitors(event_loop);
        }
        if self.is_stale
            && let Err(error) = self.draw()
        {
            return self.fail(event_loop, error);
        }
        // A display that is late is tried again with its next refresh.
        let retry_at = self.is_stale.then(|| Instant::now() + RETRY_INTERVAL);
        let next = retry_at.into_iter().chain(self.outputs.next_check_at()).min();
        event_loop.set_control_flow(next.map_or(Wake::Wait, Wake::WaitUntil));
    }
}
