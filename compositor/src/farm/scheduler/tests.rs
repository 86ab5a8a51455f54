//! The scheduler under simulated time, latency, speed and losses.

mod edges;
mod in_flight;
mod losses;
mod silence;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use proptest::prelude::*;
use shared::{
    appearance::Appearance,
    camera::Camera,
    detail::Detail,
    division::FrameSize,
    protocol::{LightingMode, SampleRange, ShadingMode},
    scene::SceneId,
};

use strum::VariantArray;

use super::*;

const A: NodeId = NodeId(1);
const B: NodeId = NodeId(2);
const C: NodeId = NodeId(3);

pub(in crate::farm) fn spec(eye_x: f64, triangles: u32) -> FrameSpec {
    let eye = glam::DVec3::new(eye_x, 0.0, 5.0);
    FrameSpec {
        scene: SceneId::Statue { triangles, treatment: Default::default() },
        camera: Camera::look_at(eye, glam::DVec3::ZERO, glam::DVec3::Y, 0.7, 2.0).unwrap(),
        size: FrameSize::new(80, 48).unwrap(),
        view: ShadingMode::Shaded,
        rays: LightingMode::Primary,
        samples: SampleRange::CENTRE,
        detail: Detail::FULL,
        appearance: Appearance::default(),
    }
}

fn goal(division: Division) -> RenderGoal {
    RenderGoal {
        spec: Some(spec(0.0, 1000)),
        scene_path: None,
        next_scene: None,
        change: 0,
        sky_path: None,
        is_refinement: false,
        division,
        min_renderers: 1,
        repeat: false,
        in_flight: 1,
        encoding: None,
        moved_at: Instant::now(),
    }
}

/// A task that was sent to a node.
#[derive(Clone, Debug)]
struct Sent {
    node: NodeId,
    frame: FrameId,
    task_id: TaskId,
    task: Task,
    size: FrameSize,
}

/// A simulated farm: nodes answer when the test says so.
struct Farm {
    scheduler: Scheduler,
    now: Time,
    at_work: VecDeque<Sent>,
    /// The units of all tasks that were sent.
    n_units_sent: u64,
    shown: Vec<FrameStats>,
    cancelled: Vec<NodeId>,
    /// The nodes that were told to load a scene, and which.
    loading: Vec<(NodeId, Option<SceneId>)>,
    /// Those that were told to load the next beside it, and which.
    preparing: Vec<(NodeId, SceneId)>,
    /// The motion that each frame is the first to show.
    motions: Vec<Option<Instant>>,
    /// The change of each frame.
    changes: Vec<u32>,
    /// How often each sample of each open frame was placed.
    placed: BTreeMap<FrameId, Vec<u32>>,
}

impl Farm {
    fn new(goal: RenderGoal) -> Self {
        let scheduler = Scheduler::new(goal);
        Self {
            scheduler,
            now: Time::ZERO,
            at_work: VecDeque::new(),
            n_units_sent: 0,
            shown: vec![],
            cancelled: vec![],
            loading: vec![],
            preparing: vec![],
            motions: vec![],
            changes: vec![],
            placed: BTreeMap::new(),
        }
    }

    fn with_nodes(goal: RenderGoal, nodes: &[NodeId]) -> Self {
        let min_renderers = nodes.len() as u32;
        let mut farm = Self::new(RenderGoal { min_renderers, ..goal.clone() });
        nodes.iter().for_each(|&node| farm.join(node));
        farm.on(Event::GoalChanged(goal));
        farm
    }

    fn on(&mut self, event: Event) {
        for action in self.scheduler.on_event(self.now, event) {
            match action {
                Action::LoadScene { node, scene, .. } => self.loading.push((node, scene)),
                Action::PrepareScene { node, scene, .. } => self.preparing.push((node, scene)),
                Action::Open { frame, spec, moved_at, change } => {
                    self.changes.push(change);
                    self.motions.push(moved_at);
                    self.placed.insert(frame, vec![0; spec.size.n_samples() as usize]);
                    let in_flight = self.scheduler.goal.in_flight as usize;
                    assert!(self.placed.len() <= in_flight, "more than {in_flight} frames in flight");
                }
                Action::Render { node, frame, task_id, spec, task, .. } => {
                    let share = task.share(spec.size).expect("tasks fit their frames");
                    self.n_units_sent += u64::from(share.count());
                    self.at_work.push_back(Sent { node, frame, task_id, task, size: spec.size });
                }
                Action::Cancel { node, frame } => {
                    self.cancelled.push(node);
                    self.at_work.retain(|sent| (sent.node, sent.frame) != (node, frame));
                }
                Action::Show { frame, stats } => {
                    let placed = self.placed.remove(&frame).expect("a frame is shown once");
                    assert!(placed.iter().all(|&times| times > 0), "a frame with holes is shown");
                    assert!(self.at_work.iter().all(|sent| sent.frame != frame), "a node still renders it");
                    self.shown.push(stats);
                }
                Action::Discard { frame } => {
                    self.placed.remove(&frame).expect("only an open frame is discarded");
                    assert!(self.at_work.iter().all(|sent| sent.frame != frame), "a node still renders it");
                }
            }
        }
    }

