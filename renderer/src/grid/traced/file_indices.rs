//! The numbers of triangles in their file, in two bytes each.
//!
//! Neighbours in space mostly have numbers that are close, so each [`WINDOW`] triangles count from the least of theirs. Where
//! numbers lie farther apart, they are in a list.

use rayon::prelude::*;

use crate::scene_file::{
    fault::{Damage, Fault},
    section::Section,
    sections::{SectionVisitor, expect},
};

/// Triangles that count from the same number.
const WINDOW: usize = 32;

/// In place of the differences of a window whose numbers are in the list.
const FAR: u16 = u16::MAX;

/// The numbers of all triangles.
#[derive(Debug, Default)]
pub(super) struct FileIndices {
    /// Of each triangle's number from its window's first, or [`FAR`].
    differences: Section<u16>,
    /// The least number of each window; or, where numbers lie far apart, the place of the window's in the list.
    firsts: Section<u32>,
    /// The numbers of windows in which they lie far apart.
    far: Section<u32>,
}

impl FileIndices {
    /// Bytes for each triangle, rounded up, but for numbers that lie far apart.
    pub(super) const BYTES_PER_TRIANGLE: u64 = 3;

    /// The numbers of triangles in this order.
    pub(super) fn new(numbers: &[u32]) -> Self {
        let mut differences = vec![0; numbers.len()];
        let mut far = Vec::new();
        let in_window = |(numbers, differences): (&[u32], &mut [u16])| {
            let first = numbers.iter().min().copied().unwrap_or_default();
            let last = numbers.iter().max().copied().unwrap_or_default();
            if last - first < FAR.into() {
                differences
                    .iter_mut()
                    .zip(numbers)
                    .for_each(|(difference, number)| *difference = (number - first) as u16);
                return first;
            }
            far.extend(numbers);
            differences.fill(FAR);
            (far.len() - numbers.len()) as u32
        };
        let firsts: Vec<u32> = numbers.chunks(WINDOW).zip(differences.chunks_mut(WINDOW)).map(in_window).collect();
        far.shrink_to_fit();
        Self { differences: differences.into(), firsts: firsts.into(), far: far.into() }
    }

    /// The number of triangles.
    pub(super) fn len(&self) -> usize {
        self.differences.len()
    }

    /// The number of a triangle.
    #[inline]
    pub(super) fn of(&self, triangle_idx: u32) -> u32 {
        let triangle_idx = triangle_idx as usize;
        let first = self.firsts[triangle_idx / WINDOW];
        match self.differences[triangle_idx] {
            FAR => self.far[first as usize + triangle_idx % WINDOW],
            difference => first.wrapping_add(difference.into()),
        }
    }

    pub(super) fn n_bytes(&self) -> usize {
        size_of_val(&*self.differences) + size_of_val(&*self.firsts) + size_of_val(&*self.far)
    }

    pub(super) fn visit_sections<'a>(&'a mut self, visitor: &mut impl SectionVisitor<'a>) -> Result<(), Fault> {
        visitor.visit("file indices", &mut self.differences)?;
        visitor.visit("first file indices", &mut self.firsts)?;
        visitor.visit("far file indices", &mut self.far)
    }

    pub(super) fn check_sizes(&self) -> Result<(), Damage> {
        expect(self.firsts.len() == self.len().div_ceil(WINDOW), "file indices")
    }

    /// Checks that all numbers that should be in the list are there.
    pub(super) fn check_contents(&self) -> Result<(), Damage> {
        let are_there = |(differences, &first): (&[u16], &u32)| {
            !differences.contains(&FAR) || first as usize + differences.len() <= self.far.len()
        };
        expect(self.differences.par_chunks(WINDOW).zip(self.firsts.par_iter()).all(are_there), "file indices")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_come_back_whether_near_or_far() {
        let n = 200_003;
        let near: Vec<u32> = (0..n).rev().collect();
        let far: Vec<u32> = (0..n).map(|k| k.wrapping_mul(40_503) % n).collect();
        let edge: Vec<u32> = (0..n).map(|k| u32::MAX - 2 - (k % 2) * 65_534).collect();
        let beyond: Vec<u32> = (0..n).map(|k| u32::MAX - 2 - (k % 2) * 65_535).collect();
        for (numbers, are_far) in [(near, false), (far, true), (edge, false), (beyond, true), (Vec::new(), false)] {
            let mut indices = FileIndices::new(&numbers);
            assert!((0..).zip(&numbers).all(|(triangle_idx, &number)| indices.of(triangle_idx) == number));
            assert_eq!((indices.len(), indices.far.is_empty()), (numbers.len(), !are_far));
            indices.check_sizes().unwrap();
            indices.check_contents().unwrap();
            if are_far {
                indices.far = indices.far[1..].to_vec().into();
                assert!(indices.check_contents().is_err());
            }
        }
    }
}
