//! Which units of a frame are in their places.

use std::ops::Range;

use shared::division::{Part, Task};

use crate::farm::unit_set::UnitSet;

/// A frame as the works that it was first divided into; what was given out later are parts of those.
#[derive(Clone, Debug, Default)]
pub(super) struct Coverage {
    received_by_task: Vec<UnitSet>,
    n_missing: u32,
}

/// A part of one of the works that the frame was first divided into.
#[derive(Clone, Debug)]
pub(super) struct TaskPart {
    /// Which one, in the order in which they were added.
    share: usize,
    pub(super) task: Task,
    n_units: u32,
}

impl TaskPart {
    /// Part `index` of `n_parts` of this one.
    pub(super) fn part(&self, index: u32, n_parts: u32) -> Option<Self> {
        let n_units = self.n_units.saturating_sub(index).div_ceil(n_parts);
        Some(Self { share: self.share, task: self.task.part(index, n_parts)?, n_units })
    }
}

impl Coverage {
    /// Adds a work of so many units: together those that are added hold each unit of the frame once.
    pub(super) fn add(&mut self, task: Task, n_units: u32) -> TaskPart {
        debug_assert_eq!(task.part, Part::WHOLE, "a frame is divided into whole works");
        self.received_by_task.push(UnitSet::new(n_units));
        self.n_missing += n_units;
        TaskPart { share: self.received_by_task.len() - 1, task, n_units }
    }

    /// How many works the frame was first divided into.
    pub(super) fn n_initial_tasks(&self) -> usize {
        self.received_by_task.len()
    }

    /// Marks units of a piece, by their places in it.
    pub(super) fn mark_received(&mut self, task_part: &TaskPart, units: Range<u32>) {
        let share = &mut self.received_by_task[task_part.share];
        let n_new: u32 = runs(task_part.task.part, units).map(|run| share.insert(run)).sum();
        self.n_missing -= n_new;
    }

    /// Whether none of a piece's units is missing.
    pub(super) fn has_received_all(&self, task_part: &TaskPart) -> bool {
        let share = &self.received_by_task[task_part.share];
        share.n_missing() == 0 || runs(task_part.task.part, 0..task_part.n_units).all(|run| share.contains(run))
    }

    /// Whether no unit of the frame is missing.
    pub(super) fn is_complete(&self) -> bool {
        self.n_missing == 0
    }
}

/// Where the units of a part lie in the whole: at once, or one by one.
fn runs(Part { index, n_parts }: Part, units: Range<u32>) -> impl Iterator<Item = Range<u32>> {
    let (n_runs, n_per_run) = if n_parts == 1 { (1, units.len() as u32) } else { (units.len() as u32, 1) };
    (0..n_runs).map(move |run| {
        let first = index + (units.start + run) * n_parts;
        first..first + n_per_run
    })
}
