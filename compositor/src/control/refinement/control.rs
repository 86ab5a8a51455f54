//! Which resolution holds the target rate, from what frames took.
//!
//! A frame takes a time that grows with its samples and a time that does not: render servers, network and wall are asked
//! for every frame. How long the latter is shows when the resolution changes.
//!
//! Late frames lower the resolution at once, as far as it takes; the fewer there are the later they must be, and a single
//! one never does. Frames that leave room for the next finer resolution raise it by one, only after some time, and later
//! still each time when that proved too much: steady nodes do not make the picture flicker.
//!
//! Frames are rendered while others are shown, so a frame is late that takes longer than the target rate allows either to
//! render or to show. A rate that cannot be seen is not paid for: where the display could not show the target rate even with
//! the coarsest frames, the rate that it can show takes its place.

use std::{collections::VecDeque, time::Duration};

use shared::division::FrameSize;

use super::{
    display::{DisplayCost, ShowTimes},
    ladder::Ladder,
};

/// How much of the time between two frames is aimed at: the rest is for frames that take longer than others.
const TARGET_PART: f64 = 0.9;
/// Where the coarsest frames take the display nearly as long as the target rate allows, or longer, frames may take so many
/// times as long as those: what is finer is worth a part of a rate that is low in any case.
const DISPLAY_ROOM: f64 = 1.25;
/// The next finer resolution must be expected to leave this much of what is aimed at.
const HEADROOM: f64 = 0.9;
/// With so much room it is not waited for longer, however often it proved too much.
const CLEAR_ROOM: f64 = 0.5;
/// A frame that takes longer than so many times what is aimed at counts as one that takes as long.
const LONGEST: f64 = 3.0;
/// The time of so many frames is remembered.
const N_RECENT: usize = 8;
/// A change shows what frames of any size take if so many of both sizes are known.
const N_KNOWN: usize = 4;
/// Frames that must leave room before the resolution is raised, at first…
const FEWEST_FRAMES_BEFORE_RAISE: u32 = N_RECENT as u32;
/// …and at most: a minute's worth at 30 a second.
const MOST_FRAMES_BEFORE_RAISE: u32 = 2048;

/// The resolution of a moving camera's frames.
#[derive(Clone, Debug)]
pub(super) struct ResolutionControl {
    /// The time between two frames at the target rate, in seconds.
    target_s: f64,
    display: DisplayCost,
    rung: usize,
    /// What the last frames took since the resolution was changed, in seconds.
    recent_s: VecDeque<f64>,
    /// How many frames there were since then.
    n_frames: u32,
    /// What frames took on average since then, or the last of them if there were more than patience asks for; in seconds.
    long_mean_s: f64,
    frames_before_raise: u32,
    /// Whether the resolution was raised when it was last changed.
    was_raised: bool,
    /// What a frame of any size takes, in seconds.
    fixed_s: f64,
    /// The resolution before, in samples, and what its frames took, in seconds.
    previous: Option<(f64, f64)>,
}

impl ResolutionControl {
    pub(super) fn new(target_interval: Duration, ladder: &Ladder, rung: usize) -> Self {
        Self {
            target_s: target_interval.as_secs_f64(),
            display: DisplayCost::new(ladder.size(0)),
            rung,
            recent_s: VecDeque::with_capacity(N_RECENT),
            n_frames: 0,
            long_mean_s: 0.0,
            frames_before_raise: FEWEST_FRAMES_BEFORE_RAISE,
            was_raised: false,
            fixed_s: 0.0,
            previous: None,
        }
    }

    pub(super) fn rung(&self) -> usize {
        self.rung
    }

    /// The camera rests: what comes after has little to do with what was before.
    pub(super) fn rest(&mut self) {
        self.set_rung(self.rung);
        self.frames_before_raise = FEWEST_FRAMES_BEFORE_RAISE;
        (self.was_raised, self.previous) = (false, None);
    }

    /// The time between two frames to hold, in seconds: the target's, or the display's where that cannot be had.
    fn interval_s(&self, ladder: &Ladder) -> f64 {
        let coarsest_s = self.shown_s(ladder, ladder.last());
        self.target_s.max(DISPLAY_ROOM * coarsest_s).max(self.display.refresh_s())
    }

