//! Lays the canvas onto the wall that was solved, and finds each projector's corners.

use glam::{DMat3, DVec2};

use super::{
    fitting::fitted,
    lens::Lens,
    solve::{Shot, Solution},
};
use crate::wall::{
    Projector, Wall,
    homography::{UNIT_SQUARE, apply},
};

/// Where the canvas lies on the wall. Photographs alone do not tell: they show it at a slant.
#[derive(Clone, Debug, PartialEq)]
pub enum Placement {
    /// Where the wall file has it: all corners together move as little as possible, and projectors that were bumped count
    /// little. With screens, whose places are known, this is the frame of their bezels.
    Keep,
    /// As [`Placement::Keep`], then as large as possible while each projector lights all of the part that the file gives
    /// it; if they overlap too little for that, as [`Placement::Keep`].
    Largest,
    /// Its four corners are where the wall file's corners have them; the others follow.
    Corners,
    /// Its four corners, upper left, upper right, lower right and lower left, are at these pixels of a shot.
    Marks {
        /// The shot, by index.
        shot: usize,
        /// Pixels of its photograph.
        at: [DVec2; 4],
    },
}

/// Corners are rounded to this part of a pixel.
const STEPS_PER_PX: f64 = 100.0;

impl Placement {
    /// The placement for a wall whose operator chose none: kept if corners were moved before.
    pub fn of_wall(wall: &Wall) -> Self {
        let was_aligned = wall.projectors().iter().any(Projector::is_warped);
        let overlaps = (0..wall.projectors().len()).any(|index| wall.neighbours(index).len() > 1);
        if overlaps && !was_aligned { Self::Largest } else { Self::Keep }
    }

    /// From the canvas, whose corners are (0, 0) lower left and (1, 1) upper right, to the plane of the solution.
    ///
    /// `None` if too little was solved for it.
    pub fn plane_from_canvas(&self, wall: &Wall, shots: &[Shot], solution: &Solution) -> Option<DMat3> {
        match self {
            Self::Keep => kept(wall, solution),
            Self::Largest => {
                let kept = kept(wall, solution)?;
                Some(largest(wall, solution, kept).unwrap_or(kept))
            }
            Self::Corners => {
                let corner = |corner: DVec2| Some([corner, outer_corner(wall, solution, corner)?]);
                let pairs: Option<Vec<_>> = CANVAS_CORNERS.into_iter().map(corner).collect();
                fitted(&pairs?)
            }
            Self::Marks { shot, at } => {
                let map = (*solution.plane_from_shot.get(*shot)?)?;
                let plane = |at: DVec2| {
                    let seen = Lens::normalised(shots[*shot].size, at);
                    apply(map, solution.lenses[*shot].undistorted(seen).at)
                };
                let pairs: Option<Vec<_>> =
                    CANVAS_CORNERS.into_iter().zip(at).map(|(corner, at)| Some([corner, plane(*at)?])).collect();
                fitted(&pairs?)
            }
        }
    }
}

/// Upper left, upper right, lower right, lower left.
const CANVAS_CORNERS: [DVec2; 4] = [DVec2::Y, DVec2::ONE, DVec2::X, DVec2::ZERO];

/// The corners of a projector's image that make it show its rectangle of the canvas; see [`Projector::warp_px`].
///
/// `None` if a corner lies beyond the projector's horizon.
pub fn warp_px(projector: &Projector, px_from_plane: DMat3, plane_from_canvas: DMat3) -> Option<[[f64; 2]; 4]> {
    let upright_px = DVec2::from(projector.upright_size().map(f64::from));
    let upright_from_raster = projector.raster_from_upright().inverse();
    let mut warp_px = [[0.0; 2]; 4];
    for (warp, corner) in warp_px.iter_mut().zip(UNIT_SQUARE) {
        let plane = apply(plane_from_canvas, projector.canvas.canvas_from_rect(corner))?;
        let raster = apply(px_from_plane, plane)? / projector.output.size();
        let moved = (upright_from_raster.transform_point2(raster) - corner) * upright_px;
        // Zero is added to -0, which would look odd in a file.
        *warp = (moved * STEPS_PER_PX).round().to_array().map(|steps| steps / STEPS_PER_PX + 0.0);
    }
    Some(warp_px)
}

/// The point of the plane where the wall file has a point of a projector's rectangle.
fn plane_at(projector: &Projector, px_from_plane: DMat3, rect_point: DVec2) -> Option<DVec2> {
    let px = apply(projector.raster_from_image()?, projector.image_at(rect_point))? * projector.output.size();
    apply(px_from_plane.inverse(), px)
}

/// Projectors that were solved.
fn solved<'a>(wall: &'a Wall, solution: &'a Solution) -> impl Iterator<Item = (&'a Projector, DMat3)> {
    wall.projectors().iter().zip(&solution.px_from_plane).filter_map(|(projector, map)| Some((projector, (*map)?)))
}

fn kept(wall: &Wall, solution: &Solution) -> Option<DMat3> {
    let pairs: Vec<[DVec2; 2]> = solved(wall, solution)
        .flat_map(|(projector, map)| {
            UNIT_SQUARE.into_iter().filter_map(move |corner| {
                Some([projector.canvas.canvas_from_rect(corner), plane_at(projector, map, corner)?])
            })
        })
        .collect();
    fitted(&pairs)
}

