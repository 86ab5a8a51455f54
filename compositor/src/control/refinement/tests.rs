//! Cameras in motion and at rest, with simulated farms.

use glam::DVec3;
use proptest::prelude::*;
use shared::{
    appearance::Appearance,
    camera::Camera,
    detail::Detail,
    noise::NoiseLimit,
    protocol::{LightingMode, ShadingMode},
    scene::SceneId,
};

use super::*;

/// The interval at the default target rate, in seconds.
const INTERVAL_S: f64 = 1.0 / DEFAULT_TARGET_RATE;

fn options() -> RefinementOptions {
    RefinementOptions {
        is_on: true,
        target_rate: DEFAULT_TARGET_RATE,
        native: FrameSize::new(4096, 2304).unwrap(),
        n_samples: DEFAULT_SAMPLES,
        paths: SampleRange::asked(LightingMode::Path, None, None),
        fixed_size: FrameSize::PAPER,
        fixed_samples: SampleRange::CENTRE,
        lights_at_rest: false,
    }
}

fn spec_at(eye_x: f64) -> FrameSpec {
    FrameSpec {
        scene: SceneId::Statue { triangles: 1, treatment: Default::default() },
        camera: Camera::look_at(DVec3::new(eye_x, 0.0, 5.0), DVec3::ZERO, DVec3::Y, 0.7, 2.0).unwrap(),
        size: FrameSize::ONE,
        view: ShadingMode::Shaded,
        rays: LightingMode::Primary,
        samples: SampleRange::CENTRE,
        detail: Detail::FULL,
        appearance: Appearance::default(),
    }
}

/// A wall with a simulated farm: each frame takes a fixed time, and a time for each sample.
struct Wall {
    refinement: Refinement,
    now: Instant,
    n_moves: u32,
    fixed_s: f64,
    per_sample_s: f64,
    /// The display's fixed time, and its time for each sample, all of which is upload.
    display_fixed_s: f64,
    display_per_sample_s: f64,
    refresh: Duration,
    /// The largest relative deviation of times, and the state of a random generator.
    waver: f64,
    random: u64,
}

impl Wall {
    fn new(fixed_s: f64, per_sample_s: f64, waver: f64) -> Self {
        let (refinement, now) = (Refinement::new(options()), Instant::now());
        Self {
            refinement,
            now,
            n_moves: 0,
            fixed_s,
            per_sample_s,
            display_fixed_s: 0.0,
            display_per_sample_s: 0.0,
            refresh: Duration::ZERO,
            waver,
            random: 1,
        }
    }

    /// A farm that takes this time for a frame of the paper's size.
    fn with_paper_frame_of(seconds: f64) -> Self {
        Self::new(0.0, seconds / f64::from(FrameSize::PAPER.n_samples()), 0.0)
    }

    /// Renders a frame while the display shows the previous one. Returns the time in seconds.
    fn render(&mut self, spec: &FrameSpec) -> f64 {
        let cost = match spec.rays {
            LightingMode::Primary | LightingMode::Path => 1.0,
            LightingMode::Shadows => 2.0,
            LightingMode::AmbientOcclusion => 6.0,
        };
        let n_rays = f64::from(spec.size.n_samples()) * f64::from(spec.samples.count);
        let took = self.wavering(self.fixed_s + self.per_sample_s * n_rays * cost);
        self.refinement.on_frame(spec, took);
        let upload_s = self.display_per_sample_s * f64::from(spec.size.n_samples());
        let shown_in = self.wavering(self.display_fixed_s + upload_s);
        let upload = Duration::from_secs_f64(upload_s);
        self.refinement.on_shown(spec, &ShowTimes { took: shown_in, upload, refresh: self.refresh });
        let interval = took.max(shown_in).max(self.refresh);
        self.now += interval;
        interval.as_secs_f64()
    }

    fn wavering(&mut self, seconds: f64) -> Duration {
        // The constants are Knuth's, of MMIX.
        self.random = self.random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let waver = 1.0 + self.waver * ((self.random >> 33) as f64 / f64::from(1u32 << 30) - 1.0);
        Duration::from_secs_f64(seconds * waver)
    }

    /// Moves the camera and renders its frame. Returns the frame's size and time in seconds.
    fn move_on(&mut self) -> (FrameSize, f64) {
        self.n_moves += 1;
        let step = self.refinement.change(self.now, spec_at(f64::from(self.n_moves)), None);
        assert_eq!((step.is_refinement, step.spec.samples), (false, SampleRange::CENTRE));
        (step.spec.size, self.render(&step.spec))
    }

