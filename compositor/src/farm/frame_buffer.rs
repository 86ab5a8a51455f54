//! The samples of one frame, placed by many threads at once.

use std::{
    ops::{Deref, Range},
    sync::{
        Arc, Mutex, OnceLock, PoisonError,
        atomic::{AtomicU32, Ordering::Relaxed},
    },
};

use shared::{
    curve,
    division::{Division, FrameSize, Share},
};

use super::tile_row;

/// Buffers that are reused: the system takes longer to allocate and clear a frame's memory than its samples take to
/// arrive.
#[derive(Clone, Debug, Default)]
pub struct BufferPool(Arc<Mutex<PooledBuffers>>);

#[derive(Debug, Default)]
struct PooledBuffers {
    rgba: Vec<Vec<u32>>,
    curve: Option<Arc<CurveTiles>>,
}

/// Positions of the tiles along the curve in frames of one size: computing one takes longer than placing its samples.
#[derive(Debug)]
struct CurveTiles {
    size: FrameSize,
    /// By index along the curve: tile indices, row by row from the bottom left. Filled on first use.
    tiles: OnceLock<Vec<u32>>,
}

impl CurveTiles {
    fn tile(&self, index: u32) -> u32 {
        let (columns, rows) = (self.size.x_tiles(), self.size.y_tiles());
        let tile_idx = |index| {
            let (column, row) = curve::tile_at(index, columns, rows);
            row * columns + column
        };
        self.tiles.get_or_init(|| (0..columns * rows).map(tile_idx).collect())[index as usize]
    }
}

/// Frames of at least this many samples are written past the caches, which cannot hold the frames in flight until they are
/// uploaded: along the curve that takes little more than half the time. Smaller frames are uploaded from the caches.
const LEAST_NON_TEMPORAL_SAMPLES: usize = 1 << 20;

/// The frames in flight, one that waits, one that is shown, and one more.
pub(crate) const MOST_FRAMES: usize = 6;

impl BufferPool {
    /// A buffer for a frame; its contents are arbitrary.
    pub fn take(&self, size: FrameSize) -> FrameBuffer {
        let mut spare = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        spare.rgba.retain(|rgba| rgba.len() == size.n_samples() as usize);
        let rgba = spare.rgba.pop().unwrap_or_else(|| vec![0; size.n_samples() as usize]);
        let known = spare.curve.take().filter(|curve| curve.size == size);
        let curve = known.unwrap_or_else(|| Arc::new(CurveTiles { size, tiles: OnceLock::new() }));
        spare.curve = Some(Arc::clone(&curve));
        FrameBuffer { size, rgba: rgba.into_iter().map(AtomicU32::new).collect(), curve }
    }

    fn put(&self, rgba: Vec<u32>) {
        let mut spare = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if spare.rgba.len() < MOST_FRAMES {
            spare.rgba.push(rgba);
        }
    }
}

/// The samples of a complete frame: red, green, blue, 255 in memory order, row by row, the bottom row first.
#[derive(Clone, Debug)]
pub struct FrameSamples {
    rgba: Vec<u32>,
    spare: BufferPool,
}

impl Deref for FrameSamples {
    type Target = [u32];

    fn deref(&self) -> &[u32] {
        &self.rgba
    }
}

impl Drop for FrameSamples {
    fn drop(&mut self) {
        self.spare.put(std::mem::take(&mut self.rgba));
    }
}

/// A frame's samples while they arrive.
///
/// Receiving threads write to it together, without a lock: all answers to one task have equal bits, so the last writer of
/// a sample does not matter.
#[derive(Debug)]
pub struct FrameBuffer {
    size: FrameSize,
    /// Red, green, blue, 255 in memory order, row by row, the bottom row first.
    rgba: Vec<AtomicU32>,
    curve: Arc<CurveTiles>,
}

