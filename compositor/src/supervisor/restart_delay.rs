//! The delay before a crashed wall restarts. Pure.

use std::time::Duration;

const SHORTEST: Duration = Duration::from_secs(1);
const LONGEST: Duration = Duration::from_secs(60);

/// A child that showed frames for this long resets the delay: its start was not what failed.
const LONG_LIFE: Duration = Duration::from_secs(60);

/// Doubles with each crash in a row.
#[derive(Clone, Debug)]
pub(super) struct RestartDelay {
    delay: Duration,
}

impl Default for RestartDelay {
    fn default() -> Self {
        Self { delay: SHORTEST }
    }
}

impl RestartDelay {
    /// The delay before the next start, after a child that showed frames for `shown_for`.
    pub(super) fn next_delay(&mut self, shown_for: Duration) -> Duration {
        if shown_for >= LONG_LIFE {
            self.delay = SHORTEST;
        }
        let delay = self.delay;
        self.delay = (2 * delay).min(LONGEST);
        delay
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repeated_crashes_double_the_delay_up_to_a_minute() {
        let mut restart_delay = RestartDelay::default();
        let delays: Vec<u64> = (0..9).map(|_| restart_delay.next_delay(Duration::from_secs(5)).as_secs()).collect();
        assert_eq!(delays, [1, 2, 4, 8, 16, 32, 60, 60, 60]);
        assert_eq!(restart_delay.next_delay(Duration::from_secs(3600)).as_secs(), 1);
        assert_eq!(restart_delay.next_delay(Duration::ZERO).as_secs(), 2);
    }
}