    fn move_for(&mut self, n_frames: u32) -> Vec<(FrameSize, f64)> {
        (0..n_frames).map(|_| self.move_on()).collect()
    }

    /// Rests until no frame is asked for. Returns all refinements.
    fn rest(&mut self) -> Vec<FrameSpec> {
        let mut refinements = Vec::new();
        while let Some(refines_at) = self.refinement.refines_at() {
            assert!(!self.refinement.is_done());
            self.now = self.now.max(refines_at);
            let step = self.refinement.refine(self.now).expect("it is time");
            assert!(step.is_refinement && self.refinement.refines_at().is_none(), "one refinement at a time");
            self.render(&step.spec);
            refinements.push(step.spec);
        }
        assert!(self.refinement.is_done());
        refinements
    }
}

fn n_changes(frames: &[(FrameSize, f64)]) -> usize {
    frames.windows(2).filter(|pair| pair[0].0 != pair[1].0).count()
}

fn mean_s(frames: &[(FrameSize, f64)]) -> f64 {
    frames.iter().map(|frame| frame.1).sum::<f64>() / frames.len() as f64
}

#[test]
fn a_farm_that_is_too_slow_gets_coarser_frames_within_a_few() {
    let mut wall = Wall::with_paper_frame_of(10.0 * INTERVAL_S);
    let frames = wall.move_for(100);
    assert!(frames[2].1 <= INTERVAL_S, "two late frames are enough: {frames:?}");
    assert!(frames[2..].iter().all(|frame| (0.5..1.0).contains(&(frame.1 / INTERVAL_S))), "{frames:?}");
    assert_eq!(n_changes(&frames), 1);
}

#[test]
fn a_farm_with_room_gets_finer_frames_one_step_after_the_other() {
    let mut wall = Wall::with_paper_frame_of(INTERVAL_S / 8.0);
    let frames = wall.move_for(200);
    let sizes: Vec<f64> = frames.iter().map(|frame| f64::from(frame.0.n_samples())).collect();
    assert!(sizes.windows(2).all(|pair| (1.0..1.6).contains(&(pair[1] / pair[0]))), "never coarser, by single steps");
    assert!(frames.last().is_some_and(|frame| (0.6..1.0).contains(&(frame.1 / INTERVAL_S))), "{:?}", frames.last());
}

#[test]
fn a_farm_that_is_fast_enough_renders_the_wall_s_own_resolution_in_motion() {
    let mut wall = Wall::with_paper_frame_of(INTERVAL_S / 50.0);
    let frames = wall.move_for(200);
    assert_eq!(frames.last().map(|frame| frame.0), Some(options().native));
    let counts: Vec<u32> = wall.rest().iter().map(|spec| spec.samples.count).collect();
    assert_eq!(counts, [4, 16], "one sample a pixel is there already");
}

#[test]
fn a_farm_with_time_to_spare_lights_the_wall_s_own_resolution_in_motion() {
    use LightingMode::{AmbientOcclusion, Path, Primary, Shadows};
    // Parts of the interval that primary rays, shadows and ambient occlusion take: rays come as soon as they can be afforded.
    for (part, expected) in [(0.8, Primary), (0.3, Shadows), (0.08, AmbientOcclusion)] {
        let seconds = part * INTERVAL_S * f64::from(FrameSize::PAPER.n_samples());
        let mut wall = Wall::with_paper_frame_of(seconds / f64::from(options().native.n_samples()));
        let rays = |wall: &Wall| wall.refinement.last.unwrap().step.spec.rays;
        wall.move_for(200);
        assert_eq!(rays(&wall), Primary, "as they were chosen");
        wall.refinement.set_lights_at_rest(true);
        let frames = wall.move_for(400);
        assert_eq!((rays(&wall), frames[399].0), (expected, options().native), "{part}");
        assert!(mean_s(&frames[300..]) < INTERVAL_S, "{part}");
        wall.per_sample_s *= 0.99 / part;
        let frames = wall.move_for(100);
        assert_eq!(rays(&wall), Primary, "light goes before the rate does");
        assert!(mean_s(&frames[50..]) < INTERVAL_S, "{part}");
        wall.per_sample_s *= part / 0.99;
        wall.move_for(400);
        // What lit the motion changes no picture at rest.
        let ends: Vec<_> = wall.rest().iter().map(|spec| (spec.samples.count, spec.rays)).collect();
        assert_eq!(ends[ends.len() - 3..], [(4, AmbientOcclusion), (16, Path), (256, Path)], "{part}");
        wall.refinement.set_lights_at_rest(false);
        wall.move_on();
        assert_eq!(rays(&wall), Primary, "as they were chosen");
        let spec = FrameSpec { view: ShadingMode::Normals, ..spec_at(-1.0) };
        wall.refinement.set_lights_at_rest(true);
        assert_eq!(wall.refinement.change(wall.now, spec, None).spec.rays, Primary, "normals need no light");
    }
}

