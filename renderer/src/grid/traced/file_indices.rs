//! The numbers that triangles have in their file, in as few bits as they need.
//!
//! Triangles that are neighbours in space lie in few parts of a file, as in a few rows of a scan, and close together in each.
//! So each [`WINDOW`] numbers are cut into runs of close ones, which count from the least of their run.

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::scene_file::{
    fault::{Damage, Fault},
    section::Section,
    sections::{SectionVisitor, expect},
};

/// Numbers that are packed together: as many as a word of flags has bits.
const WINDOW: usize = u64::BITS as usize;

/// Bits of a unit.
const UNIT: usize = u32::BITS as usize;

/// Units after the last window: eight bytes are loaded from any bit.
const UNITS_BEHIND: usize = 2;

/// Windows that are written by one job.
const WINDOWS_PER_JOB: usize = 1 << 12;

/// The number of each triangle.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct FileIndices {
    n: usize,
    /// With one more, which begins where the last one ends.
    #[serde(skip)]
    windows: Section<Window>,
    /// The bits of all windows, the first in the lowest: a flag for each number, set where a run begins; how far each number
    /// lies above the least of its run; how far that of each run lies above the window's.
    #[serde(skip)]
    units: Section<u32>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct Window {
    least: u32,
    first_unit: u32,
    widths: Widths,
}

/// How many bits numbers of a window have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct Widths {
    /// Of a number in its run.
    number: u16,
    /// Of the least number of a run.
    base: u16,
}

impl FileIndices {
    /// Packs these numbers.
    pub(super) fn new(numbers: &[u32]) -> Self {
        // Plan all windows, and place them one after the other.
        let planned = |numbers: &[u32]| {
            let (widths, n_bits) = Widths::best(numbers);
            Window { least: bounds(numbers)[0], first_unit: n_bits.div_ceil(UNIT) as u32, widths }
        };
        let mut windows: Vec<_> = numbers.par_chunks(WINDOW).map(planned).collect();
        windows.push(Window::default());
        let mut n_units = 0;
        for window in &mut windows {
            n_units += std::mem::replace(&mut window.first_unit, n_units);
        }

        // Write them.
        let mut units = vec![0; n_units as usize + UNITS_BEHIND];
        let (mut rest, mut jobs) = (&mut *units, Vec::new());
        for (nth, numbers) in numbers.chunks(WINDOWS_PER_JOB * WINDOW).enumerate() {
            let of_job = nth * WINDOWS_PER_JOB..;
            let windows = &windows[of_job][..=numbers.len().div_ceil(WINDOW)];
            let n_units = windows[windows.len() - 1].first_unit - windows[0].first_unit;
            let (units, others) = rest.split_at_mut(n_units as usize);
            jobs.push((numbers, windows, units));
            rest = others;
        }
        jobs.into_par_iter().for_each(|(numbers, windows, units)| {
            let mut to = BitWriter { units: units.iter_mut(), bits: 0, n_bits: 0 };
            numbers.chunks(WINDOW).zip(windows).for_each(|(numbers, window)| to.push_window(numbers, window));
        });
        Self { n: numbers.len(), windows: windows.into(), units: units.into() }
    }

    /// How many triangles there are.
    pub(super) fn len(&self) -> usize {
        self.n
    }

    /// The number of a triangle.
    #[inline]
    pub(super) fn get(&self, triangle: usize) -> u32 {
        let (Window { least, first_unit, widths }, nth) = (self.windows[triangle / WINDOW], triangle % WINDOW);
        let bytes = &bytemuck::cast_slice::<_, u8>(&self.units)[size_of::<u32>() * first_unit as usize..];
        let run = (bits_from(bytes, 0) << (WINDOW - 1 - nth)).count_ones() as usize - 1;
        let [number_bits, base_bits] = [widths.number, widths.base].map(usize::from);
        let number = bits_from(bytes, WINDOW + nth * number_bits) & ((1 << number_bits) - 1);
        let base = bits_from(bytes, WINDOW + WINDOW * number_bits + run * base_bits) & ((1 << base_bits) - 1);
        least.wrapping_add(base as u32).wrapping_add(number as u32)
    }