/// Samples that do not fit their units.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PlaceError {
    /// The task has no such units.
    #[error("units {first}+{count} of a task of {n_units}")]
    NoSuchUnits {
        /// Index of the first unit.
        first: u32,
        /// Number of units.
        count: u32,
        /// Number of units of the task.
        n_units: u32,
    },
    /// Not three bytes a sample.
    #[error("{n_bytes} bytes for {n_samples} samples")]
    WrongLength {
        /// Bytes received.
        n_bytes: usize,
        /// Samples of the units.
        n_samples: usize,
    },
}

impl FrameBuffer {
    pub(super) fn size(&self) -> FrameSize {
        self.size
    }

    /// Places the samples of units `first..first + count` of a share of this frame.
    ///
    /// # Errors
    /// Units that the share does not have, and too few or too many bytes for them; some samples may be placed all the same.
    pub fn place(&self, share: &Share, first: u32, count: u32, rgb: &[u8]) -> Result<(), PlaceError> {
        let n_units = share.count();
        let Some(end) = first.checked_add(count).filter(|&end| end <= n_units) else {
            return Err(PlaceError::NoSuchUnits { first, count, n_units });
        };
        let units = first..end;
        let is_placed = match share.single_samples(units.clone()) {
            Some(samples) => self.place_samples(samples, rgb),
            None => self.place_tiles(share, units.clone(), rgb),
        };
        is_placed.ok_or_else(|| {
            let n_samples = units.map(|k| share.samples(k).count() as usize).sum();
            PlaceError::WrongLength { n_bytes: rgb.len(), n_samples }
        })
    }

    /// Places single samples. `None` if there are too few or too many bytes.
    fn place_samples(&self, samples: impl ExactSizeIterator<Item = u32>, rgb: &[u8]) -> Option<()> {
        let (pixels, rest) = rgb.as_chunks::<3>();
        if !rest.is_empty() || pixels.len() != samples.len() {
            return None;
        }
        store_samples(samples.map(|sample| &self.rgba[sample as usize]), pixels);
        Some(())
    }

    /// Places tiles. `None` if there are too few or too many bytes.
    fn place_tiles(&self, share: &Share, units: Range<u32>, rgb: &[u8]) -> Option<()> {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            // SAFETY: the machine has AVX2.
            return unsafe { self.place_tiles_avx2(share, units, rgb) };
        }
        self.place_tiles_by(share, units, rgb, tile_row::store_row)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn place_tiles_avx2(&self, share: &Share, units: Range<u32>, rgb: &[u8]) -> Option<()> {
        if self.rgba.len() < LEAST_NON_TEMPORAL_SAMPLES {
            return self.place_tiles_by(share, units, rgb, |cells, rgb| tile_row::store_row_avx2(cells, rgb));
        }
        let is_placed =
            self.place_tiles_by(share, units, rgb, |cells, rgb| tile_row::store_row_non_temporal(cells, rgb));
        tile_row::fence_non_temporal();
        is_placed
    }

    #[inline(always)]
    fn place_tiles_by(
        &self,
        share: &Share,
        units: Range<u32>,
        mut rgb: &[u8],
        store_row: impl Fn(&tile_row::RowCells, &tile_row::RowRgb),
    ) -> Option<()> {
        let tiles = Division::Tiled.units(self.size);
        let is_on_curve = share.is_on_curve();
        for k in units {
            let unit = share.unit(k);
            let tile = tiles.samples(if is_on_curve { self.curve.tile(unit) } else { unit });
            for j in tile.rows {
                let row = j * self.size.xres();
                let cells = &self.rgba[(row + tile.columns.start) as usize..(row + tile.columns.end) as usize];
                let (row_rgb, after) = rgb.split_at_checked(3 * cells.len())?;
                rgb = after;
                match (cells.try_into(), row_rgb.try_into()) {
                    (Ok(cells), Ok(row_rgb)) => store_row(cells, row_rgb),
                    // The frame's right edge cuts the tile.
                    _ => store_samples(cells.iter(), row_rgb.as_chunks().0),
                }
            }
        }
        rgb.is_empty().then_some(())
    }

