//! News of render servers that the wall itself starts, for the farm: it tells operators what the wall does about a loss.

use tokio::sync::mpsc;

/// Something happened to a process of the wall's own.
#[derive(Debug)]
pub(super) enum LocalNews {
    /// It has been started, perhaps again.
    Started { name: String },
    /// It has ended; the text says why, and what becomes of it.
    Ended { name: String, text: String },
}

/// Tells the farm of render servers that the wall starts.
#[derive(Clone, Debug)]
pub struct LocalReporter(pub(super) mpsc::UnboundedSender<LocalNews>);

impl LocalReporter {
    /// A render server of this name was started.
    pub fn started(&self, name: &str) {
        // A farm that has ended needs no news.
        let _ = self.0.send(LocalNews::Started { name: name.to_owned() });
    }

    /// A render server of this name has ended. `text`: why, and what becomes of it.
    pub fn ended(&self, name: &str, text: String) {
        let _ = self.0.send(LocalNews::Ended { name: name.to_owned(), text });
    }
}
