//! Requests of one part of the window, or of another thread, to the other parts.

use crate::{
    control::show::{SceneMap, Show},
    overlay::FileList,
};

/// A file operation, on the thread of [`super::jobs::Jobs`].
pub(super) type Job = Box<dyn FnOnce() -> Effect + Send>;

/// The consequences of a command, an event or a job, which `App::apply` carries out.
#[derive(Default)]
pub(super) struct Effect {
    /// The camera or the appearance has changed: render a new picture.
    pub(super) wants_picture: bool,
    /// A text to show for a while.
    pub(super) note: Option<String>,
    /// A text to show until it is dismissed.
    pub(super) problem: Option<String>,
    pub(super) job: Option<Job>,
    pub(super) files: Option<FileList>,
    /// The models of a folder, for remotes.
    pub(super) models: Option<Vec<String>>,
    /// The edited show, and where its scenes are now.
    pub(super) show: Option<Box<(Show, SceneMap)>>,
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

    /// The job returns its own effect, or a problem.
    pub(super) fn job(job: impl FnOnce() -> Result<Self, String> + Send + 'static) -> Self {
        Self { job: Some(Box::new(|| job().unwrap_or_else(Self::problem))), ..Self::default() }
    }

    pub(super) fn with_note(self, text: impl Into<String>) -> Self {
        Self { note: Some(text.into()), ..self }
    }
}
