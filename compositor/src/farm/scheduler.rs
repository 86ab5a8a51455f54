//! Divides frames among render servers, and reassigns the tasks of lost and late ones: a pure state machine.
//!
//! Events go in with their times, actions come out. The scheduler has no clock, no socket and no thread, so tests invent
//! all three.

mod balance;
mod coverage;
mod encoding_chooser;
mod frame;

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    path::PathBuf,
    time::{Duration, Instant},
};

use shared::{
    division::{Division, Task},
    protocol::{Encoding, FrameId, FrameSpec, RunCosts, TaskId, TaskTimings},
    scene::SceneId,
};

use self::{balance::Balance, coverage::TaskPart, encoding_chooser::EncodingChooser, frame::FrameInFlight};
pub use super::RenderGoal;
use super::stats::{FrameStats, NodeId};

/// Lost tasks are divided into parts of at least this many samples, even if many render servers die in one frame.
const SMALLEST_PART: u32 = 256;

/// Time since the wall started.
pub type Time = Duration;

/// An event in the farm.
#[derive(Clone, Debug)]
#[expect(missing_docs, reason = "fields are named after their types")]
pub enum Event {
    /// A render server has joined.
    Joined { node: NodeId, name: String, threads: u32 },
    /// It has, or no longer has, the wall's scene.
    SceneReady { node: NodeId, ready: bool },
    /// It is connected but silent, or is heard again.
    Silent { node: NodeId, is_silent: bool },
    /// Its connection is gone.
    Lost { node: NodeId },
    /// Units of a task are in the frame buffer.
    UnitsPlaced { node: NodeId, frame: FrameId, task_id: TaskId, units: PlacedUnits },
    /// It has finished a task.
    TaskDone { node: NodeId, frame: FrameId, task_id: TaskId, timings: TaskTimings, costs: RunCosts },
    /// The wall wants something else rendered.
    GoalChanged(RenderGoal),
    /// Render servers must keep the scene in another structure.
    StructureChanged,
    /// The wall has taken the finished frame.
    FrameTaken,
    /// Time has passed: look for late tasks.
    Tick,
}

/// Units of a task that were placed.
#[derive(Clone, Copy, Debug)]
pub struct PlacedUnits {
    /// Index of the first unit in its task.
    pub first: u32,
    /// How many units.
    pub count: u32,
    /// Bytes received, headers included.
    pub n_bytes: u64,
    /// Time that placing took.
    pub place_time: Duration,
}

/// An action that the scheduler asks for.
#[derive(Clone, Debug, PartialEq)]
#[expect(missing_docs, reason = "fields are named after their types")]
pub enum Action {
    /// Forget what a render server reported about its scene, and have it load the wall's, if there is one.
    LoadScene { node: NodeId, scene: Option<SceneId>, path: Option<PathBuf> },
    /// Open a buffer for this frame. `moved_at`: when its camera was set, if no earlier frame shows that motion.
    Open { frame: FrameId, spec: FrameSpec, moved_at: Option<Instant> },
    /// Send a task.
    Render { node: NodeId, frame: FrameId, task_id: TaskId, spec: FrameSpec, task: Task, encoding: Encoding },
    /// Tell a render server to stop rendering a frame.
    Cancel { node: NodeId, frame: FrameId },
    /// Show a complete frame.
    Show { frame: FrameId, stats: FrameStats },
    /// Drop the buffer of a frame that is no longer wanted.
    Discard { frame: FrameId },
}

/// A render server as the scheduler sees it.
#[derive(Clone, Debug)]
struct NodeState {
    name: String,
    /// At least 1.
    threads: u32,
    ready: bool,
    is_silent: bool,
    /// When it last ran out of tasks: it began then with the next.
    free_at: Time,
    encoding_chooser: EncodingChooser,
}

/// The scheduler's state.
#[derive(Debug)]
pub struct Scheduler {
    nodes: BTreeMap<NodeId, NodeState>,
    goal: RenderGoal,
    /// Whether no frame has been started for `goal` yet.
    is_stale: bool,
    /// The spec of the finished frame that waits to be taken, if there is one.
    untaken_spec: Option<FrameSpec>,
    /// Frames in flight, in the order in which they will be shown.
    frames: VecDeque<FrameInFlight>,
    balance: Balance,
    /// When the camera of the last frame that was opened was set.
    last_moved_at: Option<Instant>,
    /// When the last shown frame was complete.
    last_completed_at: Time,
    last_frame: FrameId,
    last_task: TaskId,
}

