//! Decides which scene of a show is due. Pure: time is an argument.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use super::{
    edit::SceneMap,
    file::{Show, ShowScene},
};

/// A show none of whose scenes can be shown is tried again after this.
const RETRY: Duration = Duration::from_secs(5);

/// A step that the wall takes for a show.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// Read the model of this scene, have render servers load it, and answer with [`Player::on_read`].
    Prepare(usize),
    /// Show this scene, whose model was read, and answer with [`Player::on_shown`].
    Enter(usize),
}

/// Plays a show.
///
/// A scene's time counts from its first frame on the wall, so a slow farm cuts none short, and its caption is that of the
/// picture, never of one to come. A step of time ends one scene at most, however far the clock jumps.
#[derive(Clone, Debug)]
pub(crate) struct Player {
    show: Show,
    /// The scene that is on the wall, or was last.
    position: usize,
    /// Whether its picture is on the wall.
    is_shown: bool,
    /// How long it has been shown, up to `counted_at`.
    passed: Duration,
    counted_at: Instant,
    /// The time of its camera path, if it has one.
    path_time: Option<Duration>,
    next: Option<Next>,
    is_playing: bool,
    /// Whether a hand has moved the camera since.
    is_steered: bool,
    /// Whether the last scene of a show that does not repeat is over.
    has_ended: bool,
    /// The reasons why scenes were left out.
    skipped: BTreeMap<usize, String>,
    retry_at: Option<Instant>,
}

/// The scene to come.
#[derive(Clone, Copy, Debug)]
struct Next {
    index: usize,
    stage: Stage,
    /// Whether it comes as soon as it can.
    is_due: bool,
    /// Whether scenes that cannot be shown are left out towards the first.
    is_backwards: bool,
    /// Scenes that were left out on the way to it.
    n_skipped: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    Wanted,
    Reading,
    Read,
    /// Its first frame is awaited.
    Entered,
}

impl Player {
    /// Begins with the first scene.
    pub(crate) fn new(show: Show, now: Instant) -> Self {
        let mut player = Self {
            show,
            position: 0,
            is_shown: false,
            passed: Duration::ZERO,
            counted_at: now,
            path_time: None,
            next: None,
            is_playing: true,
            is_steered: false,
            has_ended: false,
            skipped: BTreeMap::new(),
            retry_at: None,
        };
        player.go_to(0, false);
        player
    }

    pub(crate) fn show(&self) -> &Show {
        &self.show
    }

    /// Takes an edited show, whose scenes are where `map` says, and perhaps more behind them.
    pub(crate) fn set_show(&mut self, show: Show, map: SceneMap) {
        let was_empty = self.show.scenes.is_empty();
        self.show = show;
        // Whoever makes a show wants to see the next view, not the one that was just kept.
        self.is_playing &= !was_empty;
        let skipped = std::mem::take(&mut self.skipped).into_iter();
        self.skipped = skipped.filter_map(|(index, reason)| Some((map.now(index)?, reason))).collect();
        // What comes next may be another now, and is read again.
        self.next = self.next.and_then(|next| {
            let index = map.now(next.index)?;
            match next.stage {
                Stage::Entered => Some(Next { index, ..next }),
                _ => next.is_due.then(|| Next { is_backwards: next.is_backwards, ..Next::new(index, true) }),
            }
        });
        match map.now(self.position) {
            Some(position) => self.position = position,
            // The scene after it takes its place on the wall, too.
            None => {
                self.is_shown = false;
                let n_scenes = self.show.scenes.len();
                if self.position >= n_scenes {
                    self.position = if self.show.repeats { 0 } else { n_scenes.saturating_sub(1) };
                }
                if self.next.is_none() {
                    self.go_to(self.position, false);
                }
            }
        }
    }

    /// The number of the scene that is on the wall, from 0, and the scene.
    pub(crate) fn shown(&self) -> Option<(usize, &ShowScene)> {
        Some(self.position).filter(|_| self.is_shown).and_then(|index| Some((index, self.show.scenes.get(index)?)))
    }

