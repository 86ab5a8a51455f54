//! Steps of an alignment that can be undone and redone.

use std::collections::VecDeque;

/// The corners of some projectors, by index; see [`crate::wall::Projector::warp_px`].
pub(super) type Corners = Vec<(usize, [[f64; 2]; 4])>;

/// Older steps are forgotten.
const MOST_STEPS: usize = 256;

/// The corners that each step replaced.
#[derive(Clone, Debug, Default)]
pub(super) struct History {
    pub(super) done: VecDeque<Corners>,
    pub(super) undone: Vec<Corners>,
}

impl History {
    /// Adds a new step; what was undone before it cannot be redone any more.
    pub(super) fn add(&mut self, replaced: Corners) {
        self.undone.clear();
        self.add_done(replaced);
    }

    pub(super) fn add_done(&mut self, replaced: Corners) {
        if self.done.len() == MOST_STEPS {
            self.done.pop_front();
        }
        self.done.push_back(replaced);
    }
}