    fn join(&mut self, node: NodeId) {
        self.on(Event::Joined { node, name: format!("node {}", node.0), threads: 1 });
        self.on(Event::SceneReady { node, ready: true });
    }

    fn lose(&mut self, node: NodeId) {
        self.at_work.retain(|sent| sent.node != node);
        self.on(Event::Lost { node });
    }

    fn place(&mut self, sent: &Sent, first: u32, count: u32) {
        let share = sent.task.share(sent.size).unwrap();
        for (i, j) in (first..first + count).flat_map(|k| share.samples(k).iter()) {
            let placed = self.placed.get_mut(&sent.frame).expect("only open frames are rendered");
            placed[(j * sent.size.xres() + i) as usize] += 1;
        }
        let units = PlacedUnits { first, count, n_bytes: 3, place_time: Time::ZERO };
        self.on(Event::UnitsPlaced { node: sent.node, frame: sent.frame, task_id: sent.task_id, units });
    }

    /// A node finishes its oldest task.
    fn answer(&mut self, node: NodeId) {
        let at = self.at_work.iter().position(|sent| sent.node == node).expect("the node has a task");
        let sent = self.at_work.remove(at).unwrap();
        let n_units = sent.task.share(sent.size).unwrap().count();
        self.place(&sent, 0, n_units);
        let timings = TaskTimings { trace_us: 1000, trace_cpu_us: 500, ..TaskTimings::default() };
        // Arbitrary, but those of the first frames differ by factors of thousands.
        let costs = RunCosts { run_units: n_units.max(1), cpu_ns: vec![1000 << (7 * sent.task_id.0 % 16)] };
        self.on(Event::TaskDone { node, frame: sent.frame, task_id: sent.task_id, timings, costs });
    }

    fn pass(&mut self, milliseconds: u64) {
        self.now += Duration::from_millis(milliseconds);
        self.on(Event::Tick);
    }
}

#[test]
fn a_frame_is_shown_once_all_tasks_are_done() {
    for &division in Division::VARIANTS {
        let mut farm = Farm::with_nodes(goal(division), &[A, B, C]);
        farm.pass(4);
        farm.answer(B);
        farm.answer(A);
        assert!(farm.shown.is_empty());
        farm.pass(6);
        farm.answer(C);
        let [stats] = &farm.shown[..] else { panic!("{} frames", farm.shown.len()) };
        assert_eq!((stats.render_ms, stats.attempts), (10.0, 1));
        let idle: Vec<_> = stats.nodes.iter().map(|node| node.idle_ms).collect();
        assert_eq!(idle, [6.0, 6.0, 0.0]);
        assert!((stats.nodes.iter().map(|node| node.share).sum::<f64>() - 1.0).abs() < 1e-12);
        assert_eq!(stats.nodes[2].network_ms, 9.0, "ten less one of tracing");
        assert_eq!((stats.nodes[2].busy_ms, stats.imbalance), (0.5, 1.0));
    }
}

#[test]
fn nothing_is_rendered_until_enough_are_ready() {
    let mut farm = Farm::new(RenderGoal { min_renderers: 2, ..goal(Division::Tiled) });
    farm.join(A);
    farm.on(Event::Joined { node: B, name: "b".into(), threads: 1 });
    assert!(farm.at_work.is_empty());
    farm.on(Event::SceneReady { node: B, ready: true });
    assert_eq!(farm.at_work.len(), 2);

    // Once a frame has begun, those that are left render alone, unless the wall asks for others.
    farm.lose(B);
    while !farm.at_work.is_empty() {
        farm.answer(A);
    }
    farm.on(Event::FrameTaken);
    farm.on(Event::GoalChanged(RenderGoal { min_renderers: 2, ..goal(Division::Interleaved) }));
    assert_eq!(farm.at_work.len(), 1);
    farm.answer(A);
    farm.on(Event::FrameTaken);
    farm.on(Event::GoalChanged(RenderGoal { min_renderers: 3, ..goal(Division::Tiled) }));
    assert!(farm.at_work.is_empty());
}

