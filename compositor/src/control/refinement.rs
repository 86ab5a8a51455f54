//! Resolution and samples per pixel: the target rate in motion, refinement at rest. Pure: time is an argument.
//!
//! While the camera moves, [`control`] chooses each frame's resolution from a [`ladder`], by the times that frames take the
//! farm and the [`display`]; where the native one leaves time, also shadows and ambient occlusion. What is finer than the samples
//! of such a frame is shown by stand-ins. At rest, frames in the wall's native resolution follow with 1, 4, 16 … samples a pixel; once
//! edges are smooth, ambient occlusion and then paths light them, unless the operator chose the rays. Few paths are noise, so
//! while the camera moves there are none. While sun or exposure change there are a few, in a resolution of their own that holds
//! the rate: other rays would not show the change.

mod control;
mod display;
mod ladder;

use std::time::{Duration, Instant};

use glam::DVec3;
use shared::{
    appearance::Appearance,
    detail::Detail,
    division::FrameSize,
    protocol::{FrameSpec, LightingMode, SampleRange, ShadingMode},
};

pub(crate) use self::display::ShowTimes;
use self::{control::ResolutionControl, ladder::Ladder};

/// Default target rate while the camera moves, in frames a second.
pub(crate) const DEFAULT_TARGET_RATE: f64 = 30.0;

/// Default samples a pixel at rest.
pub(crate) const DEFAULT_SAMPLES: u32 = 16;

/// Paths a pixel of the first frame that has any: fewer have more noise than the frame before them. All others follow in one
/// frame, in which each pixel gets as many as its noise needs.
const FEWEST_PATHS: u32 = 16;

/// Paths a pixel while sun or exposure change.
const CHANGING_PATHS: u32 = 4;

/// About how many times as long a pixel takes with these paths as with its primary ray; measured times replace it.
const CHANGING_COST: u32 = 32;

/// The camera is at rest after this time. A shorter time would start a refinement between two motions of a hand.
const REST: Duration = Duration::from_millis(200);

/// Each refinement multiplies the samples by this: all of them together take a third longer than the last alone.
const SAMPLES_FACTOR: u32 = 4;

#[derive(Clone, Copy, Debug)]
pub(crate) struct RefinementOptions {
    /// Whether the resolution follows the motion at first.
    pub is_on: bool,
    /// Frames a second while the camera moves; above zero.
    pub target_rate: f64,
    /// The resolution at rest.
    pub native: FrameSize,
    /// Samples a pixel at rest; from 1 to [`SampleRange::LARGEST_COUNT`].
    pub n_samples: u32,
    /// Paths a pixel at rest, from sample 0 on.
    pub paths: SampleRange,
    /// The resolution of all frames while refinement is off, and about that of the first frames while it is on.
    pub fixed_size: FrameSize,
    /// The samples of each pixel that frames average while refinement is off.
    pub fixed_samples: SampleRange,
    /// Whether ambient occlusion and then paths light a picture at rest, though only primary rays light it in motion.
    pub lights_at_rest: bool,
}

/// A frame to ask for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct RenderStep {
    pub spec: FrameSpec,
    /// Whether it only refines a frame that was shown already.
    pub is_refinement: bool,
}

/// Decides which frame to ask for.
#[derive(Clone, Debug)]
pub(crate) struct Refinement {
    options: RefinementOptions,
    ladder: Ladder,
    control: ResolutionControl,
    /// Of paths while sun or exposure change.
    path_control: ResolutionControl,
    last: Option<LastStep>,
}

/// The frame that was asked for last.
#[derive(Clone, Copy, Debug)]
struct LastStep {
    step: RenderStep,
    /// The rays that were asked for, which paths replace only at rest.
    asked_rays: LightingMode,
    is_shown: bool,
    /// When camera, scene or appearance changed last.
    changed_at: Instant,
}

impl Refinement {
    /// Asks for nothing yet.
    pub(crate) fn new(options: RefinementOptions) -> Self {
        let ladder = Ladder::down_from(options.native);
        let rung = ladder.rung_of(options.fixed_size.n_samples());
        let path_rung = ladder.rung_of(options.fixed_size.n_samples() / CHANGING_COST);
        let interval = Duration::from_secs_f64(1.0 / options.target_rate);
        let [control, path_control] = [rung, path_rung].map(|rung| ResolutionControl::new(interval, &ladder, rung));
        Self { control, path_control, ladder, options, last: None }
    }

