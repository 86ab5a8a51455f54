//! Sorts triangles into equal cubes: a list of triangles for each cube, in parallel over the triangles.

use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::{
    grid::{
        cells::CellSpace,
        tree::overlap::{self, DILATION},
    },
    model::mesh::Mesh,
};

const TRIANGLES_PER_JOB: usize = 1 << 14;

/// Pairs of triangle and cube that a job finds between updates of the shared count.
const PAIRS_PER_REPORT: u64 = 1 << 12;

pub(crate) struct Scatter<'a> {
    pub(crate) mesh: &'a Mesh,
    pub(crate) space: CellSpace,
    /// Side of a cube, in finest cells.
    pub(crate) cube_size: u32,
    pub(crate) dims: [u32; 3],
}

impl Scatter<'_> {
    /// The corners of a triangle in finest cells, or `None` if it was rejected or two of its corners are equal.
    ///
    /// No ray hits the latter; a polygon can have millions of them in one point, which no division separates.
    #[inline]
    pub(crate) fn corners(&self, triangle: u32) -> Option<[DVec3; 3]> {
        let [a, b, c] = self.mesh.corners(triangle as usize)?;
        if a == b || b == c || c == a {
            return None;
        }
        let point = |corner| self.space.point_to_cells(Vec3::from_array(corner).as_dvec3());
        Some([point(a), point(b), point(c)])
    }

    /// Calls `visit` with every cube and each triangle that overlaps it, in parallel and in any order.
    /// Returns the number of pairs; stops early with `None` if there are more than `most_pairs`.
    pub(crate) fn for_each_pair(&self, most_pairs: u64, visit: impl Fn([u32; 3], u32) + Sync) -> Option<u64> {
        let n_triangles = self.mesh.triangles.len();
        let scale = 1.0 / f64::from(self.cube_size);
        let total = AtomicU64::new(0);
        let all = (0..n_triangles.div_ceil(TRIANGLES_PER_JOB)).into_par_iter().all(|job_idx| {
            let end = ((job_idx + 1) * TRIANGLES_PER_JOB).min(n_triangles);
            let mut n_pairs = 0;
            for triangle in (job_idx * TRIANGLES_PER_JOB) as u32..end as u32 {
                let Some(corners) = self.corners(triangle) else { continue };
                overlap::for_each_cube(
                    &overlap::corners_in_cube(&corners, [0; 3], scale),
                    DILATION * scale,
                    self.dims,
                    |cube| {
                        n_pairs += 1;
                        visit(cube, triangle);
                    },
                );
                if n_pairs > PAIRS_PER_REPORT {
                    if total.fetch_add(n_pairs, Relaxed) > most_pairs {
                        return false;
                    }
                    n_pairs = 0;
                }
            }
            total.fetch_add(n_pairs, Relaxed) <= most_pairs
        });
        let total = total.into_inner();
        (all && total <= most_pairs).then_some(total)
    }

    /// The number of triangles in each list, at the list's index + 1; `None` if there are more than `most_pairs` in
    /// all. `list` maps a cube to its list.
    pub(crate) fn count(
        &self,
        n_lists: usize,
        most_pairs: u64,
        list: impl Fn([u32; 3]) -> usize + Sync,
    ) -> Option<Vec<AtomicU32>> {
        let counts: Vec<_> = (0..=n_lists).into_par_iter().map(|_| AtomicU32::new(0)).collect();
        self.for_each_pair(most_pairs, |cube, _| {
            counts[list(cube) + 1].fetch_add(1, Relaxed);
        })?;
        Some(counts)
    }

    /// Fills the counted lists, each in random order: returns their starts, with the last's end, and the triangles.
    pub(crate) fn fill(&self, counts: Vec<AtomicU32>, list: impl Fn([u32; 3]) -> usize + Sync) -> (Vec<u32>, Vec<u32>) {
        let mut total = 0;
        for count in &counts[1..] {
            total += count.swap(total, Relaxed);
        }
        // Entry n + 1 begins as the start of list n, and ends as its end.
        let ends = counts;
        // In parallel: the first write to fresh memory waits for page faults.
        let filled: Vec<_> = (0..total).into_par_iter().map(|_| AtomicU32::new(0)).collect();
        self.for_each_pair(u64::MAX, |cube, triangle| {
            filled[ends[list(cube) + 1].fetch_add(1, Relaxed) as usize].store(triangle, Relaxed);
        });
        let into_plain = |atomics: Vec<AtomicU32>| atomics.into_iter().map(AtomicU32::into_inner).collect();
        (into_plain(ends), into_plain(filled))
    }
}

const LISTS_PER_JOB: usize = 1 << 14;

pub(crate) fn sort_lists(starts: &[u32], references: &mut [u32]) {
    let mut jobs = Vec::new();
    let mut rest = references;
    for first in (0..starts.len() - 1).step_by(LISTS_PER_JOB) {
        let starts = &starts[first..starts.len().min(first + LISTS_PER_JOB + 1)];
        let (these, others) = rest.split_at_mut((starts[starts.len() - 1] - starts[0]) as usize);
        jobs.push((starts, these));
        rest = others;
    }
    jobs.into_par_iter().for_each(|(starts, references)| {
        for bounds in starts.windows(2) {
            references[(bounds[0] - starts[0]) as usize..(bounds[1] - starts[0]) as usize].sort_unstable();
        }
    });
}
