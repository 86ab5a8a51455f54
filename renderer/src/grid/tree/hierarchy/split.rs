//! Splits of leaves or triangles in two, by the surface area heuristic.

use glam::Vec3A;

use super::{BoundedItem, Bounds, CHILDREN};

/// Most leaves of which every split is compared; with more, those between 16 bins are. With these alone, triangle nodes take a
/// tenth more memory.
const FEW_LEAVES: usize = 1024;

/// Leaves for which a node takes memory, however few it holds: inner nodes are few beside their leaves.
pub(super) const fn granule<const OF_TRIANGLES: bool>() -> usize {
    if OF_TRIANGLES { CHILDREN } else { 1 }
}

/// A split of a part in two.
pub(super) struct Split {
    axis: usize,
    /// Leaves on the low side.
    n_low: usize,
    /// Sum over both sides of area times the leaves that count.
    cost: f32,
}

impl Split {
    /// Halves along the longest axis.
    pub(super) fn half(n: usize, bounds: &Bounds) -> Self {
        let axis = (bounds.high - bounds.low).max_position();
        Self { axis, n_low: n / 2, cost: f32::INFINITY }
    }

    /// Orders leaves by side; returns how many are on the low one.
    pub(super) fn apply(&self, leaves: &mut [BoundedItem]) -> usize {
        let along = |leaf: &BoundedItem| leaf.bounds.centre()[self.axis];
        leaves.select_nth_unstable_by(self.n_low, |a, b| along(a).total_cmp(&along(b)));
        self.n_low
    }

    /// The best split along any axis: of all, or, with many leaves, of those between 16 bins.
    ///
    /// A node below takes memory for a multiple of `granule` leaves, and so many count.
    pub(super) fn best(leaves: &[BoundedItem], granule: usize) -> Self {
        let (mut low, mut high) = (Vec3A::INFINITY, Vec3A::NEG_INFINITY);
        for leaf in leaves {
            (low, high) = (low.min(leaf.bounds.centre()), high.max(leaf.bounds.centre()));
        }
        let mut best = Self::half(leaves.len(), &Bounds { low, high });
        for axis in 0..3 {
            let bins =
                if leaves.len() <= FEW_LEAVES { Bin::each(leaves, axis) } else { Bin::sort(leaves, axis, low, high) };
            best.compare(axis, &bins, leaves.len(), granule);
        }
        best
    }

    /// Takes the best of the splits between the bins of `n` leaves along an axis, if it is better.
    fn compare(&mut self, axis: usize, bins: &[Bin], n: usize, granule: usize) {
        let mut areas_above = vec![0.0; bins.len()];
        let mut above = Bounds::EMPTY;
        for bin in (1..bins.len()).rev() {
            above = above.with(&bins[bin].bounds);
            areas_above[bin] = above.half_area();
        }
        let (mut n_low, mut below) = (0, Bounds::EMPTY);
        for bin in 1..bins.len() {
            (n_low, below) = (n_low + bins[bin - 1].n, below.with(&bins[bin - 1].bounds));
            // Where nothing has a surface, nodes are still worth saving.
            let cost_of = |area: f32, n: usize| area.max(f32::MIN_POSITIVE) * n.next_multiple_of(granule) as f32;
            let cost = cost_of(below.half_area(), n_low) + cost_of(areas_above[bin], n - n_low);
            if cost < self.cost && n_low > 0 && n_low < n {
                *self = Self { axis, n_low, cost };
            }
        }
    }
}

/// Leaves between two splits.
struct Bin {
    n: usize,
    bounds: Bounds,
}

impl Bin {
    /// A bin for each leaf, in their order along an axis.
    fn each(leaves: &[BoundedItem], axis: usize) -> Vec<Self> {
        let mut order: Vec<_> = (0..).zip(leaves).map(|(leaf, item)| (item.bounds.centre()[axis], leaf)).collect();
        order.sort_unstable_by(|(a, _): &(f32, u32), (b, _)| a.total_cmp(b));
        order.into_iter().map(|(_, leaf)| Self { n: 1, bounds: leaves[leaf as usize].bounds }).collect()
    }

    /// Sorts leaves, whose centres have these bounds, into bins of equal width along an axis.
    fn sort(leaves: &[BoundedItem], axis: usize, low: Vec3A, high: Vec3A) -> Vec<Self> {
        const N_BINS: usize = 16;
        let bins_per_unit = N_BINS as f32 / (high[axis] - low[axis]).max(N_BINS as f32 * f32::MIN_POSITIVE);
        let mut bins: Vec<_> = (0..N_BINS).map(|_| Self { n: 0, bounds: Bounds::EMPTY }).collect();
        for leaf in leaves {
            let bin = ((leaf.bounds.centre()[axis] - low[axis]) * bins_per_unit) as usize;
            let Self { n, bounds } = &mut bins[bin.min(N_BINS - 1)];
            (*n, *bounds) = (*n + 1, bounds.with(&leaf.bounds));
        }
        bins
    }
}