    pub(super) fn n_bytes(&self) -> usize {
        size_of_val(&*self.windows) + size_of_val(&*self.units)
    }

    pub(super) fn visit_sections<'a>(&'a mut self, visitor: &mut impl SectionVisitor<'a>) -> Result<(), Fault> {
        visitor.visit("file index windows", &mut self.windows)?;
        visitor.visit("file indices", &mut self.units)
    }

    /// Checks that there are windows for all numbers.
    pub(super) fn check_sizes(&self) -> Result<(), Damage> {
        expect(self.windows.len() == self.n.div_ceil(WINDOW) + 1, "file indices")
    }

    /// Checks that all numbers can be read.
    pub(super) fn check_contents(&self) -> Result<(), Damage> {
        let (first, last) = (self.windows[0].first_unit, self.windows[self.windows.len() - 1].first_unit);
        let are_all_there = first == 0 && self.units.len() == last as usize + UNITS_BEHIND;
        let is_sound = |(nth, pair): (usize, &[Window])| {
            let units = self.units.get(pair[0].first_unit as usize..pair[1].first_unit as usize);
            units.is_some_and(|units| pair[0].widths.are_those_of(units, (self.n - nth * WINDOW).min(WINDOW)))
        };
        expect(are_all_there && self.windows.par_windows(2).enumerate().all(is_sound), "file indices")
    }
}

impl Widths {
    /// Those with which numbers take the fewest bits, and how many bits that are.
    fn best(numbers: &[u32]) -> (Self, usize) {
        let [least, greatest] = bounds(numbers);
        let base = (u32::BITS - (greatest - least).leading_zeros()) as u16;
        let of_number = |number: u16| {
            let widths = Self { number, base };
            (widths, widths.n_bits(runs(numbers, number).count()))
        };
        (0..=base).map(of_number).min_by_key(|&(_, n_bits)| n_bits).expect("zero is among the widths")
    }

    /// Bits of a window with so many runs.
    fn n_bits(self, n_runs: usize) -> usize {
        WINDOW + WINDOW * usize::from(self.number) + n_runs * usize::from(self.base)
    }

    /// Whether these units hold the runs of so many numbers.
    fn are_those_of(self, units: &[u32], n_numbers: usize) -> bool {
        let &[low, high, ..] = units else { return false };
        let flags = u64::from(low) | u64::from(high) << UNIT;
        flags & 1 == 1
            && flags.leading_zeros() as usize + n_numbers >= WINDOW
            && usize::from(self.number.max(self.base)) <= UNIT
            && self.n_bits(flags.count_ones() as usize) <= UNIT * units.len()
    }
}

/// Cuts numbers into runs in which no two are farther apart than so many bits hold, each as long as can be.
fn runs(mut numbers: &[u32], n_bits: u16) -> impl Iterator<Item = &[u32]> {
    std::iter::from_fn(move || {
        let first = *numbers.first()?;
        let (mut least, mut greatest) = (first, first);
        let is_near = |&&number: &&u32| {
            (least, greatest) = (least.min(number), greatest.max(number));
            u64::from(greatest - least) >> n_bits == 0
        };
        let (run, others) = numbers.split_at(numbers.iter().take_while(is_near).count());
        numbers = others;
        Some(run)
    })
}

/// The least and the greatest number.
fn bounds(numbers: &[u32]) -> [u32; 2] {
    numbers.iter().fold([u32::MAX, 0], |[least, greatest], &number| [least.min(number), greatest.max(number)])
}

/// The bits from one on, of which 57 are valid.
#[inline]
fn bits_from(bytes: &[u8], first_bit: usize) -> u64 {
    let eight = bytes[first_bit / 8..].first_chunk();
    u64::from_le_bytes(*eight.expect("some units follow the last window")) >> (first_bit % 8)
}

/// Writes numbers of a few bits one after the other.
struct BitWriter<'a> {
    units: std::slice::IterMut<'a, u32>,
    /// The bits of the present unit, and how many there are.
    bits: u64,
    n_bits: usize,
}

