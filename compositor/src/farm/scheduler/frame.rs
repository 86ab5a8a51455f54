//! A frame while its samples come in.

use std::time::Duration;

use shared::{
    division::{Division, Share, Work},
    protocol::{BlockCosts, Encoding, FrameId, Picture, WorkId, WorkTimings},
};

use super::{
    Placed, Time,
    balance::Measured,
    coverage::{Coverage, Piece},
};
use crate::farm::stats::{FrameStats, FrameWork, NodeFrameStats, NodeId, max_over_mean};

/// Work is late when it has taken this many times as long as the slowest finished work of the frame…
const LATE_FACTOR: u32 = 3;

/// …and at least this long: below it, giving it out again costs more than waiting.
const LATE_AT_LEAST: Duration = Duration::from_millis(30);

/// A frame, who renders what of it, and what has come.
#[derive(Debug)]
pub(super) struct FrameInFlight {
    pub(super) id: FrameId,
    pub(super) picture: Picture,
    /// Whether it only refines what was shown already.
    pub(super) refines: bool,
    /// 1, and one more each time work was given out again.
    pub(super) attempts: u32,
    pub(super) division: Division,
    started_at: Time,
    pub(super) whole_at: Option<Time>,
    coverage: Coverage,
    works: Vec<GivenWork>,
}

/// A work, to whom it was given, and what became of it.
#[derive(Debug)]
struct GivenWork {
    id: WorkId,
    node: NodeId,
    name: String,
    threads: u32,
    piece: Piece,
    encoding: Encoding,
    sent_at: Time,
    state: WorkState,
    n_bytes: u64,
    place_time: Duration,
}

#[derive(Debug)]
enum WorkState {
    AtWork,
    /// Its node is silent, and nobody else has it yet.
    Silent,
    /// Late, or its node is silent, and given to others as well.
    Doubled,
    Done {
        at: Time,
        /// From when its node had received it and had nothing else to do.
        took: Duration,
        timings: WorkTimings,
        costs: BlockCosts,
    },
    /// Its node is lost, and nobody else has it yet.
    Lost,
    /// Its node is lost, and others have it.
    GivenOn,
}

impl FrameInFlight {
    pub(super) fn new(id: FrameId, picture: Picture, refines: bool, division: Division, now: Time) -> Self {
        let (coverage, works) = (Coverage::default(), Vec::new());
        Self { id, picture, refines, attempts: 1, division, started_at: now, whole_at: None, coverage, works }
    }

    /// Adds one of the works that the frame is divided into at its beginning.
    pub(super) fn add(&mut self, work: Work) -> Piece {
        let n_units = share(&work, self.picture).count();
        self.coverage.add(work, n_units)
    }

    pub(super) fn give(
        &mut self,
        now: Time,
        id: WorkId,
        node: NodeId,
        (name, threads): (String, u32),
        piece: Piece,
        encoding: Encoding,
    ) {
        self.works.push(GivenWork {
            id,
            node,
            name,
            threads,
            piece,
            encoding,
            sent_at: now,
            state: WorkState::AtWork,
            n_bytes: 0,
            place_time: Duration::ZERO,
        });
    }

    pub(super) fn place(&mut self, node: NodeId, work_id: WorkId, units: Placed) {
        let Some(given) = self.works.iter_mut().find(|given| given.id == work_id && given.node == node) else { return };
        given.n_bytes += units.n_bytes;
        given.place_time += units.place_time;
        self.coverage.cover(&given.piece, units.first..units.first + units.count);
    }

    /// A work is answered by a node that had nothing else to do since some time. How it travelled, how many samples it
    /// has, and how long it took.
    pub(super) fn finish(
        &mut self,
        now: Time,
        since: Time,
        node: NodeId,
        work_id: WorkId,
        timings: WorkTimings,
        costs: BlockCosts,
    ) -> Option<(Encoding, u32, Duration)> {
        let given = self.works.iter_mut().find(|given| given.id == work_id && given.node == node)?;
        // A render server that says "done" without having sent everything does not make the frame whole.
        if !self.coverage.has_all_of(&given.piece) {
            given.state = WorkState::Lost;
            return None;
        }
        let took = now.saturating_sub(given.sent_at.max(since));
        given.state = WorkState::Done { at: now, took, timings, costs };
        Some((given.encoding, n_samples(&share(&given.piece.work, self.picture)), took))
    }

