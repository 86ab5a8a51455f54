//! The number and the size of cells.

use glam::DVec3;

/// Most cells along one axis: an `i32` then holds the coordinates of all deeper cells.
const MOST_CELLS_PER_AXIS: f64 = 16384.0;

/// The paper's resolution: M = ρN cells, M_i = S_i·∛(ρN/V).
///
/// An axis that would get less than one cell is left out, and the formula is used in two dimensions or in one: flat
/// models and lines get as many cells as others, where the paper's formula divides by V = 0. Returns the cells per axis
/// and the side of a cell in world units.
pub(crate) fn resolution(extent: DVec3, n_triangles: usize, density: f64) -> ([u32; 3], f64) {
    let n_cells = density * n_triangles as f64;
    let mut has_extent = [true; 3];
    loop {
        let n_axes = has_extent.iter().filter(|&&has_extent| has_extent).count();
        if n_axes == 0 {
            return ([1; 3], if extent.max_element() > 0.0 { extent.max_element() } else { 1.0 });
        }

        // Take the root of each factor: V itself can leave the range of f64.
        let root = 1.0 / n_axes as f64;
        let axes = || (0..3).filter(|&axis| has_extent[axis]);
        let cells_per_unit = axes().map(|axis| extent[axis].powf(-root)).product::<f64>() * n_cells.powf(root);

        // Leave out a thin axis and begin again.
        let thin = axes().find(|&axis| extent[axis] == 0.0 || extent[axis] * cells_per_unit < 1.0);
        if let Some(axis) = thin {
            has_extent[axis] = false;
            continue;
        }

        // Round up, within the limit of an axis.
        let cells_per_unit = cells_per_unit.min(MOST_CELLS_PER_AXIS / extent.max_element());
        let cells = extent.to_array().map(|s| ((s * cells_per_unit).ceil() as u32).max(1));
        return (cells, 1.0 / cells_per_unit);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_paper_s_formula() {
        let (cells, size) = resolution(DVec3::new(1.0, 2.0, 4.0), 1000, 32.0);
        // ∛(32000/8) = 15.874
        assert_eq!(cells, [16, 32, 64]);
        assert!((1.0 / size - 15.874).abs() < 1e-3);
    }

    #[test]
    fn axes_without_extent_do_not_count() {
        assert_eq!(resolution(DVec3::new(1.0, 0.0, 1.0), 50, 32.0).0, [40, 1, 40]);
        assert_eq!(resolution(DVec3::new(3.0, 0.0, 0.0), 2, 32.0).0, [64, 1, 1]);
        assert_eq!(resolution(DVec3::ZERO, 1, 32.0).0, [1; 3]);
        // Thinner than a cell.
        assert_eq!(resolution(DVec3::new(1.0, 1e-9, 1.0), 50, 32.0).0, [40, 1, 40]);
    }

    #[test]
    fn every_extent_is_bounded() {
        for extent in [DVec3::new(3.6e18, 1e-30, 1e-38), DVec3::splat(3.6e18), DVec3::splat(1e-38)] {
            let (cells, size) = resolution(extent, 1 << 30, 4096.0);
            assert!(cells.iter().all(|&n| (1..=16385).contains(&n)), "{cells:?}");
            assert!(size.is_finite() && size > 0.0);
        }
    }
}
