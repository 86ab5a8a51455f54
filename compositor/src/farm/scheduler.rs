//! Who renders what, and what happens when somebody does not: a pure state machine.
//!
//! Events go in with the time at which they happened, actions come out. There is no clock, no socket and no thread in
//! here, so tests invent all three.

mod balance;
mod coverage;
mod frame;
mod link;

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    time::Duration,
};

use shared::{
    division::{Division, Work},
    protocol::{BlockCosts, Encoding, FrameId, Picture, WorkId, WorkTimings},
    scene::SceneId,
};

use self::{balance::Balance, coverage::Piece, frame::FrameInFlight, link::Link};
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
    Placed { node: NodeId, frame: FrameId, work_id: WorkId, units: Placed },
    /// It has answered all of a work.
    WorkDone { node: NodeId, frame: FrameId, work_id: WorkId, timings: WorkTimings, costs: BlockCosts },
    /// The wall wants another picture, or the same divided otherwise.
    Wanted(Wanted),
    /// The wall has taken the finished frame.
    FrameTaken,
    /// Time has passed.
    Tick,
}

/// Which units of a work were placed, and what that took.
#[derive(Clone, Copy, Debug)]
pub(super) struct Placed {
    pub(super) first: u32,
    pub(super) count: u32,
    pub(super) n_bytes: u64,
    pub(super) place_time: Duration,
}

/// What the wall wants to see.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Wanted {
    pub(super) picture: Option<Picture>,
    /// Whether it only refines what was shown already.
    pub(super) refines: bool,
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
    Open { frame: FrameId, picture: Picture },
    /// Send this work.
    Render { node: NodeId, frame: FrameId, work_id: WorkId, picture: Picture, work: Work, encoding: Encoding },
    /// Tell a render server that it may stop.
    Cancel { node: NodeId, frame: FrameId },
    /// Every sample is in its place: show the frame.
    Show { frame: FrameId, stats: FrameStats },
    /// The frame is no longer wanted; forget its buffer.
    Discard { frame: FrameId },
}

/// A render server as the scheduler sees it.
#[derive(Clone, Debug)]
struct Node {
    name: String,
    /// At least 1.
    threads: u32,
    ready: bool,
    is_silent: bool,
    /// When it last had nothing to do, as far as is known: what it was given before, it began then.
    free_at: Time,
    link: Link,
}

/// The state of the farm.
#[derive(Debug)]
pub(super) struct Scheduler {
    nodes: BTreeMap<NodeId, Node>,
    wanted: Wanted,
    /// Whether `wanted` differs from what was last asked for.
    is_stale: bool,
    /// What the finished frame shows that waits to be taken, if one does.
    waiting: Option<Picture>,
    /// Frames being rendered, in the order in which they will be shown.
    frames: VecDeque<FrameInFlight>,
    balance: Balance,
    /// When the last frame that is shown became whole.
    last_whole_at: Time,
    last_frame: FrameId,
    last_work: WorkId,
}

impl Scheduler {
    pub(super) fn new(wanted: Wanted) -> Self {
        Self {
            nodes: BTreeMap::new(),
            wanted,
            is_stale: true,
            waiting: None,
            frames: VecDeque::new(),
            balance: Balance::default(),
            last_whole_at: Time::ZERO,
            last_frame: FrameId(0),
            last_work: WorkId(0),
        }
    }

    /// Takes an event and says what is to be done, in order.
    pub(super) fn on_event(&mut self, now: Time, event: Event) -> Vec<Action> {
        let mut actions = Vec::new();
        match event {
            Event::Joined { node, name, threads } => {
                self.nodes.insert(
                    node,
                    Node {
                        name,
                        threads: threads.max(1),
                        ready: false,
                        is_silent: false,
                        free_at: now,
                        link: Link::default(),
                    },
                );
            }
            Event::SceneReady { node, ready } => {
                if let Some(node) = self.nodes.get_mut(&node) {
                    node.ready = ready;
                }
                // Whoever does not have the scene does not render it, whatever it was given.
                if !ready {
                    self.frames.iter_mut().for_each(|frame| frame.lose(node));
                }
            }
            Event::Silent { node, is_silent } => {
                if let Some(node) = self.nodes.get_mut(&node) {
                    node.is_silent = is_silent;
                }
                self.frames.iter_mut().for_each(|frame| frame.hush(node, is_silent));
            }
            Event::Lost { node } => {
                self.nodes.remove(&node);
                self.balance.lose(node);
                self.frames.iter_mut().for_each(|frame| frame.lose(node));
            }
            Event::Placed { node, frame, work_id, units } => {
                if let Some(in_flight) = self.in_flight(frame) {
                    in_flight.place(node, work_id, units);
                }
            }
            Event::WorkDone { node, frame, work_id, timings, costs } => {
                let since = self.nodes.get(&node).map_or(Time::ZERO, |node| node.free_at);
                if let Some(in_flight) = self.in_flight(frame) {
                    let answered = in_flight.finish(now, since, node, work_id, timings, costs);
                    if let (Some((encoding, n_samples, took)), Some(node)) = (answered, self.nodes.get_mut(&node)) {
                        node.link.learn(encoding, n_samples, took);
                    }
                }
                self.set_free(now, [node]);
            }
            Event::Wanted(wanted) => self.want(now, wanted, &mut actions),
            Event::FrameTaken => self.waiting = None,
            Event::Tick => {}
        }
        while self.show_if_whole(now, &mut actions) {}
        while self.start_frame(now, &mut actions) {}
        for index in 0..self.frames.len() {
            self.divide_lost_work(index, now, &mut actions);
        }
        self.double_late_work(now, &mut actions);
        actions
    }

