//! Dynamic division on a simulated cluster: costs of tiles, speeds of nodes, nodes that join, slow down or die.

use std::time::Instant;

use proptest::prelude::*;
use shared::{
    appearance::Appearance,
    camera::Camera,
    detail::Detail,
    protocol::{FrameId, LightingMode, SampleRange, ShadingMode, TaskId, TaskTimings},
};

use super::*;
use crate::farm::{
    scheduler::{Action, Event, PlacedUnits, RenderGoal, Scheduler, Time},
    stats::FrameStats,
};

const SIZE: (u32, u32) = (1024, 512);

/// The cost of the tile in this column and row of this frame, in nanoseconds on a node of slowness 1.
type TileCost = fn(frame: u64, column: f64, row: f64) -> f64;

/// A scan before an empty background: most of the frame costs little, an edge of the model fifty times as much.
fn still(_: u64, column: f64, row: f64) -> f64 {
    let model = |x: f64, y: f64, radius: f64| (1.0 - ((column - x).hypot(row - y) / radius).powi(4)).max(0.0);
    3e3 + 5e4 * model(40.0, 30.0, 18.0) + 1.5e5 * model(85.0, 20.0, 9.0) + 2e4 * model(100.0, 50.0, 12.0)
}

/// The same, moving to and fro by half a tile a frame, as fast as a model that turns once in four seconds.
fn moving(frame: u64, column: f64, row: f64) -> f64 {
    let way = 0.5 * (frame % 160) as f64;
    still(0, column - way.min(80.0 - way), row)
}

fn spec() -> FrameSpec {
    spec_from(0.0)
}

fn goal(min_renderers: usize) -> RenderGoal {
    let min_renderers = min_renderers as u32;
    RenderGoal {
        spec: Some(spec()),
        scene_path: None,
        next_scene: None,
        change: 0,
        sky_path: None,
        is_refinement: false,
        division: Division::Dynamic,
        min_renderers,
        repeat: true,
        in_flight: 1,
        encoding: None,
        moved_at: Instant::now(),
    }
}

fn spec_from(eye_x: f64) -> FrameSpec {
    FrameSpec {
        scene: SceneId::Statue { triangles: 1, treatment: Default::default() },
        camera: Camera::look_at(glam::DVec3::new(eye_x, 0.0, 1.0), glam::DVec3::ZERO, glam::DVec3::Y, 0.7, 2.0)
            .unwrap(),
        size: SIZE.try_into().unwrap(),
        view: ShadingMode::Shaded,
        rays: LightingMode::Primary,
        samples: SampleRange::CENTRE,
        detail: Detail::FULL,
        appearance: Appearance::default(),
    }
}

/// A task that is under way.
struct Pending {
    done_at: Time,
    node: NodeId,
    frame: FrameId,
    task_id: TaskId,
    n_units: u32,
    costs: RunCosts,
}

struct Cluster {
    scheduler: Scheduler,
    now: Time,
    tile_cost: TileCost,
    slowness: BTreeMap<NodeId, f64>,
    pending: Vec<Pending>,
    shown: Vec<FrameStats>,
    /// Whether each frame has a camera of its own.
    is_moving: bool,
    /// The sizes of frames, in turn.
    sizes: Vec<(u32, u32)>,
}

