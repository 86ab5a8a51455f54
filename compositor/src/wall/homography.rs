//! Homographies: maps from plane to plane, as a projector that stands askew makes them.

use glam::{DMat3, DVec2};

/// Upper left, upper right, lower right and lower left, with y downwards.
pub const UNIT_SQUARE: [DVec2; 4] =
    [DVec2::new(0.0, 0.0), DVec2::new(1.0, 0.0), DVec2::new(1.0, 1.0), DVec2::new(0.0, 1.0)];

/// The least sine of a corner's angle, times the lengths of its edges.
const LEAST_CORNER: f64 = 1e-3;

/// The homography that maps the corners of [`UNIT_SQUARE`] to `corners`, after Heckbert, "Fundamentals of Texture Mapping
/// and Image Warping" (1989), section 2.2.3.
///
/// `None` unless the corners make a convex quadrilateral of the same orientation.
pub fn square_to_quad(corners: [DVec2; 4]) -> Option<DMat3> {
    let [p0, p1, p2, p3] = corners;
    let turns = [(p3, p0, p1), (p0, p1, p2), (p1, p2, p3), (p2, p3, p0)];
    if !turns.iter().all(|(before, at, after)| (*at - *before).perp_dot(*after - *at) >= LEAST_CORNER) {
        return None;
    }
    let sum = p0 - p1 + p2 - p3;
    let [d1, d2] = [p1 - p2, p3 - p2];
    let area = d1.perp_dot(d2);
    let [g, h] = [sum.perp_dot(d2) / area, d1.perp_dot(sum) / area];
    let x = p1 - p0 + g * p1;
    let y = p3 - p0 + h * p3;
    Some(DMat3::from_cols(x.extend(g), y.extend(h), p0.extend(1.0)))
}

/// The image of a point; `None` at and behind the horizon.
pub fn apply(map: DMat3, point: DVec2) -> Option<DVec2> {
    let image = map * point.extend(1.0);
    (image.z > 1e-9).then(|| image.truncate() / image.z)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_go_where_they_are_wanted_and_straight_lines_stay_straight() {
        let corners = [[0.1, -0.05], [0.93, 0.02], [1.2, 0.9], [-0.07, 1.0]].map(DVec2::from);
        let map = square_to_quad(corners).expect("convex");
        for (corner, expected) in UNIT_SQUARE.into_iter().zip(corners) {
            assert!((apply(map, corner).expect("in front") - expected).length() < 1e-14);
        }
        // The diagonals cross where the square's do.
        let [a, c] = [corners[0], corners[2]];
        let centre = apply(map, DVec2::splat(0.5)).expect("in front");
        assert!((c - a).perp_dot(centre - a).abs() < 1e-14);
    }

    #[test]
    fn the_unit_square_maps_to_itself() {
        assert_eq!(square_to_quad(UNIT_SQUARE), Some(DMat3::IDENTITY));
    }

    #[test]
    fn crossed_folded_flat_and_mirrored_pictures_are_refused() {
        let refused = |corners: [[f64; 2]; 4]| square_to_quad(corners.map(DVec2::from)).is_none();
        assert!(refused([[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]]), "crossed");
        assert!(refused([[0.0, 0.0], [1.0, 0.0], [0.2, 0.2], [0.0, 1.0]]), "folded");
        assert!(refused([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]), "flat");
        assert!(refused([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]), "mirrored");
        assert!(refused([[0.5, 0.5]; 4]), "a point");
        assert!(refused([[f64::NAN, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), "no numbers");
    }
}
