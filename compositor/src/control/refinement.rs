//! How finely the wall is rendered: as coarse as a moving camera needs to be followed at the target rate, and at rest as
//! fine as the wall is, with more and more samples a pixel until there are enough. Pure: time is an argument.
//!
//! While the camera moves each frame has one sample a pixel, and [`pace`] chooses from a [`ladder`] of resolutions by what
//! frames take the farm and the [`display`]. At rest the picture is rendered again, each time by as many whole frames as it
//! takes: in the wall's own resolution with one sample a pixel, then four, sixteen and so on. Each of these is a [`Picture`]
//! like any other, whose samples render servers average in linear light; so nothing is added up here, and nothing that nodes
//! do or fail to do changes a bit of it.

mod display;
mod ladder;
mod pace;

use std::time::{Duration, Instant};

use shared::{
    division::FrameSize,
    protocol::{Picture, SampleRange},
};

pub use self::display::Shown;
use self::{ladder::Ladder, pace::Pace};

/// Frames a second that are held while the camera moves, unless somebody says otherwise.
pub const DEFAULT_TARGET_RATE: f64 = 30.0;

/// Samples a pixel of a wall at rest, unless somebody says otherwise.
pub const DEFAULT_SAMPLES: u32 = 16;

/// A camera that has not moved for so long rests: shorter than a hand takes to begin the next motion, the wall would begin
/// to refine and stop again.
const REST: Duration = Duration::from_millis(200);

/// Each refinement has so many times the samples of the one before: all of them together take a third more than the last.
const SAMPLES_FACTOR: u32 = 4;

/// How finely a wall may be rendered.
#[derive(Clone, Copy, Debug)]
pub struct RefinementOptions {
    /// Whether the resolution follows the motion, at first.
    pub is_on: bool,
    /// Frames a second while the camera moves; above zero.
    pub target_rate: f64,
    /// The resolution at rest.
    pub native: FrameSize,
    /// Samples a pixel at rest; from 1 to [`SampleRange::LARGEST_COUNT`].
    pub n_samples: u32,
    /// The resolution of all frames while it is off; the first frames have about as many samples while it is on.
    pub fixed_size: FrameSize,
    /// Which samples of each pixel are averaged in all frames while it is off.
    pub fixed_samples: SampleRange,
}

/// A picture to render now.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ask {
    /// The picture.
    pub picture: Picture,
    /// Whether it only refines what was shown already.
    pub refines: bool,
}

/// Which picture is to be rendered now.
#[derive(Clone, Debug)]
pub struct Refinement {
    options: RefinementOptions,
    ladder: Ladder,
    pace: Pace,
    state: Option<State>,
}

/// What was asked for last.
#[derive(Clone, Copy, Debug)]
struct State {
    ask: Ask,
    is_shown: bool,
    /// When what is seen was changed last.
    changed_at: Instant,
}

impl Refinement {
    /// Nothing is to be rendered yet.
    pub fn new(options: RefinementOptions) -> Self {
        let ladder = Ladder::down_from(options.native);
        let rung = ladder.rung_of(options.fixed_size.n_samples());
        let interval = Duration::from_secs_f64(1.0 / options.target_rate);
        Self { pace: Pace::new(interval, &ladder, rung), ladder, options, state: None }
    }

    /// No frame that follows the motion has a longer side than this from now on: what the GPU takes.
    pub fn limit_sides(&mut self, largest: u32) {
        let [xres, yres] =
            <[u32; 2]>::from(<(u32, u32)>::from(self.options.native)).map(|side| side.min(largest.max(1)));
        if let Ok(native) = FrameSize::new(xres, yres)
            && native != self.options.native
        {
            *self = Self::new(RefinementOptions { native, ..self.options });
        }
    }

    /// Whether the resolution follows the motion.
    pub fn is_on(&self) -> bool {
        self.options.is_on
    }

    /// Has the resolution follow the motion, or not, from the next change on.
    pub fn set_on(&mut self, is_on: bool) {
        self.options.is_on = is_on;
        self.start_again();
    }

    /// The next change is one, even if what is seen is the same.
    pub fn start_again(&mut self) {
        self.state = None;
    }

    /// Samples a pixel that a picture has once it is refined.
    pub fn n_samples(&self) -> u32 {
        if self.is_on() { self.options.n_samples } else { self.options.fixed_samples.count }
    }

    /// Somebody wants to see this, from here: what to render now. Size and samples of `subject` do not matter.
    pub fn change(&mut self, now: Instant, subject: Picture) -> Ask {
        let (size, samples) = match self.is_on() {
            true => (self.ladder.size(self.pace.rung()), SampleRange::CENTRE),
            false => (self.options.fixed_size, self.options.fixed_samples),
        };
        let is_same = |state: &State| {
            let Picture { size, samples, .. } = state.ask.picture;
            state.ask.picture == Picture { size, samples, ..subject }
        };
        let ask = Ask { picture: Picture { size, samples, ..subject }, refines: false };
        // What is seen already need not become coarse again.
        self.state.take_if(|state| !is_same(state));
        self.state.get_or_insert(State { ask, is_shown: false, changed_at: now }).ask
    }

    /// A frame has come, and took so long of the farm's time.
    pub fn on_frame(&mut self, picture: &Picture, took: Duration) {
        let is_moving_size = picture.size == self.ladder.size(self.pace.rung());
        if self.is_on() && is_moving_size && picture.samples == SampleRange::CENTRE {
            self.pace.learn(&self.ladder, took);
        }
        if let Some(state) = self.state.as_mut().filter(|state| state.ask.picture == *picture) {
            state.is_shown = true;
        }
    }

    /// A frame was shown.
    pub fn on_shown(&mut self, picture: &Picture, shown: &Shown) {
        self.pace.learn_shown(picture.size, shown);
    }

    /// When to ask for the next refinement, unless anything changes; `None` when there is none, or the last is yet to come.
    pub fn refines_at(&self) -> Option<Instant> {
        let state = self.state.filter(|state| state.is_shown)?;
        self.finer(&state.ask.picture).map(|_| state.changed_at + REST)
    }

    /// The next refinement, once it is time.
    pub fn refine(&mut self, now: Instant) -> Option<Ask> {
        if now < self.refines_at()? {
            return None;
        }
        let state = self.state?;
        let ask = Ask { picture: self.finer(&state.ask.picture)?, refines: true };
        self.pace.rest();
        self.state = Some(State { ask, is_shown: false, ..state });
        Some(ask)
    }

    /// Whether what was asked for last has come, and is as fine as it gets.
    pub fn is_done(&self) -> bool {
        self.state.is_some_and(|state| state.is_shown && self.finer(&state.ask.picture).is_none())
    }

    /// The next finer picture than this.
    fn finer(&self, picture: &Picture) -> Option<Picture> {
        let RefinementOptions { is_on, native, n_samples, .. } = self.options;
        let count = match picture.size == native {
            true => picture.samples.count.saturating_mul(SAMPLES_FACTOR).min(n_samples),
            false => 1,
        };
        let finer = Picture { size: native, samples: SampleRange { first: 0, count }, ..*picture };
        (is_on && finer != *picture).then_some(finer)
    }
}

#[cfg(test)]
mod tests;
