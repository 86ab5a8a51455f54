//! Simulates a cluster: the wall's own scheduler, render servers whose tasks take their measured time, and one link into the
//! wall that all of them share.
//!
//! The simulation leaves out operating systems, the wall's placing of samples, and its display.

use std::{
    cmp::Reverse,
    collections::{BinaryHeap, HashMap, VecDeque},
    rc::Rc,
    time::Duration,
};

use compositor::farm::{
    scheduler::{Action, Event, PlacedUnits, RenderGoal, Scheduler, Time},
    stats::{FrameStats, NodeId},
};
use shared::{
    codec,
    division::{Division, Task},
    protocol::{Encoding, FrameId, FrameSpec, RunCosts, TaskId, TaskTimings, ToWall},
};

use crate::farm;

/// Interval of the scheduler's ticks, as in the farm.
const TICK: Duration = Duration::from_millis(10);

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct SimulatedLink {
    /// Bits of payload a second into the wall, of all render servers together; infinity for a link without delay.
    pub(super) bits_per_second: f64,
    /// Of one direction.
    pub(super) latency: Duration,
}

impl SimulatedLink {
    /// The time that `n_bytes` occupy the link.
    pub(super) fn time_for(&self, n_bytes: u64) -> Duration {
        Duration::from_secs_f64(n_bytes as f64 * 8.0 / self.bits_per_second)
    }
}

/// A task as a render server traced it: its chunks in order, with CPU times on this machine.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct TracedShare {
    pub(super) chunks: Vec<TracedChunk>,
    pub(super) costs: RunCosts,
}

/// Consecutive units of a task that are sent together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct TracedChunk {
    /// Index of the first unit in the task.
    pub(super) first_unit: u32,
    pub(super) n_units: u32,
    /// Headers included.
    pub(super) n_bytes: u64,
    pub(super) cpu: Duration,
}

#[derive(Clone, Debug)]
pub(super) struct SimulatedCluster {
    /// For each one-core render server its time relative to this machine's.
    pub(super) slowness: Vec<f64>,
    pub(super) link: SimulatedLink,
    pub(super) division: Division,
    pub(super) in_flight: u32,
}

#[derive(Clone, Debug)]
pub(super) struct ReplayedFrame {
    /// Since the replay began.
    pub(super) shown_at: Duration,
    pub(super) stats: FrameStats,
}

/// Renders until `n_frames` are shown. `spec` gives the frame to ask for after a number of shown frames; `trace` traces the
/// tasks of a frame, and ends the replay by `None`.
pub(super) fn replay<P, T>(cluster: &SimulatedCluster, n_frames: usize, spec: P, trace: T) -> Vec<ReplayedFrame>
where
    P: Fn(usize) -> FrameSpec,
    T: FnMut(&[(FrameSpec, Task)]) -> Option<Vec<Rc<TracedShare>>>,
{
    let mut replay = Replay {
        cluster,
        scheduler: Scheduler::new(goal(cluster, spec(0))),
        now: Time::ZERO,
        agenda: BinaryHeap::new(),
        events: Vec::new(),
        servers: vec![SimulatedServer::default(); cluster.slowness.len()],
        link_free_at: Time::ZERO,
        untraced: Vec::new(),
        traced: HashMap::new(),
        shown: Vec::new(),
        is_over: false,
        spec,
        trace,
    };
    for number in 0..cluster.slowness.len() as u32 {
        let node = NodeId(number);
        replay.deliver(Event::Joined { node, name: String::new(), threads: 1 });
        replay.deliver(Event::SceneReady { node, ready: true });
    }
    replay.schedule(TICK, SimulationEvent::Tick);
    while replay.shown.len() < n_frames && !replay.is_over {
        let Some(Reverse((at, index))) = replay.agenda.pop() else { break };
        replay.now = at;
        replay.process(index);
    }
    replay.shown
}

fn goal(cluster: &SimulatedCluster, spec: FrameSpec) -> RenderGoal {
    let (in_flight, encoding) = (cluster.in_flight, Some(Encoding::Raw));
    RenderGoal { spec: Some(spec), in_flight, encoding, ..farm::goal(cluster.division, cluster.slowness.len() as u32) }
}

#[derive(Clone, Debug)]
struct Job {
    frame: FrameId,
    task_id: TaskId,
    spec: FrameSpec,
    task: Task,
}