impl Scheduler {
    /// A farm without render servers.
    pub fn new(goal: RenderGoal) -> Self {
        Self {
            nodes: BTreeMap::new(),
            goal,
            is_stale: true,
            untaken_spec: None,
            frames: VecDeque::new(),
            balance: Balance::default(),
            last_moved_at: None,
            last_completed_at: Time::ZERO,
            last_frame: FrameId(0),
            last_task: TaskId(0),
        }
    }

    /// Handles an event and returns the actions to take, in order.
    pub fn on_event(&mut self, now: Time, event: Event) -> Vec<Action> {
        let mut actions = Vec::new();
        match event {
            Event::Joined { node, name, threads } => {
                self.nodes.insert(
                    node,
                    NodeState {
                        name,
                        threads: threads.max(1),
                        ready: false,
                        is_silent: false,
                        free_at: now,
                        encoding_chooser: EncodingChooser::default(),
                    },
                );
                actions.push(self.load_scene(node));
            }
            Event::SceneReady { node, ready } => self.set_ready(node, ready),
            Event::Silent { node, is_silent } => {
                if let Some(node) = self.nodes.get_mut(&node) {
                    node.is_silent = is_silent;
                }
                self.frames.iter_mut().for_each(|frame| frame.set_silent(node, is_silent));
            }
            Event::Lost { node } => {
                self.nodes.remove(&node);
                self.balance.mark_lost(node);
                self.frames.iter_mut().for_each(|frame| frame.mark_lost(node));
            }
            Event::UnitsPlaced { node, frame, task_id, units } => {
                if let Some(in_flight) = self.in_flight(frame) {
                    in_flight.place(node, task_id, units);
                }
            }
            Event::TaskDone { node, frame, task_id, timings, costs } => {
                let since = self.nodes.get(&node).map_or(Time::ZERO, |node| node.free_at);
                if let Some(in_flight) = self.in_flight(frame) {
                    let finished = in_flight.finish(now, since, node, task_id, timings, costs);
                    if let (Some((encoding, n_samples, took)), Some(node)) = (finished, self.nodes.get_mut(&node)) {
                        node.encoding_chooser.learn(encoding, n_samples, took);
                    }
                }
                self.set_free(now, [node]);
            }
            Event::GoalChanged(goal) => self.set_goal(now, goal, &mut actions),
            Event::StructureChanged => self.load_scenes(&mut actions),
            Event::FrameTaken => self.untaken_spec = None,
            Event::Tick => {}
        }
        while self.show_if_complete(now, &mut actions) {}
        while self.start_frame(now, &mut actions) {}
        for index in 0..self.frames.len() {
            self.reassign_lost_tasks(index, now, &mut actions);
        }
        self.duplicate_late_tasks(now, &mut actions);
        actions
    }

    /// Whether the scheduler needs ticks.
    pub fn has_frame_in_flight(&self) -> bool {
        !self.frames.is_empty()
    }

    /// The wall's scene.
    pub fn scene(&self) -> Option<SceneId> {
        self.goal.spec.map(|spec| spec.scene)
    }

    fn in_flight(&mut self, frame: FrameId) -> Option<&mut FrameInFlight> {
        self.frames.iter_mut().find(|in_flight| in_flight.id == frame)
    }

    fn set_free(&mut self, now: Time, nodes: impl IntoIterator<Item = NodeId>) {
        for node in nodes {
            if let Some(node) = self.nodes.get_mut(&node) {
                node.free_at = now;
            }
        }
    }

    fn set_goal(&mut self, now: Time, goal: RenderGoal, actions: &mut Vec<Action>) {
        let is_other_scene = goal.spec.map(|spec| spec.scene) != self.scene();
        let is_other = (goal.spec, goal.division) != (self.goal.spec, self.goal.division);
        self.goal = goal;
        self.is_stale |= is_other;
        // Finish the first frame in flight, or nothing would be shown while the camera keeps moving, and finish frames
        // with samples. Refinements show nothing new: cancel them.
        let is_superseded = |frame: &FrameInFlight, is_first: bool| {
            is_other_scene || is_other && (frame.is_refinement || !is_first && !frame.has_begun())
        };
        let mut index = 0;
        while let Some(frame) = self.frames.get(index) {
            if is_superseded(frame, index == 0) {
                self.cancel(now, index, actions);
            } else {
                index += 1;
            }
        }
        if is_other_scene {
            self.load_scenes(actions);
        }
    }