    /// About how many samples a work of this frame has.
    pub(super) fn n_samples(&self, work: &Work) -> u32 {
        n_samples(&share(work, self.picture))
    }

    /// A node is silent: it may still answer, but nobody waits for it. Or it is heard again, and what nobody else has
    /// is its own as before.
    pub(super) fn hush(&mut self, node: NodeId, is_silent: bool) {
        for given in self.works.iter_mut().filter(|given| given.node == node) {
            match given.state {
                WorkState::AtWork if is_silent => given.state = WorkState::Silent,
                WorkState::Silent if !is_silent => given.state = WorkState::AtWork,
                _ => {}
            }
        }
    }

    pub(super) fn lose(&mut self, node: NodeId) {
        for given in self.works.iter_mut().filter(|given| given.node == node) {
            given.state = match given.state {
                WorkState::AtWork | WorkState::Silent => WorkState::Lost,
                WorkState::Doubled => WorkState::GivenOn,
                _ => continue,
            };
        }
    }

    /// Works whose nodes are lost or silent and of which samples are missing: whoever calls this gives them to others.
    pub(super) fn take_lost_work(&mut self) -> Vec<Piece> {
        let mut missing = Vec::new();
        for given in &mut self.works {
            given.state = match given.state {
                WorkState::Lost => WorkState::GivenOn,
                WorkState::Silent => WorkState::Doubled,
                _ => continue,
            };
            if !self.coverage.has_all_of(&given.piece) {
                missing.push(given.piece.clone());
            }
        }
        missing
    }

    /// The oldest work that is late: whoever calls this gives it to others as well.
    ///
    /// `free_at`: since when a node had nothing to do but works of this frame; `None` if it still has.
    pub(super) fn take_late_work(&mut self, now: Time, free_at: impl Fn(NodeId) -> Option<Time>) -> Option<Piece> {
        let slowest = self.works.iter().filter_map(|given| match given.state {
            WorkState::Done { took, .. } => Some(took),
            _ => None,
        });
        let late_after = (slowest.max()? * LATE_FACTOR).max(LATE_AT_LEAST);
        let is_late = |given: &&mut GivenWork| {
            matches!(given.state, WorkState::AtWork)
                && free_at(given.node)
                    .is_some_and(|free_at| now.saturating_sub(given.sent_at.max(free_at)) > late_after)
        };
        let late = self.works.iter_mut().find(is_late)?;
        late.state = WorkState::Doubled;
        Some(late.piece.clone())
    }

    /// Whether anything of it has come.
    pub(super) fn has_begun(&self) -> bool {
        self.works.iter().any(|given| given.n_bytes > 0)
    }

    pub(super) fn nodes_at_work(&self) -> impl Iterator<Item = NodeId> {
        let is_at_work =
            |given: &&GivenWork| matches!(given.state, WorkState::AtWork | WorkState::Silent | WorkState::Doubled);
        self.works.iter().filter(is_at_work).map(|given| given.node)
    }

    /// Whether every sample is in its place, and everybody whose answer counts has said how long it took.
    pub(super) fn is_whole(&mut self, now: Time) -> bool {
        let is_whole =
            self.coverage.is_whole() && !self.works.iter().any(|given| matches!(given.state, WorkState::AtWork));
        if is_whole {
            self.whole_at.get_or_insert(now);
        }
        is_whole
    }

