//! Keeps log lines few: strangers and nodes that come and go could fill a disk with them.

use std::{collections::HashMap, hash::Hash, time::Duration};

use super::{rate_limit::RateLimit, service::MOST_NODES};

/// One line of a kind on a node in this time…
const INTERVAL: Duration = Duration::from_secs(1);

/// …and as many at once after a rest: a node that is lost and back within a second is told of.
const BURST: u32 = 3;

/// One line of a kind on strangers in this time: a render server with a wrong key tries again each second, for days.
const STRANGER_INTERVAL: Duration = Duration::from_secs(600);

/// Lines about controllers that are written at once for each machine, and the pause between further ones: enough for
/// somebody who sets a controller up, few for one that is wrong for days.
const OF_CONTROLLERS: (u32, Duration) = (5, Duration::from_secs(60));

/// Log lines about render servers that are written at once: all of a farm join, are ready, fall silent and are lost.
const MOST_NODE_LINES_AT_ONCE: u32 = 4 * MOST_NODES as u32;

/// Log lines about strangers that are written at once: more than there are reasons to drop one.
const MOST_STRANGER_LINES_AT_ONCE: u32 = 32;

/// The pause between further log lines, of render servers and of strangers each.
const LINE_INTERVAL: Duration = Duration::from_millis(250);

/// Most kinds that are told apart; more share one.
const MOST_KINDS: usize = 4096;

/// Decides which lines are written, and counts those that are not: peers can choose names, so kinds alone are no limit.
#[derive(Debug)]
pub(crate) struct LogLimit<K> {
    /// The limit of each kind, and how many lines were left out since the last. `None`: kinds beyond [`MOST_KINDS`].
    kinds: HashMap<Option<K>, (RateLimit, u32)>,
    /// The burst and the interval of each kind.
    of_kind: (u32, Duration),
    /// All kinds together.
    total: RateLimit,
    /// Lines that `total` left out since the last one that was written.
    n_others_left_out: u32,
}

impl<K: Eq + Hash> LogLimit<K> {
    /// Lets a few lines of a kind pass at once and one each second, and of all kinds as many as a farm needs.
    pub(super) fn of_nodes() -> Self {
        Self::new((BURST, INTERVAL), RateLimit::new(MOST_NODE_LINES_AT_ONCE, LINE_INTERVAL))
    }

    /// Lets one line of a kind pass each ten minutes.
    pub(crate) fn of_strangers() -> Self {
        Self::new((1, STRANGER_INTERVAL), RateLimit::new(MOST_STRANGER_LINES_AT_ONCE, LINE_INTERVAL))
    }

    /// Lets five lines of a kind pass at once, and one each minute.
    pub(crate) fn of_controllers() -> Self {
        Self::new(OF_CONTROLLERS, RateLimit::new(MOST_STRANGER_LINES_AT_ONCE, OF_CONTROLLERS.1))
    }

    fn new(of_kind: (u32, Duration), total: RateLimit) -> Self {
        Self { kinds: HashMap::new(), of_kind, total, n_others_left_out: 0 }
    }

    /// Whether a line may be written at `now`; if so, what to add to it about those that were left out before.
    pub(crate) fn admit(&mut self, now: Duration, kind: K) -> Option<String> {
        if self.kinds.len() >= MOST_KINDS {
            self.kinds.retain(|_, (limit, _)| !limit.is_full(now));
        }
        let kind = Some(kind);
        let kind = if self.kinds.len() < MOST_KINDS || self.kinds.contains_key(&kind) { kind } else { None };
        let (burst, interval) = self.of_kind;
        let (limit, n_left_out) = self.kinds.entry(kind).or_insert_with(|| (RateLimit::new(burst, interval), 0));
        if !limit.wait(now).is_zero() {
            *n_left_out += 1;
            return None;
        }
        if !self.total.wait(now).is_zero() {
            self.n_others_left_out += 1;
            return None;
        }
        limit.count(now);
        self.total.count(now);
        let mut more = String::new();
        if *n_left_out > 0 {
            more = format!(" ({n_left_out} more like this before)");
        }
        *n_left_out = 0;
        if std::mem::take(&mut self.n_others_left_out) > 0 {
            more += " (other lines were left out: there were too many)";
        }
        Some(more)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_line_of_a_kind_is_written_each_second_with_a_count() {
        let mut limit = LogLimit::new((BURST, INTERVAL), RateLimit::new(100, Duration::ZERO));
        let mut admit = |milliseconds, kind| limit.admit(Duration::from_millis(milliseconds), kind);
        assert_eq!([0, 0, 5].map(|at| admit(at, "lost")), [(); 3].map(|()| Some(String::new())));
        assert_eq!(admit(5, "joined"), Some(String::new()), "another kind");
        assert_eq!([admit(10, "lost"), admit(20, "lost")], [None, None]);
        assert_eq!(admit(1020, "lost"), Some(" (2 more like this before)".to_owned()));
        assert_eq!(admit(1030, "lost"), None);
        assert_eq!(admit(9000, "lost"), Some(" (1 more like this before)".to_owned()));
        assert_eq!(admit(9000, "lost"), Some(String::new()), "after a rest");
    }

    #[test]
    fn a_stranger_that_tries_again_each_second_is_told_of_each_ten_minutes() {
        let mut limit = LogLimit::of_strangers();
        let lines = (0..1800).filter_map(|second| limit.admit(Duration::from_secs(second), "wrong key"));
        assert_eq!(lines.collect::<Vec<_>>(), ["", " (599 more like this before)", " (599 more like this before)"]);
        assert_eq!(limit.admit(Duration::from_secs(1799), "no key"), Some(String::new()), "something else");
    }

    #[test]
    fn kinds_without_end_share_a_line() {
        let mut limit = LogLimit::new((BURST, INTERVAL), RateLimit::new(100_000, Duration::ZERO));
        let n_lines = (0..10_000).filter(|kind| limit.admit(Duration::ZERO, *kind).is_some()).count();
        assert_eq!(n_lines, MOST_KINDS + BURST as usize);
        assert!(limit.kinds.len() <= MOST_KINDS + 1);
        assert!(limit.admit(Duration::from_secs(9), 10_000).is_some());
        assert!(limit.kinds.len() <= 2, "they are forgotten");
    }

    #[test]
    fn kinds_without_end_write_few_lines_in_all() {
        let mut limit = LogLimit::new((BURST, INTERVAL), RateLimit::new(10, Duration::from_millis(250)));
        // 10,000 kinds in ten seconds.
        let mut lines = (0..10_000).filter_map(|kind| limit.admit(Duration::from_millis(kind), kind));
        let last = lines.by_ref().skip(20).last().unwrap();
        assert!(last.contains("other lines were left out"), "{last}");
        drop(lines);
        let mut limit = LogLimit::new((BURST, INTERVAL), RateLimit::new(10, Duration::from_millis(250)));
        let n_lines = (0..10_000).filter(|&kind| limit.admit(Duration::from_millis(kind), kind).is_some()).count();
        assert!((40..=50).contains(&n_lines), "{n_lines}");
    }
}
