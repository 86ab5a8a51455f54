//! The resolutions of frames in motion, and the rays that light them.

use shared::{
    division::{FrameSize, TILE_SIZE},
    protocol::LightingMode,
};

/// What frames in motion may show, the best first: the wall's native resolution lit by more rays than the primary ones, then
/// by these alone, then resolutions of about the same aspect, each with about 1/√2 of the samples of the one before.
///
/// A step down changes each side by a sixth: enough to measure a difference in time, and hardly visible. Resolution comes before
/// light: up to the native one, more pixels bring a picture closer to the truth than shadows do (`lab chart`).
#[derive(Clone, Debug)]
pub(super) struct Ladder(Vec<FrameSize>);

/// Rays of the rungs above [`Ladder::PLAIN`], and about how many times as long their frames take; measured times replace it.
const LIT: [(LightingMode, f64); Ladder::PLAIN] = [(LightingMode::AmbientOcclusion, 8.0), (LightingMode::Shadows, 2.5)];

/// Fewer samples show nothing recognisable.
const FEWEST_SAMPLES: u32 = 1 << 15;

impl Ladder {
    /// The rung of the native resolution, lit by primary rays alone.
    pub(super) const PLAIN: usize = 2;

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

    /// The resolution of a rung: 0 is the best; higher numbers than the last give the last.
    pub(super) fn size(&self, rung: usize) -> FrameSize {
        self.0[rung.min(self.last()).saturating_sub(Self::PLAIN)]
    }

    /// The rays of a rung.
    pub(super) fn rays(&self, rung: usize) -> LightingMode {
        LIT.get(rung).map_or(LightingMode::Primary, |(rays, _)| *rays)
    }

    /// The expected time of a rung's frame, in those of a sample with a primary ray alone.
    pub(super) fn cost(&self, rung: usize) -> f64 {
        f64::from(self.size(rung).n_samples()) * LIT.get(rung).map_or(1.0, |(_, cost)| *cost)
    }

    pub(super) fn last(&self) -> usize {
        Self::PLAIN + self.0.len() - 1
    }

    /// The rung of primary rays whose resolution is nearest to a number of samples.
    pub(super) fn rung_of(&self, n_samples: u32) -> usize {
        let distance = |rung: usize| (self.cost(rung) / f64::from(n_samples.max(1))).ln().abs();
        let nearest = (Self::PLAIN..=self.last()).min_by(|&a, &b| distance(a).total_cmp(&distance(b)));
        nearest.unwrap_or(Self::PLAIN)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wall_s_ladder_goes_down_evenly_in_its_shape() {
        let ladder = Ladder::down_from(FrameSize::new(4096, 2304).unwrap());
        assert_eq!([0, 1, 2].map(|rung| ladder.size(rung)), [FrameSize::new(4096, 2304).unwrap(); 3]);
        assert_eq!(ladder.size(Ladder::PLAIN + 4), FrameSize::new(2048, 1152).unwrap());
        assert_eq!(ladder.last(), Ladder::PLAIN + 16);
        for rung in Ladder::PLAIN + 1..=ladder.last() {
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
            assert!((Ladder::PLAIN + 1..=ladder.last()).all(|rung| {
                let n_samples = ladder.size(rung).n_samples();
                n_samples < ladder.size(rung - 1).n_samples() && n_samples >= FEWEST_SAMPLES
            }));
            assert_eq!(ladder.size(usize::MAX), ladder.size(ladder.last()));
            for n_samples in [0, 1, u32::MAX] {
                assert!(ladder.rung_of(n_samples) <= ladder.last());
            }
        }
    }

    #[test]
    fn each_rung_costs_less_than_the_one_before() {
        let ladder = Ladder::down_from(FrameSize::new(4096, 2304).unwrap());
        assert!((1..=ladder.last()).all(|rung| ladder.cost(rung) < ladder.cost(rung - 1)));
        let rays: Vec<_> = (0..4).map(|rung| ladder.rays(rung)).collect();
        use LightingMode::*;
        assert_eq!(rays, [AmbientOcclusion, Shadows, Primary, Primary]);
    }
}