/// The point of the plane where the wall file's corners have a corner of the canvas.
fn outer_corner(wall: &Wall, solution: &Solution, corner: DVec2) -> Option<DVec2> {
    let reaches = |projector: &Projector| {
        let rect_point = projector.canvas.rect_from_canvas(corner);
        rect_point.cmpge(DVec2::splat(-1e-6)).all() && rect_point.cmple(DVec2::splat(1.0 + 1e-6)).all()
    };
    let (projector, map) = solved(wall, solution).find(|(projector, _)| reaches(projector))?;
    plane_at(projector, map, projector.canvas.rect_from_canvas(corner))
}

/// Moves and scales the canvas to be as large as possible while each projector's rectangle lies within its pixels.
fn largest(wall: &Wall, solution: &Solution, plane_from_canvas: DMat3) -> Option<DMat3> {
    // Edges of projectors' pixels on the canvas, as half-planes: normal · point <= limit, for each corner of the rectangle.
    let canvas_from_plane = plane_from_canvas.inverse();
    let centre = DVec2::splat(0.5);
    let mut limits: Vec<(DVec2, f64, DVec2)> = Vec::new();
    for (projector, map) in solved(wall, solution) {
        let px_corner = |corner: DVec2| {
            let plane = apply(map.inverse(), corner * projector.output.size())?;
            apply(canvas_from_plane, plane)
        };
        let quad: Option<Vec<DVec2>> = UNIT_SQUARE.into_iter().map(px_corner).collect();
        let quad = quad?;
        let middle = quad.iter().sum::<DVec2>() / 4.0;
        for index in 0..4 {
            let (from, to) = (quad[index], quad[(index + 1) % 4]);
            let outwards = {
                let normal = (to - from).perp().normalize_or_zero();
                if normal.dot(from - middle) >= 0.0 { normal } else { -normal }
            };
            for corner in UNIT_SQUARE {
                limits.push((outwards, outwards.dot(from), projector.canvas.canvas_from_rect(corner)));
            }
        }
    }
    // Moves that keep all corners within their limits at a scale: a convex polygon, cut by each limit.
    let moves = |scale: f64| {
        let mut polygon: Vec<DVec2> = UNIT_SQUARE.iter().map(|corner| *corner * 2.0 - 1.0).collect();
        for (normal, limit, corner) in &limits {
            let most = limit - normal.dot(centre + scale * (corner - centre));
            polygon = cut(&polygon, *normal, most);
        }
        polygon
    };
    // Scales that are possible are near 1: a smaller canvas would leave projectors outside, too.
    let scales = (0..=1000).map(|step| 1.5 - f64::from(step) / 1000.0);
    let mut fits = scales.into_iter().find(|scale| !moves(*scale).is_empty())?;
    let mut exceeds = fits + 1e-3;
    for _ in 0..20 {
        let scale = f64::midpoint(fits, exceeds);
        if moves(scale).is_empty() { exceeds = scale } else { fits = scale }
    }
    // A little smaller, so that rounded corners stay within.
    let fits = fits - 1e-4;
    let polygon = moves(fits);
    let by = polygon.iter().sum::<DVec2>() / polygon.len() as f64;
    let placed =
        DMat3::from_translation(centre + by) * DMat3::from_scale(DVec2::splat(fits)) * DMat3::from_translation(-centre);
    Some(plane_from_canvas * placed)
}

/// The part of a convex polygon in which normal · point is at most `limit` (Sutherland and Hodgman 1974).
fn cut(polygon: &[DVec2], normal: DVec2, limit: f64) -> Vec<DVec2> {
    let mut kept = Vec::with_capacity(polygon.len() + 1);
    for (index, point) in polygon.iter().enumerate() {
        let next = polygon[(index + 1) % polygon.len()];
        let (here, there) = (normal.dot(*point) - limit, normal.dot(next) - limit);
        if here <= 0.0 {
            kept.push(*point);
        }
        if (here < 0.0 && there > 0.0) || (here > 0.0 && there < 0.0) {
            kept.push(*point + (next - *point) * (here / (here - there)));
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wall::{CanvasRect, Flip, PixelRect, Rotation};

    #[test]
    fn corners_that_a_projector_has_are_found_again_however_it_hangs() {
        for degrees in [0, 90, 180, 270] {
            for flip in [Flip::None, Flip::Horizontal, Flip::Vertical] {
                let canvas = CanvasRect { left: 0.2, bottom: 0.1, width: 0.5, height: 0.7 };
                let plain = Projector::plain("a".into(), canvas, PixelRect { x: 7, y: 3, width: 400, height: 300 });
                let warp = [[3.0, 5.25], [-4.5, 2.0], [-7.0, -3.5], [6.0, -1.0]];
                let rotation = Rotation::from_degrees(degrees).expect("a quarter turn");
                let projector = Projector { rotation, flip, warp_px: warp, ..plain };
                // The plane is the canvas.
                let pairs: Vec<[DVec2; 2]> = UNIT_SQUARE
                    .into_iter()
                    .map(|corner| {
                        let raster = apply(projector.raster_from_image().expect("convex"), corner).expect("there");
                        [canvas.canvas_from_rect(corner), raster * projector.output.size()]
                    })
                    .collect();
                let px_from_plane = fitted(&pairs).expect("four corners");
                let found = warp_px(&projector, px_from_plane, DMat3::IDENTITY).expect("before the horizon");
                assert_eq!(found, warp, "{degrees} {flip:?}");
            }
        }
    }

    #[test]
    fn a_polygon_is_cut_by_a_line() {
        let square: Vec<DVec2> = UNIT_SQUARE.to_vec();
        assert_eq!(cut(&square, DVec2::X, 2.0), square);
        assert_eq!(cut(&square, DVec2::X, -1.0), []);
        let half = cut(&square, DVec2::X, 0.5);
        assert_eq!(half.len(), 4);
        assert!(half.iter().all(|point| point.x <= 0.5));
    }
}
