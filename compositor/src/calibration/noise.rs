//! The noise of crossings in photographs, whatever the wall and the lens.

use std::collections::HashMap;

use glam::DVec2;

use super::{fitting::median, identify::Sighting, solve::Shot};

/// Half of all crossings lie nearer than this to where their neighbours let them be expected, in their projectors' pixels;
/// infinite if too few were seen.
///
/// That is the fourth difference along rows and columns of crossings: walls, slants and lenses are smooth over five squares,
/// except at a fold, and hardly change it. Of independent errors it is √70 times as large as one.
pub(super) fn noise_px(shots: &[Shot]) -> f64 {
    median(shots.iter().flat_map(|shot| &shot.sightings).flat_map(of_sighting).collect())
}

fn of_sighting(sighting: &Sighting) -> Vec<f64> {
    // Crossings lie on whole pixels.
    let key = |px: DVec2| px.round().as_ivec2();
    let seen: HashMap<_, DVec2> = sighting.points.iter().map(|[px, at]| (key(*px), *at)).collect();
    // Points are sorted along rows.
    let apart = |pair: &[[DVec2; 2]]| (pair[1][0] - pair[0][0]).x;
    let side = sighting.points.windows(2).map(apart).filter(|apart| *apart > 0.0).fold(f64::INFINITY, f64::min);
    let off = |(px, here): (DVec2, DVec2), axis: DVec2| {
        let there = |n: f64| seen.get(&key(px + axis * n * side)).copied();
        let (near, far) = ([there(-1.0)?, there(1.0)?], [there(-2.0)?, there(2.0)?]);
        let off = far[0] + far[1] - 4.0 * (near[0] + near[1]) + 6.0 * here;
        Some(off.length() / 70_f64.sqrt() * 2.0 * side / near[0].distance(near[1]))
    };
    let points = sighting.points.iter().map(|[px, at]| (*px, *at));
    points.flat_map(|point| [DVec2::X, DVec2::Y].map(|axis| off(point, axis))).flatten().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Crossings sixteen pixels apart, seen at a slant on a bent wall by a bent lens, three squares to ten pixels of the
    /// photograph, and off by these distances.
    fn shot(off_px: f64, n_columns: u32) -> Shot {
        let point = |n: u32| {
            let (column, row) = (f64::from(n % n_columns), f64::from(n / n_columns));
            let px = 16.0 * DVec2::new(column, row) + DVec2::new(24.0, 8.0);
            let bent = DVec2::new((px.x / 400.0).sin() * 400.0, px.y);
            let slant = bent / (1.0 + 4e-4 * bent.x + 2e-4 * bent.y);
            let seen = slant * (1.0 - 1e-7 * slant.length_squared());
            // Directions by the golden angle.
            [px, (seen + off_px * DVec2::from_angle(2.399_963 * f64::from(n * n % 1009))) / 4.8]
        };
        let points = (0..n_columns * 18).map(point).collect();
        let sighting = Sighting { projector_idx: 0, pattern: 0, is_mirrored: false, points };
        Shot { size: [400, 300], sightings: vec![sighting] }
    }

    #[test]
    fn the_noise_is_found_whatever_bends_the_lattice() {
        let smooth = noise_px(&[shot(0.0, 24)]);
        assert!(smooth < 0.003, "{smooth}");
        for off_px in [0.03, 0.1, 0.5] {
            let found = noise_px(&[shot(off_px, 24)]);
            // Pixels are nearer to each other at the slant's far end, where the same distance is more of them.
            assert!((0.8..2.0).contains(&(found / off_px)), "{off_px}: {found}");
        }
        assert!(noise_px(&[shot(0.1, 4)]).is_finite());
        assert_eq!(noise_px(&[]), f64::INFINITY);
    }
}