    /// The samples, once all of them are placed. Their buffer returns to the pool when they are dropped.
    pub fn into_samples(self: Arc<Self>, spare: BufferPool) -> FrameSamples {
        let rgba = match Arc::try_unwrap(self) {
            Ok(buffer) => buffer.rgba.into_iter().map(AtomicU32::into_inner).collect(),
            // A second answer is still being placed; it changes no bit.
            Err(shared) => shared.rgba.iter().map(|cell| cell.load(Relaxed)).collect(),
        };
        FrameSamples { rgba, spare }
    }
}

fn store_samples<'a>(cells: impl Iterator<Item = &'a AtomicU32>, rgb: &[[u8; 3]]) {
    for (cell, &[r, g, b]) in cells.zip(rgb) {
        cell.store(u32::from_ne_bytes([r, g, b, 255]), Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use shared::division::Division;

    use super::*;

    #[test]
    fn samples_of_every_machine_are_placed() {
        // One frame is written to the caches and one past them; the edges of both cut tiles.
        for (xres, yres) in [(19, 11), (1028, 1021)] {
            let size = FrameSize::new(xres, yres).unwrap();
            assert_eq!(size.n_samples() as usize >= LEAST_NON_TEMPORAL_SAMPLES, xres > 1000);
            let rgb_of = |(i, j): (u32, u32)| [i as u8, j as u8, (i >> 8) as u8];
            let rgba_of = |sample| {
                let [r, g, b] = rgb_of(sample);
                u32::from_ne_bytes([r, g, b, 255])
            };
            let expected: Vec<u32> = (0..yres).flat_map(|j| (0..xres).map(move |i| rgba_of((i, j)))).collect();
            for division in [Division::Interleaved, Division::Tiled, Division::Dynamic] {
                let spare = BufferPool::default();
                let buffer = Arc::new(spare.take(size));
                thread::scope(|scope| {
                    for machine in 0..3 {
                        let buffer = &buffer;
                        scope.spawn(move || {
                            let task = division.task(machine, 3);
                            let share = task.share(size).unwrap();
                            let rgb: Vec<u8> =
                                (0..share.count()).flat_map(|k| share.samples(k).iter()).flat_map(rgb_of).collect();
                            buffer.place(&share, 0, share.count(), &rgb).unwrap();
                        });
                    }
                });
                assert!(*buffer.into_samples(spare.clone()) == *expected, "{size} {division:?}");
                assert_eq!(spare.0.lock().unwrap().rgba.len(), 1, "the buffer waits for the next frame");
            }
        }
    }

    #[test]
    fn bytes_that_do_not_fit_are_refused() {
        let size = FrameSize::new(16, 8).unwrap();
        let buffer = BufferPool::default().take(size);
        let task = Division::Tiled.task(0, 1);
        let share = task.share(size).unwrap();
        assert!(buffer.place(&share, 1, 1, &[0; 192]).is_ok());
        assert!(matches!(buffer.place(&share, 1, 1, &[0; 191]), Err(PlaceError::WrongLength { .. })));
        assert!(matches!(buffer.place(&share, 1, 1, &[0; 193]), Err(PlaceError::WrongLength { n_samples: 64, .. })));
        let single = Division::Interleaved.task(0, 1);
        let single = single.share(size).unwrap();
        assert!(buffer.place(&single, 126, 2, &[0; 6]).is_ok());
        assert!(matches!(buffer.place(&single, 126, 2, &[0; 7]), Err(PlaceError::WrongLength { .. })));
        assert!(matches!(buffer.place(&share, 1, 2, &[0; 384]), Err(PlaceError::NoSuchUnits { .. })));
        assert!(matches!(buffer.place(&share, u32::MAX, 2, &[]), Err(PlaceError::NoSuchUnits { .. })));
    }
}
