//! Who renders what, and what happens when somebody does not: a pure state machine.
//!
//! Events go in with the time at which they happened, actions come out. There is no clock, no socket and no thread in
//! here, so tests invent all three.

mod balance;
mod coverage;
mod frame;

use std::{collections::BTreeMap, time::Duration};

use shared::{
    division::{Division, Work},
    protocol::{BlockCosts, FrameId, Picture, WorkId, WorkTimings},
    scene::SceneId,
};

use self::{balance::Balance, coverage::Piece, frame::FrameInFlight};
use crate::stats::{FrameStats, NodeId};

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
    pub(super) division: Division,
    pub(super) min_renderers: u32,
    pub(super) repeat: bool,
}

/// What is to be done.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Action {
    /// Have a buffer ready for the answers to this frame.
    Open { frame: FrameId, picture: Picture },
    /// Send this work.
    Render { node: NodeId, frame: FrameId, work_id: WorkId, picture: Picture, work: Work },
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
    frame: Option<FrameInFlight>,
    balance: Balance,
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
            frame: None,
            balance: Balance::default(),
            last_frame: FrameId(0),
            last_work: WorkId(0),
        }
    }

    /// Takes an event and says what is to be done, in order.
    pub(super) fn on_event(&mut self, now: Time, event: Event) -> Vec<Action> {
        let mut actions = Vec::new();
        match event {
            Event::Joined { node, name, threads } => {
                self.nodes.insert(node, Node { name, threads: threads.max(1), ready: false });
            }
            Event::SceneReady { node, ready } => {
                if let Some(node) = self.nodes.get_mut(&node) {
                    node.ready = ready;
                }
                // Whoever does not have the scene does not render it, whatever it was given.
                if let (false, Some(frame)) = (ready, &mut self.frame) {
                    frame.lose(node);
                }
            }
            Event::Lost { node } => {
                self.nodes.remove(&node);
                self.balance.lose(node);
                if let Some(frame) = &mut self.frame {
                    frame.lose(node);
                }
            }
            Event::Placed { node, frame, work_id, units } => {
                if let Some(in_flight) = self.in_flight(frame) {
                    in_flight.place(node, work_id, units);
                }
            }
            Event::WorkDone { node, frame, work_id, timings, costs } => {
                if let Some(in_flight) = self.in_flight(frame) {
                    in_flight.finish(now, node, work_id, timings, costs);
                }
            }
            Event::Wanted(wanted) => self.want(wanted, &mut actions),
            Event::FrameTaken => self.waiting = None,
            Event::Tick => {}
        }
        self.show_if_whole(now, &mut actions);
        self.start_frame(now, &mut actions);
        self.divide_lost_work(now, &mut actions);
        self.double_late_work(now, &mut actions);
        actions
    }

    /// Whether ticks are worth sending.
    pub(super) fn has_frame_in_flight(&self) -> bool {
        self.frame.is_some()
    }

    /// The scene that render servers must have.
    pub(super) fn scene(&self) -> Option<SceneId> {
        self.wanted.picture.map(|picture| picture.scene)
    }

    fn in_flight(&mut self, frame: FrameId) -> Option<&mut FrameInFlight> {
        self.frame.as_mut().filter(|in_flight| in_flight.id == frame)
    }

    fn want(&mut self, wanted: Wanted, actions: &mut Vec<Action>) {
        if wanted.picture.map(|picture| picture.scene) != self.scene() {
            self.nodes.values_mut().for_each(|node| node.ready = false);
            if let Some(frame) = self.frame.take() {
                actions.extend(frame.nodes_at_work().map(|node| Action::Cancel { node, frame: frame.id }));
                actions.push(Action::Discard { frame: frame.id });
            }
        }
        self.is_stale |= (wanted.picture, wanted.division) != (self.wanted.picture, self.wanted.division);
        self.wanted = wanted;
    }

    fn ready_nodes(&self) -> Vec<NodeId> {
        self.nodes.iter().filter(|(_, node)| node.ready).map(|(&id, _)| id).collect()
    }

    /// Starts the next frame, if one is wanted and there is room and somebody to render it.
    fn start_frame(&mut self, now: Time, actions: &mut Vec<Action>) {
        let Some(picture) = self.wanted.picture else { return };
        let is_due = self.is_stale || self.wanted.repeat;
        if !is_due || self.frame.is_some() {
            return;
        }
        let nodes = self.ready_nodes();
        if nodes.is_empty() || nodes.len() < self.wanted.min_renderers as usize {
            return;
        }
        self.is_stale = false;
        self.last_frame.0 += 1;
        let division = self.wanted.division;
        let mut frame = FrameInFlight::new(self.last_frame, picture, division, now);
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
        self.frame = Some(frame);
    }

    /// Divides the shares of lost render servers among the others, those that joined since included.
    fn divide_lost_work(&mut self, now: Time, actions: &mut Vec<Action>) {
        let Some(mut frame) = self.frame.take() else { return };
        let nodes = self.ready_nodes();
        if !nodes.is_empty() {
            for lost in frame.take_lost_work() {
                frame.attempts += 1;
                actions.extend(self.give_parts(&mut frame, now, &nodes, &lost));
            }
        }
        self.frame = Some(frame);
    }

    /// Gives work that is late to render servers that have nothing left to do, too; the first answer wins.
    fn double_late_work(&mut self, now: Time, actions: &mut Vec<Action>) {
        let Some(mut frame) = self.frame.take() else { return };
        let idle: Vec<_> = self.ready_nodes().into_iter().filter(|&node| !frame.is_at_work(node)).collect();
        if !idle.is_empty()
            && let Some(late) = frame.take_late_work(now)
        {
            frame.attempts += 1;
            actions.extend(self.give_parts(&mut frame, now, &idle, &late));
        }
        self.frame = Some(frame);
    }

    fn give_parts(&mut self, frame: &mut FrameInFlight, now: Time, nodes: &[NodeId], piece: &Piece) -> Vec<Action> {
        let share = piece.work.share(frame.picture.size).expect("the scheduler makes works that fit their frame");
        let n_samples: u32 = (0..share.count()).map(|k| share.samples(k).count()).sum();
        let parts = (nodes.len() as u32).min(n_samples / SMALLEST_PART).max(1);
        // Those who got a part of the last work are not the first to get one of this.
        let mut nodes = nodes.iter().cycle().skip(self.last_work.0 as usize % nodes.len());
        (0..parts)
            .map(|index| {
                let part = piece.part(index, parts).expect("parts hold units, so there are no more than the frame has");
                let &node = nodes.next().expect("nodes go round");
                self.give(frame, now, node, part)
            })
            .collect()
    }

    fn give(&mut self, frame: &mut FrameInFlight, now: Time, node: NodeId, piece: Piece) -> Action {
        let work = piece.work.clone();
        self.last_work.0 = self.last_work.0.wrapping_add(1);
        let of_node = self.nodes.get(&node).map_or((String::new(), 1), |node| (node.name.clone(), node.threads));
        frame.give(now, self.last_work, node, of_node, piece);
        Action::Render { node, frame: frame.id, work_id: self.last_work, picture: frame.picture, work }
    }

    /// Shows a whole frame as soon as the one before it is taken, so that the next is rendered while one is displayed.
    ///
    /// A frame that waits while the camera moves on is superseded: the newer one takes its place. Frames of the same
    /// picture are each shown.
    fn show_if_whole(&mut self, now: Time, actions: &mut Vec<Action>) {
        let Some(frame) = &mut self.frame else { return };
        if !frame.is_whole(now) || self.waiting == Some(frame.picture) {
            return;
        }
        let Some(frame) = self.frame.take() else { return };
        if frame.division == Division::Dynamic {
            self.balance.learn(&frame.picture, &frame.measured().collect::<Vec<_>>());
        }
        // Whoever still works on it does what another has done already.
        actions.extend(frame.nodes_at_work().map(|node| Action::Cancel { node, frame: frame.id }));
        actions.push(Action::Show { frame: frame.id, stats: frame.stats(now) });
        self.waiting = Some(frame.picture);
    }
}

#[cfg(test)]
mod tests;
