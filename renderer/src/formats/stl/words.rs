//! The words of a text STL. Most programs write a vertex on a line, but line ends mean no more than spaces.

use std::io::{self, Read};

use crate::formats::file::BYTE_ORDER_MARK;

/// Bytes of the text that are held at once. Longer words, which no program writes, come in parts.
const HELD_BYTES: usize = 1 << 16;

/// The words of a text, in order.
pub(super) struct Words<R> {
    reader: R,
    held: Vec<u8>,
    /// The part of `held` that is still to be read.
    start: usize,
    end: usize,
    line_end: u8,
    /// The line of the last word; counts from 1.
    pub(super) line: usize,
}

impl<R: Read> Words<R> {
    pub(super) fn new(reader: R) -> io::Result<Self> {
        let mut words = Self { reader, held: vec![0; HELD_BYTES], start: 0, end: 0, line_end: b'\n', line: 1 };
        words.refill()?;
        let held = &words.held[..words.end];
        if held.starts_with(BYTE_ORDER_MARK) {
            words.start = BYTE_ORDER_MARK.len();
        }
        // Old Macs end lines with a carriage return alone.
        if !held.contains(&b'\n') && held.contains(&b'\r') {
            words.line_end = b'\r';
        }
        Ok(words)
    }

    /// The next word; `None` at the end of the text.
    pub(super) fn next(&mut self) -> io::Result<Option<&[u8]>> {
        loop {
            let mut bytes = self.held[self.start..self.end].iter();
            let n_spaces = bytes.position(|byte| !byte.is_ascii_whitespace()).unwrap_or(self.end - self.start);
            let (spaces, rest) = self.held[self.start..self.end].split_at(n_spaces);
            self.line += spaces.iter().filter(|&&byte| byte == self.line_end).count();
            self.start += n_spaces;
            let length = rest.iter().position(u8::is_ascii_whitespace);
            // The last word may go on in the bytes that follow.
            if length.is_none() && self.refill()? > 0 {
                continue;
            }
            let word = self.start..length.map_or(self.end, |length| self.start + length);
            self.start = word.end;
            return Ok(Some(&self.held[word]).filter(|word| !word.is_empty()));
        }
    }

    /// Reads more bytes behind those that are left, and returns how many; 0 at the end of the text, or if there is no room.
    fn refill(&mut self) -> io::Result<usize> {
        self.held.copy_within(self.start..self.end, 0);
        (self.start, self.end) = (0, self.end - self.start);
        let n_before = self.end;
        while self.end < HELD_BYTES {
            match self.reader.read(&mut self.held[self.end..]) {
                Ok(0) => break,
                Ok(n) => self.end += n,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(self.end - n_before)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_have_lines_wherever_the_text_is_cut() {
        let text = |space: &str| (0..30_000).map(|i| format!("{i}{space}")).collect::<String>();
        for (space, rows) in [(" ", 0), ("\n", 1), ("\r\n", 1), ("\r", 1), (" \t\n\n", 2)] {
            let text = text(space);
            let mut words = Words::new(text.as_bytes()).unwrap();
            for i in 0..30_000 {
                assert_eq!(words.next().unwrap(), Some(i.to_string().as_bytes()), "{space:?}");
                assert_eq!(words.line, 1 + rows * i, "{space:?}");
            }
            assert_eq!(words.next().unwrap(), None);
        }
    }

    #[test]
    fn long_words_take_no_more_memory() {
        let text = "x".repeat(HELD_BYTES * 5 / 2);
        let mut words = Words::new(text.as_bytes()).unwrap();
        for n_bytes in [HELD_BYTES, HELD_BYTES, HELD_BYTES / 2] {
            assert_eq!(words.next().unwrap().map(<[u8]>::len), Some(n_bytes));
        }
        assert_eq!(words.next().unwrap(), None);
        assert_eq!(words.held.capacity(), HELD_BYTES);
    }
}
