//! A frame in flight: its tasks, and which of its samples have arrived.

use std::{
    collections::{BTreeMap, VecDeque},
    time::Duration,
};

use shared::{
    division::{Division, Share, Task},
    protocol::{Encoding, FrameId, FrameSpec, RunCosts, TaskId, TaskTimings},
};

use super::{
    PlacedUnits, Time,
    balance::TaskResult,
    coverage::{Coverage, TaskPart},
};
use crate::farm::stats::{FrameStats, FrameTask, NodeFrameStats, NodeId, max_over_mean};

/// A task is late after this many times the duration of the frame's slowest finished task…
const LATE_FACTOR: u32 = 3;

/// …but not before this time: giving it out again sooner costs more than waiting.
const LEAST_LATENESS: Duration = Duration::from_millis(30);

/// While no task of the frame is finished, a task is late after this time. It doubles with each time that the same samples
/// were handed out, so that copies of a heavy task do not multiply.
const LATENESS_WITHOUT_RESULTS: Duration = Duration::from_millis(250);

/// While no task of the frame is finished, a late one is divided into at least this many parts, so that render servers that
/// join later can help.
const LATE_TASK_PARTS: u32 = 4;

/// Parts have at least this many samples, even if many render servers die in one frame.
const SMALLEST_PART: u32 = 256;

/// A frame takes long if it is in flight for this time.
const LONG: Duration = Duration::from_millis(500);

/// A frame in flight.
#[derive(Debug)]
pub(super) struct FrameInFlight {
    pub(super) id: FrameId,
    pub(super) spec: FrameSpec,
    /// Whether it only refines a frame that was shown.
    pub(super) is_refinement: bool,
    /// 1, and one more each time a task was given out again.
    pub(super) attempts: u32,
    pub(super) division: Division,
    started_at: Time,
    pub(super) completed_at: Option<Time>,
    coverage: Coverage,
    tasks: Vec<AssignedTask>,
    waiting: VecDeque<WaitingTask>,
}

/// A task that waits for a node to take it: its node is lost, silent or late.
#[derive(Debug)]
struct WaitingTask {
    task: HandedOut,
    /// The assigned task that it repeats.
    of: TaskId,
    /// Whether its node may still answer in time, so that only idle nodes take it.
    is_late: bool,
    /// Whether it is a part of that task, and is not divided again.
    is_divided: bool,
}

/// A task on its way to a node.
#[derive(Clone, Debug)]
pub(super) struct HandedOut {
    pub(super) task_part: TaskPart,
    /// How often its samples were handed out before.
    copies: u32,
}

/// A task that was given to a node, and its state.
#[derive(Debug)]
struct AssignedTask {
    id: TaskId,
    node: NodeId,
    name: String,
    threads: u32,
    task_part: TaskPart,
    copies: u32,
    encoding: Encoding,
    sent_at: Time,
    state: TaskState,
    n_bytes: u64,
    place_time: Duration,
}

#[derive(Debug)]
enum TaskState {
    Running,
    /// Its node is silent; the task waits for others.
    Silent,
    /// Late, or its node is silent; others have it, or it waits for them.
    Duplicated,
    Done {
        at: Time,
        /// Time since it was sent and its node had nothing else to do.
        took: Duration,
        timings: TaskTimings,
        costs: RunCosts,
    },
    /// Its node is lost, or is without the scene; others have it, or it waits for them.
    GivenUp,
}

impl AssignedTask {
    /// Whether its node may still answer.
    fn is_unfinished(&self) -> bool {
        matches!(self.state, TaskState::Running | TaskState::Silent | TaskState::Duplicated)
    }

    fn waiting(&self, is_late: bool) -> WaitingTask {
        let task = HandedOut { task_part: self.task_part.clone(), copies: self.copies + 1 };
        WaitingTask { task, of: self.id, is_late, is_divided: false }
    }
}

impl FrameInFlight {
    pub(super) fn new(id: FrameId, spec: FrameSpec, is_refinement: bool, division: Division, now: Time) -> Self {
        Self {
            id,
            spec,
            is_refinement,
            attempts: 1,
            division,
            started_at: now,
            completed_at: None,
            coverage: Coverage::default(),
            tasks: Vec::new(),
            waiting: VecDeque::new(),
        }
    }