/// From 0 to 1, the same for the same numbers.
fn noise(a: u64, b: u64) -> f64 {
    let mixed = (a ^ b.rotate_left(32)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    let mixed = (mixed ^ mixed >> 29).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    ((mixed ^ mixed >> 32) >> 11) as f64 / (1u64 << 53) as f64
}

impl Cluster {
    fn new(tile_cost: TileCost, slowness: &[f64]) -> Self {
        let scheduler = Scheduler::new(goal(slowness.len()));
        let mut cluster = Self {
            scheduler,
            now: Time::ZERO,
            tile_cost,
            slowness: BTreeMap::new(),
            pending: vec![],
            shown: vec![],
            is_moving: false,
            sizes: vec![SIZE],
        };
        (1..).zip(slowness).for_each(|(node, &slowness)| cluster.join(NodeId(node), slowness));
        cluster
    }

    fn join(&mut self, node: NodeId, slowness: f64) {
        self.slowness.insert(node, slowness);
        self.on(Event::Joined { node, name: String::new(), threads: 1 });
        self.on(Event::SceneReady { node, ready: true });
    }

    fn on(&mut self, event: Event) {
        for action in self.scheduler.on_event(self.now, event) {
            match action {
                Action::LoadScene { .. } | Action::PrepareScene { .. } | Action::Open { .. } => {}
                Action::Render { node, frame, task_id, spec, task, .. } => {
                    self.pend(node, frame, task_id, &task, spec.size);
                }
                Action::Cancel { node, frame } => {
                    self.pending.retain(|pending| (pending.node, pending.frame) != (node, frame));
                }
                Action::Show { stats, .. } => self.shown.push(stats),
                Action::Discard { .. } => {}
            }
        }
    }

    /// Simulates a render server: measures costs in the same runs as a real one.
    fn pend(&mut self, node: NodeId, frame: FrameId, task_id: TaskId, task: &Task, size: FrameSize) {
        let share = task.share(size).unwrap();
        let n_units = share.count();
        let run_units = RunCosts::run_units(&share);
        // Speeds of nodes vary by 2 %, costs of tiles by 20 %.
        let slowness = self.slowness[&node] * (0.99 + 0.02 * noise(frame.0, node.0.into()));
        let cost = |k: u32| {
            let samples = share.samples(k);
            // In tiles of a frame of `SIZE`.
            let scale = [f64::from(SIZE.0) / f64::from(size.xres()), f64::from(SIZE.1) / f64::from(size.yres())];
            let column = (f64::from(samples.columns.start / 8) * scale[0]).floor();
            let row = (f64::from(samples.rows.start / 8) * scale[1]).floor();
            let variation = 0.9 + 0.2 * noise(frame.0, 1000 + u64::from(share.unit(k)));
            (self.tile_cost)(frame.0, column, row) * slowness * variation
        };
        let tiles: Vec<f64> = (0..n_units).map(cost).collect();
        let cpu_ns = tiles.chunks(run_units as usize).map(|tiles| tiles.iter().sum::<f64>() as u32).collect();
        let busy_until = self.pending.iter().filter(|pending| pending.node == node).map(|pending| pending.done_at);
        let starts_at = busy_until.max().unwrap_or(self.now);
        let done_at = starts_at + Time::from_nanos(tiles.iter().sum::<f64>() as u64);
        self.pending.push(Pending { done_at, node, frame, task_id, n_units, costs: RunCosts { run_units, cpu_ns } });
    }

    fn answer_next(&mut self) {
        let next =
            (0..self.pending.len()).min_by_key(|&index| self.pending[index].done_at).expect("a task is under way");
        let Pending { done_at, node, frame, task_id, n_units, costs } = self.pending.swap_remove(next);
        self.now = self.now.max(done_at);
        let units = PlacedUnits { first: 0, count: n_units, n_bytes: 0, place_time: Time::ZERO };
        self.on(Event::UnitsPlaced { node, frame, task_id, units });
        let trace_cpu_us = (costs.cpu_ns.iter().map(|&ns| f64::from(ns)).sum::<f64>() / 1e3) as u32;
        let timings = TaskTimings { trace_us: trace_cpu_us, trace_cpu_us, ..TaskTimings::default() };
        self.on(Event::TaskDone { node, frame, task_id, timings, costs });
        if self.is_moving || self.sizes.len() > 1 {
            // The next goal comes while a frame is in flight, and is rendered after it.
            let size = self.sizes[self.shown.len() % self.sizes.len()].try_into().unwrap();
            let spec = Some(FrameSpec { size, ..spec_from(self.shown.len() as f64) });
            self.on(Event::GoalChanged(RenderGoal { spec, ..goal(1) }));
        }
        self.on(Event::FrameTaken);
    }

    /// Renders `n_frames` more frames and returns the imbalance of each.
    fn render(&mut self, n_frames: usize) -> Vec<f64> {
        let n_shown = self.shown.len();
        while self.shown.len() < n_shown + n_frames {
            self.answer_next();
        }
        self.shown[n_shown..].iter().map(|stats| stats.imbalance).collect()
    }
}

fn quantile(values: &[f64], part: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[((sorted.len() - 1) as f64 * part) as usize]
}

fn check(name: &str, imbalances: &[f64], median: f64, p95: f64) {
    let (is_median, is_p95) = (quantile(imbalances, 0.5), quantile(imbalances, 0.95));
    println!("{name}: median {is_median:.3}, p95 {is_p95:.3}, first {:.3?}", &imbalances[..4.min(imbalances.len())]);
    assert!(is_median <= median && is_p95 <= p95, "{name}: median {is_median:.3}, p95 {is_p95:.3}");
}

#[test]
fn equal_nodes_are_equally_busy() {
    for n_nodes in [2, 12, 64] {
        let mut cluster = Cluster::new(still, &vec![1.0; n_nodes]);
        cluster.render(2);
        let most = if n_nodes <= 12 { 1.05 } else { 1.10 };
        check(&format!("still, {n_nodes} nodes"), &cluster.render(40), most, most + 0.05);
    }
}

#[test]
fn frames_in_flight_do_not_unbalance_each_other() {
    let mut cluster = Cluster::new(still, &[1.0; 12]);
    cluster.on(Event::GoalChanged(RenderGoal { in_flight: 3, ..goal(12) }));
    cluster.render(3);
    check("still, 12 nodes, 3 frames in flight", &cluster.render(40), 1.05, 1.10);
}

#[test]
fn equal_nodes_are_equally_busy_while_the_camera_moves() {
    let mut cluster = Cluster::new(moving, &[1.0; 12]);
    cluster.is_moving = true;
    cluster.render(2);
    check("moving, 12 nodes", &cluster.render(200), 1.05, 1.15);
}

#[test]
fn a_node_at_a_third_of_the_speed_is_as_busy_as_the_others() {
    let mut slowness = [1.0; 12];
    slowness[4] = 3.0;
    for (name, tile_cost) in [("still", still as TileCost), ("moving", moving)] {
        let mut cluster = Cluster::new(tile_cost, &slowness);
        cluster.is_moving = name == "moving";
        cluster.render(2);
        check(&format!("{name}, one of 12 nodes slow"), &cluster.render(100), 1.10, 1.15);
        let share = |node: usize| cluster.shown.last().unwrap().nodes[node].share;
        assert!(share(4) > 0.0 && cluster.shown.iter().all(|stats| stats.attempts == 1 || stats.frame == 1));
    }
}

#[test]
fn another_resolution_is_divided_by_the_costs_of_the_last() {
    let mut slowness = [1.0; 12];
    slowness[4] = 3.0;
    let mut cluster = Cluster::new(still, &slowness);
    cluster.sizes = [(1024, 512), (728, 360), (2048, 1024), (512, 256)].map(|size| [size; 3]).concat();
    cluster.render(6);
    // If speeds were not kept across resolutions, the slow node would get 2.5 times its part in each third frame.
    check("another size after three frames, one of 12 nodes slow", &cluster.render(60), 1.15, 1.25);
}

#[test]
fn a_node_that_never_finishes_gets_less_until_it_does() {
    let (spec, nodes) = (spec(), [(NodeId(1), 1), (NodeId(2), 1)]);
    let mut balance = Balance::default();
    let mut tasks = vec![Division::Dynamic.task(0, 2), Division::Dynamic.task(1, 2)];
    // Node 1 takes 1000 ns a tile; node 2 is so slow that others always finish its task before it does.
    let measure = |balance: &mut Balance, tasks: &[Task], slowness: Option<u32>| {
        let shares: Vec<_> = tasks.iter().map(|task| task.share(spec.size).unwrap()).collect();
        let costs = |share: &Share, ns| RunCosts { run_units: 1, cpu_ns: vec![ns; share.count() as usize] };
        let of_first = costs(&shares[0], 1000);
        let of_second = slowness.map(|slowness| costs(&shares[1], 1000 * slowness));
        let [first, second] = [0, 1].map(|index| shares[index]);
        balance.learn(
            &spec,
            &[
                TaskResult { node: NodeId(1), share: first, costs: Some(&of_first) },
                TaskResult { node: NodeId(2), share: second, costs: of_second.as_ref() },
            ],
        );
        balance.divide(&spec, &nodes).unwrap()
    };
    let n_tiles = |tasks: &[Task]| tasks[1].share(spec.size).unwrap().count();
    for _ in 0..12 {
        let before = n_tiles(&tasks);
        tasks = measure(&mut balance, &tasks, None);
        assert!(n_tiles(&tasks) <= before);
    }
    assert!((1..1500).contains(&n_tiles(&tasks)), "{} of 8192 tiles", n_tiles(&tasks));
    for _ in 0..12 {
        tasks = measure(&mut balance, &tasks, Some(8));
    }
    assert!((820..1000).contains(&n_tiles(&tasks)), "{} of 8192 tiles for a ninth of the speed", n_tiles(&tasks));
}

#[test]
fn the_balance_returns_after_a_change() {
    let mut cluster = Cluster::new(still, &[1.0; 12]);
    cluster.render(5);
    cluster.tile_cost = |frame, column, row| still(frame, 127.0 - column, 63.0 - row);
    cluster.render(3);
    check("after another camera", &cluster.render(10), 1.05, 1.10);
    cluster.slowness.insert(NodeId(7), 3.0);
    cluster.render(4);
    check("after a node has slowed down", &cluster.render(10), 1.10, 1.15);
    cluster.join(NodeId(13), 0.5);
    cluster.render(4);
    check("after a fast node has joined", &cluster.render(10), 1.10, 1.15);
    cluster.pending.retain(|pending| pending.node != NodeId(2));
    cluster.on(Event::Lost { node: NodeId(2) });
    cluster.render(3);
    check("after a node has died", &cluster.render(10), 1.05, 1.10);
    assert_eq!(cluster.shown.last().unwrap().nodes.len(), 12);
}

#[test]
fn one_slow_frame_of_a_node_moves_nothing() {
    let mut cluster = Cluster::new(still, &[1.0; 12]);
    cluster.render(10);
    cluster.slowness.insert(NodeId(3), 5.0);
    let n_shown = cluster.shown.len();
    // The tasks under way were begun at full speed: the next frame is the slow one.
    cluster.render(1);
    cluster.slowness.insert(NodeId(3), 1.0);
    cluster.render(1);
    assert!(cluster.shown[n_shown + 1].imbalance > 2.0);
    check("after one slow frame", &cluster.render(1), 1.06, 1.06);
}

#[test]
fn costs_of_another_scene_or_division_are_not_used() {
    let mut balance = Balance::default();
    let nodes = [(NodeId(1), 1), (NodeId(2), 3)];
    assert_eq!(balance.divide(&spec(), &nodes), None);
    balance.learn(&spec(), &[]);
    let Some([first, second]) = balance.divide(&spec(), &nodes).map(|tasks| <[Task; 2]>::try_from(tasks).unwrap())
    else {
        panic!("a frame was learned from");
    };
    let run = |first, count| Task { selection: Selection::CurveRun(TileRun { first, count }), part: Part::WHOLE };
    assert_eq!((first, second), (run(0, 2048), run(2048, 6144)), "three threads get three times the tiles");
    let small = FrameSpec { size: FrameSize::new(64, 64).unwrap(), ..spec() };
    assert_eq!(balance.divide(&small, &nodes), Some(vec![run(0, 16), run(16, 48)]), "in any resolution");
    assert_eq!(
        balance.divide(
            &FrameSpec { scene: SceneId::Statue { triangles: 2, treatment: Default::default() }, ..spec() },
            &nodes
        ),
        None
    );
    balance.forget_costs();
    assert_eq!(balance.divide(&spec(), &nodes), None);
}

#[test]
fn runs_of_many_tiles_are_cut_between_squares() {
    let of_tile: Vec<f64> = (0..4099).map(|tile| f64::from(tile % 7)).collect();
    for (n_runs, is_square) in [(1, true), (16, true), (17, false), (200, false)] {
        let runs = cut_curve(&of_tile, &vec![1.0; n_runs]);
        assert_eq!(
            runs.iter().all(|run| run.first.is_multiple_of(curve::TILES_PER_SQUARE)),
            is_square,
            "{n_runs} runs"
        );
        assert_eq!(runs.iter().map(|run| run.count).sum::<u32>(), 4099);
    }
}

proptest! {
    #[test]
    fn runs_follow_each_other_and_miss_no_tile(
        of_tile in proptest::collection::vec(prop_oneof![Just(0.0), 0.0..1.0, 100.0..1e6], 1..600),
        speeds in proptest::collection::vec(prop_oneof![0.3..3.0, 1e-3..1e3], 1..40),
    ) {
        let runs = cut_curve(&of_tile, &speeds);
        prop_assert_eq!(runs.len(), speeds.len());
        let mut end = 0;
        for run in &runs {
            prop_assert_eq!(run.first, end);
            prop_assert!(run.count > 0 || speeds.len() > of_tile.len());
            end += run.count;
        }
        prop_assert_eq!(end as usize, of_tile.len());
    }

    /// A render server that lies about its costs gets a wrong share, and does no other harm.
    #[test]
    fn lies_about_costs_leave_a_division(
        lies in proptest::collection::vec((0..4u32, prop_oneof![Just(0u32), Just(u32::MAX), any::<u32>()]), 1..60),
    ) {
        let mut balance = Balance::default();
        let size = FrameSize::new(80, 48).unwrap();
        let spec = FrameSpec { size, ..spec() };
        let nodes: Vec<_> = (0..4).map(|node| (NodeId(node), 1)).collect();
        for lies in lies.chunks(3) {
            let equal = || (0..4).map(|machine| Division::Dynamic.task(machine, 4)).collect();
            let tasks = balance.divide(&spec, &nodes).unwrap_or_else(equal);
            let costs: Vec<_> = lies
                .iter()
                .map(|&(node, lie)| {
                    let n_units = tasks[node as usize].share(size).unwrap().count();
                    (node, RunCosts { run_units: 2, cpu_ns: vec![lie; n_units.div_ceil(2) as usize] })
                })
                .collect();
            let measured: Vec<_> = costs
                .iter()
                .map(|&(node, ref costs)| TaskResult {
                    node: NodeId(node),
                    share: tasks[node as usize].share(size).unwrap(),
                    costs: Some(costs),
                })
                .collect();
            balance.learn(&spec, &measured);
            let tasks = balance.divide(&spec, &nodes).unwrap();
            let n_tiles: u32 = tasks.iter().map(|task| task.share(size).unwrap().count()).sum();
            prop_assert_eq!(n_tiles, 60);
        }
    }
}