/// A render server: one core that processes its jobs in order.
#[derive(Clone, Debug, Default)]
struct SimulatedServer {
    jobs: VecDeque<Job>,
    /// The first job: its chunks, how many of them are done, and when it began.
    traced: Rc<TracedShare>,
    n_done: usize,
    began_at: Time,
}

#[derive(Debug)]
enum SimulationEvent {
    Asked(NodeId, Job),
    Cancelled(NodeId, FrameId),
    /// A render server has done a chunk of its first job.
    ChunkDone(NodeId, TaskId),
    /// A message of some bytes reaches the link into the wall.
    AtLink(u64, Event),
    /// A message has passed the link.
    Arrived(Event),
    Tick,
}

struct Replay<'a, P, T> {
    cluster: &'a SimulatedCluster,
    scheduler: Scheduler,
    now: Time,
    /// Times and indices of events; simultaneous events in the order in which they were scheduled.
    agenda: BinaryHeap<Reverse<(Time, usize)>>,
    events: Vec<Option<SimulationEvent>>,
    servers: Vec<SimulatedServer>,
    link_free_at: Time,
    /// Tasks that are not yet traced, and traced tasks that have not begun.
    untraced: Vec<Job>,
    traced: HashMap<TaskId, Rc<TracedShare>>,
    shown: Vec<ReplayedFrame>,
    is_over: bool,
    spec: P,
    trace: T,
}

