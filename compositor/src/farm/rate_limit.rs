//! A rate limit with a burst: what is rare passes at once, a flood passes evenly.

use std::time::Duration;

/// Lets `burst` events pass at once, and one each `interval` in the long run (the generic cell rate algorithm).
#[derive(Debug)]
pub(crate) struct RateLimit {
    burst: u32,
    interval: Duration,
    /// When the whole burst may pass again.
    full_at: Duration,
}

impl RateLimit {
    pub(crate) fn new(burst: u32, interval: Duration) -> Self {
        Self { burst, interval, full_at: Duration::ZERO }
    }

    /// How long the next event must wait from `now` on.
    pub(crate) fn wait(&self, now: Duration) -> Duration {
        (self.full_at + self.interval).saturating_sub(now + self.interval * self.burst)
    }

    /// Whether the whole burst may pass at `now`: nothing is lost if the limit is forgotten.
    pub(crate) fn is_full(&self, now: Duration) -> bool {
        self.full_at <= now
    }

    /// Counts an event that passes at `now`.
    pub(crate) fn count(&mut self, now: Duration) {
        self.full_at = self.full_at.max(now) + self.interval;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_burst_passes_at_once_and_a_flood_evenly() {
        let mut limit = RateLimit::new(10, Duration::from_millis(100));
        let passes = |limit: &mut RateLimit, milliseconds| {
            let now = Duration::from_millis(milliseconds);
            let passes = limit.wait(now).is_zero();
            if passes {
                limit.count(now);
            }
            passes
        };
        let n_at_once = (0..20).filter(|_| passes(&mut limit, 5000)).count();
        assert_eq!(n_at_once, 10);
        assert_eq!(limit.wait(Duration::from_millis(5030)), Duration::from_millis(70));
        let n_in_a_second = (5001..=6000).filter(|&milliseconds| passes(&mut limit, milliseconds)).count();
        assert_eq!(n_in_a_second, 10);
        assert!((0..20).filter(|_| passes(&mut limit, 9000)).count() == 10, "it recovers");
    }
}
