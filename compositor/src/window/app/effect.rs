//! Requests of one part of the window to the others.

use crate::window::jobs::{Job, Outcome};

/// The consequences of a command or an event, which `App::apply` carries out.
#[derive(Default)]
pub(super) struct Effect {
    /// The camera or the appearance has changed: render a new picture.
    pub(super) wants_picture: bool,
    /// A text to show for a while.
    pub(super) note: Option<String>,
    /// A text to show until it is dismissed.
    pub(super) problem: Option<String>,
    /// A file operation to run.
    pub(super) job: Option<Job>,
}

impl Effect {
    pub(super) fn picture() -> Self {
        Self { wants_picture: true, ..Self::default() }
    }

    pub(super) fn note(text: impl Into<String>) -> Self {
        Self { note: Some(text.into()), ..Self::default() }
    }

    pub(super) fn problem(text: impl Into<String>) -> Self {
        Self { problem: Some(text.into()), ..Self::default() }
    }

    pub(super) fn job(job: impl FnOnce() -> Outcome + Send + 'static) -> Self {
        Self { job: Some(Box::new(job)), ..Self::default() }
    }

    pub(super) fn with_note(self, text: impl Into<String>) -> Self {
        Self { note: Some(text.into()), ..self }
    }
}
