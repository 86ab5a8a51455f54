//! Whether a film's picture is whole, without reading all of it: a full disk or a crash leaves files that are not.

use std::{
    fs::File,
    io::{self, BufReader, ErrorKind, Read, Seek, SeekFrom},
    path::Path,
};

/// The state of a picture's file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum State {
    Missing,
    /// It is no PNG from its first byte to its last.
    Damaged,
    /// It is a PNG of another size than the film's.
    OtherSize,
    /// It begins and ends as a PNG of the film's size.
    Whole,
}

/// The signature of a PNG, and the length and name of its first chunk.
const START: &[u8; 16] = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR";
/// The last chunk, which is empty, with its checksum.
const END: &[u8; 12] = b"\0\0\0\0IEND\xae\x42\x60\x82";

/// The state of the picture at `path` in a film of pictures of `size`: columns, rows.
pub(super) fn state(path: &Path, size: [u32; 2]) -> io::Result<State> {
    match ends(path) {
        Ok((start, end)) => {
            let (signature, sides) = start.split_at(START.len());
            let sides: Vec<_> = sides.as_chunks::<4>().0.iter().map(|side| u32::from_be_bytes(*side)).collect();
            Ok(match signature == START && end == *END {
                false => State::Damaged,
                true if sides != size => State::OtherSize,
                true => State::Whole,
            })
        }
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(State::Missing),
        // Shorter than that.
        Err(error) if matches!(error.kind(), ErrorKind::UnexpectedEof | ErrorKind::InvalidInput) => Ok(State::Damaged),
        Err(error) => Err(error),
    }
}

/// The first bytes, with columns and rows, and the last.
fn ends(path: &Path) -> io::Result<([u8; START.len() + 8], [u8; END.len()])> {
    let mut file = File::open(path)?;
    let (mut start, mut end) = ([0; START.len() + 8], [0; END.len()]);
    file.read_exact(&mut start)?;
    file.seek(SeekFrom::End(-(END.len() as i64)))?;
    file.read_exact(&mut end)?;
    Ok((start, end))
}

/// Whether all pixels of a picture can be read: this takes as long as showing it.
pub(super) fn is_readable(path: &Path) -> bool {
    let read = || -> Result<(), png::DecodingError> {
        let mut reader = png::Decoder::new(BufReader::new(File::open(path)?)).read_info()?;
        while reader.next_row()?.is_some() {}
        reader.finish()
    };
    read().is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::RgbImage;

    #[test]
    fn a_cut_an_empty_and_another_picture_are_told_from_a_whole_one() {
        let folder = std::env::temp_dir().join(format!("raywall-picture-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join("picture.png");
        assert_eq!(state(&path, [5, 7]).unwrap(), State::Missing);
        let image = RgbImage { size: [5, 7], rgb: (0..105).collect() };
        image.write_png(&path).unwrap();
        assert_eq!((state(&path, [5, 7]).unwrap(), state(&path, [7, 5]).unwrap()), (State::Whole, State::OtherSize));
        assert!(is_readable(&path));
        let bytes = std::fs::read(&path).unwrap();
        for n_left in [0, 1, 20, 30, bytes.len() - 1] {
            std::fs::write(&path, &bytes[..n_left]).unwrap();
            assert_eq!(state(&path, [5, 7]).unwrap(), State::Damaged, "{n_left} bytes");
            assert!(!is_readable(&path), "{n_left} bytes");
        }
        let mut holed = bytes.clone();
        let middle = holed.len() / 2;
        holed[middle] ^= 0xff;
        std::fs::write(&path, holed).unwrap();
        assert!(state(&path, [5, 7]).unwrap() == State::Whole && !is_readable(&path));
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
