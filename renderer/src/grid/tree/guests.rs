//! The triangle indices of guests, in as few bits as they need.
//!
//! Neighbours in space mostly have close indices, so each [`WINDOW`] of them count from the least, all in as many bits as the
//! greatest needs. In runs, as the numbers in a file, they would take a third less, and single rays 3 to 5 % longer.

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::scene_file::{
    fault::{Damage, Fault},
    section::Section,
    sections::{SectionVisitor, expect},
};

/// Numbers that count from the same one; so many differences fill as many words as each has bits.
const WINDOW: usize = u64::BITS as usize;

/// The triangle index of each guest.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Guests {
    n: usize,
    /// With one more, whose first word is the end of the last one's.
    #[serde(skip)]
    windows: Section<Window>,
    /// The differences, the first in the lowest bits, and one word more: eight bytes are loaded from any difference's first.
    #[serde(skip)]
    words: Section<u64>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct Window {
    least: u32,
    /// There are as many words as a difference has bits.
    first_word: u32,
}

impl Guests {
    /// Packs these triangle indices.
    pub(super) fn new(numbers: &[u32]) -> Self {
        let window_of = |numbers: &[u32]| {
            let (least, greatest) = numbers.iter().fold((u32::MAX, 0), |(a, b), &it| (a.min(it), b.max(it)));
            let n_words = u32::BITS - (greatest - least).leading_zeros();
            Window { least, first_word: n_words }
        };
        let mut windows: Vec<Window> = numbers.par_chunks(WINDOW).map(window_of).collect();
        windows.push(Window::default());
        let mut n_words = 0;
        for window in &mut windows {
            n_words += std::mem::replace(&mut window.first_word, n_words);
        }

        let mut words = vec![0; n_words as usize + 1];
        for (numbers, window) in numbers.chunks(WINDOW).zip(windows.windows(2)) {
            let n_bits = (window[1].first_word - window[0].first_word) as usize;
            let words = &mut words[window[0].first_word as usize..];
            for (nth, number) in numbers.iter().enumerate() {
                let (word, shift) = (nth * n_bits / 64, nth * n_bits % 64);
                let difference = u64::from(number - window[0].least);
                words[word] |= difference << shift;
                if shift + n_bits > 64 {
                    words[word + 1] |= difference >> (64 - shift);
                }
            }
        }
        Self { n: numbers.len(), windows: windows.into(), words: words.into() }
    }

    /// How many guests there are.
    pub(super) fn len(&self) -> usize {
        self.n
    }

    /// The triangle index of a guest.
    #[inline]
    pub(super) fn get(&self, guest: usize) -> u32 {
        let (window, next) = (self.windows[guest / WINDOW], self.windows[guest / WINDOW + 1]);
        let n_bits = (next.first_word - window.first_word) as usize;
        let first_bit = guest % WINDOW * n_bits;
        let first_byte = size_of::<u64>() * window.first_word as usize + first_bit / 8;
        let bytes = bytemuck::cast_slice::<_, u8>(&self.words)[first_byte..].first_chunk();
        let differences = u64::from_le_bytes(*bytes.expect("a word follows the last"));
        let difference = differences >> (first_bit % 8) & ((1 << n_bits) - 1);
        window.least.wrapping_add(difference as u32)
    }

    pub(super) fn n_bytes(&self) -> usize {
        size_of_val(&*self.windows) + size_of_val(&*self.words)
    }

    pub(super) fn visit_sections<'a>(&'a mut self, visitor: &mut impl SectionVisitor<'a>) -> Result<(), Fault> {
        visitor.visit("guest windows", &mut self.windows)?;
        visitor.visit("guests", &mut self.words)
    }

    /// Checks that there are windows for all guests.
    pub(super) fn check_sizes(&self) -> Result<(), Damage> {
        expect(self.windows.len() == self.n.div_ceil(WINDOW) + 1, "guests")
    }

    /// Checks that all numbers can be read.
    pub(super) fn check_contents(&self) -> Result<(), Damage> {
        let follow = |pair: &[Window]| {
            let n_words = pair[1].first_word.checked_sub(pair[0].first_word);
            n_words.is_some_and(|n_words| n_words <= u32::BITS)
        };
        let (first, last) = (self.windows[0].first_word, self.windows[self.windows.len() - 1].first_word);
        let are_all_there = first == 0 && self.words.len() == last as usize + 1;
        expect(are_all_there && self.windows.par_windows(2).all(follow), "guests")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_come_back_whether_near_or_far() {
        let n = 20_003;
        let rising: Vec<u32> = (0..n).collect();
        let far: Vec<u32> = (0..n).map(|k| k.wrapping_mul(2_654_435_761)).collect();
        let extremes: Vec<u32> = (0..n).map(|k| if k % 3 == 0 { u32::MAX } else { 0 }).collect();
        let widths: Vec<u32> = (0..n).map(|k| u32::MAX - (k.wrapping_mul(40_503) >> (k / 64 % 32))).collect();
        let mostly_equal: Vec<u32> = (0..n).map(|k| 7 + u32::from(k > 10_000)).collect();
        for numbers in [rising, far, extremes, widths, mostly_equal, vec![5; 64], vec![u32::MAX], Vec::new()] {
            let packed = Guests::new(&numbers);
            assert_eq!(packed.len(), numbers.len());
            assert!(numbers.iter().enumerate().all(|(index, &number)| packed.get(index) == number));
            packed.check_sizes().unwrap();
            packed.check_contents().unwrap();
        }
    }

    #[test]
    fn near_numbers_take_few_bits() {
        assert_eq!(Guests::new(&[9; 6400]).n_bytes(), 101 * 8 + 8);
        let rising: Vec<u32> = (0..6400).collect();
        assert_eq!(Guests::new(&rising).n_bytes(), 101 * 8 + (100 * 6 + 1) * 8);
    }

    #[test]
    fn numbers_that_are_not_there_are_found() {
        let sound = || Guests::new(&(0..1000).collect::<Vec<_>>());
        assert!(Guests { n: 1025, ..sound() }.check_sizes().is_err());
        assert!(Guests { words: Section::default(), ..sound() }.check_contents().is_err());
        for (index, first_word) in [(0, 6), (3, 5), (3, 57)] {
            let mut windows = sound().windows.to_vec();
            windows[index].first_word = first_word;
            assert!(Guests { windows: windows.into(), ..sound() }.check_contents().is_err());
        }
    }
}