impl<P, T> Replay<'_, P, T>
where
    P: Fn(usize) -> FrameSpec,
    T: FnMut(&[(FrameSpec, Task)]) -> Option<Vec<Rc<TracedShare>>>,
{
    fn schedule(&mut self, after: Duration, event: SimulationEvent) {
        self.agenda.push(Reverse((self.now + after, self.events.len())));
        self.events.push(Some(event));
    }

    fn process(&mut self, index: usize) {
        let Some(event) = self.events[index].take() else { return };
        match event {
            SimulationEvent::Asked(node, job) => {
                let server = &mut self.servers[node.0 as usize];
                server.jobs.push_back(job);
                if server.jobs.len() == 1 {
                    self.begin(node);
                }
            }
            SimulationEvent::Cancelled(node, frame) => {
                let server = &mut self.servers[node.0 as usize];
                let first = server.jobs.front().map(|job| job.task_id);
                let cancelled: Vec<_> =
                    server.jobs.iter().filter(|job| job.frame == frame).map(|job| job.task_id).collect();
                self.untraced.retain(|job| !cancelled.contains(&job.task_id));
                cancelled.iter().for_each(|task_id| drop(self.traced.remove(task_id)));
                server.jobs.retain(|job| job.frame != frame);
                if server.jobs.front().map(|job| job.task_id) != first {
                    self.begin(node);
                }
            }
            SimulationEvent::ChunkDone(node, task_id) => self.send_chunk(node, task_id),
            SimulationEvent::AtLink(n_bytes, event) => {
                // First come, first served: the order does not change when a frame's last byte has passed.
                self.link_free_at = self.link_free_at.max(self.now) + self.cluster.link.time_for(n_bytes);
                self.schedule(self.link_free_at - self.now, SimulationEvent::Arrived(event));
            }
            SimulationEvent::Arrived(event) => self.deliver(event),
            SimulationEvent::Tick => {
                self.deliver(Event::Tick);
                self.schedule(TICK, SimulationEvent::Tick);
            }
        }
    }

    /// A render server begins its first job, if it has one.
    fn begin(&mut self, node: NodeId) {
        let Some(job) = self.servers[node.0 as usize].jobs.front().cloned() else { return };
        if !self.traced.contains_key(&job.task_id) {
            // All tasks of its frame are traced in turn.
            let of_frame: Vec<_> = self.untraced.extract_if(.., |other| other.frame == job.frame).collect();
            let tasks: Vec<_> = of_frame.iter().map(|job| (job.spec, job.task)).collect();
            let Some(traced) = (self.trace)(&tasks) else {
                self.is_over = true;
                return;
            };
            self.traced.extend(of_frame.iter().map(|job| job.task_id).zip(traced));
        }
        let traced = self.traced.remove(&job.task_id).expect("all tasks of the frame are traced");
        let server = &mut self.servers[node.0 as usize];
        (server.traced, server.n_done, server.began_at) = (traced, 0, self.now);
        self.next_chunk(node);
    }

    /// A render server begins its next chunk, or ends its job after the last.
    fn next_chunk(&mut self, node: NodeId) {
        let slowness = self.cluster.slowness[node.0 as usize];
        let server = &mut self.servers[node.0 as usize];
        let Some(&Job { frame, task_id, .. }) = server.jobs.front() else { return };
        let traced = Rc::clone(&server.traced);
        if let Some(chunk) = traced.chunks.get(server.n_done) {
            return self.schedule(chunk.cpu.mul_f64(slowness), SimulationEvent::ChunkDone(node, task_id));
        }
        server.jobs.pop_front();
        let began_at = server.began_at;
        let cpu: Duration = traced.chunks.iter().map(|chunk| chunk.cpu).sum();
        let timings = TaskTimings {
            trace_us: (self.now - began_at).as_micros() as u32,
            trace_cpu_us: cpu.mul_f64(slowness).as_micros() as u32,
            ..TaskTimings::default()
        };
        let cpu_ns = traced.costs.cpu_ns.iter().map(|&ns| (f64::from(ns) * slowness) as u32).collect();
        let costs = RunCosts { cpu_ns, ..traced.costs };
        let mut bytes = Vec::new();
        let done = ToWall::TaskDone { frame, task_id, timings, costs: costs.clone() };
        codec::encode(&done, &mut bytes).expect("timings and costs are short");
        let event = Event::TaskDone { node, frame, task_id, timings, costs };
        self.schedule(self.cluster.link.latency, SimulationEvent::AtLink(bytes.len() as u64, event));
        self.begin(node);
    }

    fn send_chunk(&mut self, node: NodeId, of_task: TaskId) {
        let server = &mut self.servers[node.0 as usize];
        let Some(&Job { frame, task_id, .. }) = server.jobs.front() else { return };
        if task_id != of_task {
            // The task was cancelled meanwhile.
            return;
        }
        let TracedChunk { first_unit, n_units, n_bytes, .. } = server.traced.chunks[server.n_done];
        server.n_done += 1;
        let units = PlacedUnits { first: first_unit, count: n_units, n_bytes, place_time: Duration::ZERO };
        let event = Event::UnitsPlaced { node, frame, task_id, units };
        self.schedule(self.cluster.link.latency, SimulationEvent::AtLink(n_bytes, event));
        self.next_chunk(node);
    }

    /// Gives an event to the scheduler and carries out its actions.
    fn deliver(&mut self, event: Event) {
        let mut events = VecDeque::from([event]);
        while let Some(event) = events.pop_front() {
            for action in self.scheduler.on_event(self.now, event) {
                match action {
                    Action::Render { node, frame, task_id, spec, task, .. } => {
                        let job = Job { frame, task_id, spec, task };
                        self.untraced.push(job.clone());
                        self.schedule(self.cluster.link.latency, SimulationEvent::Asked(node, job));
                    }
                    Action::Cancel { node, frame } => {
                        self.schedule(self.cluster.link.latency, SimulationEvent::Cancelled(node, frame));
                    }
                    Action::Show { stats, .. } => {
                        self.shown.push(ReplayedFrame { shown_at: self.now, stats });
                        // The wall takes no time to show it, and its camera moves on.
                        let spec = (self.spec)(self.shown.len());
                        events.push_back(Event::GoalChanged(goal(self.cluster, spec)));
                        events.push_back(Event::FrameTaken);
                    }
                    Action::LoadScene { .. }
                    | Action::PrepareScene { .. }
                    | Action::Open { .. }
                    | Action::Discard { .. } => {}
                }
            }
        }
    }
}

/// Mean time of a frame after the first `n_first`, in which the division balances.
pub(super) fn period(frames: &[ReplayedFrame], n_first: usize) -> Option<Duration> {
    let (first, last) = (frames.get(n_first.checked_sub(1)?)?, frames.last()?);
    let n_frames = (frames.len() - n_first) as u32;
    (n_frames > 0).then(|| (last.shown_at - first.shown_at) / n_frames)
}

