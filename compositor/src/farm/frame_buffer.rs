//! The samples of one frame, put in place by many threads at once.

use std::sync::{
    Arc,
    atomic::{AtomicU32, Ordering::Relaxed},
};

use shared::division::{FrameSize, Share};

/// A frame's samples while they arrive.
///
/// Receiving threads write to it together, without a lock: answers to the same work are equal bits, so it does not
/// matter who writes a sample last.
#[derive(Debug)]
pub(super) struct FrameBuffer {
    size: FrameSize,
    /// Red, green, blue, 255 in memory order, row by row, the bottom row first.
    rgba: Vec<AtomicU32>,
}

/// Bytes that do not fit the units that they claim to be.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(super) enum PlaceError {
    /// Units beyond the work's.
    #[error("units {first}+{count} of a work of {n_units}")]
    NoSuchUnits {
        /// The first one.
        first: u32,
        /// How many.
        count: u32,
        /// How many there are.
        n_units: u32,
    },
    /// Not three bytes for each sample.
    #[error("{n_bytes} bytes for {n_samples} samples")]
    WrongLength {
        /// As sent.
        n_bytes: usize,
        /// As the units have.
        n_samples: usize,
    },
}

impl FrameBuffer {
    pub(super) fn new(size: FrameSize) -> Self {
        Self { size, rgba: (0..size.n_samples()).map(|_| AtomicU32::new(0)).collect() }
    }

    pub(super) fn size(&self) -> FrameSize {
        self.size
    }

    /// Puts the samples of units `first..first + count` of a share of this frame in their places.
    pub(super) fn place(&self, share: &Share<'_>, first: u32, count: u32, rgb: &[u8]) -> Result<(), PlaceError> {
        let n_units = share.count();
        if first.checked_add(count).is_none_or(|end| end > n_units) {
            return Err(PlaceError::NoSuchUnits { first, count, n_units });
        }
        let units = first..first + count;
        let n_samples = units.clone().map(|k| share.samples(k).count() as usize).sum();
        if rgb.len() != 3 * n_samples {
            return Err(PlaceError::WrongLength { n_bytes: rgb.len(), n_samples });
        }
        let (pixels, _) = rgb.as_chunks::<3>();
        let mut pixels = pixels.iter();
        for block in units.map(|k| share.samples(k)) {
            for j in block.rows {
                let row = j * self.size.xres();
                let cells = &self.rgba[(row + block.columns.start) as usize..(row + block.columns.end) as usize];
                for (cell, &[r, g, b]) in cells.iter().zip(&mut pixels) {
                    cell.store(u32::from_ne_bytes([r, g, b, 255]), Relaxed);
                }
            }
        }
        Ok(())
    }

    /// The samples, once the scheduler has seen all of them placed.
    pub(super) fn into_rgba(self: Arc<Self>) -> Vec<u32> {
        match Arc::try_unwrap(self) {
            Ok(buffer) => buffer.rgba.into_iter().map(AtomicU32::into_inner).collect(),
            // A late second answer is still being placed; it changes no bit.
            Err(shared) => shared.rgba.iter().map(|cell| cell.load(Relaxed)).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use shared::division::Division;

    use super::*;

    #[test]
    fn samples_of_every_machine_end_up_in_their_places() {
        let size = FrameSize::new(19, 11).unwrap();
        for division in Division::ALL {
            let buffer = Arc::new(FrameBuffer::new(size));
            for machine in 0..3 {
                let work = division.work(machine, 3);
                let share = work.share(size).unwrap();
                let rgb: Vec<u8> = (0..share.count())
                    .flat_map(|k| share.samples(k).iter())
                    .flat_map(|(i, j)| [i as u8, j as u8, 7])
                    .collect();
                buffer.place(&share, 0, share.count(), &rgb).unwrap();
            }
            let expected: Vec<u32> =
                (0..11).flat_map(|j| (0..19).map(move |i| u32::from_ne_bytes([i, j, 7, 255]))).collect();
            assert_eq!(buffer.into_rgba(), expected);
        }
    }

    #[test]
    fn bytes_that_do_not_fit_are_refused() {
        let size = FrameSize::new(16, 8).unwrap();
        let buffer = FrameBuffer::new(size);
        let work = Division::Tiled.work(0, 1);
        let share = work.share(size).unwrap();
        assert!(buffer.place(&share, 1, 1, &[0; 192]).is_ok());
        assert!(matches!(buffer.place(&share, 1, 1, &[0; 191]), Err(PlaceError::WrongLength { .. })));
        assert!(matches!(buffer.place(&share, 1, 2, &[0; 384]), Err(PlaceError::NoSuchUnits { .. })));
        assert!(matches!(buffer.place(&share, u32::MAX, 2, &[]), Err(PlaceError::NoSuchUnits { .. })));
    }
}
