//! One array of a scene, in memory of its own or in that of a scene file.

use std::{
    fmt,
    ops::{Deref, Range},
    ptr::NonNull,
    slice,
    sync::Arc,
};

use bytemuck::Pod;

use crate::scene_file::bytes::FileBytes;

/// An array that is built once and never changes, read as a slice.
///
/// Its pointer and length lie where those of a `Vec` would, so rays do not notice whose memory they read.
pub(crate) struct Section<T> {
    /// Invariant: `owner` keeps these items in place, alive and unchanged.
    items: NonNull<T>,
    len: usize,
    owner: Owner<T>,
}

enum Owner<T> {
    Memory(Vec<T>),
    File { _keeps: Arc<FileBytes> },
}

// SAFETY: a section lends its items like a slice, and gives none of them away to be changed.
unsafe impl<T: Sync> Sync for Section<T> {}
// SAFETY: with the section go its items, or a share of bytes that nobody changes.
unsafe impl<T: Send + Sync> Send for Section<T> {}

impl<T: Pod> Section<T> {
    /// The items in a part of a file; `None` if it is not there, cuts an item, or begins where none may.
    pub(crate) fn in_file(file: &Arc<FileBytes>, range: Range<usize>) -> Option<Self> {
        let items: &[T] = bytemuck::try_cast_slice(file.get(range)?).ok()?;
        let (items, len) = (NonNull::from(items).cast(), items.len());
        Some(Self { items, len, owner: Owner::File { _keeps: Arc::clone(file) } })
    }
}

impl<T> From<Vec<T>> for Section<T> {
    fn from(mut items: Vec<T>) -> Self {
        let len = items.len();
        // A vector's items stay where they are while it moves.
        let first = NonNull::new(items.as_mut_ptr()).unwrap_or(NonNull::dangling());
        Self { items: first, len, owner: Owner::Memory(items) }
    }
}

impl<T> FromIterator<T> for Section<T> {
    fn from_iter<I: IntoIterator<Item = T>>(items: I) -> Self {
        Vec::from_iter(items).into()
    }
}

impl<T> Default for Section<T> {
    fn default() -> Self {
        Vec::new().into()
    }
}

impl<T> Deref for Section<T> {
    type Target = [T];

    #[inline(always)]
    fn deref(&self) -> &[T] {
        // SAFETY: the invariant of `items`; all of them were in one slice.
        unsafe { slice::from_raw_parts(self.items.as_ptr(), self.len) }
    }
}

impl<T: PartialEq> PartialEq for Section<T> {
    fn eq(&self, other: &Self) -> bool {
        **self == **other
    }
}

impl<T> fmt::Debug for Section<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let place = match &self.owner {
            Owner::Memory(items) => format!("memory of {}", items.capacity()),
            Owner::File { .. } => "a file".to_owned(),
        };
        write!(f, "{} items in {place}", self.len)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_section_outlives_its_file_s_other_users_and_moves() {
        let bytes: Vec<u8> = (0..200).collect();
        let file = Arc::new(FileBytes::copy(&bytes));
        let section = Section::<u32>::in_file(&file, 8..16).unwrap();
        drop(file);
        let moved = [section];
        assert_eq!(*moved[0], [0x0b0a_0908, 0x0f0e_0d0c]);
        let owned = Section::from(vec![1u8, 2]);
        let moved = [owned, Section::default()];
        assert_eq!((&*moved[0], moved[1].len()), (&[1, 2][..], 0));
    }

    #[test]
    fn parts_that_hold_no_whole_items_are_no_sections() {
        let file = Arc::new(FileBytes::copy(&[7; 100]));
        let reversed = Range { start: 8, end: 4 };
        for range in [0..7, 1..9, 96..104, reversed, usize::MAX - 3..usize::MAX] {
            assert!(Section::<u32>::in_file(&file, range.clone()).is_none(), "{range:?}");
        }
        assert!(Section::<u32>::in_file(&file, 100..100).is_some_and(|section| section.is_empty()));
    }
}
