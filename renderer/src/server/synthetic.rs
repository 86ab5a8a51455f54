//! Synthetic pictures: a render server that sends one answers at once, so that only the wall limits the frame rate.

use std::{
    io::BufReader,
    ops::Range,
    path::Path,
    sync::{Arc, Mutex, PoisonError},
};

use anyhow::{Context, ensure};
use channel::files;
use shared::{
    division::{FrameSize, Share, Task},
    protocol::CHUNK_BYTES,
};

/// A picture in place of a scene; frames of other sizes tile or crop it.
pub(crate) struct SyntheticPicture {
    size: FrameSize,
    /// Row by row, the bottom row first.
    rgb: Vec<u8>,
    /// The chunks of the last share: the wall asks for the same one repeatedly.
    cached: Mutex<Option<CachedChunks>>,
}

struct CachedChunks {
    task: Task,
    size: FrameSize,
    chunks: Arc<Vec<SyntheticChunk>>,
}

/// Units of a share, by index, and their samples.
pub(crate) struct SyntheticChunk {
    pub(crate) units: Range<u32>,
    pub(crate) rgb: Vec<u8>,
}

impl SyntheticPicture {
    fn new(size: FrameSize, rgb: Vec<u8>) -> Self {
        Self { size, rgb, cached: Mutex::new(None) }
    }

    /// Incompressible noise, the same on every server: SplitMix64 (Steele, Lea and Flood 2014) in counter mode.
    pub(crate) fn noise() -> Self {
        let size = FrameSize::PAPER;
        let words = (1..).map(|count: u64| {
            let mixed = count.wrapping_mul(0x9e37_79b9_7f4a_7c15);
            let mixed = (mixed ^ mixed >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            let mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
            mixed ^ mixed >> 31
        });
        Self::new(size, words.flat_map(u64::to_le_bytes).take(3 * size.n_samples() as usize).collect())
    }

    /// Reads a picture that `renderer trace --image` wrote.
    pub(crate) fn read(path: &Path) -> anyhow::Result<Self> {
        let read = || -> anyhow::Result<Self> {
            let mut reader = png::Decoder::new(BufReader::new(files::open(path)?)).read_info()?;
            let (width, height) = reader.info().size();
            let size = FrameSize::new(width, height)?;
            ensure!(
                reader.output_color_type() == (png::ColorType::Rgb, png::BitDepth::Eight),
                "it is not an 8-bit RGB image, as `renderer trace --image` writes"
            );
            let mut rows = vec![0; 3 * size.n_samples() as usize];
            reader.next_frame(&mut rows)?;
            Ok(Self::new(size, rows.rchunks_exact(3 * width as usize).flatten().copied().collect()))
        };
        read().with_context(|| format!("cannot read --replay {}", path.display()))
    }

    pub(crate) fn n_bytes(&self) -> usize {
        self.rgb.len()
    }

    /// The samples of a share, in the share's order.
    pub(crate) fn chunks(&self, task: &Task, share: &Share) -> Arc<Vec<SyntheticChunk>> {
        let size = share.units().size();
        let mut cached = self.cached.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = cached.as_ref().filter(|known| known.size == size && known.task == *task) {
            return Arc::clone(&known.chunks);
        }
        let (xres, yres) = self.size.into();
        let sample = |(i, j): (u32, u32)| {
            let at = 3 * ((j % yres) as usize * xres as usize + (i % xres) as usize);
            [self.rgb[at], self.rgb[at + 1], self.rgb[at + 2]]
        };
        let n_per_chunk = CHUNK_BYTES as u32 / (3 * share.units().samples_per_full_unit());
        let chunk = |first: u32| {
            let units = first..(first + n_per_chunk).min(share.count());
            let rgb = units.clone().flat_map(|k| share.samples(k).iter()).flat_map(sample).collect();
            SyntheticChunk { units, rgb }
        };
        let chunks = Arc::new((0..share.count()).step_by(n_per_chunk as usize).map(chunk).collect());
        *cached = Some(CachedChunks { task: *task, size, chunks: Arc::clone(&chunks) });
        chunks
    }
}

#[cfg(test)]
mod tests {
    use shared::division::Division;

    use super::*;

    #[test]
    fn a_picture_comes_back_as_it_was_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("picture.png");
        let size = FrameSize::new(9, 5).unwrap();
        let rgb: Vec<u8> = (0..3 * size.n_samples()).map(|byte| byte as u8).collect();
        crate::render::image::write_png(&path, size, &rgb).unwrap();
        let picture = SyntheticPicture::read(&path).unwrap();
        let samples = |task: &Task, size| -> Vec<u8> {
            picture.chunks(task, &task.share(size).unwrap()).iter().flat_map(|chunk| chunk.rgb.clone()).collect()
        };
        let task = Division::Interleaved.task(0, 1);
        assert_eq!(samples(&task, size), rgb);
        // A larger frame tiles the picture, and the cache of one share is not used for another.
        let larger = FrameSize::new(18, 5).unwrap();
        let twice: Vec<u8> = rgb.chunks(27).flat_map(|row| [row, row]).flatten().copied().collect();
        assert_eq!(samples(&task, larger), twice);
        let second = Division::Interleaved.task(1, 2);
        let every_other: Vec<u8> = rgb.chunks(3).skip(1).step_by(2).flatten().copied().collect();
        assert_eq!(samples(&second, size), every_other);
        assert!(SyntheticPicture::read(&folder.path().join("none.png")).is_err());
    }
}