    pub(crate) fn is_on(&self) -> bool {
        self.options.is_on
    }

    /// Lets the resolution follow the motion, or not, from the next change on.
    pub(crate) fn set_on(&mut self, is_on: bool) {
        self.options.is_on = is_on;
        self.start_again();
    }

    /// Lights pictures at rest by ambient occlusion and paths, or not, from the next change on.
    pub(crate) fn set_lights_at_rest(&mut self, lights_at_rest: bool) {
        self.options.lights_at_rest = lights_at_rest;
    }

    /// Forgets the last frame: the next change starts coarse even if nothing differs.
    pub(crate) fn start_again(&mut self) {
        self.last = None;
    }

    /// Samples a pixel of a fully refined picture.
    pub(crate) fn n_samples(&self) -> u32 {
        let RefinementOptions { is_on, n_samples, paths, fixed_samples, .. } = self.options;
        let has_paths = self.last.is_some_and(|last| self.ends_with_paths(&last));
        match (is_on, has_paths) {
            (true, true) => paths.count,
            (true, false) => n_samples,
            (false, _) => fixed_samples.count,
        }
    }

    /// The frame to ask for after a change of camera, scene or appearance, of a model that has stand-ins if its `fine_bounds`
    /// are given, in world space. Ignores the size, samples and detail of `spec`.
    pub(crate) fn change(&mut self, now: Instant, spec: FrameSpec, fine_bounds: Option<(DVec3, DVec3)>) -> RenderStep {
        let asked_rays = spec.rays;
        let (size, samples, rays) = match asked_rays {
            _ if !self.is_on() => (self.options.fixed_size, self.options.fixed_samples, asked_rays),
            _ if self.changes_paths_alone(&spec) => self.changing_paths(),
            _ => self.moving(asked_rays, spec.view),
        };
        let is_same = |last: &LastStep| {
            let FrameSpec { size, samples, detail, rays, .. } = last.step.spec;
            let are_refined = self.options.lights_at_rest || asked_rays == LightingMode::Path;
            let rays = if are_refined { rays } else { asked_rays };
            last.asked_rays == asked_rays && last.step.spec == FrameSpec { size, samples, detail, rays, ..spec }
        };
        // Stand-ins bound no solid, and have other costs.
        let may_be_coarse = self.is_on() && spec.appearance.clip.is_none() && spec.view != ShadingMode::Cost;
        let of_samples = |bounds| Detail::of_samples(&spec.camera, size, bounds);
        let detail = fine_bounds.filter(|_| may_be_coarse).map_or(Detail::FULL, of_samples);
        let step = RenderStep { spec: FrameSpec { size, samples, detail, rays, ..spec }, is_refinement: false };
        // A picture that did not change need not become coarse again.
        self.last.take_if(|last| !is_same(last));
        self.last.get_or_insert(LastStep { step, asked_rays, is_shown: false, changed_at: now }).step
    }

    /// The best rung of the ladder: if the operator chose rays, none is lit by others.
    fn best_rung(&self, asked_rays: LightingMode, view: ShadingMode) -> usize {
        let is_free = match asked_rays {
            LightingMode::Path => true,
            LightingMode::Primary => self.options.lights_at_rest,
            LightingMode::Shadows | LightingMode::AmbientOcclusion => false,
        };
        if is_free && view == ShadingMode::Shaded { 0 } else { Ladder::PLAIN }
    }

    /// Size, samples and rays of a frame while the camera moves.
    fn moving(&self, asked_rays: LightingMode, view: ShadingMode) -> (FrameSize, SampleRange, LightingMode) {
        let rung = self.control.rung.max(self.best_rung(asked_rays, view));
        let rays = match asked_rays {
            LightingMode::Path | LightingMode::Primary => self.ladder.rays(rung),
            LightingMode::Shadows | LightingMode::AmbientOcclusion => asked_rays,
        };
        (self.ladder.size(rung), SampleRange::CENTRE, rays)
    }

