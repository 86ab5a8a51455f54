//! The delay before a process that died starts again. Pure.

use std::time::Duration;

/// The first delay, and the longest.
const DELAYS: [Duration; 2] = [Duration::from_secs(1), Duration::from_secs(60)];

/// A process that worked for this long resets the delay: its start was not what failed.
const LONG_LIFE: Duration = Duration::from_secs(60);

/// The delay before the next start, after a process that worked for `worked_for`; doubles with each death in a row.
pub(crate) fn next_delay(last: Option<Duration>, worked_for: Duration) -> Duration {
    let [first, longest] = DELAYS;
    last.filter(|_| worked_for < LONG_LIFE).map_or(first, |last| (2 * last).min(longest))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repeated_deaths_double_the_delay_up_to_a_minute() {
        let mut last = None;
        let mut next = |worked_s| {
            last = Some(next_delay(last, Duration::from_secs(worked_s)));
            last.map(|delay| delay.as_secs())
        };
        assert_eq!([5; 9].map(&mut next), [1, 2, 4, 8, 16, 32, 60, 60, 60].map(Some));
        assert_eq!([3600, 0].map(next), [1, 2].map(Some));
    }
}
