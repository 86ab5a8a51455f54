//! How long a wall that dies again and again is left alone.

use std::time::Duration;

const SHORTEST: Duration = Duration::from_secs(1);
const LONGEST: Duration = Duration::from_secs(60);

/// A wall that lived for so long may be started again at once: what killed it was no part of starting.
const LONG_LIFE: Duration = Duration::from_secs(60);

/// Grows with every death in a row.
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
    /// How long to wait before a wall is started again that showed frames for so long.
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
    fn who_dies_again_and_again_waits_ever_longer_up_to_a_minute() {
        let mut patience = RestartDelay::default();
        let pauses: Vec<u64> = (0..9).map(|_| patience.next_delay(Duration::from_secs(5)).as_secs()).collect();
        assert_eq!(pauses, [1, 2, 4, 8, 16, 32, 60, 60, 60]);
        assert_eq!(patience.next_delay(Duration::from_secs(3600)).as_secs(), 1);
        assert_eq!(patience.next_delay(Duration::ZERO).as_secs(), 2);
    }
}
