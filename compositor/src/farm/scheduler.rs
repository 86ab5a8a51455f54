//! Who renders what, and what happens when somebody does not: a pure state machine.
//!
//! Events go in with the time at which they happened, actions come out. There is no clock, no socket and no thread in
//! here, so tests invent all three.

mod balance;
mod coverage;
mod encoding_chooser;
mod frame;

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::Duration,
};

use shared::{
    division::{Division, Task},
    protocol::{Encoding, FrameId, FrameSpec, RunCosts, TaskId, TaskTimings},
    scene::SceneId,
};

use self::{balance::Balance, coverage::TaskPart, encoding_chooser::EncodingChooser, frame::FrameInFlight};
use super::stats::{FrameStats, NodeId};

/// Lost work is divided into parts of no fewer samples: many deaths in one frame do not crumble it.
const SMALLEST_PART: u32 = 256;

/// Time since the wall started.
pub(super) type Time = Duration;

/// What happens to the farm.
#[derive(Clone, Debug)]
pub(super) enum Event {
    /// A render server has shaken hands.
    Joined { node: NodeId, name: String, threads: u32 },
    /// It has, or no longer has, the scene that the wall wants.
    SceneReady { node: NodeId, ready: bool },
    /// Nothing comes from it any more, though its connection is there; or it is heard again.
    Silent { node: NodeId, is_silent: bool },
    /// Its connection is gone.
    Lost { node: NodeId },
    /// Units of a work are in their places in the frame buffer.
    UnitsPlaced { node: NodeId, frame: FrameId, task_id: TaskId, units: PlacedUnits },
    /// It has answered all of a work.
    TaskDone { node: NodeId, frame: FrameId, task_id: TaskId, timings: TaskTimings, costs: RunCosts },
    /// The wall wants another picture, or the same divided otherwise.
    GoalChanged(RenderGoal),
    /// The wall has taken the finished frame.
    FrameTaken,
    /// Time has passed.
    Tick,
}

/// Which units of a work were placed, and what that took.
#[derive(Clone, Copy, Debug)]
pub(super) struct PlacedUnits {
    pub(super) first: u32,
    pub(super) count: u32,
    pub(super) n_bytes: u64,
    pub(super) place_time: Duration,
}

/// What the wall wants to see.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct RenderGoal {
    pub(super) spec: Option<FrameSpec>,
    /// Whether it only refines what was shown already.
    pub(super) is_refinement: bool,
    pub(super) division: Division,
    pub(super) min_renderers: u32,
    pub(super) repeat: bool,
    /// How many frames are rendered at a time; at least 1.
    pub(super) in_flight: u32,
    /// How samples travel, if not as measured to be best.
    pub(super) encoding: Option<Encoding>,
}

/// What is to be done.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Action {
    /// Have a buffer ready for the answers to this frame.
    Open { frame: FrameId, spec: FrameSpec },
    /// Send this work.
    Render { node: NodeId, frame: FrameId, task_id: TaskId, spec: FrameSpec, task: Task, encoding: Encoding },
    /// Tell a render server that it may stop.
    Cancel { node: NodeId, frame: FrameId },
    /// Every sample is in its place: show the frame.
    Show { frame: FrameId, stats: FrameStats },
    /// The frame is no longer wanted; forget its buffer.
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
    /// When it last had nothing to do, as far as is known: what it was given before, it began then.
    free_at: Time,
    encoding_chooser: EncodingChooser,
}

/// The state of the farm.
#[derive(Debug)]
pub(super) struct Scheduler {
    nodes: BTreeMap<NodeId, NodeState>,
    goal: RenderGoal,
    /// Whether `goal` differs from what was last asked for.
    is_stale: bool,
    /// What the finished frame shows that waits to be taken, if one does.
    untaken_spec: Option<FrameSpec>,
    /// Frames being rendered, in the order in which they will be shown.
    frames: VecDeque<FrameInFlight>,
    balance: Balance,
    /// When the last frame that is shown became whole.
    last_completed_at: Time,
    last_frame: FrameId,
    last_task: TaskId,
}

impl Scheduler {
    pub(super) fn new(goal: RenderGoal) -> Self {
        Self {
            nodes: BTreeMap::new(),
            goal,
            is_stale: true,
            untaken_spec: None,
            frames: VecDeque::new(),
            balance: Balance::default(),
            last_completed_at: Time::ZERO,
            last_frame: FrameId(0),
            last_task: TaskId(0),
        }
    }