impl BitWriter<'_> {
    /// Appends flags, numbers and bases: see [`FileIndices::units`].
    fn push_window(&mut self, numbers: &[u32], window: &Window) {
        let runs = || runs(numbers, window.widths.number);
        for run in runs() {
            (0..run.len()).for_each(|nth| self.push(u32::from(nth == 0), 1));
        }
        (numbers.len()..WINDOW).for_each(|_| self.push(0, 1));
        for run in runs() {
            let base = bounds(run)[0];
            run.iter().for_each(|number| self.push(number - base, window.widths.number));
        }
        (numbers.len()..WINDOW).for_each(|_| self.push(0, window.widths.number));
        runs().for_each(|run| self.push(bounds(run)[0] - window.least, window.widths.base));
        if self.n_bits > 0 {
            self.end_unit();
        }
    }

    /// Appends a number of up to 32 bits.
    fn push(&mut self, number: u32, n_bits: u16) {
        self.bits |= u64::from(number) << self.n_bits;
        self.n_bits += usize::from(n_bits);
        if self.n_bits >= UNIT {
            self.end_unit();
        }
    }

    fn end_unit(&mut self) {
        *self.units.next().expect("as many units as were planned") = self.bits as u32;
        self.bits >>= UNIT;
        self.n_bits = self.n_bits.saturating_sub(UNIT);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_come_back_whether_near_or_far() {
        let n = 300_003;
        let rising: Vec<u32> = (0..n).collect();
        let far: Vec<u32> = (0..n).map(|k| k.wrapping_mul(2_654_435_761)).collect();
        let extremes: Vec<u32> = (0..n).map(|k| if k % 3 == 0 { u32::MAX } else { 0 }).collect();
        let widths: Vec<u32> = (0..n).map(|k| u32::MAX - (k.wrapping_mul(40_503) >> (k / 64 % 32))).collect();
        let rows: Vec<u32> = (0..n).map(|k| k / 64 * 4 + k % 4 + k / 4 % 16 * 50_000).collect();
        for numbers in [rising, far, extremes, widths, rows, vec![5; 64], vec![u32::MAX], Vec::new()] {
            let packed = FileIndices::new(&numbers);
            assert_eq!(packed.len(), numbers.len());
            assert!(numbers.iter().enumerate().all(|(triangle, &number)| packed.get(triangle) == number));
            packed.check_sizes().unwrap();
            packed.check_contents().unwrap();
        }
    }

    #[test]
    fn near_numbers_take_few_bits() {
        let n_bits = |numbers: &[u32]| UNIT * (FileIndices::new(numbers).units.len() - UNITS_BEHIND);
        assert_eq!(n_bits(&[9; 6400]), 100 * WINDOW);
        // Four numbers from each of sixteen rows.
        let rows: Vec<u32> = (0..64).map(|k| k % 4 + k / 4 * 5000).collect();
        assert_eq!(n_bits(&rows), (WINDOW + WINDOW * 2 + 16 * 17).next_multiple_of(UNIT));
    }

    #[test]
    fn numbers_that_are_not_there_are_found() {
        let sound = || FileIndices::new(&(0..1000).collect::<Vec<_>>());
        sound().check_contents().unwrap();
        assert!(FileIndices { n: 1025, ..sound() }.check_sizes().is_err());
        assert!(FileIndices { units: Section::default(), ..sound() }.check_contents().is_err());
        let changes: [fn(&mut Window); 5] = [
            |window| window.first_unit += 1,
            |window| window.first_unit = u32::MAX,
            |window| window.widths.number += 1,
            |window| window.widths.base += 1,
            |window| window.widths = Widths { number: 0, base: 33 },
        ];
        for (nth, change) in changes.into_iter().enumerate() {
            let mut windows = sound().windows.to_vec();
            change(&mut windows[3]);
            assert!(FileIndices { windows: windows.into(), ..sound() }.check_contents().is_err(), "{nth}");
        }
        // No run at first, and one behind the last number.
        let last = sound().windows[15].first_unit as usize;
        for (unit, bit) in [(0, 0), (last + 1, 31)] {
            let mut units = sound().units.to_vec();
            units[unit] ^= 1 << bit;
            assert!(FileIndices { units: units.into(), ..sound() }.check_contents().is_err(), "{unit}");
        }
    }
}