#[test]
fn a_resting_wall_renders_nothing() {
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A]);
    farm.answer(A);
    farm.on(Event::FrameTaken);
    farm.pass(1000);
    farm.on(Event::GoalChanged(goal(Division::Tiled)));
    assert!(farm.at_work.is_empty() && !farm.scheduler.has_frame_in_flight());
}

#[test]
fn the_share_of_a_lost_node_goes_to_the_others() {
    for &division in Division::VARIANTS {
        let mut farm = Farm::with_nodes(goal(division), &[A, B, C]);
        farm.answer(A);
        farm.lose(B);
        assert_eq!(farm.at_work.len(), 3, "C's own share, and B's in two parts");
        farm.answer(C);
        farm.answer(A);
        assert!(farm.shown.is_empty());
        farm.answer(C);
        assert_eq!((farm.shown[0].attempts, farm.shown[0].is_healed), (2, true));
    }
}

#[test]
fn the_last_node_may_die_and_another_finishes_its_frame() {
    let mut farm = Farm::with_nodes(goal(Division::Interleaved), &[A]);
    let sent = farm.at_work[0].clone();
    farm.place(&sent, 0, 100);
    farm.lose(A);
    farm.pass(10_000);
    assert!(farm.at_work.is_empty());
    farm.join(B);
    farm.answer(B);
    assert_eq!(farm.shown.len(), 1);
    assert_eq!(farm.shown[0].frame, 1, "it is the same frame");
}

#[test]
fn a_node_that_dies_after_its_last_sample_costs_nothing() {
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A, B]);
    let sent = farm.at_work[0].clone();
    let n_units = sent.task.share(sent.size).unwrap().count();
    farm.place(&sent, 0, n_units);
    farm.lose(sent.node);
    farm.answer(B);
    assert_eq!((farm.shown.len(), farm.shown[0].attempts), (1, 1));
}

#[test]
fn a_node_that_joins_gets_a_task_of_the_next_frame() {
    let mut farm = Farm::with_nodes(RenderGoal { repeat: true, ..goal(Division::Tiled) }, &[A]);
    farm.join(B);
    assert!(farm.at_work.iter().all(|sent| sent.node == A));
    farm.answer(A);
    assert!(farm.at_work.iter().any(|sent| sent.node == B));
}

#[test]
fn a_late_task_is_given_to_an_idle_node_too() {
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A, B]);
    farm.pass(20);
    farm.answer(A);
    farm.pass(40);
    assert_eq!(farm.at_work.len(), 1, "60 ms is three times 20, not more");
    farm.pass(1);
    assert_eq!(farm.at_work.len(), 2);
    farm.answer(A);
    assert_eq!(farm.shown.len(), 1, "the first answer wins");
    assert_eq!(farm.cancelled, [B]);
    assert!(farm.shown[0].is_healed);
}

#[test]
fn a_late_node_that_answers_first_has_done_its_own_work() {
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A, B]);
    farm.pass(20);
    farm.answer(A);
    farm.pass(41);
    assert_eq!(farm.at_work.len(), 2);
    farm.answer(B);
    farm.answer(A);
    assert_eq!((farm.shown.len(), farm.shown[0].attempts, farm.shown[0].is_healed), (1, 2, false));
}

#[test]
fn a_node_without_the_scene_does_not_hold_up_the_frame() {
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A]);
    farm.at_work.clear();
    farm.on(Event::SceneReady { node: A, ready: false });
    assert!(farm.at_work.is_empty());
    farm.on(Event::SceneReady { node: A, ready: true });
    farm.answer(A);
    assert_eq!(farm.shown.len(), 1);
}

#[test]
fn a_node_that_is_ready_again_gets_its_tasks_again() {
    for &division in Division::VARIANTS {
        let mut farm = Farm::with_nodes(goal(division), &[A]);
        // It had another scene when they came, and took no notice of them.
        farm.at_work.clear();
        farm.on(Event::SceneReady { node: A, ready: true });
        assert_eq!((&farm.cancelled[..], farm.at_work.len()), (&[A][..], 1));
        farm.answer(A);
        assert_eq!(farm.shown.len(), 1);
        farm.on(Event::SceneReady { node: A, ready: true });
        assert_eq!(farm.cancelled, [A], "it holds none");
    }
}

