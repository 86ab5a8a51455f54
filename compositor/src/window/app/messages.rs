//! Notes and problems on screen, and when they leave it. Pure: time is an argument.

use std::time::{Duration, Instant};

use crate::farm::{notices::Notices, stats::FarmStatus};

/// Notes are shown for this time, and so are messages without the panel.
const NOTE_LIFE: Duration = Duration::from_secs(8);

#[derive(Debug, Default)]
pub(super) struct Messages {
    note: Option<(String, Instant)>,
    /// Shown until it is dismissed.
    pub(super) problem: Option<String>,
    /// The farm's notices until they were dismissed.
    n_dismissed: u64,
    /// The missing monitors when the message about them was dismissed.
    dismissed_monitors: Vec<String>,
    /// The messages that were listed last, and when there was a new one.
    listed: Vec<String>,
    news_at: Option<Instant>,
}

impl Messages {
    pub(super) fn show_note(&mut self, note: String, now: Instant) {
        self.note = Some((note, now));
    }

    pub(super) fn show_problem(&mut self, problem: String, now: Instant) {
        (self.problem, self.news_at) = (Some(problem), Some(now));
    }

    /// Clears all messages; those of farm and monitors return when they change.
    pub(super) fn dismiss(&mut self, status: &FarmStatus, missing_monitors: Vec<String>) {
        *self = Self { n_dismissed: status.notices.n_put(), dismissed_monitors: missing_monitors, ..Self::default() };
    }

    pub(super) fn note(&mut self, now: Instant) -> Option<String> {
        self.note.take_if(|(_, since)| now.duration_since(*since) >= NOTE_LIFE);
        self.note.as_ref().map(|(note, _)| note.clone())
    }

    pub(super) fn note_ends_at(&self) -> Option<Instant> {
        self.note.as_ref().map(|(_, since)| *since + NOTE_LIFE)
    }

    pub(super) fn news_end_at(&self) -> Option<Instant> {
        self.news_at.map(|since| since + NOTE_LIFE)
    }

    /// The messages to show: beside the panel until they are dismissed, otherwise for a while after there is a new one.
    pub(super) fn list(
        &mut self,
        status: &FarmStatus,
        missing_monitors: &[String],
        has_panel: bool,
        now: Instant,
    ) -> Vec<String> {
        let messages = self.all(status, missing_monitors);
        if messages.iter().any(|message| !self.listed.contains(message)) {
            self.news_at = Some(now);
        }
        self.listed.clone_from(&messages);
        let is_news = self.news_end_at().is_some_and(|news_end_at| now < news_end_at);
        if has_panel || is_news { messages } else { Vec::new() }
    }

    /// All messages that were not dismissed.
    pub(super) fn all(&self, status: &FarmStatus, missing_monitors: &[String]) -> Vec<String> {
        let notices = Some(&status.notices).filter(|notices| notices.n_put() != self.n_dismissed);
        let farm_message = notices.and_then(Notices::message);
        let is_missing = !missing_monitors.is_empty() && missing_monitors != self.dismissed_monitors;
        let missing = is_missing.then(|| {
            format!(
                "Monitor missing: {}. The wall uses it again once it is connected and on",
                missing_monitors.join(", ")
            )
        });
        self.problem.clone().into_iter().chain(missing).chain(farm_message).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_note_leaves_the_screen_by_itself() {
        let (mut messages, start) = (Messages::default(), Instant::now());
        messages.show_note("saved".to_owned(), start);
        assert_eq!(messages.note(start + NOTE_LIFE / 2).as_deref(), Some("saved"));
        assert_eq!(messages.note_ends_at(), Some(start + NOTE_LIFE));
        assert_eq!(messages.note(start + NOTE_LIFE), None);
        assert_eq!(messages.note_ends_at(), None);
    }

    #[test]
    fn dismissed_messages_return_only_with_news() {
        let lost = |n_lost| {
            let mut status = FarmStatus::default();
            for _ in 0..n_lost {
                status.notices.clear(&("node".to_owned(), None));
                status.notices.put(("node".to_owned(), None), "node lost".to_owned());
            }
            status
        };
        let (left, both) = (["DP-1".to_owned()], ["DP-1".to_owned(), "DP-2".to_owned()]);
        let mut messages = Messages { problem: Some("disk full".to_owned()), ..Messages::default() };
        assert_eq!(messages.all(&lost(1), &left).len(), 3);
        messages.dismiss(&lost(1), left.to_vec());
        assert_eq!(messages.all(&lost(1), &left), Vec::<String>::new());
        assert_eq!(messages.all(&lost(2), &left), ["node lost"]);
        assert!(messages.all(&lost(1), &both)[0].contains("DP-1, DP-2"));
    }

    #[test]
    fn without_the_panel_messages_are_shown_for_a_while_and_again_with_news() {
        let (mut messages, start) = (Messages::default(), Instant::now());
        let mut status = FarmStatus::default();
        let n_shown = |messages: &mut Messages, status: &FarmStatus, has_panel, now| {
            messages.list(status, &[], has_panel, now).len()
        };
        messages.show_problem("disk full".to_owned(), start);
        assert_eq!(n_shown(&mut messages, &status, false, start), 1);
        assert_eq!(messages.news_end_at(), Some(start + NOTE_LIFE));
        assert_eq!(n_shown(&mut messages, &status, false, start + NOTE_LIFE), 0);
        assert_eq!(n_shown(&mut messages, &status, true, start + NOTE_LIFE), 1);
        messages.show_problem("disk full".to_owned(), start + NOTE_LIFE);
        assert_eq!(n_shown(&mut messages, &status, false, start + NOTE_LIFE), 1, "the same mistake again");
        status.notices.put(("node".to_owned(), None), "node lost".to_owned());
        assert_eq!(n_shown(&mut messages, &status, false, start + 3 * NOTE_LIFE), 2);
        assert_eq!(n_shown(&mut messages, &status, false, start + 4 * NOTE_LIFE), 0);
    }
}