#[test]
fn one_frame_that_takes_long_changes_nothing() {
    let mut wall = Wall::with_paper_frame_of(0.8 * INTERVAL_S);
    for n_between in [0, 1, 2, 5, 20] {
        wall.move_for(n_between);
        let spec = wall.refinement.change(wall.now, spec_at(-1.0 - f64::from(n_between)), None).spec;
        wall.refinement.on_frame(&spec, Duration::from_secs(2));
        let frames = wall.move_for(10);
        assert_eq!(n_changes(&frames), 0, "after {n_between}: {frames:?}");
    }
}

#[test]
fn a_hopelessly_slow_farm_gets_the_coarsest_frames() {
    let mut wall = Wall::new(10.0 * INTERVAL_S, 0.0, 0.1);
    let frames = wall.move_for(200);
    assert_eq!(frames.last().map(|frame| frame.0), Some(wall.refinement.ladder.size(usize::MAX)));
    assert!(n_changes(&frames[20..]) == 0, "{frames:?}");
}

#[test]
fn resolution_is_not_traded_for_a_rate_that_the_display_cannot_show() {
    // Three intervals for each frame of any size, as with a software driver on a large wall.
    let mut wall = Wall { display_fixed_s: 3.0 * INTERVAL_S, ..Wall::with_paper_frame_of(2.0 * INTERVAL_S) };
    let frames = wall.move_for(200);
    assert!(frames.iter().all(|frame| frame.0.n_samples() >= FrameSize::PAPER.n_samples()));
    assert!(frames[100..].iter().all(|frame| frame.1 < 1.25 * 3.0 * INTERVAL_S), "nothing waits for the farm");
    // An output that is refreshed 24 times a second.
    let refresh = Duration::from_secs_f64(1.0 / 24.0);
    let mut wall = Wall { refresh, ..Wall::with_paper_frame_of(1.1 * INTERVAL_S) };
    assert_eq!(n_changes(&wall.move_for(200)), 0, "every frame comes in time");
    // The same farm with a display that keeps up.
    let mut wall = Wall::with_paper_frame_of(2.0 * INTERVAL_S);
    assert!(wall.move_for(10).last().is_some_and(|frame| frame.0.n_samples() < FrameSize::PAPER.n_samples()));
}

#[test]
fn resolution_is_lowered_as_far_as_it_makes_a_slow_display_faster() {
    let native = f64::from(options().native.n_samples());
    let to_draw_and_upload = |draw: f64, upload: f64| {
        let mut wall = Wall::with_paper_frame_of(INTERVAL_S / 50.0);
        (wall.display_fixed_s, wall.display_per_sample_s) = (draw * INTERVAL_S, upload * INTERVAL_S / native);
        let frames = wall.move_for(400);
        let last = frames[399];
        (f64::from(last.0.n_samples()) / native, last.1 / INTERVAL_S, n_changes(&frames[200..]))
    };
    let (size, interval, n_changes) = to_draw_and_upload(0.3, 1.2);
    assert!((0.3..=0.55).contains(&size) && interval < 0.95, "{size} of native in {interval}");
    assert_eq!(n_changes, 0);
    let (size, interval, n_changes) = to_draw_and_upload(2.0, 2.0);
    assert!((0.05..0.3).contains(&size) && interval < 2.5, "{size} of native in {interval}: a quarter longer at most");
    assert_eq!(n_changes, 0);
    let (size, ..) = to_draw_and_upload(2.0, 0.2);
    assert_eq!(size, 1.0, "it would hardly help");
}

