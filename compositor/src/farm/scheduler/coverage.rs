//! Which units of a frame have arrived.

use std::ops::Range;

use fixedbitset::FixedBitSet;
use shared::division::{Part, Task};

/// The tasks that a frame was first divided into, and which of their units have arrived. Tasks that were given out later
/// are parts of those.
#[derive(Clone, Debug, Default)]
pub(super) struct Coverage {
    received_by_task: Vec<FixedBitSet>,
    n_missing: usize,
}

/// A part of one of the tasks that the frame was first divided into.
#[derive(Clone, Debug)]
pub(super) struct TaskPart {
    /// Index of that task, in the order of [`Coverage::add`].
    initial_task: usize,
    pub(super) task: Task,
    n_units: u32,
}

impl TaskPart {
    /// Part `index` of `n_parts` of this one.
    pub(super) fn part(&self, index: u32, n_parts: u32) -> Self {
        let n_units = self.n_units.saturating_sub(index).div_ceil(n_parts);
        let task = self.task.part(index, n_parts).expect("parts hold units, so there are no more than the frame has");
        Self { task, n_units, ..*self }
    }
}

impl Coverage {
    /// Adds a task of `n_units` units. Together, the added tasks hold each unit of the frame once.
    pub(super) fn add(&mut self, task: Task, n_units: u32) -> TaskPart {
        debug_assert_eq!(task.part, Part::WHOLE, "a frame is divided into whole tasks");
        self.received_by_task.push(FixedBitSet::with_capacity(n_units as usize));
        self.n_missing += n_units as usize;
        TaskPart { initial_task: self.received_by_task.len() - 1, task, n_units }
    }

    /// The number of tasks that the frame was first divided into.
    pub(super) fn n_initial_tasks(&self) -> usize {
        self.received_by_task.len()
    }

    /// Marks units as received, given by their indices in the part.
    pub(super) fn mark_received(&mut self, task_part: &TaskPart, units: Range<u32>) {
        let received = &mut self.received_by_task[task_part.initial_task];
        for run in runs(task_part.task.part, units) {
            self.n_missing -= received.count_zeroes(run.clone());
            received.insert_range(run);
        }
    }

    /// The part of the frame's units that have arrived, in percent.
    pub(super) fn percent(&self) -> u8 {
        let n_units: usize = self.received_by_task.iter().map(FixedBitSet::len).sum();
        (100 * (n_units - self.n_missing) / n_units.max(1)) as u8
    }

    /// Whether every unit of a part has arrived.
    pub(super) fn has_received_all(&self, task_part: &TaskPart) -> bool {
        let received = &self.received_by_task[task_part.initial_task];
        runs(task_part.task.part, 0..task_part.n_units).all(|run| received.contains_all_in_range(run))
    }

    /// Whether every unit of the frame has arrived.
    pub(super) fn is_complete(&self) -> bool {
        self.n_missing == 0
    }
}

/// The indices in the whole task of a part's units: one run if the part is the whole, otherwise one run for each unit.
fn runs(Part { index, n_parts }: Part, units: Range<u32>) -> impl Iterator<Item = Range<usize>> {
    let (n_runs, n_per_run) = if n_parts == 1 { (1, units.len() as u32) } else { (units.len() as u32, 1) };
    (0..n_runs).map(move |run| {
        let first = index + (units.start + run) * n_parts;
        first as usize..(first + n_per_run) as usize
    })
}