    pub(crate) fn is_playing(&self) -> bool {
        self.is_playing
    }

    /// Whether no scene can be shown now.
    pub(crate) fn is_stuck(&self) -> bool {
        !self.is_shown && (self.next.is_none() || self.retry_at.is_some())
    }

    /// A line for each scene that was left out.
    pub(crate) fn problems(&self) -> Vec<String> {
        self.skipped.iter().map(|(index, reason)| format!("Scene {} is left out: {reason}", index + 1)).collect()
    }

    /// The next step to take, if there is one: call it again until there is none.
    pub(crate) fn advance(&mut self, now: Instant) -> Option<Step> {
        self.count(now);
        if self.retry_at.is_some_and(|retry_at| now < retry_at) {
            return None;
        }
        self.retry_at = None;
        if self.next.is_none() && self.is_shown {
            self.next = self.after(self.position).map(|index| Next::new(index, false));
            self.end_last();
        }
        let is_over = self.is_playing && self.is_over();
        let next = self.next.as_mut()?;
        let step = match next.stage {
            Stage::Wanted => (Stage::Reading, Step::Prepare(next.index)),
            Stage::Read if next.is_due || is_over => (Stage::Entered, Step::Enter(next.index)),
            Stage::Read | Stage::Reading | Stage::Entered => return None,
        };
        next.stage = step.0;
        Some(step.1)
    }

    /// When to call [`Player::advance`] unless something happens before.
    pub(crate) fn wakes_at(&self) -> Option<Instant> {
        let is_read = self.next.is_some_and(|next| next.stage == Stage::Read);
        let is_last = self.next.is_none();
        let left = self.length().filter(|_| self.is_playing && self.is_shown && (is_read || is_last));
        let ends_at = left.map(|length| self.counted_at + length.saturating_sub(self.passed));
        self.retry_at.into_iter().chain(ends_at).min()
    }

    /// Takes the answer to [`Step::Prepare`]: why the scene cannot be shown, if so. Returns whether that is news.
    pub(crate) fn on_read(&mut self, index: usize, read: Result<(), String>, now: Instant) -> bool {
        let Some(next) = self.next.as_mut().filter(|next| (next.index, next.stage) == (index, Stage::Reading)) else {
            return false;
        };
        let Err(problem) = read else {
            next.stage = Stage::Read;
            self.skipped.remove(&index);
            return false;
        };
        let Next { is_due, is_backwards, n_skipped, .. } = *next;
        let is_news = self.skipped.insert(index, problem.clone()) != Some(problem);
        let beyond = if is_backwards { self.before(index) } else { self.after(index) };
        // Without a picture, all scenes are tried again and again, also by a show that does not repeat.
        let first_again = (!self.is_shown).then_some((index + 1) % self.show.scenes.len());
        let is_here = self.is_shown && beyond == Some(self.position);
        let is_whole = n_skipped + 1 >= self.show.scenes.len() || beyond.is_none();
        let is_round = is_here || is_whole && (self.show.repeats || !self.is_shown);
        let n_skipped = if is_round { 0 } else { n_skipped + 1 };
        self.next = beyond.or(first_again).map(|index| Next { is_backwards, n_skipped, ..Next::new(index, is_due) });
        self.retry_at = is_round.then(|| now + RETRY);
        is_news
    }

    /// The first frame of a scene that was entered is on the wall; `path_time` is as it was read.
    pub(crate) fn on_shown(&mut self, index: usize, path_time: Option<Duration>, now: Instant) {
        // Another may have been asked for since.
        self.next.take_if(|next| (next.index, next.stage) == (index, Stage::Entered));
        (self.position, self.is_shown, self.path_time) = (index, true, path_time);
        (self.passed, self.counted_at) = (Duration::ZERO, now);
    }

    /// Goes on to the scene after this one.
    pub(crate) fn go_on(&mut self) {
        if let Some(index) = self.after(self.target()) {
            self.go_to(index, false);
        }
    }