    /// Whether a frame differs from the last one only in the light of paths, which light the picture at rest.
    fn changes_paths_alone(&self, spec: &FrameSpec) -> bool {
        self.last.filter(|last| last.asked_rays == spec.rays && self.ends_with_paths(last)).is_some_and(|last| {
            let FrameSpec { size, samples, detail, rays, appearance, .. } = last.step.spec;
            let appearance = Appearance { path: appearance.path, ..spec.appearance };
            let as_last = FrameSpec { size, samples, detail, rays, appearance, ..*spec };
            appearance != spec.appearance && last.step.spec == as_last
        })
    }

    /// Size, samples and rays of a frame while the light of paths changes.
    fn changing_paths(&self) -> (FrameSize, SampleRange, LightingMode) {
        let SampleRange { first, count, .. } = self.options.paths;
        let samples = SampleRange::all(first, CHANGING_PATHS.min(count));
        (self.ladder.size(self.path_control.rung), samples, LightingMode::Path)
    }

    /// Accounts for a frame that the farm has completed in this time.
    pub(crate) fn on_frame(&mut self, spec: &FrameSpec, took: Duration) {
        let shown = (spec.size, spec.samples, spec.rays);
        let asked_rays = self.last.map_or(spec.rays, |last| last.asked_rays);
        if self.is_on() && shown == self.moving(asked_rays, spec.view) {
            let best = self.best_rung(asked_rays, spec.view);
            self.control.learn(&self.ladder, best, took);
        }
        if self.is_on() && shown == self.changing_paths() {
            self.path_control.learn(&self.ladder, Ladder::PLAIN, took);
        }
        if let Some(last) = self.last.as_mut().filter(|last| last.step.spec == *spec) {
            last.is_shown = true;
        }
    }

    pub(crate) fn on_shown(&mut self, spec: &FrameSpec, times: &ShowTimes) {
        self.control.display.learn(spec.size, times);
        self.path_control.display.learn(spec.size, times);
    }

    /// When the next refinement is due; `None` if there is none, or the last frame has yet to come.
    pub(crate) fn refines_at(&self) -> Option<Instant> {
        let last = self.last.filter(|last| last.is_shown)?;
        self.finer(&last).map(|_| last.changed_at + REST)
    }

    /// The next refinement, once it is due.
    pub(crate) fn refine(&mut self, now: Instant) -> Option<RenderStep> {
        if now < self.refines_at()? {
            return None;
        }
        let last = self.last?;
        let step = RenderStep { spec: self.finer(&last)?, is_refinement: true };
        self.control.rest();
        self.path_control.rest();
        self.last = Some(LastStep { step, is_shown: false, ..last });
        Some(step)
    }

    /// Whether the last frame has come and is fully refined.
    pub(crate) fn is_done(&self) -> bool {
        self.last.is_some_and(|last| last.is_shown && self.finer(&last).is_none())
    }

    /// Whether paths light the last frame of the refinement.
    fn ends_with_paths(&self, last: &LastStep) -> bool {
        let is_asked = last.asked_rays == LightingMode::Path || self.options.lights_at_rest;
        is_asked && last.step.spec.view == ShadingMode::Shaded
    }

    /// The frame after the last one in the refinement.
    fn finer(&self, last: &LastStep) -> Option<FrameSpec> {
        let RefinementOptions { is_on, native, n_samples, paths, lights_at_rest, .. } = self.options;
        let spec = &last.step.spec;
        let is_native = spec.size == native;
        let is_smooth = is_native && spec.samples.count >= SAMPLES_FACTOR.min(n_samples);
        let is_plain = last.asked_rays == LightingMode::Primary && spec.view == ShadingMode::Shaded;
        let first_paths = SampleRange { count: FEWEST_PATHS.min(paths.count), ..paths };
        let (samples, rays) = if spec.rays == LightingMode::Path {
            (if is_native { paths } else { first_paths }, spec.rays)
        } else if lights_at_rest && is_smooth && is_plain && spec.rays != LightingMode::AmbientOcclusion {
            (spec.samples, LightingMode::AmbientOcclusion)
        } else if is_smooth && self.ends_with_paths(last) {
            (first_paths, LightingMode::Path)
        } else if is_native {
            (SampleRange::all(0, spec.samples.count.saturating_mul(SAMPLES_FACTOR).min(n_samples)), spec.rays)
        } else {
            (SampleRange::CENTRE, spec.rays)
        };
        let finer = FrameSpec { size: native, samples, detail: Detail::FULL, rays, ..*spec };
        (is_on && finer != *spec).then_some(finer)
    }
}

#[cfg(test)]
mod tests;
