//! The last lines of the log, for those who watch a program from elsewhere.

use std::{
    collections::VecDeque,
    fmt::{Debug, Write},
    sync::{LazyLock, Mutex, PoisonError},
    time::{SystemTime, UNIX_EPOCH},
};

use serde::Serialize;
use shared::printable::printable_line;
use tokio::sync::watch;
use tracing::{
    Event, Level, Subscriber,
    field::{Field, Visit},
};
use tracing_subscriber::{Layer, layer::Context};

/// Lines that are kept.
const MOST_LINES: usize = 100;
/// The most bytes of a line that are kept.
const LONGEST_LINE: usize = 400;

/// A line of the log.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct LogLine {
    /// Seconds since 1970.
    pub time_s: u64,
    /// ERROR, WARN or INFO.
    pub level: &'static str,
    /// Without characters that forge lines.
    pub text: String,
}

static LINES: Mutex<VecDeque<LogLine>> = Mutex::new(VecDeque::new());
static NEWS: LazyLock<watch::Sender<()>> = LazyLock::new(watch::Sender::default);

/// The last lines, the newest last.
pub fn lines() -> Vec<LogLine> {
    LINES.lock().unwrap_or_else(PoisonError::into_inner).iter().cloned().collect()
}

/// Changes with each line.
pub fn news() -> watch::Receiver<()> {
    NEWS.subscribe()
}

/// Keeps lines of the level `INFO` and above.
pub(super) struct RecentLog;

impl<S: Subscriber> Layer<S> for RecentLog {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let level = *event.metadata().level();
        if level > Level::INFO {
            return;
        }
        let mut text = Text::default();
        event.record(&mut text);
        let mut text = printable_line(&text.0);
        text.truncate(text.floor_char_boundary(LONGEST_LINE));
        let time_s = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
        let mut lines = LINES.lock().unwrap_or_else(PoisonError::into_inner);
        if lines.len() == MOST_LINES {
            lines.pop_front();
        }
        lines.push_back(LogLine { time_s, level: level.as_str(), text });
        drop(lines);
        NEWS.send_replace(());
    }
}

/// An event's message, and its other fields behind it.
#[derive(Default)]
struct Text(String);

impl Visit for Text {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        // Writing to a text cannot fail.
        let _ = match field.name() {
            "message" => write!(self.0, "{value:?}"),
            name => write!(self.0, " {name}={value:?}"),
        };
    }
}

#[cfg(test)]
mod tests {
    use tracing_subscriber::layer::SubscriberExt;

    use super::*;

    #[test]
    fn the_last_lines_are_kept_in_order_and_cannot_be_forged() {
        let mut news = news();
        tracing::subscriber::with_default(tracing_subscriber::registry().with(RecentLog), || {
            (0..MOST_LINES).for_each(|number| tracing::info!("line {number}"));
            tracing::debug!("hidden");
            tracing::warn!(count = 3, "lost\nERROR {}", "é".repeat(LONGEST_LINE));
        });
        assert!(news.has_changed().unwrap());
        news.mark_unchanged();
        let lines = lines();
        assert_eq!((lines.len(), lines[0].text.as_str(), lines[0].level), (MOST_LINES, "line 1", "INFO"));
        let last = lines.last().unwrap();
        assert!(last.text.starts_with("lost ERROR é") && last.text.len() <= LONGEST_LINE, "{last:?}");
        assert_eq!(last.level, "WARN");
    }
}
