//! Chooses the rung of the ladder, resolution and rays, that holds the target rate, from the times that frames took.
//!
//! ARCHITECTURE.md ("Resolution") has the model. The fewer late frames there are, the later they must be to lower the
//! resolution. Raises wait longer each time, so that with steady nodes the picture does not flicker.

use std::{collections::VecDeque, time::Duration};

use super::{display::DisplayCost, ladder::Ladder};

/// The part of the target interval to aim at; the rest is for frames that take longer than others.
const TARGET_PART: f64 = 0.9;
/// Frames may always take this many times as long to show as the coarsest: on a slow display a finer picture is worth a
/// part of a rate that is low in any case.
const DISPLAY_ROOM: f64 = 1.25;
/// A finer resolution may be expected to take at most this part of the aim.
const HEADROOM: f64 = 0.9;
/// A finer resolution that is expected to take at most this part of the aim is tried without a longer wait.
const CLEAR_ROOM: f64 = 0.5;
/// Times are clamped to this multiple of the aim.
const LONGEST: f64 = 3.0;
/// Recent frames whose times are kept.
const N_RECENT: usize = 8;
/// Frames of both resolutions that are needed to compute the fixed time after a change.
const N_KNOWN: usize = 4;
/// Frames in time before the resolution is raised, at first…
const FEWEST_FRAMES_BEFORE_RAISE: u32 = N_RECENT as u32;
/// …and at most: a minute's worth at 30 a second.
const MOST_FRAMES_BEFORE_RAISE: u32 = 2048;

#[derive(Clone, Debug, Default)]
pub(super) struct ResolutionControl {
    target_s: f64,
    pub(super) display: DisplayCost,
    pub(super) rung: usize,
    /// The times of the last frames since the resolution changed, in seconds.
    recent_s: VecDeque<f64>,
    /// Frames since then.
    n_frames: u32,
    /// Mean time of the frames since then, or of the last `frames_before_raise` of them, in seconds.
    long_mean_s: f64,
    frames_before_raise: u32,
    was_raised: bool,
    /// Whether the display, not the farm, lowered the resolution last: room of the farm then tells nothing.
    is_display_limited: bool,
    /// The fixed part of a frame's time, in seconds.
    fixed_s: f64,
    /// The previous resolution in samples, and the mean time of its frames in seconds.
    previous: Option<(f64, f64)>,
}

impl ResolutionControl {
    pub(super) fn new(target_interval: Duration, ladder: &Ladder, rung: usize) -> Self {
        Self {
            target_s: target_interval.as_secs_f64(),
            display: DisplayCost::new(ladder.size(0)),
            rung,
            frames_before_raise: FEWEST_FRAMES_BEFORE_RAISE,
            ..Self::default()
        }
    }

    /// The camera rests: the next motion may differ from this one.
    pub(super) fn rest(&mut self) {
        self.set_rung(self.rung);
        self.frames_before_raise = FEWEST_FRAMES_BEFORE_RAISE;
        (self.was_raised, self.is_display_limited, self.previous) = (false, false, None);
    }

    /// The interval to hold, in seconds: the target's, or the display's if that is longer.
    fn interval_s(&self, ladder: &Ladder) -> f64 {
        let coarsest_s = self.shown_s(ladder, ladder.last());
        self.target_s.max(DISPLAY_ROOM * coarsest_s).max(self.display.refresh_s)
    }