    /// Adds one of the tasks that the frame is first divided into.
    pub(super) fn add(&mut self, task: Task) -> HandedOut {
        let n_units = share(&task, self.spec).count();
        HandedOut { task_part: self.coverage.add(task, n_units), copies: 0 }
    }

    pub(super) fn assign(
        &mut self,
        now: Time,
        id: TaskId,
        node: NodeId,
        (name, threads): (String, u32),
        HandedOut { task_part, copies }: HandedOut,
        encoding: Encoding,
    ) {
        self.tasks.push(AssignedTask {
            id,
            node,
            name,
            threads,
            task_part,
            copies,
            encoding,
            sent_at: now,
            state: TaskState::Running,
            n_bytes: 0,
            place_time: Duration::ZERO,
        });
    }

    /// How much of the frame has arrived, in percent, if it takes long.
    pub(super) fn percent(&self, now: Time) -> Option<u8> {
        (now.saturating_sub(self.started_at) >= LONG).then(|| self.coverage.percent())
    }

    pub(super) fn place(&mut self, node: NodeId, task_id: TaskId, units: PlacedUnits) {
        let Some(assigned) = self.tasks.iter_mut().find(|assigned| assigned.id == task_id && assigned.node == node)
        else {
            return;
        };
        assigned.n_bytes += units.n_bytes;
        assigned.place_time += units.place_time;
        self.coverage.mark_received(&assigned.task_part, units.first..units.first + units.count);
    }

    /// Marks a task as done by a node that has had nothing else to do since `since`. Returns its encoding, number of
    /// samples and duration.
    pub(super) fn finish(
        &mut self,
        now: Time,
        since: Time,
        node: NodeId,
        task_id: TaskId,
        timings: TaskTimings,
        costs: RunCosts,
    ) -> Option<(Encoding, u32, Duration)> {
        let assigned = self.tasks.iter_mut().find(|assigned| assigned.id == task_id && assigned.node == node)?;
        // Samples are missing: the report is false.
        if !self.coverage.has_received_all(&assigned.task_part) {
            assigned.state = TaskState::GivenUp;
            self.waiting.push_back(assigned.waiting(false));
            return None;
        }
        let took = now.saturating_sub(assigned.sent_at.max(since));
        assigned.state = TaskState::Done { at: now, took, timings, costs };
        Some((assigned.encoding, n_samples(&share(&assigned.task_part.task, self.spec)), took))
    }

    /// About how many samples a task of this frame has.
    pub(super) fn n_samples(&self, task: &Task) -> u32 {
        n_samples(&share(task, self.spec))
    }

    /// Marks a node as silent: it may still answer, but its tasks wait for others. Or as heard again: it keeps the tasks that
    /// no other has taken.
    pub(super) fn set_silent(&mut self, node: NodeId, is_silent: bool) {
        for assigned in self.tasks.iter_mut().filter(|assigned| assigned.node == node) {
            match assigned.state {
                TaskState::Running if is_silent => {
                    assigned.state = TaskState::Silent;
                    self.waiting.push_back(assigned.waiting(false));
                }
                TaskState::Silent if !is_silent => {
                    assigned.state = TaskState::Running;
                    self.waiting.retain(|waiting| waiting.of != assigned.id);
                }
                _ => {}
            }
        }
    }

    /// Gives up a node's tasks; they wait for others. Returns whether it had any.
    pub(super) fn give_up(&mut self, node: NodeId) -> bool {
        let mut had_tasks = false;
        for assigned in self.tasks.iter_mut().filter(|assigned| assigned.node == node && assigned.is_unfinished()) {
            had_tasks = true;
            match assigned.state {
                TaskState::Running => self.waiting.push_back(assigned.waiting(false)),
                // Those that wait are no longer only late.
                _ => self.waiting.iter_mut().filter(|w| w.of == assigned.id).for_each(|w| w.is_late = false),
            }
            assigned.state = TaskState::GivenUp;
        }
        had_tasks
    }

