//! The newest frame, and when windows must be drawn.

use std::time::Instant;

use crate::{farm::Frame, window::frame_rate::FrameRate};

/// The newest frame, and when to draw.
#[derive(Debug)]
pub(super) struct Presentation {
    pub(super) frame: Option<Frame>,
    /// The frame has yet to be shown.
    pub(super) is_new: bool,
    /// The windows are out of date.
    pub(super) is_stale: bool,
    pub(super) rate: FrameRate,
    /// When the overlay is to be drawn again.
    pub(super) repaint_at: Option<Instant>,
    /// When to draw again after a window could not be drawn on.
    pub(super) retry_at: Option<Instant>,
}

impl Default for Presentation {
    fn default() -> Self {
        let rate = FrameRate::default();
        Self { frame: None, is_new: false, is_stale: true, rate, repaint_at: None, retry_at: None }
    }
}