#[cfg(test)]
mod tests {
    use shared::{
        appearance::Appearance,
        camera::Camera,
        detail::Detail,
        division::FrameSize,
        protocol::{LightingMode, SampleRange, ShadingMode},
        scene::SceneId,
    };

    use super::*;

    const SIZE: (u32, u32) = (256, 128);
    /// Bytes of a chunk of one tile.
    const TILE_BYTES: u64 = 217;
    const FAST: SimulatedLink = SimulatedLink { bits_per_second: f64::INFINITY, latency: Duration::ZERO };

    fn spec(_: usize) -> FrameSpec {
        FrameSpec {
            scene: SceneId::Statue { triangles: 1, treatment: Default::default() },
            camera: Camera::look_at(glam::DVec3::Z, glam::DVec3::ZERO, glam::DVec3::Y, 0.7, 2.0).unwrap(),
            size: FrameSize::try_from(SIZE).unwrap(),
            view: ShadingMode::Shaded,
            rays: LightingMode::default(),
            samples: SampleRange::CENTRE,
            detail: Detail::FULL,
            appearance: Appearance::default(),
        }
    }

    /// Each tile takes a millisecond and is a chunk of its own.
    fn even(tasks: &[(FrameSpec, Task)]) -> Option<Vec<Rc<TracedShare>>> {
        Some(tasks.iter().map(|(spec, task)| even_share(spec, task)).collect())
    }

    fn even_share(spec: &FrameSpec, task: &Task) -> Rc<TracedShare> {
        let share = task.share(spec.size).unwrap();
        let chunk =
            |first_unit| TracedChunk { first_unit, n_units: 1, n_bytes: TILE_BYTES, cpu: Duration::from_millis(1) };
        let cpu_ns = if share.is_on_curve() { vec![1_000_000; share.count() as usize] } else { Vec::new() };
        let costs = RunCosts { run_units: 1, cpu_ns };
        Rc::new(TracedShare { chunks: (0..share.count()).map(chunk).collect(), costs })
    }

    fn run(slowness: Vec<f64>, link: SimulatedLink, division: Division) -> Vec<ReplayedFrame> {
        replay(&SimulatedCluster { slowness, link, division, in_flight: 1 }, 12, spec, even)
    }

    fn is_about(period: Option<Duration>, expected_ms: f64) {
        let period_ms = period.unwrap().as_secs_f64() * 1e3;
        assert!((period_ms / expected_ms - 1.0).abs() < 0.02, "{period_ms} ms, not {expected_ms} ms");
    }

    #[test]
    fn equal_nodes_divide_the_time() {
        // 32×16 tiles of 1 ms.
        for division in [Division::Tiled, Division::Dynamic] {
            is_about(period(&run(vec![1.0], FAST, division), 4), 512.0);
            let frames = run(vec![1.0; 8], FAST, division);
            is_about(period(&frames, 4), 64.0);
            assert!(frames.last().unwrap().stats.imbalance < 1.001);
        }
    }

    #[test]
    fn a_slow_node_holds_up_a_static_division_and_not_the_dynamic_one() {
        let slowness = vec![1.0, 1.0, 1.0, 2.0];
        // 128 tiles at 2 ms: late, but not late enough to be given to the others as well.
        is_about(period(&run(slowness.clone(), FAST, Division::Tiled), 4), 256.0);
        // Speeds 1 + 1 + 1 + 1/2.
        is_about(period(&run(slowness, FAST, Division::Dynamic), 4), 512.0 / 3.5);
    }

    #[test]
    fn a_slow_link_is_what_binds_and_latency_is_added() {
        // 512 tiles of 217 bytes in 100 ms, where tracing takes 64.
        let bits_per_second = 512.0 * TILE_BYTES as f64 * 8.0 / 0.1;
        let slow = SimulatedLink { bits_per_second, latency: Duration::ZERO };
        is_about(period(&run(vec![1.0; 8], slow, Division::Tiled), 4), 101.0);
        let far = SimulatedLink { latency: Duration::from_millis(10), ..FAST };
        is_about(period(&run(vec![1.0; 8], far, Division::Tiled), 4), 84.0);
        // With two frames at a time nobody waits for the way.
        let cluster = SimulatedCluster { slowness: vec![1.0; 8], link: far, division: Division::Tiled, in_flight: 2 };
        is_about(period(&replay(&cluster, 12, spec, even), 4), 64.0);
    }
}
