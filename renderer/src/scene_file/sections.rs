//! The arrays of a scene, in the order in which files hold them.
//!
//! A scene lists its arrays once, in its `visit_sections` and those of its parts; writing and reading follow that list.

use std::{
    io::{self, Write},
    sync::Arc,
};

use bytemuck::Pod;

use crate::scene_file::{
    bytes::FileBytes,
    fault::{Damage, Fault},
    head::{Head, ZEROS},
    section::Section,
};

/// Visits the arrays of a scene, always in the same order.
pub(crate) trait SectionVisitor<'a> {
    /// Visits the next one, which has this name in a file.
    fn visit<T: Pod>(&mut self, name: &'static str, section: &'a mut Section<T>) -> Result<(), Fault>;
}

/// Collects the bytes of all arrays.
#[derive(Default)]
pub(crate) struct Collector<'a> {
    /// With the arrays' names.
    pub(crate) sections: Vec<(&'static str, &'a [u8])>,
}

impl<'a> SectionVisitor<'a> for Collector<'a> {
    fn visit<T: Pod>(&mut self, name: &'static str, section: &'a mut Section<T>) -> Result<(), Fault> {
        self.sections.push((name, bytemuck::cast_slice(section)));
        Ok(())
    }
}

/// Writes the bytes of all arrays to a file, whose next byte begins a page.
pub(crate) struct Writer<'p, W> {
    pub(crate) out: W,
    /// Whether the scene keeps its arrays; else each is dropped when it is written.
    pub(crate) keeps: bool,
    /// Bytes that were written.
    pub(crate) n_written: usize,
    /// Receives their number.
    pub(crate) progress: &'p dyn Fn(usize),
}

impl<W: Write> Writer<'_, W> {
    /// Writes bytes, and zeros up to the next page.
    pub(crate) fn put(&mut self, bytes: &[u8]) -> io::Result<()> {
        // In pieces, for the progress.
        for piece in bytes.chunks(1 << 24) {
            self.out.write_all(piece)?;
            self.n_written += piece.len();
            (self.progress)(self.n_written);
        }
        let n_zeros = self.n_written.next_multiple_of(ZEROS.len()) - self.n_written;
        self.n_written += n_zeros;
        self.out.write_all(&ZEROS[..n_zeros])
    }
}

impl<W: Write> SectionVisitor<'_> for Writer<'_, W> {
    fn visit<T: Pod>(&mut self, _: &'static str, section: &mut Section<T>) -> Result<(), Fault> {
        self.put(bytemuck::cast_slice(section))?;
        if !self.keeps {
            *section = Section::default();
        }
        Ok(())
    }
}

/// Gives a scene the arrays of a file.
pub(crate) struct Filler<'h> {
    file: Arc<FileBytes>,
    head: &'h Head,
    next: usize,
}

impl<'h> Filler<'h> {
    pub(crate) fn new(file: Arc<FileBytes>, head: &'h Head) -> Self {
        Self { file, head, next: 0 }
    }

    /// Ends the visit: the file must have no other sections.
    pub(crate) fn finish(self) -> Result<(), Fault> {
        if self.next == self.head.n_sections() { Ok(()) } else { Err(Damage::Content("sections").into()) }
    }
}

impl SectionVisitor<'_> for Filler<'_> {
    fn visit<T: Pod>(&mut self, name: &'static str, section: &mut Section<T>) -> Result<(), Fault> {
        let range = self.head.section(self.next, name);
        let filled = range.and_then(|range| Section::in_file(&self.file, range));
        *section = filled.ok_or(Damage::Content(name))?;
        self.next += 1;
        Ok(())
    }
}

/// `Err` with the name of what is damaged, unless `is_sound`.
pub(crate) fn expect(is_sound: bool, name: &'static str) -> Result<(), Damage> {
    if is_sound { Ok(()) } else { Err(Damage::Content(name)) }
}
