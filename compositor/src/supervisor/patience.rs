//! How long a wall that dies again and again is left alone.

use std::time::Duration;

const SHORTEST: Duration = Duration::from_secs(1);
const LONGEST: Duration = Duration::from_secs(60);

/// A wall that lived for so long may be started again at once: what killed it was no part of starting.
const LONG_LIFE: Duration = Duration::from_secs(60);

/// Grows with every death in a row.
#[derive(Clone, Debug)]
pub(super) struct Patience {
    pause: Duration,
}

impl Default for Patience {
    fn default() -> Self {
        Self { pause: SHORTEST }
    }
}

impl Patience {
    /// How long to wait before a wall is started again that showed frames for so long.
    pub(super) fn after(&mut self, shown_for: Duration) -> Duration {
        if shown_for >= LONG_LIFE {
            self.pause = SHORTEST;
        }
        let pause = self.pause;
        self.pause = (2 * pause).min(LONGEST);
        pause
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_dies_again_and_again_waits_ever_longer_up_to_a_minute() {
        let mut patience = Patience::default();
        let pauses: Vec<u64> = (0..9).map(|_| patience.after(Duration::from_secs(5)).as_secs()).collect();
        assert_eq!(pauses, [1, 2, 4, 8, 16, 32, 60, 60, 60]);
        assert_eq!(patience.after(Duration::from_secs(3600)).as_secs(), 1);
        assert_eq!(patience.after(Duration::ZERO).as_secs(), 2);
    }
}
