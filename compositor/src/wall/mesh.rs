//! A mesh of control points, for projectors on a wall that is not flat: where each point of a projector's image lies on
//! the canvas.
//!
//! Control points lie on a lattice over the image, the outermost on its edges. Between them `keys` interpolates. [`pfm`] is
//! the format of mesh files, `inverse` the way back from the canvas.

mod inverse;
pub(crate) mod keys;
pub mod pfm;

use std::fmt;

use glam::{DMat2, DVec2, DVec4};

use self::{
    inverse::Inverse,
    keys::{padded, weights},
    pfm::Pfm,
};
use super::projector::CanvasRect;

/// Where a projector's image lies on the canvas.
///
/// The image runs from (0, 0) upper left to (1, 1) lower right, as seen on the wall; the canvas from (0, 0) lower left to
/// (1, 1) upper right. Invariant: the mesh folds nowhere, is not mirrored, and a part of it lies on the canvas.
#[derive(Clone)]
pub struct Mesh {
    /// The name of its file, beside the wall file.
    file: String,
    /// Columns and rows of control points.
    size: [usize; 2],
    /// Control points on the canvas, row by row from the top, in a border of points by which the mesh continues.
    padded: Vec<DVec2>,
    /// The smallest rectangle of the canvas that holds the mesh, as far as it lies on the canvas.
    bounds: CanvasRect,
    inverse: Inverse,
}

/// Why control points make no mesh.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum MeshError {
    #[error("{0}")]
    NoPfm(String),
    #[error(
        "{columns}×{rows} control points: a mesh has from 2 to {} a side, so leave out some",
        Mesh::MOST_POINTS_A_SIDE
    )]
    Size { columns: usize, rows: usize },
    #[error("the control point in column {column} and row {row} from the top is no place near the canvas")]
    NoPlace { column: usize, row: usize },
    #[error(
        "the mesh folds, or is mirrored, at the control point in column {column} and row {row} from the top: points run \
         from the upper left of the picture, as seen on the wall, to the right and down"
    )]
    Folded { column: usize, row: usize },
    #[error(
        "its control points all lie on one place or line, from ({}, {}) to ({}, {}) of the canvas, which runs from (0, 0) to \
         (1, 1): write each point's own place",
        least.x, least.y, greatest.x, greatest.y
    )]
    Flat { least: DVec2, greatest: DVec2 },
    #[error("the mesh lies beyond the canvas: its points are metres from the canvas's lower-left corner")]
    BeyondCanvas,
}

/// The farthest that control points may lie from the canvas, in sides of it.
const FARTHEST: f64 = 10.0;
/// A mesh smaller than this part of the canvas, each way, lights less than a pixel.
const LEAST_SIDE: f64 = 1e-4;

impl Mesh {
    /// The most control points a side: one for each four pixels of the widest projectors.
    pub const MOST_POINTS_A_SIDE: usize = 1025;

    /// A mesh of control points on the canvas, row by row from the upper left, as seen on the wall.
    ///
    /// # Errors
    /// There are too few points or too many, or the mesh folds or lies beyond the canvas.
    pub fn new(file: String, size: [usize; 2], points: &[DVec2]) -> Result<Self, MeshError> {
        let [columns, rows] = size;
        let is_possible = |n: usize| (2..=Self::MOST_POINTS_A_SIDE).contains(&n);
        if !is_possible(columns) || !is_possible(rows) || points.len() != columns * rows {
            return Err(MeshError::Size { columns, rows });
        }
        let is_far = |at: &DVec2| !at.is_finite() || (*at - 0.5).abs().max_element() > FARTHEST;
        if let Some(index) = points.iter().position(is_far) {
            return Err(MeshError::NoPlace { column: index % columns, row: index / columns });
        }
        let mut mesh =
            Self { file, size, padded: padded(size, points), bounds: bounds(points)?, inverse: Inverse::default() };
        if let Some([column, row]) = mesh.fold() {
            return Err(MeshError::Folded { column, row });
        }
        mesh.inverse = Inverse::new(&mesh);
        Ok(mesh)
    }

    /// The mesh in a PFM file of three channels: metres to the right of the canvas's left edge, metres above its lower
    /// edge, and one that is not used.
    ///
    /// # Errors
    /// It is no such file, or no mesh.
    pub fn from_pfm(file: String, bytes: &[u8], canvas_m: [f64; 2]) -> Result<Self, MeshError> {
        let Pfm { size, values } = Pfm::read(bytes).map_err(MeshError::NoPfm)?;
        let canvas_m = DVec2::from(canvas_m);
        let points: Vec<DVec2> =
            values.iter().map(|[x, y, _]| DVec2::new((*x).into(), (*y).into()) / canvas_m).collect();
        Self::new(file, size, &points)
    }

    /// The bytes of the mesh's file; see [`Mesh::from_pfm`].
    pub fn to_pfm(&self, canvas_m: [f64; 2]) -> Vec<u8> {
        let metres = |at: DVec2| (at * DVec2::from(canvas_m)).as_vec2();
        let values = self.points().map(metres).map(|at| [at.x, at.y, 0.0]).collect();
        Pfm { size: self.size, values }.write()
    }

    /// The name of its file, beside the wall file.
    pub fn file(&self) -> &str {
        &self.file
    }

    /// Columns and rows of control points.
    pub fn size(&self) -> [usize; 2] {
        self.size
    }