#[test]
fn a_resting_camera_is_refined_and_then_no_frame_is_asked_for() {
    let mut wall = Wall::with_paper_frame_of(INTERVAL_S);
    let moving = wall.move_for(30).last().unwrap().0;
    assert!(moving.n_samples() < options().native.n_samples());
    let refinements = wall.rest();
    let levels: Vec<_> = refinements.iter().map(|spec| (spec.size, spec.samples.count)).collect();
    assert_eq!(levels, [1, 4, 16].map(|count| (options().native, count)));
    assert!(refinements.iter().all(|spec| spec.samples.first == 0 && spec.camera == spec_at(30.0).camera));
    assert_eq!(wall.refinement.refine(wall.now + Duration::from_secs(1000)), None);
    // The same camera again is no motion.
    let step = wall.refinement.change(wall.now, spec_at(30.0), None);
    assert_eq!((step.spec, wall.refinement.is_done()), (refinements[2], true));
    assert_eq!(wall.move_on().0, moving, "the next motion starts with the last one's resolution");
}

#[test]
fn refinement_waits_for_a_rest_and_for_the_coarse_frame() {
    let mut wall = Wall::with_paper_frame_of(INTERVAL_S / 2.0);
    let start = wall.now;
    let step = wall.refinement.change(start, spec_at(1.0), None);
    assert_eq!(wall.refinement.refine(start + 9 * REST), None, "the coarse frame has not come");
    wall.refinement.on_frame(&step.spec, Duration::from_millis(1));
    assert_eq!(wall.refinement.refines_at(), Some(start + REST));
    assert_eq!(wall.refinement.refine(start + REST / 2), None);
    let finer = wall.refinement.refine(start + REST).unwrap();
    assert_eq!(wall.refinement.refine(start + 9 * REST), None, "one refinement at a time");
    // A motion ends the refinement; a frame of it that comes later does not count.
    let step = wall.refinement.change(start + REST, spec_at(2.0), None);
    assert!(!step.is_refinement);
    wall.refinement.on_frame(&finer.spec, Duration::from_secs(1));
    assert_eq!(wall.refinement.refines_at(), None);
    wall.refinement.on_frame(&step.spec, Duration::from_millis(1));
    assert_eq!(wall.refinement.refines_at(), Some(start + 2 * REST));
}

#[test]
fn stand_ins_show_a_fine_model_in_motion_and_never_at_rest() {
    let bounds = (DVec3::NEG_ONE, DVec3::ONE);
    let mut wall = Wall::with_paper_frame_of(0.02);
    let cut = Appearance { clip: "x:50".parse().ok(), ..Appearance::default() };
    let asked = [spec_at(1.0), FrameSpec { appearance: cut, ..spec_at(2.0) }];
    let [moving, cut] = asked.map(|spec| wall.refinement.change(wall.now, spec, Some(bounds)).spec);
    let [none, costs] = [(spec_at(3.0), None), (FrameSpec { view: ShadingMode::Cost, ..spec_at(4.0) }, Some(bounds))]
        .map(|(spec, bounds)| wall.refinement.change(wall.now, spec, bounds).spec);
    assert_eq!(moving.detail, Detail::of_samples(&moving.camera, moving.size, bounds));
    assert_ne!(moving.detail, Detail::FULL);
    assert_eq!([cut, none, costs].map(|spec| spec.detail), [Detail::FULL; 3]);

    let step = wall.refinement.change(wall.now, spec_at(5.0), Some(bounds));
    wall.render(&step.spec);
    assert_eq!(wall.refinement.change(wall.now, spec_at(5.0), Some(bounds)), step, "nothing has moved");
    let refinements = wall.rest();
    assert!(!refinements.is_empty() && refinements.iter().all(|spec| spec.detail == Detail::FULL));
    // One sample in the native resolution while moving: the same at rest is another picture.
    let one = RefinementOptions { n_samples: 1, native: FrameSize::PAPER, ..options() };
    wall.refinement = Refinement::new(one);
    let step = wall.refinement.change(wall.now, spec_at(6.0), Some(bounds));
    assert_eq!(step.spec.size, FrameSize::PAPER);
    wall.render(&step.spec);
    assert_eq!(wall.rest(), [FrameSpec { detail: Detail::FULL, ..step.spec }]);
}

#[test]
fn without_refinement_every_frame_has_the_fixed_resolution() {
    let mut wall = Wall::with_paper_frame_of(10.0 * INTERVAL_S);
    wall.refinement.set_on(false);
    let frames = wall.move_for(20);
    assert!(frames.iter().all(|frame| frame.0 == options().fixed_size));
    assert_eq!((wall.refinement.is_done(), wall.refinement.refines_at()), (true, None));
    let fine = wall.refinement.change(wall.now, spec_at(19.5), Some((DVec3::NEG_ONE, DVec3::ONE)));
    assert_eq!(fine.spec.detail, Detail::FULL);
    wall.refinement.set_on(true);
    let step = wall.refinement.change(wall.now, spec_at(20.0), None);
    wall.render(&step.spec);
    assert_eq!(wall.rest().len(), 3, "switched on, the picture is refined");
}