#[test]
fn a_slow_node_is_not_a_lost_one() {
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A]);
    farm.pass(60_000);
    farm.answer(A);
    assert_eq!((farm.shown.len(), farm.shown[0].attempts), (1, 1));
}

#[test]
fn the_next_frame_is_rendered_but_not_shown_before_the_last_is_taken() {
    let mut farm = Farm::with_nodes(RenderGoal { repeat: true, ..goal(Division::Tiled) }, &[A]);
    farm.answer(A);
    farm.answer(A);
    assert_eq!(farm.shown.len(), 1);
    farm.on(Event::FrameTaken);
    assert_eq!(farm.shown.len(), 2);
    assert_eq!((farm.shown[0].frame, farm.shown[1].frame), (1, 2));
}

#[test]
fn waiting_to_be_shown_is_not_rendering() {
    let mut farm = Farm::with_nodes(RenderGoal { repeat: true, ..goal(Division::Tiled) }, &[A]);
    farm.answer(A);
    farm.pass(5);
    farm.answer(A);
    farm.pass(100);
    farm.on(Event::FrameTaken);
    assert_eq!((farm.shown[1].render_ms, farm.shown[1].nodes[0].idle_ms), (5.0, 0.0));
}

#[test]
fn a_newer_camera_supersedes_a_frame_that_waits_to_be_shown() {
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A]);
    farm.answer(A);
    farm.on(Event::GoalChanged(RenderGoal { spec: Some(spec(1.0, 1000)), ..goal(Division::Tiled) }));
    farm.answer(A);
    assert_eq!(farm.shown.len(), 2, "the second takes the place of the first");
}

#[test]
fn only_the_newest_camera_is_rendered_next() {
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A]);
    for eye_x in 1..5 {
        farm.on(Event::GoalChanged(RenderGoal { spec: Some(spec(eye_x.into(), 1000)), ..goal(Division::Tiled) }));
    }
    farm.answer(A);
    farm.on(Event::FrameTaken);
    assert_eq!(farm.scheduler.frames[0].spec, spec(4.0, 1000));
    farm.answer(A);
    assert_eq!(farm.shown.len(), 2);
}

#[test]
fn a_division_is_switched_between_two_frames() {
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A]);
    farm.answer(A);
    farm.on(Event::FrameTaken);
    farm.on(Event::GoalChanged(goal(Division::Interleaved)));
    farm.answer(A);
    assert_eq!(farm.shown[1].division, Division::Interleaved);
}

#[test]
fn another_scene_cancels_the_frame_and_every_node_loads_it() {
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A, B]);
    let [first, second] =
        [1000, 2000].map(|triangles| Some(SceneId::Statue { triangles, treatment: Default::default() }));
    assert_eq!(farm.loading, [(A, first), (B, first)], "each loads it on joining");
    farm.on(Event::GoalChanged(RenderGoal { spec: Some(spec(0.0, 2000)), ..goal(Division::Tiled) }));
    assert_eq!(farm.cancelled, [A, B]);
    assert_eq!(farm.loading[2..], [(A, second), (B, second)]);
    assert!(farm.at_work.is_empty());
    farm.on(Event::GoalChanged(RenderGoal { spec: Some(spec(1.0, 2000)), ..goal(Division::Tiled) }));
    assert_eq!(farm.loading.len(), 4, "another camera is no other scene");
    farm.on(Event::SceneReady { node: B, ready: true });
    farm.answer(B);
    assert_eq!(farm.shown.len(), 1);
}

#[test]
fn the_next_scene_is_loaded_ahead_and_frames_tell_their_change() {
    let statue = |triangles| SceneId::Statue { triangles, treatment: Default::default() };
    let next =
        |triangles, spec| RenderGoal { next_scene: Some((statue(triangles), None)), spec, ..goal(Division::Tiled) };
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A]);
    let first = goal(Division::Tiled).spec;
    farm.on(Event::GoalChanged(next(2000, first)));
    farm.on(Event::GoalChanged(next(2000, first)));
    assert_eq!(farm.preparing, [(A, statue(2000))], "told once");
    farm.join(B);
    assert_eq!(farm.preparing[1..], [(B, statue(2000))]);
    farm.on(Event::GoalChanged(RenderGoal { change: 1, ..next(2000, Some(spec(0.0, 2000))) }));
    assert_eq!(farm.preparing.len(), 2, "the scene on show is not the next");
    farm.on(Event::SceneReady { node: A, ready: true });
    farm.answer(A);
    farm.on(Event::FrameTaken);
    assert_eq!((farm.shown.len(), farm.changes.last()), (1, Some(&1)));
    // The same picture again is a frame of the new change.
    farm.on(Event::GoalChanged(RenderGoal { change: 2, ..next(1000, Some(spec(0.0, 2000))) }));
    assert_eq!((farm.changes.last(), farm.preparing.len()), (Some(&2), 4));
}