    /// Takes an event and says what is to be done, in order.
    pub(super) fn on_event(&mut self, now: Time, event: Event) -> Vec<Action> {
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
            }
            Event::SceneReady { node, ready } => {
                if let Some(node) = self.nodes.get_mut(&node) {
                    node.ready = ready;
                }
                // Whoever does not have the scene does not render it, whatever it was given.
                if !ready {
                    self.frames.iter_mut().for_each(|frame| frame.mark_lost(node));
                }
            }
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
                    let answered = in_flight.finish(now, since, node, task_id, timings, costs);
                    if let (Some((encoding, n_samples, took)), Some(node)) = (answered, self.nodes.get_mut(&node)) {
                        node.encoding_chooser.learn(encoding, n_samples, took);
                    }
                }
                self.set_free(now, [node]);
            }
            Event::GoalChanged(goal) => self.set_goal(now, goal, &mut actions),
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

    /// Whether ticks are worth sending.
    pub(super) fn has_frame_in_flight(&self) -> bool {
        !self.frames.is_empty()
    }

    /// The scene that render servers must have.
    pub(super) fn scene(&self) -> Option<SceneId> {
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
        if is_other_scene {
            self.nodes.values_mut().for_each(|node| node.ready = false);
        }
        self.goal = goal;
        self.is_stale |= is_other;
        // The first frame in flight is finished in any case, or a camera that moves all the time would never be seen; and
        // so is what somebody has begun to render. What is refined has been seen.
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
    }

    fn cancel(&mut self, now: Time, index: usize, actions: &mut Vec<Action>) {
        let Some(frame) = self.frames.remove(index) else { return };
        self.stop_nodes(now, &frame, actions);
        actions.push(Action::Discard { frame: frame.id });
    }

    /// Tells whoever still works on a frame that nobody waits for it.
    fn stop_nodes(&mut self, now: Time, frame: &FrameInFlight, actions: &mut Vec<Action>) {
        actions.extend(frame.busy_nodes().map(|node| Action::Cancel { node, frame: frame.id }));
        self.set_free(now, frame.busy_nodes());
    }

    fn ready_nodes(&self) -> Vec<NodeId> {
        self.nodes.iter().filter(|(_, node)| node.ready && !node.is_silent).map(|(&id, _)| id).collect()
    }

    /// Starts the next frame, if one is wanted and there is room and somebody to render it; whether it did.
    fn start_frame(&mut self, now: Time, actions: &mut Vec<Action>) -> bool {
        let Some(spec) = self.goal.spec else { return false };
        let is_due = self.is_stale || self.goal.repeat;
        if !is_due || self.frames.len() >= self.goal.in_flight.max(1) as usize {
            return false;
        }
        // A moving camera's frame is divided by what the last one cost: measured, that is worth more than not waiting.
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
        actions.push(Action::Open { frame: frame.id, spec });
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

    /// Divides the shares of lost and silent render servers among the others, those that joined since included. There are
    /// about as many parts as render servers in all: works must not become more and more as silence follows silence.
    fn reassign_lost_tasks(&mut self, index: usize, now: Time, actions: &mut Vec<Action>) {
        let nodes = self.ready_nodes();
        if !nodes.is_empty() {
            let lost = self.frames[index].take_lost_tasks();
            let parts = nodes.len().div_ceil(lost.len().max(1)) as u32;
            lost.iter().for_each(|lost| self.assign_parts(index, now, &nodes, (lost, parts), actions));
        }
    }

    /// Gives work that is late to render servers that have nothing left to do, too; the first answer wins.
    fn duplicate_late_tasks(&mut self, now: Time, actions: &mut Vec<Action>) {
        let at_work: BTreeSet<_> = self.frames.iter().flat_map(FrameInFlight::busy_nodes).collect();
        let idle: Vec<_> = self.ready_nodes().into_iter().filter(|node| !at_work.contains(node)).collect();
        if idle.is_empty() {
            return;
        }
        // What a render server was given for a later frame has not been begun, and so is not late.
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

    /// Gives a piece of a frame to nodes, in so many parts at most.
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
        // Those who got a part of the last work are not the first to get one of this.
        let mut nodes = nodes.iter().cycle().skip(self.last_task.0 as usize % nodes.len());
        for part in 0..parts {
            let part = task_part.part(part, parts).expect("parts hold units, so there are no more than the frame has");
            let &node = nodes.next().expect("nodes go round");
            actions.push(self.assign(&mut frame, now, node, part));
        }
        self.frames.insert(index, frame);
    }

    fn assign(&mut self, frame: &mut FrameInFlight, now: Time, node: NodeId, task_part: TaskPart) -> Action {
        let task = task_part.task.clone();
        self.last_task.0 = self.last_task.0.wrapping_add(1);
        let n_samples = frame.n_samples(&task);
        let encoding = |encoding_chooser: &mut EncodingChooser| {
            self.goal.encoding.unwrap_or_else(|| encoding_chooser.choose(n_samples))
        };
        let (name_and_threads, encoding) = match self.nodes.get_mut(&node) {
            Some(node) => ((node.name.clone(), node.threads), encoding(&mut node.encoding_chooser)),
            None => ((String::new(), 1), Encoding::Raw),
        };
        frame.assign(now, self.last_task, node, name_and_threads, task_part, encoding);
        Action::Render { node, frame: frame.id, task_id: self.last_task, spec: frame.spec, task, encoding }
    }

    /// Shows the first frame once it is whole and the one before it is taken, so that the next are rendered while one is
    /// displayed; whether it did.
    ///
    /// A frame that waits while the camera moves on is superseded: the newer one takes its place. Frames of the same
    /// picture are each shown.
    fn show_if_complete(&mut self, now: Time, actions: &mut Vec<Action>) -> bool {
        // Each notes when it became whole, whether or not it is its turn.
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
        // Whoever still works on it does what another has done already.
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
