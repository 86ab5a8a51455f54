//! The resolutions of frames in motion.

use shared::division::{FrameSize, TILE_SIZE};

/// Resolutions of about the same aspect, from the finest down; each has about 1/√2 of the samples of the one before.
///
/// A step changes each side by a sixth: enough to measure a difference in time, and hardly visible.
#[derive(Clone, Debug)]
pub(super) struct Ladder(Vec<FrameSize>);

/// Fewer samples show nothing recognisable.
const FEWEST_SAMPLES: u32 = 1 << 15;

impl Ladder {
    /// From the wall's native resolution down.
    pub(super) fn down_from(native: FrameSize) -> Self {
        let mut sizes = vec![native];
        loop {
            let scale = 0.5f64.powf(sizes.len() as f64 / 4.0);
            // Whole tiles, but never more pixels than there are.
            let side = |native: u32| {
                let n_tiles = (f64::from(native) * scale / f64::from(TILE_SIZE)).round().max(1.0);
                (n_tiles as u32 * TILE_SIZE).min(native)
            };
            let [xres, yres] = [native.xres(), native.yres()].map(side);
            let is_smaller = |last: &FrameSize| xres * yres < last.n_samples();
            match FrameSize::new(xres, yres) {
                Ok(size) if size.n_samples() >= FEWEST_SAMPLES && sizes.last().is_some_and(is_smaller) => {
                    sizes.push(size);
                }
                _ => return Self(sizes),
            }
        }
    }

    /// The resolution of a rung: 0 is the finest; higher numbers than the last give the last.
    pub(super) fn size(&self, rung: usize) -> FrameSize {
        self.0[rung.min(self.last())]
    }

    pub(super) fn last(&self) -> usize {
        self.0.len() - 1
    }

    /// The rung whose resolution is nearest to a number of samples.
    pub(super) fn rung_of(&self, n_samples: u32) -> usize {
        let distance = |size: &FrameSize| (f64::from(size.n_samples()) / f64::from(n_samples.max(1))).ln().abs();
        let nearest = (0..self.0.len()).min_by(|&a, &b| distance(&self.0[a]).total_cmp(&distance(&self.0[b])));
        nearest.unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wall_s_ladder_goes_down_evenly_in_its_shape() {
        let ladder = Ladder::down_from(FrameSize::new(4096, 2304).unwrap());
        assert_eq!(ladder.size(0), FrameSize::new(4096, 2304).unwrap());
        assert_eq!(ladder.size(4), FrameSize::new(2048, 1152).unwrap());
        assert_eq!(ladder.last(), 16);
        for rung in 1..=ladder.last() {
            let [finer, coarser] = [ladder.size(rung - 1), ladder.size(rung)];
            let factor = f64::from(finer.n_samples()) / f64::from(coarser.n_samples());
            assert!((1.3..1.55).contains(&factor), "{finer} to {coarser}");
            let aspect = f64::from(coarser.xres()) / f64::from(coarser.yres());
            assert!((aspect / (16.0 / 9.0) - 1.0).abs() < 0.04, "{coarser}");
            assert_eq!((coarser.xres() % 8, coarser.yres() % 8), (0, 0));
        }
        assert_eq!(ladder.size(ladder.rung_of(1024 * 512)), FrameSize::new(1024, 576).unwrap());
    }

    #[test]
    fn walls_of_any_size_have_a_ladder() {
        for (xres, yres) in
            [(1, 1), (1, 16384), (7, 3), (200, 100), (256, 128), (257, 129), (38400, 2160), (16384, 16384)]
        {
            let native = FrameSize::new(xres, yres).unwrap();
            let ladder = Ladder::down_from(native);
            assert_eq!(ladder.size(0), native);
            assert!((1..=ladder.last()).all(|rung| {
                let n_samples = ladder.size(rung).n_samples();
                n_samples < ladder.size(rung - 1).n_samples() && n_samples >= FEWEST_SAMPLES
            }));
            assert_eq!(ladder.size(usize::MAX), ladder.size(ladder.last()));
            for n_samples in [0, 1, u32::MAX] {
                assert!(ladder.rung_of(n_samples) <= ladder.last());
            }
        }
    }
}
