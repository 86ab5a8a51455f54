//! The triangles in leaves.
//!
//! The leaves of a tree have items, leaf after leaf. An item is a triangle that lies in no leaf before, or a guest, which lies
//! in one. The former make the order of the mesh, so their triangle indices are counted, and only guests have a list. A bit
//! tells which an item is, and sums of bits which guest: Jacobson, "Space-efficient Static Trees and Graphs" (1989).

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{
    grid::tree::guests::Guests,
    scene_file::{
        fault::{Damage, Fault},
        section::Section,
        sections::{SectionVisitor, expect},
    },
    simd::Simd,
};

/// The items of all leaves.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Items {
    #[serde(skip)]
    words: Section<Word>,
    guests: Guests,
}

/// Sixty-four items.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct Word {
    /// A bit for each guest, the first 32 items before the others: a `u64` would bring four bytes of padding.
    are_guests: [u32; 2],
    /// Guests before these items.
    n_before: u32,
}

impl Word {
    /// A bit for each guest.
    #[inline(always)]
    fn guests(self) -> u64 {
        u64::from(self.are_guests[0]) | u64::from(self.are_guests[1]) << 32
    }
}

impl Items {
    /// The items of leaves that list these triangles, by their number in a file of so many. Returns the order of the mesh, by
    /// the same numbers, too.
    pub(crate) fn new(mut listed: Vec<u32>, n_in_file: usize) -> (Self, Vec<u32>) {
        let mut triangle_indices = vec![u32::MAX; n_in_file];
        let mut words = Vec::with_capacity(listed.len().div_ceil(64));
        let mut guests = Vec::new();
        // The order takes the place of the list: no more is written of it than was read.
        let mut n_triangles = 0;
        for item in 0..listed.len() {
            if item % 64 == 0 {
                words.push(Word { n_before: guests.len() as u32, ..Word::default() });
            }
            let number = listed[item];
            let triangle_idx = &mut triangle_indices[number as usize];
            if *triangle_idx == u32::MAX {
                *triangle_idx = n_triangles as u32;
                listed[n_triangles] = number;
                n_triangles += 1;
            } else {
                words[item / 64].are_guests[item % 64 / 32] |= 1 << (item % 32);
                guests.push(*triangle_idx);
            }
        }
        listed.truncate(n_triangles);
        listed.shrink_to_fit();
        (Self { words: words.into(), guests: Guests::new(&guests) }, listed)
    }

    pub(crate) fn n_bytes(&self) -> usize {
        size_of_val(&*self.words) + self.guests.n_bytes()
    }

    /// The triangle index of an item.
    //
    // The branch pays: to read a guest for every item, so that there is none, costs a cache miss each.
    #[inline(always)]
    pub(crate) fn triangle(&self, item: u32) -> u32 {
        let word = self.words[item as usize / 64];
        let (guests, bit) = (word.guests(), 1 << (item % 64));
        let nth_guest = word.n_before + (guests & (bit - 1)).count_ones();
        if guests & bit == 0 { item - nth_guest } else { self.guests.get(nth_guest as usize) }
    }

    /// Hints that the items of a leaf will be read soon.
    #[inline(always)]
    pub(crate) fn prefetch<S: Simd>(&self, first_item: usize) {
        S::prefetch(&self.words, first_item / 64);
    }

    pub(super) fn visit_sections<'a>(&'a mut self, visitor: &mut impl SectionVisitor<'a>) -> Result<(), Fault> {
        visitor.visit("items", &mut self.words)?;
        self.guests.visit_sections(visitor)
    }

    /// Checks that so many items can have so many triangles.
    pub(super) fn check_sizes(&self, n_items: usize, n_triangles: usize) -> Result<(), Damage> {
        expect(self.words.len() == n_items.div_ceil(64), "items")?;
        self.guests.check_sizes()?;
        expect(self.guests.len().checked_add(n_triangles) == Some(n_items), "guests")
    }

    /// Checks that all guests exist, and are counted rightly.
    pub(super) fn check_contents(&self, n_items: usize, n_triangles: usize) -> Result<(), Damage> {
        let mut n_guests = 0;
        for word in &*self.words {
            expect(word.n_before as usize == n_guests, "items")?;
            n_guests += word.guests().count_ones() as usize;
        }
        let n_in_last = n_items % 64;
        let are_items = n_in_last == 0 || self.words.last().is_some_and(|word| word.guests() >> n_in_last == 0);
        expect(are_items && n_guests + n_triangles == n_items, "items")?;
        self.guests.check_contents()?;
        expect((0..n_guests).into_par_iter().all(|nth| (self.guests.get(nth) as usize) < n_triangles), "guests")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn items_name_the_listed_triangles_in_the_order_of_their_first_mention() {
        let far: Vec<u32> = (0..5000).map(|item| item * item % 3001).collect();
        for (listed, n_in_file) in [(vec![7, 3, 3, 9, 7, 1, 3], 10), (far, 3001), ((0..64).collect(), 64), (vec![], 0)]
        {
            let (mut items, order) = Items::new(listed.clone(), n_in_file);
            let numbers: Vec<u32> = (0..listed.len() as u32).map(|item| order[items.triangle(item) as usize]).collect();
            assert_eq!(numbers, listed);
            let mut first_mentions = listed.clone();
            let mut is_known = vec![false; n_in_file];
            first_mentions.retain(|&number| !std::mem::replace(&mut is_known[number as usize], true));
            assert_eq!(order, first_mentions);
            items.check_sizes(listed.len(), order.len()).unwrap();
            items.check_contents(listed.len(), order.len()).unwrap();

            // No other sizes or contents pass.
            assert!(items.check_sizes(listed.len() + 1, order.len()).is_err());
            if order.len() < listed.len() {
                assert!(items.check_contents(listed.len(), order.len() - 1).is_err());
                let mut words = items.words.to_vec();
                words[0].are_guests[0] ^= 1;
                items.words = words.into();
                assert!(items.check_contents(listed.len(), order.len()).is_err());
            }
        }
    }

    #[test]
    fn guests_that_do_not_exist_are_found() {
        let (mut items, order) = Items::new(vec![0, 1, 0], 2);
        items.guests = Guests::new(&[2]);
        assert!(items.check_contents(3, order.len()).is_err());
    }
}
