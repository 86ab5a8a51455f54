//! The way back through a mesh, from the canvas to the image: a lattice over the mesh's bounds, read bilinearly.

use std::collections::VecDeque;

use glam::{DMat2, DVec2};

use super::Mesh;

/// Points of the image on a lattice over the mesh's bounds, row by row from the top.
#[derive(Clone, Default)]
pub(super) struct Inverse {
    /// Columns and rows.
    pub(super) size: [usize; 2],
    pub(super) points: Vec<DVec2>,
}

/// Points a side: bilinear between them, a quarter of a cylinder is found to a 30,000th of the image.
const SIDE: usize = 97;
/// Steps of Newton's method for one point; three are usual.
const MOST_STEPS: usize = 12;
/// A point is found when it is nearer than this, in sides of the canvas.
const TOLERANCE: f64 = 1e-9;
/// Points farther from the image than this, in sides of it, are not looked for.
const FARTHEST: f64 = 3.0;

impl Inverse {
    /// Finds points one after the other, from the middle of the image outwards, each from a neighbour that was found.
    pub(super) fn new(mesh: &Mesh) -> Self {
        let canvas_at = |index: usize| {
            let part = DVec2::new((index % SIDE) as f64, (index / SIDE) as f64) / (SIDE - 1) as f64;
            mesh.bounds.canvas_from_rect(part)
        };
        let mut found: Vec<Option<DVec2>> = vec![None; SIDE * SIDE];
        let middle = mesh.bounds.rect_from_canvas(mesh.canvas_at(DVec2::splat(0.5))).clamp(DVec2::ZERO, DVec2::ONE);
        let first = (middle * (SIDE - 1) as f64).round();
        let mut queue = VecDeque::from([(first.y as usize * SIDE + first.x as usize, DVec2::splat(0.5))]);
        while let Some((index, near)) = queue.pop_front() {
            if found[index].is_some() {
                continue;
            }
            let image = refined(mesh, canvas_at(index), near);
            found[index] = Some(image);
            let (column, row) = (index % SIDE, index / SIDE);
            let mut visit = |is_there: bool, next: usize| {
                if is_there && found[next].is_none() {
                    queue.push_back((next, image));
                }
            };
            visit(column > 0, index.wrapping_sub(1));
            visit(column + 1 < SIDE, index + 1);
            visit(row > 0, index.wrapping_sub(SIDE));
            visit(row + 1 < SIDE, index + SIDE);
        }
        let points = found.into_iter().map(|image| image.unwrap_or(DVec2::splat(-FARTHEST))).collect();
        Self { size: [SIDE; 2], points }
    }

    /// The point of the image at a point of the bounds, which run from (0, 0) upper left to (1, 1).
    pub(super) fn at(&self, rect_point: DVec2) -> DVec2 {
        let n_cells = DVec2::new((self.size[0] - 1) as f64, (self.size[1] - 1) as f64);
        let at = rect_point * n_cells;
        let cell = at.floor().clamp(DVec2::ZERO, n_cells - 1.0);
        let part = at - cell;
        let first = cell.y as usize * self.size[0] + cell.x as usize;
        let row = |first: usize| self.points[first].lerp(self.points[first + 1], part.x);
        row(first).lerp(row(first + self.size[0]), part.y)
    }
}

/// The point of the image at a point of the canvas, by Newton's method from a point near it; a point beyond the image if
/// there is none.
pub(super) fn refined(mesh: &Mesh, canvas: DVec2, near: DVec2) -> DVec2 {
    let mut image = near;
    for _ in 0..MOST_STEPS {
        let (at, slope) = mesh.with_slope(image);
        let away = canvas - at;
        if away.abs().max_element() <= TOLERANCE {
            return image;
        }
        let step = solved(slope, away);
        // Half an image at most: slopes change on the way.
        let next = image + step * (0.5 / step.length()).min(1.0);
        if !next.is_finite() {
            break;
        }
        image = next.clamp(DVec2::splat(-FARTHEST), DVec2::splat(1.0 + FARTHEST));
    }
    // Not quite at the point: near a kink it is next to it, elsewhere there is none.
    let is_near = (mesh.canvas_at(image) - canvas).abs().max_element() <= 1e-4;
    let is_beyond = image.cmplt(DVec2::ZERO).any() || image.cmpgt(DVec2::ONE).any();
    if is_near || is_beyond { image } else { DVec2::splat(-FARTHEST) }
}

fn solved(slope: DMat2, away: DVec2) -> DVec2 {
    slope.inverse() * away
}
