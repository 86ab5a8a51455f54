//! Wakes the window from other threads.

use winit::event_loop::EventLoopProxy;

/// A request of another thread to the window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Call {
    /// Check for frames, loaded models and other results.
    Check,
    /// Close the window.
    Close,
}

/// Wakes the window from other threads.
#[derive(Clone, Debug)]
pub struct Waker(pub(super) EventLoopProxy<Call>);

impl Waker {
    /// Makes the window check for results.
    pub fn wake(&self) {
        // The window may be closed already.
        let _ = self.0.send_event(Call::Check);
    }

    /// Closes the window, as an operator would.
    pub fn close(&self) {
        let _ = self.0.send_event(Call::Close);
    }
}