#[test]
fn paths_light_a_picture_at_rest_unless_other_rays_were_chosen() {
    use LightingMode::{AmbientOcclusion, Path, Primary};
    let mut wall = Wall::with_paper_frame_of(0.02);
    let rest = |wall: &mut Wall| {
        wall.move_on();
        wall.rest().iter().map(|spec| (spec.samples.count, spec.rays)).collect::<Vec<_>>()
    };
    assert_eq!(rest(&mut wall), [(1, Primary), (4, Primary), (16, Primary)]);
    wall.refinement.set_lights_at_rest(true);
    let lit = [(1, Primary), (4, Primary), (4, AmbientOcclusion), (16, Path), (256, Path)];
    assert_eq!(rest(&mut wall), lit);
    let same = wall.refinement.change(wall.now, spec_at(f64::from(wall.n_moves)), None).spec;
    assert_eq!((same.samples.count, same.rays), (256, Path), "it need not become coarse again");
    wall.refinement.set_lights_at_rest(false);
    let chosen = wall.refinement.change(wall.now, spec_at(f64::from(wall.n_moves)), None).spec;
    assert_eq!((chosen.samples.count, chosen.rays), (1, Primary));
}

#[test]
fn paths_light_a_picture_at_rest_only() {
    use LightingMode::{Path, Primary};
    let mut refinement = Refinement::new(options());
    let (start, asked) = (Instant::now(), FrameSpec { rays: Path, ..spec_at(1.0) });
    let moving = refinement.change(start, asked, None).spec;
    assert_eq!((moving.samples.count, moving.rays), (1, Primary), "in motion they would be noise");
    assert_eq!(refinement.n_samples(), SampleRange::LARGEST_COUNT);
    refinement.on_frame(&moving, Duration::from_millis(20));
    let mut steps = Vec::new();
    while let Some(step) = refinement.refine(start + REST) {
        let SampleRange { count, noise, .. } = step.spec.samples;
        steps.push((count, noise, step.spec.rays));
        refinement.on_frame(&step.spec, Duration::from_secs(9));
    }
    let (all, limit) = (NoiseLimit::NONE, NoiseLimit::default());
    assert_eq!(steps, [(1, all, Primary), (4, all, Primary), (16, limit, Path), (256, limit, Path)]);
    assert!(refinement.is_done() && refinement.refines_at().is_none(), "then nothing is rendered");
    let same = refinement.change(start, asked, None).spec;
    assert_eq!((same.samples.count, same.rays), (256, Path), "it need not become coarse again");
    assert_eq!(refinement.change(start, spec_at(1.0), None).spec.rays, Primary, "other rays are another picture");
    refinement.set_on(false);
    assert_eq!(refinement.change(start, asked, None).spec.rays, Path, "without refinement, frames are as asked");
}

#[test]
fn a_change_of_the_sun_is_shown_by_paths_that_hold_the_rate() {
    use LightingMode::{Path, Primary};
    let with_sun = |decidegrees: u16, rays| {
        let spec = FrameSpec { rays, ..spec_at(1.0) };
        let path = spec.appearance.path.with_sun(decidegrees);
        FrameSpec { appearance: Appearance { path, ..spec.appearance }, ..spec }
    };
    for (asked, lights_at_rest) in [(Path, false), (Primary, true)] {
        let mut wall = Wall::with_paper_frame_of(2.0 * INTERVAL_S);
        wall.refinement.set_lights_at_rest(lights_at_rest);
        let first = wall.refinement.change(wall.now, with_sun(40, asked), None).spec;
        assert_eq!(first.rays, Primary, "the camera moves");
        wall.render(&first);
        wall.rest();
        let steps: Vec<_> = (0..100u16)
            .map(|step| {
                let spec = wall.refinement.change(wall.now, with_sun(41 + step, asked), None).spec;
                assert_eq!((spec.rays, spec.samples), (Path, SampleRange::all(0, CHANGING_PATHS)));
                (spec.size, wall.render(&spec))
            })
            .collect();
        assert!(mean_s(&steps[50..]) < 1.02 * INTERVAL_S && n_changes(&steps[50..]) <= 1, "{steps:?}");
        let refinements = wall.rest();
        let counts: Vec<_> = refinements.iter().map(|spec| (spec.size, spec.samples.count, spec.rays)).collect();
        assert_eq!(counts, [16, 256].map(|count| (options().native, count, Path)), "no other rays come between");
        let moved = wall.refinement.change(wall.now, FrameSpec { rays: asked, ..spec_at(2.0) }, None).spec;
        assert_eq!((moved.rays, moved.samples), (Primary, SampleRange::CENTRE));
    }
}

