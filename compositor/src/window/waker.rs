//! Calls of other threads to the window.

use winit::event_loop::EventLoopProxy;

use super::{
    effect::Effect,
    model_loader::{Loaded, Prepared},
};

pub(super) enum Call {
    /// Check for frames and other news.
    Check,
    Apply(Effect),
    /// Show a model, or the reason why it cannot be loaded.
    Show(Loaded),
    /// A scene of a show by its number.
    Prepared(usize, Prepared),
    Close,
}

#[derive(Clone, Debug)]
pub(crate) struct Waker(pub(super) EventLoopProxy<Call>);

impl Waker {
    pub(crate) fn wake(&self) {
        self.call(Call::Check);
    }

    /// Closes the window, as an operator would.
    pub(crate) fn close(&self) {
        self.call(Call::Close);
    }

    pub(super) fn call(&self, call: Call) {
        // The window may be closed already.
        let _ = self.0.send_event(call);
    }
}
