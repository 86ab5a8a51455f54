//! A frame in flight: its tasks, and which of its samples have arrived.

use std::time::Duration;

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
}

/// A task that was given to a node, and its state.
#[derive(Debug)]
struct AssignedTask {
    id: TaskId,
    node: NodeId,
    name: String,
    threads: u32,
    task_part: TaskPart,
    encoding: Encoding,
    sent_at: Time,
    state: TaskState,
    n_bytes: u64,
    place_time: Duration,
}

#[derive(Debug)]
enum TaskState {
    Running,
    /// Its node is silent, and no other has it yet.
    Silent,
    /// Late, or its node is silent; others have it as well.
    Duplicated,
    Done {
        at: Time,
        /// Time since it was sent and its node had nothing else to do.
        took: Duration,
        timings: TaskTimings,
        costs: RunCosts,
    },
    /// Its node is lost, and no other has it yet.
    Lost,
    /// Its node is lost, and others have it.
    Reassigned,
}

impl FrameInFlight {
    pub(super) fn new(id: FrameId, spec: FrameSpec, is_refinement: bool, division: Division, now: Time) -> Self {
        let (coverage, tasks) = (Coverage::default(), Vec::new());
        Self { id, spec, is_refinement, attempts: 1, division, started_at: now, completed_at: None, coverage, tasks }
    }

    /// Adds one of the tasks that the frame is first divided into.
    pub(super) fn add(&mut self, task: Task) -> TaskPart {
        let n_units = share(&task, self.spec).count();
        self.coverage.add(task, n_units)
    }

    pub(super) fn assign(
        &mut self,
        now: Time,
        id: TaskId,
        node: NodeId,
        (name, threads): (String, u32),
        task_part: TaskPart,
        encoding: Encoding,
    ) {
        self.tasks.push(AssignedTask {
            id,
            node,
            name,
            threads,
            task_part,
            encoding,
            sent_at: now,
            state: TaskState::Running,
            n_bytes: 0,
            place_time: Duration::ZERO,
        });
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
            assigned.state = TaskState::Lost;
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

    /// Marks a node as silent: it may still answer, but others will get its tasks. Or as heard again: it keeps the tasks
    /// that no other has.
    pub(super) fn set_silent(&mut self, node: NodeId, is_silent: bool) {
        for assigned in self.tasks.iter_mut().filter(|assigned| assigned.node == node) {
            match assigned.state {
                TaskState::Running if is_silent => assigned.state = TaskState::Silent,
                TaskState::Silent if !is_silent => assigned.state = TaskState::Running,
                _ => {}
            }
        }
    }

    pub(super) fn mark_lost(&mut self, node: NodeId) {
        for assigned in self.tasks.iter_mut().filter(|assigned| assigned.node == node) {
            assigned.state = match assigned.state {
                TaskState::Running | TaskState::Silent => TaskState::Lost,
                TaskState::Duplicated => TaskState::Reassigned,
                _ => continue,
            };
        }
    }

    /// The incomplete tasks of lost and silent nodes; the caller must give them to others.
    pub(super) fn take_lost_tasks(&mut self) -> Vec<TaskPart> {
        let mut missing = Vec::new();
        for assigned in &mut self.tasks {
            assigned.state = match assigned.state {
                TaskState::Lost => TaskState::Reassigned,
                TaskState::Silent => TaskState::Duplicated,
                _ => continue,
            };
            if !self.coverage.has_received_all(&assigned.task_part) {
                missing.push(assigned.task_part.clone());
            }
        }
        missing
    }

    /// The oldest late task; the caller must give it to others as well.
    ///
    /// `free_at`: since when a node has had only tasks of this frame; `None` if it is busy with an earlier one.
    pub(super) fn take_late_task(&mut self, now: Time, free_at: impl Fn(NodeId) -> Option<Time>) -> Option<TaskPart> {
        let slowest = self.tasks.iter().filter_map(|assigned| match assigned.state {
            TaskState::Done { took, .. } => Some(took),
            _ => None,
        });
        let late_after = (slowest.max()? * LATE_FACTOR).max(LEAST_LATENESS);
        let is_late = |assigned: &&mut AssignedTask| {
            matches!(assigned.state, TaskState::Running)
                && free_at(assigned.node)
                    .is_some_and(|free_at| now.saturating_sub(assigned.sent_at.max(free_at)) > late_after)
        };
        let late = self.tasks.iter_mut().find(is_late)?;
        late.state = TaskState::Duplicated;
        Some(late.task_part.clone())
    }

    /// Whether any samples have arrived.
    pub(super) fn has_begun(&self) -> bool {
        self.tasks.iter().any(|assigned| assigned.n_bytes > 0)
    }

    pub(super) fn busy_nodes(&self) -> impl Iterator<Item = NodeId> {
        let is_at_work = |assigned: &&AssignedTask| {
            matches!(assigned.state, TaskState::Running | TaskState::Silent | TaskState::Duplicated)
        };
        self.tasks.iter().filter(is_at_work).map(|assigned| assigned.node)
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
        FrameStats {
            frame: self.id.0,
            size: self.spec.size,
            division: self.division,
            render_ms: milliseconds(now - self.started_at),
            interval_ms: milliseconds(now.saturating_sub(self.started_at.max(last_completed_at))),
            place_ms: milliseconds(self.tasks.iter().map(|assigned| assigned.place_time).sum()),
            imbalance: max_over_mean(nodes.iter().map(|node| node.busy_ms)),
            attempts: self.attempts,
            n_lost: 0,
            n_healed: 0,
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