    /// Whether ticks are worth sending.
    pub(super) fn has_frame_in_flight(&self) -> bool {
        !self.frames.is_empty()
    }

    /// The scene that render servers must have.
    pub(super) fn scene(&self) -> Option<SceneId> {
        self.wanted.picture.map(|picture| picture.scene)
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

    fn want(&mut self, now: Time, wanted: Wanted, actions: &mut Vec<Action>) {
        let is_other_scene = wanted.picture.map(|picture| picture.scene) != self.scene();
        let is_other = (wanted.picture, wanted.division) != (self.wanted.picture, self.wanted.division);
        if is_other_scene {
            self.nodes.values_mut().for_each(|node| node.ready = false);
        }
        self.wanted = wanted;
        self.is_stale |= is_other;
        // The first frame in flight is finished in any case, or a camera that moves all the time would never be seen; and
        // so is what somebody has begun to render. What is refined has been seen.
        let is_superseded = |frame: &FrameInFlight, is_first: bool| {
            is_other_scene || is_other && (frame.refines || !is_first && !frame.has_begun())
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
        self.end(now, &frame, actions);
        actions.push(Action::Discard { frame: frame.id });
    }

    /// Tells whoever still works on a frame that nobody waits for it.
    fn end(&mut self, now: Time, frame: &FrameInFlight, actions: &mut Vec<Action>) {
        actions.extend(frame.nodes_at_work().map(|node| Action::Cancel { node, frame: frame.id }));
        self.set_free(now, frame.nodes_at_work());
    }

    fn ready_nodes(&self) -> Vec<NodeId> {
        self.nodes.iter().filter(|(_, node)| node.ready && !node.is_silent).map(|(&id, _)| id).collect()
    }

    /// Starts the next frame, if one is wanted and there is room and somebody to render it; whether it did.
    fn start_frame(&mut self, now: Time, actions: &mut Vec<Action>) -> bool {
        let Some(picture) = self.wanted.picture else { return false };
        let is_due = self.is_stale || self.wanted.repeat;
        if !is_due || self.frames.len() >= self.wanted.in_flight.max(1) as usize {
            return false;
        }
        // A moving camera's frame is divided by what the last one cost: measured, that is worth more than not waiting.
        let division = self.wanted.division;
        if division == Division::Dynamic && self.frames.back().is_some_and(|last| last.picture != picture) {
            return false;
        }
        let nodes = self.ready_nodes();
        if nodes.is_empty() || nodes.len() < self.wanted.min_renderers as usize {
            return false;
        }
        self.is_stale = false;
        self.last_frame.0 += 1;
        let mut frame = FrameInFlight::new(self.last_frame, picture, self.wanted.refines, division, now);
        actions.push(Action::Open { frame: frame.id, picture });
        let machines = nodes.len() as u32;
        let balanced = match division {
            Division::Dynamic => {
                let threads: Vec<_> = nodes.iter().map(|&node| (node, self.nodes[&node].threads)).collect();
                self.balance.divide(&picture, &threads)
            }
            Division::Interleaved | Division::Tiled => {
                self.balance.forget_costs();
                None
            }
        };
        let works = balanced.unwrap_or_else(|| (0..machines).map(|machine| division.work(machine, machines)).collect());
        for (node, work) in nodes.into_iter().zip(works) {
            let piece = frame.add(work);
            actions.push(self.give(&mut frame, now, node, piece));
        }
        self.frames.push_back(frame);
        true
    }

    /// Divides the shares of lost and silent render servers among the others, those that joined since included. There are
    /// about as many parts as render servers in all: works must not become more and more as silence follows silence.
    fn divide_lost_work(&mut self, index: usize, now: Time, actions: &mut Vec<Action>) {
        let nodes = self.ready_nodes();
        if !nodes.is_empty() {
            let lost = self.frames[index].take_lost_work();
            let parts = nodes.len().div_ceil(lost.len().max(1)) as u32;
            lost.iter().for_each(|lost| self.give_parts(index, now, &nodes, (lost, parts), actions));
        }
    }

    /// Gives work that is late to render servers that have nothing left to do, too; the first answer wins.
    fn double_late_work(&mut self, now: Time, actions: &mut Vec<Action>) {
        let at_work: BTreeSet<_> = self.frames.iter().flat_map(FrameInFlight::nodes_at_work).collect();
        let idle: Vec<_> = self.ready_nodes().into_iter().filter(|node| !at_work.contains(node)).collect();
        if idle.is_empty() {
            return;
        }
        // What a render server was given for a later frame has not been begun, and so is not late.
        let mut busy = BTreeSet::new();
        for index in 0..self.frames.len() {
            let nodes = &self.nodes;
            let begun_at = |node| nodes.get(&node).filter(|_| !busy.contains(&node)).map(|node| node.free_at);
            if let Some(late) = self.frames[index].take_late_work(now, begun_at) {
                return self.give_parts(index, now, &idle, (&late, idle.len() as u32), actions);
            }
            busy.extend(self.frames[index].nodes_at_work());
        }
    }

    /// Gives a piece of a frame to nodes, in so many parts at most.
    fn give_parts(
        &mut self,
        index: usize,
        now: Time,
        nodes: &[NodeId],
        (piece, most_parts): (&Piece, u32),
        actions: &mut Vec<Action>,
    ) {
        let Some(mut frame) = self.frames.remove(index) else { return };
        frame.attempts += 1;
        let parts = most_parts.min(frame.n_samples(&piece.work) / SMALLEST_PART).max(1);
        // Those who got a part of the last work are not the first to get one of this.
        let mut nodes = nodes.iter().cycle().skip(self.last_work.0 as usize % nodes.len());
        for part in 0..parts {
            let part = piece.part(part, parts).expect("parts hold units, so there are no more than the frame has");
            let &node = nodes.next().expect("nodes go round");
            actions.push(self.give(&mut frame, now, node, part));
        }
        self.frames.insert(index, frame);
    }

    fn give(&mut self, frame: &mut FrameInFlight, now: Time, node: NodeId, piece: Piece) -> Action {
        let work = piece.work.clone();
        self.last_work.0 = self.last_work.0.wrapping_add(1);
        let n_samples = frame.n_samples(&work);
        let encoding = |link: &mut Link| self.wanted.encoding.unwrap_or_else(|| link.choose(n_samples));
        let (of_node, encoding) = match self.nodes.get_mut(&node) {
            Some(node) => ((node.name.clone(), node.threads), encoding(&mut node.link)),
            None => ((String::new(), 1), Encoding::Raw),
        };
        frame.give(now, self.last_work, node, of_node, piece, encoding);
        Action::Render { node, frame: frame.id, work_id: self.last_work, picture: frame.picture, work, encoding }
    }

    /// Shows the first frame once it is whole and the one before it is taken, so that the next are rendered while one is
    /// displayed; whether it did.
    ///
    /// A frame that waits while the camera moves on is superseded: the newer one takes its place. Frames of the same
    /// picture are each shown.
    fn show_if_whole(&mut self, now: Time, actions: &mut Vec<Action>) -> bool {
        // Each notes when it became whole, whether or not it is its turn.
        for frame in &mut self.frames {
            frame.is_whole(now);
        }
        let is_shown = |frame: &mut FrameInFlight| frame.is_whole(now) && self.waiting != Some(frame.picture);
        if !self.frames.front_mut().is_some_and(is_shown) {
            return false;
        }
        let Some(frame) = self.frames.pop_front() else { return false };
        if frame.division == Division::Dynamic {
            self.balance.learn(&frame.picture, &frame.measured().collect::<Vec<_>>());
        }
        // Whoever still works on it does what another has done already.
        self.end(now, &frame, actions);
        let stats = frame.stats(now, self.last_whole_at);
        self.last_whole_at = frame.whole_at.unwrap_or(now);
        actions.push(Action::Show { frame: frame.id, stats });
        self.waiting = Some(frame.picture);
        true
    }
}

#[cfg(test)]
mod tests;