    pub(super) fn has_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Takes the task that has waited longest, or a part of it if fewer wait than there are takers. Only idle nodes take late
    /// tasks.
    pub(super) fn take_waiting(&mut self, n_takers: u32, is_idle: bool) -> Option<HandedOut> {
        loop {
            let index = self.waiting.iter().position(|waiting| is_idle || !waiting.is_late)?;
            let n_parts = n_takers.div_ceil(self.waiting.len() as u32);
            let whole = self.waiting.remove(index)?;
            // Its node has answered after all.
            if self.coverage.has_received_all(&whole.task.task_part) {
                continue;
            }
            if whole.is_divided {
                return Some(whole.task);
            }
            self.attempts += 1;
            if let Some(repeated) = self.tasks.iter_mut().find(|assigned| assigned.id == whole.of)
                && matches!(repeated.state, TaskState::Silent)
            {
                repeated.state = TaskState::Duplicated;
            }
            let mut parts = self.parts(&whole, n_parts);
            let first = parts.next()?;
            parts.enumerate().for_each(|(offset, part)| self.waiting.insert(index + offset, part));
            return Some(first.task);
        }
    }

    /// Divides a task into at most `most_parts` parts.
    fn parts(&self, whole: &WaitingTask, most_parts: u32) -> impl Iterator<Item = WaitingTask> + use<> {
        let WaitingTask { task: HandedOut { task_part, copies }, of, is_late, .. } = whole;
        let n_parts = most_parts.min(self.n_samples(&task_part.task) / SMALLEST_PART).max(1);
        let (task_part, copies, of, is_late) = (task_part.clone(), *copies, *of, *is_late);
        (0..n_parts).map(move |index| {
            let task = HandedOut { task_part: task_part.part(index, n_parts), copies };
            WaitingTask { task, of, is_late, is_divided: true }
        })
    }

    /// Has the oldest late task wait for `n_idle` idle nodes as well. Returns whether there is one.
    ///
    /// `free_at`: since when a node has had only tasks of this frame; `None` if it is busy with an earlier one.
    pub(super) fn repeat_late_task(
        &mut self,
        now: Time,
        n_idle: u32,
        free_at: impl Fn(NodeId) -> Option<Time>,
    ) -> bool {
        let slowest = self.tasks.iter().filter_map(|assigned| match assigned.state {
            TaskState::Done { took, .. } => Some(took),
            _ => None,
        });
        let slowest = slowest.max().map(|slowest| (slowest * LATE_FACTOR).max(LEAST_LATENESS));
        let late_after = |copies: u32| slowest.unwrap_or(LATENESS_WITHOUT_RESULTS * 2_u32.pow(copies.min(16)));
        let is_late = |assigned: &&mut AssignedTask| {
            let is_overdue = |free_at| now.saturating_sub(assigned.sent_at.max(free_at)) > late_after(assigned.copies);
            matches!(assigned.state, TaskState::Running) && free_at(assigned.node).is_some_and(is_overdue)
        };
        let Some(late) = self.tasks.iter_mut().find(is_late) else { return false };
        late.state = TaskState::Duplicated;
        let late = late.waiting(true);
        self.attempts += 1;
        let n_parts = if slowest.is_none() { n_idle.max(LATE_TASK_PARTS) } else { n_idle };
        self.waiting.extend(self.parts(&late, n_parts));
        true
    }

    /// The nodes with unfinished tasks of this frame, and how many each has.
    pub(super) fn n_unfinished(&self) -> BTreeMap<NodeId, u32> {
        let mut n_unfinished = BTreeMap::new();
        for assigned in self.tasks.iter().filter(|assigned| assigned.is_unfinished()) {
            *n_unfinished.entry(assigned.node).or_default() += 1;
        }
        n_unfinished
    }

    /// Whether any samples have arrived.
    pub(super) fn has_begun(&self) -> bool {
        self.tasks.iter().any(|assigned| assigned.n_bytes > 0)
    }

    /// Whether every sample is placed and no task is running; silent and late nodes do not count.
    pub(super) fn is_complete(&mut self, now: Time) -> bool {
        let is_complete = self.coverage.is_complete()
            && !self.tasks.iter().any(|assigned| matches!(assigned.state, TaskState::Running));
        if is_complete {
            self.completed_at.get_or_insert(now);
        }
        is_complete
    }