    /// The control points on the canvas, row by row from the top.
    pub fn points(&self) -> impl Iterator<Item = DVec2> + '_ {
        let [columns, rows] = self.size;
        (0..rows)
            .flat_map(move |row| (0..columns).map(move |column| self.padded[(row + 1) * (columns + 2) + column + 1]))
    }

    /// The control points in their border, as `shaders/places.wgsl` reads them.
    pub(crate) fn padded(&self) -> &[DVec2] {
        &self.padded
    }

    /// The way back, as `shaders/blend_weights.wgsl` reads it: see [`Mesh::image_near`].
    pub(crate) fn inverse_points(&self) -> ([usize; 2], &[DVec2]) {
        (self.inverse.size, &self.inverse.points)
    }

    /// The smallest rectangle of the canvas that holds the mesh, as far as it lies on the canvas.
    pub fn bounds(&self) -> CanvasRect {
        self.bounds
    }

    /// The point of the canvas at a point of the image; beyond the image the mesh continues straight.
    pub fn canvas_at(&self, image: DVec2) -> DVec2 {
        self.with_slope(image).0
    }

    /// The point of the image at a point of the canvas; beyond the image, about where the mesh would continue.
    pub fn image_at(&self, canvas: DVec2) -> DVec2 {
        inverse::refined(self, canvas, self.image_near(canvas))
    }

    /// The same to within a part in ten thousand of the image, as the GPU finds it.
    pub fn image_near(&self, canvas: DVec2) -> DVec2 {
        self.inverse.at(self.bounds.rect_from_canvas(canvas))
    }

    /// The point of the canvas, and its change with the image's columns and rows.
    fn with_slope(&self, image: DVec2) -> (DVec2, DMat2) {
        let within = image.clamp(DVec2::ZERO, DVec2::ONE);
        let n_cells = DVec2::new((self.size[0] - 1) as f64, (self.size[1] - 1) as f64);
        let at = within * n_cells;
        let cell = at.floor().min(n_cells - 1.0);
        let ([across, across_slope], [down, down_slope]) = (weights((at - cell).x), weights((at - cell).y));
        let first = cell.y as usize * (self.size[0] + 2) + cell.x as usize;
        let (mut canvas, mut slope) = (DVec2::ZERO, DMat2::ZERO);
        for row in 0..4 {
            let points = &self.padded[first + row * (self.size[0] + 2)..][..4];
            let mixed = |weights: DVec4| (0..4).map(|column| points[column] * weights[column]).sum::<DVec2>();
            let here = mixed(across);
            canvas += here * down[row];
            slope.x_axis += mixed(across_slope) * down[row] * n_cells.x;
            slope.y_axis += here * down_slope[row] * n_cells.y;
        }
        (canvas + slope * (image - within), slope)
    }

    /// The first control point at which the mesh folds or is mirrored.
    fn fold(&self) -> Option<[usize; 2]> {
        let [columns, rows] = self.size;
        let n_cells = DVec2::new((columns - 1) as f64, (rows - 1) as f64);
        let places = (0..rows).flat_map(|row| (0..columns).map(move |column| [column, row]));
        places.into_iter().find(|&[column, row]| {
            // At the control point, and in the middle of the cell to its lower right.
            [0.0, 0.5].into_iter().any(|half| {
                let slope = self.with_slope((DVec2::new(column as f64, row as f64) + half).min(n_cells) / n_cells).1;
                // The image runs down, the canvas up.
                slope.determinant() >= 0.0
            })
        })
    }

    /// Columns and rows of pixels to a width and a height of the canvas, where they are densest, for an image of `size`
    /// pixels.
    pub(super) fn density(&self, [width, height]: [u32; 2]) -> [f64; 2] {
        let [columns, rows] = self.size;
        let points: Vec<DVec2> = self.points().collect();
        let length = |line: &mut dyn Iterator<Item = DVec2>, axis: usize| {
            let line: Vec<DVec2> = line.collect();
            line.windows(2).map(|pair| (pair[1] - pair[0])[axis].abs()).sum::<f64>()
        };
        let across = (0..rows).map(|row| length(&mut points[row * columns..][..columns].iter().copied(), 0));
        let down = (0..columns).map(|column| length(&mut points.iter().skip(column).step_by(columns).copied(), 1));
        let least = |lengths: &mut dyn Iterator<Item = f64>| lengths.fold(f64::INFINITY, f64::min).max(LEAST_SIDE);
        [f64::from(width) / least(&mut across.into_iter()), f64::from(height) / least(&mut down.into_iter())]
    }
}

/// All else follows from these; a mesh is mostly compared with itself.
impl PartialEq for Mesh {
    fn eq(&self, other: &Self) -> bool {
        std::ptr::eq(self, other) || (&self.file, self.size, &self.padded) == (&other.file, other.size, &other.padded)
    }
}

/// Thousands of numbers say nothing.
impl fmt::Debug for Mesh {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.debug_struct("Mesh").field("file", &self.file).field("size", &self.size).finish_non_exhaustive()
    }
}

/// The part of the canvas around points.
fn bounds(points: &[DVec2]) -> Result<CanvasRect, MeshError> {
    let least = points.iter().copied().fold(DVec2::INFINITY, DVec2::min);
    let greatest = points.iter().copied().fold(DVec2::NEG_INFINITY, DVec2::max);
    let is_area = |size: DVec2| size.cmpgt(DVec2::splat(LEAST_SIDE)).all();
    if !is_area(greatest - least) {
        return Err(MeshError::Flat { least, greatest });
    }
    let (least, greatest) = (least.max(DVec2::ZERO), greatest.min(DVec2::ONE));
    let size = greatest - least;
    if !is_area(size) {
        return Err(MeshError::BeyondCanvas);
    }
    Ok(CanvasRect { left: least.x, bottom: least.y, width: size.x, height: size.y })
}

#[cfg(test)]
mod tests;