    /// A frame of any size was shown.
    pub(super) fn learn_shown(&mut self, size: FrameSize, times: &ShowTimes) {
        self.display.learn(size, times);
    }

    /// A frame of this rung took the farm so long.
    pub(super) fn learn(&mut self, ladder: &Ladder, took: Duration) {
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
        // The fewer frames there are, the less their mean says.
        let is_late = mean_s > aim_s * (1.0 + 1.0 / self.recent_s.len() as f64);
        if (is_late || self.shown_s(ladder, self.rung) > interval_s) && self.rung < ladder.last() {
            if self.was_raised {
                self.frames_before_raise = (2 * self.frames_before_raise).min(MOST_FRAMES_BEFORE_RAISE);
            }
            let in_time =
                |&rung: &usize| self.expected_s(ladder, mean_s, rung).max(self.shown_s(ladder, rung)) <= aim_s;
            let rung = (self.rung + 1..ladder.last()).find(in_time).unwrap_or(ladder.last());
            self.change_rung(ladder, mean_s, rung);
        } else if self.rung > 0
            && self.n_frames >= FEWEST_FRAMES_BEFORE_RAISE
            && self.shown_s(ladder, self.rung - 1) <= aim_s
        {
            let expected_s = |mean_s| self.expected_s(ladder, mean_s, self.rung - 1);
            let is_due = self.n_frames >= self.frames_before_raise
                && expected_s(self.long_mean_s.max(mean_s)) <= HEADROOM * aim_s;
            if is_due || expected_s(mean_s) <= CLEAR_ROOM * aim_s {
                self.change_rung(ladder, mean_s, self.rung - 1);
            }
        }
    }

    /// What the last frames took on average but for the one that took longest, which says nothing of those to come.
    fn mean_s(&self) -> Option<f64> {
        let n_others = self.recent_s.len().checked_sub(1).filter(|&n_others| n_others > 0)?;
        let longest = self.recent_s.iter().copied().fold(0.0, f64::max);
        Some((self.recent_s.iter().sum::<f64>() - longest) / n_others as f64)
    }

    /// What a frame of another rung will take, where those of this one take `mean_s`.
    fn expected_s(&self, ladder: &Ladder, mean_s: f64, rung: usize) -> f64 {
        let fixed_s = self.fixed_s.min(mean_s);
        fixed_s + (mean_s - fixed_s) * n_samples(ladder, rung) / n_samples(ladder, self.rung)
    }

    /// What the display will take for a frame of a rung.
    fn shown_s(&self, ladder: &Ladder, rung: usize) -> f64 {
        self.display.expected_s(ladder.size(rung))
    }

    fn learn_fixed(&mut self, ladder: &Ladder, mean_s: f64, aim_s: f64) {
        if let Some((n_before, before_s)) = self.previous.filter(|_| self.recent_s.len() == N_KNOWN) {
            let n_now = n_samples(ladder, self.rung);
            let per_sample_s = (mean_s - before_s) / (n_now - n_before);
            let fixed_s = mean_s - per_sample_s * n_now;
            // Nodes may have become slower or faster meanwhile, so this is no more than a hint; and believed too much it
            // would lower the resolution too far.
            self.fixed_s = (self.fixed_s + fixed_s.clamp(0.0, aim_s / 2.0)) / 2.0;
        }
    }

    fn change_rung(&mut self, ladder: &Ladder, mean_s: f64, rung: usize) {
        self.previous = (self.recent_s.len() >= N_KNOWN).then(|| (n_samples(ladder, self.rung), mean_s));
        self.was_raised = rung < self.rung;
        self.set_rung(rung);
    }

    fn set_rung(&mut self, rung: usize) {
        self.rung = rung;
        self.recent_s.clear();
        self.n_frames = 0;
    }
}

fn n_samples(ladder: &Ladder, rung: usize) -> f64 {
    f64::from(ladder.size(rung).n_samples())
}
