//! Divides frames among render servers, and reassigns the tasks of lost and late ones: a pure state machine.
//!
//! Events go in with their times, actions come out. The scheduler has no clock, no socket and no thread, so tests invent
//! all three.

mod balance;
mod coverage;
mod encoding_chooser;
mod frame;

use std::{
    collections::{BTreeMap, VecDeque},
    path::PathBuf,
    time::{Duration, Instant},
};

use shared::{
    division::{Division, Task},
    noise::NoiseLimit,
    protocol::{Encoding, FrameId, FrameSpec, RunCosts, TaskId, TaskTimings},
    scene::SceneId,
    sky::SkyId,
};

use self::{
    balance::Balance,
    encoding_chooser::EncodingChooser,
    frame::{FrameInFlight, HandedOut},
};
pub use super::RenderGoal;
use super::stats::{FrameStats, NodeId};

/// The most unfinished tasks of a frame that a render server holds: one to render, and one to begin with when that is done.
/// Others wait, and go to whoever is done first.
const MOST_HELD: u32 = 2;

/// Time since the wall started.
pub type Time = Duration;

/// An event in the farm.
#[derive(Clone, Debug)]
#[expect(missing_docs, reason = "fields are named after their types")]
#[expect(clippy::large_enum_variant, reason = "each is handled as it comes: none is stored")]
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
    LoadScene { node: NodeId, scene: Option<SceneId>, path: Option<PathBuf>, sky: Option<(SkyId, Option<PathBuf>)> },
    /// Have a render server load the scene that may come next beside the present one.
    PrepareScene { node: NodeId, scene: SceneId, path: Option<PathBuf>, sky: Option<(SkyId, Option<PathBuf>)> },
    /// Open a buffer for this frame. `moved_at`: when its camera was set, if no earlier frame shows that motion.
    Open { frame: FrameId, spec: FrameSpec, moved_at: Option<Instant>, change: u32 },
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
    /// Whether no frame has been started since `goal.min_renderers` was set.
    waits_for_renderers: bool,
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
            waits_for_renderers: true,
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
                actions.extend(self.prepare_scene(node));
            }
            Event::SceneReady { node, ready } => self.set_ready(node, ready, &mut actions),
            Event::Silent { node, is_silent } => {
                if let Some(node) = self.nodes.get_mut(&node) {
                    node.is_silent = is_silent;
                }
                self.frames.iter_mut().for_each(|frame| frame.set_silent(node, is_silent));
            }
            Event::Lost { node } => {
                self.nodes.remove(&node);
                self.balance.mark_lost(node);
                for frame in &mut self.frames {
                    frame.give_up(node);
                }
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
            Event::Tick => self.repeat_late_task(now),
        }
        while self.show_if_complete(now, &mut actions) {}
        while self.start_frame(now, &mut actions) {}
        self.hand_out_waiting(now, &mut actions);
        actions
    }

    /// Whether the scheduler needs ticks.
    pub fn has_frame_in_flight(&self) -> bool {
        !self.frames.is_empty()
    }

    /// How much of the first frame in flight has arrived, in percent, if it takes long.
    pub fn percent(&self, now: Time) -> Option<u8> {
        self.frames.front()?.percent(now)
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
        let is_other_scene = goal.spec.map(|spec| spec.scene) != self.scene() || sky_of(&goal) != sky_of(&self.goal);
        let is_other = (goal.spec, goal.division) != (self.goal.spec, self.goal.division);
        let is_other_change = goal.change != self.goal.change;
        let is_other_next = goal.next_scene != self.goal.next_scene;
        self.waits_for_renderers |= goal.min_renderers != self.goal.min_renderers;
        self.goal = goal;
        self.is_stale |= is_other || is_other_change;
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
        } else if is_other_next {
            actions.extend(self.nodes.keys().filter_map(|&node| self.prepare_scene(node)));
        }
    }

    fn set_ready(&mut self, node: NodeId, ready: bool, actions: &mut Vec<Action>) {
        if let Some(node) = self.nodes.get_mut(&node) {
            node.ready = ready;
        }
        // Without the scene it cannot finish its tasks. One that is ready again had no scene when earlier tasks came: the wall went
        // to another scene and back, and took the answer to the first order for that to the last.
        let given_up = self.frames.iter_mut().filter_map(|frame| frame.give_up(node).then_some(frame.id));
        actions.extend(given_up.map(|frame| Action::Cancel { node, frame }));
    }

    /// Has every render server load the scene anew; it is given no tasks before it reports that it is ready.
    fn load_scenes(&mut self, actions: &mut Vec<Action>) {
        for node in self.nodes.keys().copied().collect::<Vec<_>>() {
            self.set_ready(node, false, actions);
            actions.push(self.load_scene(node));
            actions.extend(self.prepare_scene(node));
        }
    }

    fn load_scene(&self, node: NodeId) -> Action {
        Action::LoadScene { node, scene: self.scene(), path: self.goal.scene_path.clone(), sky: self.sky_file() }
    }

    fn prepare_scene(&self, node: NodeId) -> Option<Action> {
        let (scene, path) = self.goal.next_scene.clone().filter(|(next, _)| self.scene() != Some(*next))?;
        Some(Action::PrepareScene { node, scene, path, sky: self.sky_file() })
    }

    fn sky_file(&self) -> Option<(SkyId, Option<PathBuf>)> {
        sky_of(&self.goal).map(|id| (id, self.goal.sky_path.clone()))
    }

    fn cancel(&mut self, now: Time, index: usize, actions: &mut Vec<Action>) {
        let Some(frame) = self.frames.remove(index) else { return };
        self.stop_nodes(now, &frame, actions);
        actions.push(Action::Discard { frame: frame.id });
    }

    /// Cancels the tasks of a frame that are still running.
    fn stop_nodes(&mut self, now: Time, frame: &FrameInFlight, actions: &mut Vec<Action>) {
        let busy = frame.n_unfinished();
        actions.extend(busy.keys().map(|&node| Action::Cancel { node, frame: frame.id }));
        self.set_free(now, busy.into_keys());
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
        // Where pixels are divided one by one, each node would trace whole tiles to learn which need more samples.
        let division = match self.goal.division {
            Division::Interleaved if spec.samples.noise != NoiseLimit::NONE => Division::Tiled,
            division => division,
        };
        // The dynamic division of a moving camera's frame waits for the costs of the last: measured, this wins.
        if division == Division::Dynamic && self.frames.back().is_some_and(|last| last.spec != spec) {
            return false;
        }
        let nodes = self.ready_nodes();
        let has_too_few = self.waits_for_renderers && nodes.len() < self.goal.min_renderers as usize;
        if nodes.is_empty() || has_too_few {
            return false;
        }
        (self.is_stale, self.waits_for_renderers) = (false, false);
        self.last_frame.0 += 1;
        let mut frame = FrameInFlight::new(self.last_frame, spec, self.goal.is_refinement, division, now);
        // Only the first frame that shows a motion measures its latency. The very first frame waited for the model.
        let moved_at = self.goal.moved_at;
        let is_first = self.last_moved_at.replace(moved_at).is_some_and(|last| last != moved_at);
        actions.push(Action::Open {
            frame: frame.id,
            spec,
            moved_at: is_first.then_some(moved_at),
            change: self.goal.change,
        });
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
            let task = frame.add(task);
            actions.push(self.assign(&mut frame, now, node, task));
        }
        self.frames.push_back(frame);
        true
    }

    /// Hands out the tasks of lost and silent render servers to those that hold few, those that joined since included, and
    /// late ones to those that hold none.
    fn hand_out_waiting(&mut self, now: Time, actions: &mut Vec<Action>) {
        for index in 0..self.frames.len() {
            if !self.frames[index].has_waiting() {
                continue;
            }
            let n_held = self.frames[index].n_unfinished();
            let mut takers: Vec<_> =
                self.ready_nodes().into_iter().map(|node| (n_held.get(&node).unwrap_or(&0), node)).collect();
            takers.retain(|&(&n_held, _)| n_held < MOST_HELD);
            // Begin with those that hold least, and after the one that took the last task.
            if let n_takers @ 1.. = takers.len() {
                takers.rotate_left(self.last_task.0 as usize % n_takers);
            }
            takers.sort_by_key(|&(n_held, _)| n_held);
            let takers = takers.into_iter().map(|(n_held, node)| (node, MOST_HELD - n_held));
            self.hand_out(index, now, takers.collect(), false, actions);
            let idle = self.idle_nodes().into_iter().map(|node| (node, 1));
            self.hand_out(index, now, idle.collect(), true, actions);
        }
    }

    /// Hands out a frame's waiting tasks to nodes in turn; each takes at most as many as its number says.
    fn hand_out(
        &mut self,
        index: usize,
        now: Time,
        mut takers: VecDeque<(NodeId, u32)>,
        are_idle: bool,
        actions: &mut Vec<Action>,
    ) {
        let Some(mut frame) = self.frames.remove(index) else { return };
        while let Some((node, room)) = takers.pop_front() {
            let Some(task) = frame.take_waiting(takers.len() as u32 + 1, are_idle) else { break };
            actions.push(self.assign(&mut frame, now, node, task));
            if room > 1 {
                takers.push_back((node, room - 1));
            }
        }
        self.frames.insert(index, frame);
    }

    /// Ready nodes without a task.
    fn idle_nodes(&self) -> Vec<NodeId> {
        let at_work: Vec<_> = self.frames.iter().map(FrameInFlight::n_unfinished).collect();
        let is_idle = |node: &NodeId| at_work.iter().all(|n_unfinished| !n_unfinished.contains_key(node));
        self.ready_nodes().into_iter().filter(is_idle).collect()
    }

    /// Has the oldest late task wait for idle render servers as well; the first answer wins.
    fn repeat_late_task(&mut self, now: Time) {
        let n_idle = self.idle_nodes().len() as u32;
        if n_idle == 0 || self.frames.iter().any(FrameInFlight::has_waiting) {
            return;
        }
        // A task for a later frame cannot be late while its render server is busy with an earlier frame.
        let mut busy: Vec<BTreeMap<NodeId, u32>> = Vec::new();
        for frame in &mut self.frames {
            let is_busy = |node: &NodeId| busy.iter().any(|n_unfinished| n_unfinished.contains_key(node));
            let free_at = |node| self.nodes.get(&node).filter(|_| !is_busy(&node)).map(|node| node.free_at);
            if frame.repeat_late_task(now, n_idle, free_at) {
                return;
            }
            busy.push(frame.n_unfinished());
        }
    }

    fn assign(&mut self, frame: &mut FrameInFlight, now: Time, node: NodeId, handed_out: HandedOut) -> Action {
        let task = handed_out.task_part.task;
        self.last_task.0 = self.last_task.0.wrapping_add(1);
        let n_samples = frame.n_samples(&task);
        let state = self.nodes.get_mut(&node).expect("only ready nodes get tasks");
        let encoding = self.goal.encoding.unwrap_or_else(|| state.encoding_chooser.choose(n_samples));
        let name_and_threads = (state.name.clone(), state.threads);
        frame.assign(now, self.last_task, node, name_and_threads, handed_out, encoding);
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

/// The sky image that lights the wall's scene.
fn sky_of(goal: &RenderGoal) -> Option<SkyId> {
    goal.spec?.appearance.sky
}

#[cfg(test)]
pub(super) mod tests;
