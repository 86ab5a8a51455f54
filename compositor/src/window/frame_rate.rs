//! The rate of frames on screen. Pure: time is an argument.

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

#[derive(Debug, Default)]
pub(super) struct FrameRate {
    shown_at: VecDeque<Instant>,
}

/// Older frames do not count; a wall without a new frame for this time is at rest.
const WINDOW: Duration = Duration::from_secs(1);

impl FrameRate {
    pub(super) fn count(&mut self, now: Instant) {
        self.forget_old(now);
        self.shown_at.push_back(now);
    }

    /// Frames per second, or `None` while the wall is at rest.
    pub(super) fn per_second(&mut self, now: Instant) -> Option<f64> {
        self.forget_old(now);
        let (&first, &last) = (self.shown_at.front()?, self.shown_at.back()?);
        let intervals = self.shown_at.len() - 1;
        (intervals > 0 && last > first).then(|| intervals as f64 / (last - first).as_secs_f64())
    }

    /// When the wall will be at rest, unless it shows another frame.
    pub(super) fn rests_at(&self) -> Option<Instant> {
        self.shown_at.back().map(|&last| last + WINDOW)
    }

    fn forget_old(&mut self, now: Instant) {
        while self.shown_at.front().is_some_and(|&shown_at| now.saturating_duration_since(shown_at) >= WINDOW) {
            self.shown_at.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_steady_rate_is_measured_and_rest_has_no_rate() {
        let start = Instant::now();
        let mut rate = FrameRate::default();
        assert_eq!(rate.per_second(start), None);
        for frame in 0..100 {
            rate.count(start + Duration::from_millis(50 * frame));
        }
        let last = start + Duration::from_millis(50 * 99);
        let per_second = rate.per_second(last).expect("frames flow");
        assert!((per_second - 20.0).abs() < 1e-9, "{per_second}");
        assert_eq!(rate.rests_at(), Some(last + WINDOW));
        assert_eq!(rate.per_second(last + WINDOW), None);
        assert_eq!(rate.rests_at(), None);
    }
}
