//! How finely the wall is rendered: as coarse as a moving camera needs to be followed at the target rate, and at rest as
//! fine as the wall is, with more and more samples a pixel until there are enough. Pure: time is an argument.
//!
//! While the camera moves each frame has one sample a pixel, and [`control`] chooses from a [`ladder`] of resolutions by what
//! frames take the farm and the [`display`]. At rest the picture is rendered again, each time by as many whole frames as it
//! takes: in the wall's own resolution with one sample a pixel, then four, sixteen and so on. Each of these is a [`FrameSpec`]
//! like any other, whose samples render servers average in linear light; so nothing is added up here, and nothing that nodes
//! do or fail to do changes a bit of it.

mod control;
mod display;
mod ladder;

use std::time::{Duration, Instant};

use shared::{
    division::FrameSize,
    protocol::{FrameSpec, SampleRange},
};

pub use self::display::ShowTimes;
use self::{control::ResolutionControl, ladder::Ladder};

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
pub struct RenderStep {
    /// The picture.
    pub spec: FrameSpec,
    /// Whether it only refines what was shown already.
    pub is_refinement: bool,
}

/// Which picture is to be rendered now.
#[derive(Clone, Debug)]
pub struct Refinement {
    options: RefinementOptions,
    ladder: Ladder,
    control: ResolutionControl,
    state: Option<LastStep>,
}

/// What was asked for last.
#[derive(Clone, Copy, Debug)]
struct LastStep {
    step: RenderStep,
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
        Self { control: ResolutionControl::new(interval, &ladder, rung), ladder, options, state: None }
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

    /// Somebody wants to see this, from here: what to render now. Size and samples of `spec` do not matter.
    pub fn change(&mut self, now: Instant, spec: FrameSpec) -> RenderStep {
        let (size, samples) = match self.is_on() {
            true => (self.ladder.size(self.control.rung()), SampleRange::CENTRE),
            false => (self.options.fixed_size, self.options.fixed_samples),
        };
        let is_same = |state: &LastStep| {
            let FrameSpec { size, samples, .. } = state.step.spec;
            state.step.spec == FrameSpec { size, samples, ..spec }
        };
        let step = RenderStep { spec: FrameSpec { size, samples, ..spec }, is_refinement: false };
        // What is seen already need not become coarse again.
        self.state.take_if(|state| !is_same(state));
        self.state.get_or_insert(LastStep { step, is_shown: false, changed_at: now }).step
    }

    /// A frame has come, and took so long of the farm's time.
    pub fn on_frame(&mut self, spec: &FrameSpec, took: Duration) {
        let is_moving_size = spec.size == self.ladder.size(self.control.rung());
        if self.is_on() && is_moving_size && spec.samples == SampleRange::CENTRE {
            self.control.learn(&self.ladder, took);
        }
        if let Some(state) = self.state.as_mut().filter(|state| state.step.spec == *spec) {
            state.is_shown = true;
        }
    }

    /// A frame was shown.
    pub fn on_shown(&mut self, spec: &FrameSpec, times: &ShowTimes) {
        self.control.learn_shown(spec.size, times);
    }

    /// When to ask for the next refinement, unless anything changes; `None` when there is none, or the last is yet to come.
    pub fn refines_at(&self) -> Option<Instant> {
        let state = self.state.filter(|state| state.is_shown)?;
        self.finer(&state.step.spec).map(|_| state.changed_at + REST)
    }

    /// The next refinement, once it is time.
    pub fn refine(&mut self, now: Instant) -> Option<RenderStep> {
        if now < self.refines_at()? {
            return None;
        }
        let state = self.state?;
        let step = RenderStep { spec: self.finer(&state.step.spec)?, is_refinement: true };
        self.control.rest();
        self.state = Some(LastStep { step, is_shown: false, ..state });
        Some(step)
    }

    /// Whether what was asked for last has come, and is as fine as it gets.
    pub fn is_done(&self) -> bool {
        self.state.is_some_and(|state| state.is_shown && self.finer(&state.step.spec).is_none())
    }

    /// The next finer picture than this.
    fn finer(&self, spec: &FrameSpec) -> Option<FrameSpec> {
        let RefinementOptions { is_on, native, n_samples, .. } = self.options;
        let count = match spec.size == native {
            true => spec.samples.count.saturating_mul(SAMPLES_FACTOR).min(n_samples),
            false => 1,
        };
        let finer = FrameSpec { size: native, samples: SampleRange { first: 0, count }, ..*spec };
        (is_on && finer != *spec).then_some(finer)
    }
}

#[cfg(test)]
mod tests;