    /// Accounts for a frame of the present rung that the farm has completed, and changes the rung if needed; none is better
    /// than `best`.
    pub(super) fn learn(&mut self, ladder: &Ladder, best: usize, took: Duration) {
        if self.rung < best {
            self.set_rung(best);
        }
        let interval_s = self.interval_s(ladder);
        let aim_s = TARGET_PART * interval_s;
        if self.recent_s.len() == N_RECENT {
            self.recent_s.pop_front();
        }
        self.recent_s.push_back(took.as_secs_f64());
        self.n_frames = self.n_frames.saturating_add(1);
        let weight = 1.0 / f64::from(self.n_frames.min(self.frames_before_raise));
        self.long_mean_s += weight * (took.as_secs_f64().min(LONGEST * aim_s) - self.long_mean_s);
        let Some(mean_s) = self.mean_s() else { return };
        self.learn_fixed(ladder, mean_s, aim_s);
        // The mean of few frames is less certain.
        let is_late = mean_s > aim_s * (1.0 + 1.0 / self.recent_s.len() as f64);
        let is_shown_late = self.shown_s(ladder, self.rung) > interval_s;
        if (is_late || is_shown_late) && self.rung < ladder.last() {
            self.is_display_limited = is_shown_late;
            if self.was_raised {
                self.frames_before_raise = (2 * self.frames_before_raise).min(MOST_FRAMES_BEFORE_RAISE);
            }
            let in_time =
                |&rung: &usize| self.expected_s(ladder, mean_s, rung).max(self.shown_s(ladder, rung)) <= aim_s;
            let rung = (self.rung + 1..ladder.last()).find(in_time).unwrap_or(ladder.last());
            self.change_rung(ladder, mean_s, rung);
        } else if self.rung > best
            && self.n_frames >= FEWEST_FRAMES_BEFORE_RAISE
            && self.shown_s(ladder, self.rung - 1) <= aim_s
        {
            let expected_s = |mean_s| self.expected_s(ladder, mean_s, self.rung - 1);
            let is_due = self.n_frames >= self.frames_before_raise
                && expected_s(self.long_mean_s.max(mean_s)) <= HEADROOM * aim_s;
            let is_clear = !self.is_display_limited && expected_s(mean_s) <= CLEAR_ROOM * aim_s;
            if is_due || is_clear {
                self.change_rung(ladder, mean_s, self.rung - 1);
            }
        }
    }

    /// Mean time of the last frames in seconds, without the longest, which is an outlier.
    fn mean_s(&self) -> Option<f64> {
        let n_others = self.recent_s.len().checked_sub(1).filter(|&n_others| n_others > 0)?;
        let longest = self.recent_s.iter().copied().fold(0.0, f64::max);
        Some((self.recent_s.iter().sum::<f64>() - longest) / n_others as f64)
    }

    /// The expected time of a frame of another rung, if those of this rung take `mean_s`; in seconds.
    fn expected_s(&self, ladder: &Ladder, mean_s: f64, rung: usize) -> f64 {
        let fixed_s = self.fixed_s.min(mean_s);
        fixed_s + (mean_s - fixed_s) * ladder.cost(rung) / ladder.cost(self.rung)
    }

    fn shown_s(&self, ladder: &Ladder, rung: usize) -> f64 {
        self.display.expected_s(ladder.size(rung))
    }

    fn learn_fixed(&mut self, ladder: &Ladder, mean_s: f64, aim_s: f64) {
        if let Some((n_before, before_s)) = self.previous.filter(|_| self.recent_s.len() == N_KNOWN) {
            let n_now = ladder.cost(self.rung);
            let per_sample_s = (mean_s - before_s) / (n_now - n_before);
            let fixed_s = mean_s - per_sample_s * n_now;
            // Nodes may have changed their speed meanwhile: average with the previous value, within limits.
            self.fixed_s = (self.fixed_s + fixed_s.clamp(0.0, aim_s / 2.0)) / 2.0;
        }
    }

    fn change_rung(&mut self, ladder: &Ladder, mean_s: f64, rung: usize) {
        // Only resolutions are known to differ in their number of samples.
        let is_known = self.recent_s.len() >= N_KNOWN && ladder.rays(rung) == ladder.rays(self.rung);
        self.previous = is_known.then(|| (ladder.cost(self.rung), mean_s));
        self.was_raised = rung < self.rung;
        self.set_rung(rung);
    }

    fn set_rung(&mut self, rung: usize) {
        self.rung = rung;
        self.recent_s.clear();
        self.n_frames = 0;
    }
}