    fn set_ready(&mut self, node: NodeId, ready: bool) {
        if let Some(node) = self.nodes.get_mut(&node) {
            node.ready = ready;
        }
        // Without the scene it cannot finish its tasks.
        if !ready {
            self.frames.iter_mut().for_each(|frame| frame.mark_lost(node));
        }
    }

    /// Has every render server load the scene anew; it is given no tasks before it reports that it is ready.
    fn load_scenes(&mut self, actions: &mut Vec<Action>) {
        for node in self.nodes.keys().copied().collect::<Vec<_>>() {
            self.set_ready(node, false);
            actions.push(self.load_scene(node));
        }
    }

    fn load_scene(&self, node: NodeId) -> Action {
        Action::LoadScene { node, scene: self.scene(), path: self.goal.scene_path.clone() }
    }

    fn cancel(&mut self, now: Time, index: usize, actions: &mut Vec<Action>) {
        let Some(frame) = self.frames.remove(index) else { return };
        self.stop_nodes(now, &frame, actions);
        actions.push(Action::Discard { frame: frame.id });
    }

    /// Cancels the tasks of a frame that are still running.
    fn stop_nodes(&mut self, now: Time, frame: &FrameInFlight, actions: &mut Vec<Action>) {
        actions.extend(frame.busy_nodes().map(|node| Action::Cancel { node, frame: frame.id }));
        self.set_free(now, frame.busy_nodes());
    }

    fn ready_nodes(&self) -> Vec<NodeId> {
        self.nodes.iter().filter(|(_, node)| node.ready && !node.is_silent).map(|(&id, _)| id).collect()
    }

    /// Starts the next frame if one is wanted, fewer than `in_flight` are rendered, and enough render servers are ready.
    /// Returns whether it did.
    fn start_frame(&mut self, now: Time, actions: &mut Vec<Action>) -> bool {
        let Some(spec) = self.goal.spec else { return false };
        let is_due = self.is_stale || self.goal.repeat;
        if !is_due || self.frames.len() >= self.goal.in_flight.max(1) as usize {
            return false;
        }
        // The dynamic division of a moving camera's frame waits for the costs of the last: measured, this wins.
        let division = self.goal.division;
        if division == Division::Dynamic && self.frames.back().is_some_and(|last| last.spec != spec) {
            return false;
        }
        let nodes = self.ready_nodes();
        if nodes.is_empty() || nodes.len() < self.goal.min_renderers as usize {
            return false;
        }
        self.is_stale = false;
        self.last_frame.0 += 1;
        let mut frame = FrameInFlight::new(self.last_frame, spec, self.goal.is_refinement, division, now);
        // Only the first frame that shows a motion measures its latency. The very first frame waited for the model.
        let moved_at = self.goal.moved_at;
        let is_first = self.last_moved_at.replace(moved_at).is_some_and(|last| last != moved_at);
        actions.push(Action::Open { frame: frame.id, spec, moved_at: is_first.then_some(moved_at) });
        let machines = nodes.len() as u32;
        let balanced = match division {
            Division::Dynamic => {
                let threads: Vec<_> = nodes.iter().map(|&node| (node, self.nodes[&node].threads)).collect();
                self.balance.divide(&spec, &threads)
            }
            Division::Interleaved | Division::Tiled => {
                self.balance.forget_costs();
                None
            }
        };
        let tasks = balanced.unwrap_or_else(|| (0..machines).map(|machine| division.task(machine, machines)).collect());
        for (node, task) in nodes.into_iter().zip(tasks) {
            let task_part = frame.add(task);
            actions.push(self.assign(&mut frame, now, node, task_part));
        }
        self.frames.push_back(frame);
        true
    }