    /// The tasks of connected nodes, with their costs as far as they are known.
    pub(super) fn task_results(&self) -> impl Iterator<Item = TaskResult<'_>> {
        self.tasks.iter().filter_map(|assigned| {
            let costs = match &assigned.state {
                TaskState::Done { costs, .. } => Some(costs),
                TaskState::Duplicated => None,
                _ => return None,
            };
            Some(TaskResult { node: assigned.node, share: share(&assigned.task_part.task, self.spec), costs })
        })
    }

    /// Measurements up to the frame's completion, not up to its turn to be shown. The service fills in the fields that
    /// only connections know.
    ///
    /// `last_completed_at`: when the previous frame was complete.
    pub(super) fn stats(&self, now: Time, last_completed_at: Time) -> FrameStats {
        let now = self.completed_at.unwrap_or(now);
        let n_units = f64::from(self.division.units(self.spec.size).count());
        let mut nodes: Vec<NodeFrameStats> = Vec::new();
        for (index, assigned) in self.tasks.iter().enumerate() {
            let share = f64::from(share(&assigned.task_part.task, self.spec).count()) / n_units;
            let (timings, took, idle) = match assigned.state {
                TaskState::Done { at, took, timings, .. } => (timings, took, now.saturating_sub(at)),
                _ => Default::default(),
            };
            let tracing = Duration::from_micros(timings.trace_us.into());
            let trace_cpu_ms = f64::from(timings.trace_cpu_us) / 1e3;
            let node_stats = NodeFrameStats {
                id: assigned.node,
                name: assigned.name.clone(),
                address: None,
                n_failures: 0,
                round_trip_ms: None,
                share,
                trace_ms: milliseconds(tracing),
                trace_cpu_ms,
                busy_ms: trace_cpu_ms / f64::from(assigned.threads),
                network_ms: milliseconds(took.saturating_sub(tracing)),
                idle_ms: milliseconds(idle),
                taken_over: u32::from(index >= self.coverage.n_initial_tasks()),
                encoding: assigned.encoding,
                mbit_per_s: if took.is_zero() { 0.0 } else { assigned.n_bytes as f64 * 8e-6 / took.as_secs_f64() },
                bytes_in: assigned.n_bytes,
                bytes_out: 0,
            };
            match nodes.iter_mut().find(|node| node.id == assigned.node) {
                Some(node) => node.add(&node_stats),
                None => nodes.push(node_stats),
            }
        }
        let is_done = |assigned: &AssignedTask| matches!(assigned.state, TaskState::Done { .. });
        // A copy of a late task that was answered after all has healed nothing.
        let is_healed = self.attempts > 1 && !self.tasks.iter().take(self.coverage.n_initial_tasks()).all(is_done);
        FrameStats {
            frame: self.id.0,
            size: self.spec.size,
            division: self.division,
            render_ms: milliseconds(now - self.started_at),
            interval_ms: milliseconds(now.saturating_sub(self.started_at.max(last_completed_at))),
            place_ms: milliseconds(self.tasks.iter().map(|assigned| assigned.place_time).sum()),
            imbalance: max_over_mean(nodes.iter().map(|node| node.busy_ms)),
            attempts: self.attempts,
            is_healed,
            n_lost: 0,
            n_healed: 0,
            fetching: Vec::new(),
            bytes_in: nodes.iter().map(|node| node.bytes_in).sum(),
            bytes_out: 0,
            nodes,
            tasks: self.finished_tasks().collect(),
        }
    }

    /// The finished tasks and their costs.
    fn finished_tasks(&self) -> impl Iterator<Item = FrameTask> {
        self.tasks.iter().filter_map(|assigned| match &assigned.state {
            TaskState::Done { timings, costs, .. } => Some(FrameTask {
                node: assigned.node,
                task: assigned.task_part.task,
                trace_cpu_ns: 1000 * u64::from(timings.trace_cpu_us),
                costs: costs.clone(),
            }),
            _ => None,
        })
    }
}

/// The share of a task.
fn share(task: &Task, spec: FrameSpec) -> Share {
    task.share(spec.size).expect("the scheduler's tasks fit their frames")
}

/// How many samples a share has; tiles at the frame's edge count in full.
fn n_samples(share: &Share) -> u32 {
    let units = share.units();
    units.size().n_samples().min(share.count().saturating_mul(units.samples_per_full_unit()))
}

fn milliseconds(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}
