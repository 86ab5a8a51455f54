//! Shows calibration patterns, and what was found with them, in the windows of a wall.

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
    control::alignment::{PatternImage, findings::CanvasPicture},
    overlay::OverlayModel,
    wall::{PixelRect, Wall},
};

/// What a person or another thread wants of the windows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Wish {
    /// Space or the right arrow.
    Next,
    /// The left arrow.
    Previous,
    /// Tab: what was seen so far.
    Progress,
    /// Enter.
    Accept,
    /// Escape, Q, or a window that was closed.
    Discard,
    /// Another thread has news.
    News,
}

/// What the windows show.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Page {
    /// A pattern, from 0.
    Pattern(u32),
    /// A picture of the canvas, through the corners or meshes of a wall.
    Picture(Box<Wall>, CanvasPicture),
}

/// Called for each wish; returns the page to show if it changes, or breaks to end.
pub(crate) type OnWish<'a> = Box<dyn FnMut(Wish) -> ControlFlow<(), Option<Page>> + 'a>;

/// All windows of a wall with a page on them.
pub(super) struct Patterns<'a> {
    wall: &'a Wall,
    plan: &'a Plan,
    on_wish: OnWish<'a>,
    outputs: Outputs,
    page: Page,
    /// Whether the windows have yet to show the page.
    is_stale: bool,
    outcome: anyhow::Result<()>,
}

impl<'a> Patterns<'a> {
    pub(super) fn new(wall: &'a Wall, plan: &'a Plan, page: Page, on_wish: OnWish<'a>) -> Self {
        let mut outputs = Outputs::new(wall, true);
        outputs.show_cursor(false);
        outputs.set_title("Patterns – Raywall".to_owned());
        Self { wall, plan, on_wish, outputs, page, is_stale: true, outcome: Ok(()) }
    }

    /// Why the windows closed: `Ok` if a person or the news ended them.
    pub(super) fn into_outcome(self) -> anyhow::Result<()> {
        self.outcome
    }

    fn wish(&mut self, event_loop: &ActiveEventLoop, wish: Wish) {
        match (self.on_wish)(wish) {
            ControlFlow::Continue(None) => {}
            ControlFlow::Continue(Some(page)) => {
                self.page = page;
                self.is_stale = true;
            }
            ControlFlow::Break(()) => event_loop.exit(),
        }
    }

    fn key(&mut self, event_loop: &ActiveEventLoop, key: &Key) {
        let wish = match key.as_ref() {
            Key::Named(NamedKey::Space | NamedKey::ArrowRight) => Wish::Next,
            Key::Named(NamedKey::ArrowLeft) => Wish::Previous,
            Key::Named(NamedKey::Tab) => Wish::Progress,
            Key::Named(NamedKey::Enter) => Wish::Accept,
            Key::Named(NamedKey::Escape) | Key::Character("q" | "Q") => Wish::Discard,
            _ => return,
        };
        self.wish(event_loop, wish);
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

    /// Draws the page; windows that are not ready are drawn at the next event.
    fn draw(&mut self) -> anyhow::Result<()> {
        let Some(painter) = &mut self.outputs.painter else { return Ok(()) };
        let wall = match &self.page {
            Page::Pattern(pattern) => {
                painter.show_pattern(&images(self.wall, self.plan, *pattern)?)?;
                self.wall
            }
            Page::Picture(wall, CanvasPicture { size, rgba }) => {
                painter.show_pattern(&[])?;
                painter.present.upload(&painter.gpu, *size, rgba)?;
                &**wall
            }
        };
        let drawn = self.outputs.draw(wall, None, &OverlayModel::default())?;
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
            Call::Check | Call::Apply(_) | Call::Show(_) | Call::Prepared(..) => self.wish(event_loop, Wish::News),
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