    /// Goes back to the scene before this one.
    pub(crate) fn go_back(&mut self) {
        if let Some(index) = self.before(self.target()) {
            self.go_to(index, true);
        }
    }

    /// Goes on with the show: with this scene from its beginning, if a hand has moved the camera since.
    pub(crate) fn play(&mut self, now: Instant) {
        self.count(now);
        self.is_playing = true;
        if std::mem::take(&mut self.has_ended) {
            self.go_to(0, false);
        }
        if std::mem::take(&mut self.is_steered) || !self.is_shown && self.next.is_none() {
            self.go_to(self.position.min(self.show.scenes.len().saturating_sub(1)), false);
        }
    }

    /// Holds the show where it is.
    pub(crate) fn pause(&mut self, now: Instant) {
        self.count(now);
        self.is_playing = false;
    }

    /// A touch of the wall. Returns whether it ends the scene, and so moves nothing.
    pub(crate) fn touch(&mut self) -> bool {
        let ends = self.is_playing && self.shown().is_some_and(|(_, scene)| scene.ending.by_touch);
        // A second finger skips nothing.
        if ends && self.target() == self.position {
            self.go_on();
        }
        ends
    }

    /// A hand moves the camera: the show waits.
    pub(crate) fn steer(&mut self, now: Instant) {
        if self.is_playing {
            self.pause(now);
            self.is_steered = true;
        }
    }

    /// Another model was opened by hand.
    pub(crate) fn leave(&mut self, now: Instant) {
        self.pause(now);
        (self.is_shown, self.next) = (false, None);
    }

    /// The scene that is on the wall, or is about to be.
    fn target(&self) -> usize {
        self.next.filter(|next| next.is_due || next.stage == Stage::Entered).map_or(self.position, |next| next.index)
    }

    fn go_to(&mut self, index: usize, is_backwards: bool) {
        self.retry_at = None;
        match &mut self.next {
            Some(next) if next.index == index && next.stage != Stage::Entered => next.is_due = true,
            next if index < self.show.scenes.len() => {
                *next = Some(Next { is_backwards, ..Next::new(index, true) });
            }
            _ => {}
        }
    }

    /// The scene after another: the first after the last of a show that repeats. One that does not tries each scene once.
    fn after(&self, index: usize) -> Option<usize> {
        let n_scenes = self.show.scenes.len();
        if !self.show.repeats {
            return (index + 1..n_scenes).find(|after| !self.skipped.contains_key(after));
        }
        Some((index + 1) % n_scenes.max(1)).filter(|&after| after != index && after < n_scenes)
    }

    fn before(&self, index: usize) -> Option<usize> {
        let n_scenes = self.show.scenes.len();
        if !self.show.repeats {
            return (0..index).rev().find(|before| !self.skipped.contains_key(before));
        }
        Some((index + n_scenes.saturating_sub(1)) % n_scenes.max(1))
            .filter(|&before| before != index && before < n_scenes)
    }

    /// The time of the scene on the wall; `None` without end.
    fn length(&self) -> Option<Duration> {
        let ending = self.show.scenes.get(self.position)?.ending;
        ending.after.or(self.path_time.filter(|_| !ending.waits))
    }

    fn is_over(&self) -> bool {
        self.is_shown && self.length().is_some_and(|length| self.passed >= length)
    }

    /// A show ends after its last scene, unless it repeats; one of a single scene begins its time again.
    fn end_last(&mut self) {
        if self.next.is_none() && self.is_over() {
            self.passed = Duration::ZERO;
            self.has_ended = !self.show.repeats;
            self.is_playing &= self.show.repeats;
        }
    }

    fn count(&mut self, now: Instant) {
        let elapsed = now.saturating_duration_since(self.counted_at);
        if self.is_playing && self.is_shown {
            self.passed = self.passed.saturating_add(elapsed);
        }
        self.counted_at = self.counted_at.max(now);
    }
}

impl Next {
    fn new(index: usize, is_due: bool) -> Self {
        Self { index, stage: Stage::Wanted, is_due, is_backwards: false, n_skipped: 0 }
    }
}

#[cfg(test)]
mod tests;