#[test]
fn normals_need_no_paths() {
    let mut refinement = Refinement::new(options());
    let (start, view) = (Instant::now(), ShadingMode::Normals);
    let moving = refinement.change(start, FrameSpec { rays: LightingMode::Path, view, ..spec_at(1.0) }, None).spec;
    refinement.on_frame(&moving, Duration::from_millis(20));
    let mut last = moving;
    while let Some(step) = refinement.refine(start + REST) {
        last = step.spec;
        refinement.on_frame(&last, Duration::from_millis(20));
    }
    assert_eq!((last.samples.count, last.rays), (DEFAULT_SAMPLES, LightingMode::Primary));
    assert!(refinement.is_done());
}

proptest! {
    /// With a farm of any speed, even a changing one, motion holds the rate within about a second, with frames no coarser
    /// than needed; at rest the refinement always has the same frames.
    #[test]
    fn the_rate_is_held_by_any_farm_and_does_not_flicker(
        fixed in 0.0..0.3f64,
        // The additional time of a frame of the paper's size, in intervals: powers of two.
        speeds in proptest::collection::vec(-5.0..3.0f64, 1..5),
        waver in 0.0..0.15f64,
        // The display's time for a frame without samples, and the addition of the native resolution, in intervals.
        draw in 0.0..4.0f64,
        upload in 0.0..4.0f64,
        random: u64,
    ) {
        let mut wall = Wall { random, ..Wall::new(fixed * INTERVAL_S, 0.0, waver) };
        let native = options().native.n_samples();
        (wall.display_fixed_s, wall.display_per_sample_s) =
            (draw * INTERVAL_S, upload * INTERVAL_S / f64::from(native));
        let held_s = (1.25 * draw).max(1.0) * INTERVAL_S;
        for speed in speeds {
            wall.per_sample_s = speed.exp2() * INTERVAL_S / f64::from(FrameSize::PAPER.n_samples());
            wall.move_for(160);
            let frames = wall.move_for(400);
            let mean = mean_s(&frames) / held_s;
            prop_assert!(mean <= 1.02, "{mean} of an interval");
            prop_assert!(n_changes(&frames) <= 6, "{} changes in 400 frames", n_changes(&frames));
            let finest = frames.iter().map(|frame| frame.0.n_samples()).max();
            prop_assert!(mean >= 0.5 || finest == Some(options().native.n_samples()), "{mean} of an interval");
            prop_assert!(wall.rest().len() <= 3);
        }
    }

    /// The same where the display sets the pace, and its times differ: how they grow with the resolution is uncertain then.
    #[test]
    fn an_unsteady_display_does_not_flicker(
        speed in -6.0..-3.0f64, waver in 0.0..0.15f64, draw in 1.0..4.0f64, upload in 0.0..4.0f64, random: u64,
    ) {
        let per_sample_s = speed.exp2() * INTERVAL_S / f64::from(FrameSize::PAPER.n_samples());
        let mut wall = Wall { random, ..Wall::new(0.0, per_sample_s, waver) };
        let native = options().native.n_samples();
        (wall.display_fixed_s, wall.display_per_sample_s) = (draw * INTERVAL_S, upload * INTERVAL_S / f64::from(native));
        wall.move_for(160);
        let n_changes = n_changes(&wall.move_for(4000));
        prop_assert!(n_changes <= 20, "{n_changes} changes in 4000 frames");
    }

    /// A farm with a steady mean changes the resolution ever more rarely, even if single frames differ much.
    #[test]
    fn unsteady_frames_change_the_resolution_ever_more_rarely(
        speed in -5.0..3.0f64, waver in 0.0..0.6f64, random: u64,
    ) {
        let per_sample_s = speed.exp2() * INTERVAL_S / f64::from(FrameSize::PAPER.n_samples());
        let mut wall = Wall { random, ..Wall::new(0.1 * INTERVAL_S, per_sample_s, waver) };
        wall.move_for(1000);
        let n_changes = n_changes(&wall.move_for(4000));
        prop_assert!(n_changes <= 20, "{n_changes} changes in 4000 frames");
    }
}