#[test]
fn every_node_loads_another_structure_before_it_gets_tasks() {
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A, B]);
    farm.at_work.clear();
    farm.on(Event::StructureChanged);
    assert_eq!(farm.loading.len(), 4, "two joined, and two load it again");
    farm.pass(1000);
    assert!(farm.at_work.is_empty(), "none has it yet");
    farm.on(Event::SceneReady { node: A, ready: true });
    farm.answer(A);
    farm.answer(A);
    assert_eq!(farm.shown.len(), 1, "the frame is kept");
}

#[test]
fn a_frame_carries_the_time_of_the_motion_that_it_is_the_first_to_show() {
    let moved = |farm: &mut Farm, eye_x: f64, moved_at| {
        let goal = RenderGoal { repeat: true, moved_at, ..goal(Division::Tiled) };
        farm.on(Event::GoalChanged(RenderGoal { spec: Some(spec(eye_x, 1000)), ..goal }));
    };
    let [first, second, third] = [1, 2, 3].map(|seconds| Instant::now() + Duration::from_secs(seconds));
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A]);
    assert_eq!(farm.motions, [None], "the first frame waited for its model");
    // The second motion comes while the first waits for room, the third while the second's frame is rendered.
    moved(&mut farm, 1.0, first);
    moved(&mut farm, 2.0, second);
    farm.answer(A);
    moved(&mut farm, 3.0, third);
    for _ in 0..2 {
        farm.on(Event::FrameTaken);
        farm.answer(A);
    }
    assert_eq!(farm.motions, [None, Some(second), Some(third), None], "no motion is shown first by two frames");
}

proptest! {
    /// In any sequence of events, no frame has holes and frames are shown in order. Afterwards, the last goal's frame is
    /// finished.
    #[test]
    fn every_frame_is_complete_in_any_sequence_of_events(
        events in proptest::collection::vec((0..8u8, 1..6u32, 0..40u64), 0..200), division in 0..3usize,
        in_flight in 1..4u32,
    ) {
        let goal = RenderGoal { repeat: true, in_flight, ..goal(Division::VARIANTS[division]) };
        let mut farm = Farm::new(goal.clone());
        let mut alive = BTreeSet::new();
        for (kind, node, milliseconds) in events {
            let id = NodeId(node);
            farm.now += Duration::from_millis(milliseconds);
            match kind {
                0 => {
                    if alive.insert(id) {
                        farm.join(id);
                    }
                }
                1 => {
                    if alive.remove(&id) {
                        farm.lose(id);
                    }
                }
                2 => farm.on(Event::FrameTaken),
                3 => {
                    // A part of a task's units, perhaps for the second time.
                    if let Some(sent) = farm.at_work.iter().find(|sent| sent.node == id).cloned() {
                        let n_units = sent.task.share(sent.size).unwrap().count();
                        farm.place(&sent, 0, n_units.min(milliseconds as u32));
                    }
                }
                4 => {
                    let spec = Some(spec(node.into(), 1000));
                    farm.on(Event::GoalChanged(RenderGoal { spec, is_refinement: milliseconds % 3 == 0, ..goal.clone() }));
                }
                // A silent node may still answer.
                5 => farm.on(Event::Silent { node: id, is_silent: milliseconds % 2 == 0 }),
                _ => {
                    if farm.at_work.iter().any(|sent| sent.node == id) {
                        farm.answer(id);
                    }
                }
            }
            farm.pass(0);
        }
        let n_shown = farm.shown.len();
        farm.on(Event::GoalChanged(RenderGoal { spec: Some(spec(99.0, 1000)), ..goal }));
        farm.on(Event::FrameTaken);
        if alive.insert(NodeId(99)) {
            farm.join(NodeId(99));
        }
        for _ in 0..200 {
            farm.on(Event::FrameTaken);
            if let Some(sent) = farm.at_work.front() {
                farm.answer(sent.node);
            }
        }
        prop_assert!(farm.shown.len() > n_shown);
        prop_assert!(farm.shown.windows(2).all(|pair| pair[0].frame < pair[1].frame), "each once, in order");
        prop_assert!(farm.scheduler.frames.iter().all(|frame| frame.spec == spec(99.0, 1000)));
    }
}