    /// Divides the tasks of lost and silent render servers among the ready ones, those that joined since included. All
    /// parts together are about as many as render servers, so that tasks do not multiply as silences repeat.
    fn reassign_lost_tasks(&mut self, index: usize, now: Time, actions: &mut Vec<Action>) {
        let nodes = self.ready_nodes();
        if !nodes.is_empty() {
            let lost = self.frames[index].take_lost_tasks();
            let parts = nodes.len().div_ceil(lost.len().max(1)) as u32;
            lost.iter().for_each(|lost| self.assign_parts(index, now, &nodes, (lost, parts), actions));
        }
    }

    /// Gives the oldest late task to idle render servers as well; the first answer wins.
    fn duplicate_late_tasks(&mut self, now: Time, actions: &mut Vec<Action>) {
        let at_work: BTreeSet<_> = self.frames.iter().flat_map(FrameInFlight::busy_nodes).collect();
        let idle: Vec<_> = self.ready_nodes().into_iter().filter(|node| !at_work.contains(node)).collect();
        if idle.is_empty() {
            return;
        }
        // A task for a later frame cannot be late while its render server is busy with an earlier frame.
        let mut busy = BTreeSet::new();
        for index in 0..self.frames.len() {
            let nodes = &self.nodes;
            let begun_at = |node| nodes.get(&node).filter(|_| !busy.contains(&node)).map(|node| node.free_at);
            if let Some(late) = self.frames[index].take_late_task(now, begun_at) {
                return self.assign_parts(index, now, &idle, (&late, idle.len() as u32), actions);
            }
            busy.extend(self.frames[index].busy_nodes());
        }
    }

    /// Divides a task into at most `most_parts` parts, and gives them to nodes in turn.
    fn assign_parts(
        &mut self,
        index: usize,
        now: Time,
        nodes: &[NodeId],
        (task_part, most_parts): (&TaskPart, u32),
        actions: &mut Vec<Action>,
    ) {
        let Some(mut frame) = self.frames.remove(index) else { return };
        frame.attempts += 1;
        let parts = most_parts.min(frame.n_samples(&task_part.task) / SMALLEST_PART).max(1);
        // Begin after the nodes that got parts of the last task.
        let mut nodes = nodes.iter().cycle().skip(self.last_task.0 as usize % nodes.len());
        for part in 0..parts {
            let part = task_part.part(part, parts).expect("parts hold units, so there are no more than the frame has");
            let &node = nodes.next().expect("the cycle has no end");
            actions.push(self.assign(&mut frame, now, node, part));
        }
        self.frames.insert(index, frame);
    }

    fn assign(&mut self, frame: &mut FrameInFlight, now: Time, node: NodeId, task_part: TaskPart) -> Action {
        let task = task_part.task;
        self.last_task.0 = self.last_task.0.wrapping_add(1);
        let n_samples = frame.n_samples(&task);
        let state = self.nodes.get_mut(&node).expect("only ready nodes get tasks");
        let encoding = self.goal.encoding.unwrap_or_else(|| state.encoding_chooser.choose(n_samples));
        let name_and_threads = (state.name.clone(), state.threads);
        frame.assign(now, self.last_task, node, name_and_threads, task_part, encoding);
        Action::Render { node, frame: frame.id, task_id: self.last_task, spec: frame.spec, task, encoding }
    }

    /// Shows the first frame once it is complete and the one before it is taken. Returns whether it did.
    ///
    /// A newer frame replaces one that waits to be taken, unless their specs are equal: then each is shown.
    fn show_if_complete(&mut self, now: Time, actions: &mut Vec<Action>) -> bool {
        // Every frame records when it was complete, even if it is not its turn.
        for frame in &mut self.frames {
            frame.is_complete(now);
        }
        let is_shown = |frame: &mut FrameInFlight| frame.is_complete(now) && self.untaken_spec != Some(frame.spec);
        if !self.frames.front_mut().is_some_and(is_shown) {
            return false;
        }
        let Some(frame) = self.frames.pop_front() else { return false };
        if frame.division == Division::Dynamic {
            self.balance.learn(&frame.spec, &frame.task_results().collect::<Vec<_>>());
        }
        // The tasks that are still running were done by others.
        self.stop_nodes(now, &frame, actions);
        let stats = frame.stats(now, self.last_completed_at);
        self.last_completed_at = frame.completed_at.unwrap_or(now);
        actions.push(Action::Show { frame: frame.id, stats });
        self.untaken_spec = Some(frame.spec);
        true
    }
}

#[cfg(test)]
mod tests;