    /// What became of each work, as far as render servers that are still there have shown it.
    pub(super) fn measured(&self) -> impl Iterator<Item = Measured<'_>> {
        self.works.iter().filter_map(|given| {
            let costs = match &given.state {
                WorkState::Done { costs, .. } => Some(costs),
                WorkState::Doubled => None,
                _ => return None,
            };
            Some(Measured { node: given.node, share: share(&given.piece.work, self.picture), costs })
        })
    }

    /// What the frame took until it was whole, not until somebody had time to look at it. What only connections know is
    /// left open.
    ///
    /// `last_whole_at`: when the frame before it was whole.
    pub(super) fn stats(&self, now: Time, last_whole_at: Time) -> FrameStats {
        let now = self.whole_at.unwrap_or(now);
        let n_units = f64::from(self.division.units(self.picture.size).count());
        let mut nodes: Vec<NodeFrameStats> = Vec::new();
        for (index, given) in self.works.iter().enumerate() {
            let share = f64::from(share(&given.piece.work, self.picture).count()) / n_units;
            let (tracing, network, idle) = match given.state {
                WorkState::Done { at, took, timings, .. } => {
                    let tracing = Duration::from_micros(timings.trace_us.into());
                    ((tracing, timings.trace_cpu_us), took.saturating_sub(tracing), now.saturating_sub(at))
                }
                _ => Default::default(),
            };
            let of_this = NodeFrameStats {
                id: given.node,
                name: given.name.clone(),
                address: None,
                n_failures: 0,
                round_trip_ms: None,
                share,
                trace_ms: milliseconds(tracing.0),
                trace_cpu_ms: f64::from(tracing.1) / 1e3,
                busy_ms: f64::from(tracing.1) / 1e3 / f64::from(given.threads),
                network_ms: milliseconds(network),
                idle_ms: milliseconds(idle),
                taken_over: u32::from(index >= self.coverage.n_shares()),
                encoding: given.encoding,
                mbit_per_s: megabits(given),
                bytes_in: given.n_bytes,
                bytes_out: 0,
            };
            match nodes.iter_mut().find(|node| node.id == given.node) {
                Some(node) => node.add(&of_this),
                None => nodes.push(of_this),
            }
        }
        FrameStats {
            frame: self.id.0,
            size: self.picture.size,
            division: self.division,
            render_ms: milliseconds(now - self.started_at),
            interval_ms: milliseconds(now.saturating_sub(self.started_at.max(last_whole_at))),
            place_ms: milliseconds(self.works.iter().map(|given| given.place_time).sum()),
            imbalance: max_over_mean(nodes.iter().map(|node| node.busy_ms)),
            attempts: self.attempts,
            n_lost: 0,
            n_healed: 0,
            bytes_in: nodes.iter().map(|node| node.bytes_in).sum(),
            bytes_out: 0,
            nodes,
            works: self.answered().collect(),
        }
    }

    /// The works that were answered, each with what it cost.
    fn answered(&self) -> impl Iterator<Item = FrameWork> {
        self.works.iter().filter_map(|given| match &given.state {
            WorkState::Done { timings, costs, .. } => Some(FrameWork {
                node: given.node,
                work: given.piece.work.clone(),
                trace_cpu_ns: 1000 * u64::from(timings.trace_cpu_us),
                costs: costs.clone(),
            }),
            _ => None,
        })
    }
}

/// The share behind a work that the scheduler made itself.
fn share(work: &Work, picture: Picture) -> Share<'_> {
    work.share(picture.size).expect("the scheduler makes works that fit their frame")
}

/// How fast a work's samples came, from when its node had nothing else to do: with tracing and encoding.
fn megabits(given: &GivenWork) -> f64 {
    match given.state {
        WorkState::Done { took, .. } if !took.is_zero() => given.n_bytes as f64 * 8e-6 / took.as_secs_f64(),
        _ => 0.0,
    }
}

/// How many samples a share has; tiles that the frame's edge cuts off count as whole ones.
fn n_samples(share: &Share<'_>) -> u32 {
    let units = share.units();
    units.size().n_samples().min(share.count().saturating_mul(units.whole_unit_samples()))
}

fn milliseconds(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}
