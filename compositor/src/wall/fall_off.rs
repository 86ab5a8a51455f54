//! The fall-off of a projector's light: lenses and lamps light the middle of a field more than its corners.

use std::sync::Arc;

use glam::DVec2;
use serde::{Deserialize, Serialize};

use super::mesh::keys;

/// A projector's light at points spread evenly over its pixels as seen on the wall, from corner to corner, as parts of the
/// light where it is brightest; between them interpolated like a mesh.
///
/// The compositor dims each place to the light of the darkest one: [`FallOff::excess`] says by how much.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(try_from = "Vec<Vec<f64>>", into = "Vec<Vec<f64>>")]
pub struct FallOff {
    parts: [[f64; FallOff::SIDE]; FallOff::SIDE],
    /// The light over that at the darkest point, row by row from the top, in a border of points that continue it.
    padded: Arc<[f64]>,
}

/// Parts of the light that a usable projector has everywhere.
const PARTS: std::ops::RangeInclusive<f64> = 0.2..=1.0;

impl FallOff {
    /// Points a side.
    pub const SIDE: usize = 5;

    /// From parts, row by row from the top.
    ///
    /// # Errors
    /// A part is too small or too large; the text names the cure.
    pub fn new(parts: [[f64; Self::SIDE]; Self::SIDE]) -> Result<Self, String> {
        let flat = || parts.iter().flatten().copied();
        if let Some(part) = flat().find(|part| !PARTS.contains(part)) {
            let (least, most) = (PARTS.start(), PARTS.end());
            return Err(format!(
                "fall_off has {part}: parts of the light where it is brightest are from {least} to {most}"
            ));
        }
        let least = flat().fold(f64::INFINITY, f64::min);
        let excesses: Vec<f64> = flat().map(|part| part / least).collect();
        Ok(Self { parts, padded: keys::padded([Self::SIDE; 2], &excesses).into() })
    }

    /// The light at a point of its pixels, from (0, 0) upper left as seen on the wall to (1, 1), over that at the darkest
    /// of all control points.
    pub fn excess(&self, upright: DVec2) -> f64 {
        let at = upright.clamp(DVec2::ZERO, DVec2::ONE) * (Self::SIDE - 1) as f64;
        let cell = at.floor().min(DVec2::splat((Self::SIDE - 2) as f64));
        let part = at - cell;
        let ([across, _], [down, _]) = (keys::weights(part.x), keys::weights(part.y));
        let first = cell.y as usize * (Self::SIDE + 2) + cell.x as usize;
        let row = |row: usize| -> f64 {
            (0..4).map(|column| self.padded[first + row * (Self::SIDE + 2) + column] * across[column]).sum()
        };
        (0..4).map(|index| row(index) * down[index]).sum()
    }

    /// The excess at control points in their border, as `shaders/blend_weights.wgsl` reads it.
    pub(crate) fn padded(&self) -> &[f64] {
        &self.padded
    }
}

impl TryFrom<Vec<Vec<f64>>> for FallOff {
    type Error = String;

    fn try_from(rows: Vec<Vec<f64>>) -> Result<Self, String> {
        let row = |row: Vec<f64>| <[f64; Self::SIDE]>::try_from(row).ok();
        let parts: Option<Vec<_>> = rows.into_iter().map(row).collect();
        let parts = parts.and_then(|rows| <[[f64; Self::SIDE]; Self::SIDE]>::try_from(rows).ok());
        Self::new(parts.ok_or_else(|| format!("fall_off has {0} rows of {0} numbers each, from the top", Self::SIDE))?)
    }
}

impl From<FallOff> for Vec<Vec<f64>> {
    fn from(fall_off: FallOff) -> Self {
        fall_off.parts.iter().map(|row| row.to_vec()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A quadratic function, brightest beside the middle.
    fn light(at: DVec2) -> f64 {
        1.0 - 0.5 * (at - DVec2::new(0.5, 0.25)).length_squared()
    }

    #[test]
    fn quadratic_fall_off_is_met_everywhere() {
        let parts =
            std::array::from_fn(|row| std::array::from_fn(|column| light(DVec2::new(column as f64, row as f64) / 4.0)));
        let fall_off = FallOff::new(parts).expect("parts");
        let darkest = light(DVec2::ONE);
        for n in 0..400 {
            let at = DVec2::new(f64::from(n % 20), f64::from(n / 20)) / 19.0;
            assert!((fall_off.excess(at) - light(at) / darkest).abs() < 1e-9, "{at}");
        }
    }

    #[test]
    fn other_grids_and_lights_are_refused() {
        let refused = |rows: Vec<Vec<f64>>| FallOff::try_from(rows).expect_err("refused");
        assert!(refused(vec![vec![1.0; 5]; 4]).contains("5 rows of 5 numbers"));
        assert!(refused(vec![vec![1.0; 6]; 5]).contains("5 rows of 5 numbers"));
        for part in [0.0, -1.0, 1.1, f64::NAN] {
            assert!(refused(vec![vec![part; 5]; 5]).contains("from 0.2 to 1"), "{part}");
        }
    }
}
