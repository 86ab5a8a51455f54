//! The patterns that projectors show: checkerboards whose squares carry a bit each.
//!
//! A dot in a square is a bit of a pseudo-random array, so any part of about seven by seven squares says which projector
//! it is on, and where: Morano et al., "Structured Light Using Pseudorandom Codes" (1998). Crossings of a checkerboard
//! stay where they are under blur, exposure and any response curve. Each photograph can be read by itself, so a camera
//! may move between two, and their order does not matter; Gray codes and phase shifts need a tripod, and ten times as many.
//!
//! Patterns of light are boards as well, with the same dots. Their squares have inks instead of black and white, by which
//! the light of projectors is measured.

use glam::{DMat3, DVec2, DVec3};

use super::light::Ink;
use crate::wall::{PixelRect, Projector, Wall, homography::apply};

/// A projector's pixels and their likely place.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Shape {
    /// Columns and rows, as stored.
    size: [u32; 2],
    /// From pixels, which run from (0, 0) upper left to (1, 1) lower right as stored, to the canvas.
    canvas_from_raster: DMat3,
}

/// The checkerboard of one projector.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Board {
    /// Columns and rows of the projector's pixels.
    size: [u32; 2],
    /// Columns and rows of squares.
    pub squares: [u32; 2],
    /// The side of a square in pixels.
    side: u32,
    /// The pixel at the first square's corner.
    origin: [u32; 2],
    /// The pattern in which this projector shows its whole board; in the others it leaves out what it shares.
    set: u32,
}

/// All patterns of a wall.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// Tells walls apart.
    seed: u64,
    /// One for each projector.
    pub(super) boards: Vec<Board>,
    /// The number of patterns that show places; as many that show light follow.
    pub(super) n_patterns: u32,
    shapes: Vec<Shape>,
}

/// The most projectors that are calibrated together: their codes take 60 MB.
pub const MOST_PROJECTORS: usize = 256;

/// The squares across a projector, unless they would be smaller than [`SMALLEST_SIDE`]: a photograph of a wall with four
/// columns then has twenty pixels or more for each.
const SQUARES_ACROSS: u32 = 40;
/// The least side of a square, in pixels: a dot has eight then.
const SMALLEST_SIDE: u32 = 16;
/// The fewest squares along a projector's side.
const LEAST_SQUARES: u32 = 6;
/// Projectors may stand this far from where the wall file has them, as a part of their sides.
const SLACK: f64 = 0.08;
/// A dot's radius, as a part of its square's side.
pub(super) const DOT_RADIUS: f64 = 0.21;

impl Plan {
    /// The patterns of a wall. They stay the same when corners move, except for the squares that are left out.
    ///
    /// # Errors
    /// It has too many projectors, or one has too few pixels; the text names the cure.
    pub fn of_wall(wall: &Wall) -> Result<Self, String> {
        let n_projectors = wall.projectors().len();
        if n_projectors > MOST_PROJECTORS {
            return Err(format!(
                "the wall has {n_projectors} projectors, and at most {MOST_PROJECTORS} are calibrated together: divide \
                 its file"
            ));
        }
        let smallest = LEAST_SQUARES * SMALLEST_SIDE;
        for Projector { name, output, .. } in wall.projectors() {
            if output.width.min(output.height) < smallest {
                return Err(format!(
                    "\"{name}\" has {}×{} pixels, and patterns need {smallest} a side: align it by hand",
                    output.width, output.height
                ));
            }
        }
        let seed = wall.projectors().iter().fold(0, |seed, Projector { name, output, .. }| {
            let PixelRect { x, y, width, height } = *output;
            let numbers = [x, y, width, height].map(u64::from);
            name.bytes().map(u64::from).chain(numbers).fold(mixed(seed), |seed, number| mixed(seed ^ number))
        });
        let shape = |projector: &Projector| {
            let rect = projector.canvas;
            let canvas_from_rect = DMat3::from_cols(
                DVec3::new(rect.width, 0.0, 0.0),
                DVec3::new(0.0, -rect.height, 0.0),
                DVec3::new(rect.left, rect.bottom + rect.height, 1.0),
            );
            let raster_from_image = projector.raster_from_image().unwrap_or(DMat3::IDENTITY);
            let size = [projector.output.width, projector.output.height];
            // A mesh is near the rectangle around it.
            Shape { size, canvas_from_raster: canvas_from_rect * raster_from_image.inverse() }
        };
        Ok(Self::new(seed, &wall.projectors().iter().map(shape).collect::<Vec<_>>()))
    }

    /// As few patterns as let each projector show all of its board while its neighbours' stay dark there.
    fn new(seed: u64, shapes: &[Shape]) -> Self {
        let mut sets: Vec<u32> = Vec::new();
        for (index, shape) in shapes.iter().enumerate() {
            // Greedy colouring of the graph of overlaps.
            let taken: Vec<u32> = (0..index).filter(|&other| meet(shape, &shapes[other])).map(|it| sets[it]).collect();
            sets.push((0..).find(|set| !taken.contains(set)).unwrap_or(0));
        }
        let board = |(shape, set): (&Shape, &u32)| {
            let [width, height] = shape.size;
            let side = (width.max(height).div_ceil(SQUARES_ACROSS)).max(SMALLEST_SIDE);
            let squares = [width / side, height / side];
            let origin = [(width - squares[0] * side) / 2, (height - squares[1] * side) / 2];
            Board { size: shape.size, squares, side, origin, set: *set }
        };
        let boards = shapes.iter().zip(&sets).map(board).collect();
        let n_patterns = sets.iter().max().map_or(0, |last| last + 1);
        Self { seed, boards, n_patterns, shapes: shapes.to_vec() }
    }

    /// The bit of a square.
    pub(super) fn bit(&self, pattern: u32, projector_idx: usize, [column, row]: [u32; 2]) -> bool {
        let place = u64::from(column) | u64::from(row) << 16 | (projector_idx as u64) << 32 | u64::from(pattern) << 48;
        mixed(self.seed ^ mixed(place)) & 1 == 1
    }

    /// Whether a projector shows a square in a pattern.
    fn shows(&self, pattern: u32, projector_idx: usize, square: [u32; 2]) -> bool {
        let board = &self.boards[projector_idx];
        if board.set == pattern % self.n_patterns {
            return true;
        }
        let own = &self.shapes[projector_idx];
        let centre = (board.corner_px(square.map(|it| f64::from(it) + 0.5))) / size_of(own);
        let Some(on_canvas) = apply(own.canvas_from_raster, centre) else { return false };
        let others = self.shapes.iter().enumerate().filter(|(other, _)| *other != projector_idx);
        !others.into_iter().any(|(_, other)| contains(other, on_canvas))
    }

    /// The number of patterns that show places: numbers from 0.
    pub fn n_patterns(&self) -> u32 {
        self.n_patterns
    }

    /// The pattern that shows all of a projector's board, from 0.
    pub fn whole_in(&self, projector_idx: usize) -> u32 {
        self.boards[projector_idx].set
    }

    /// The number of all patterns: those that show places, then those that show light.
    pub fn n_with_light(&self) -> u32 {
        2 * self.n_patterns
    }

    /// The ink of a square that has no dot and is shown in a pattern of light; `None` for all others.
    pub(super) fn ink(&self, pattern: u32, projector_idx: usize, square: [u32; 2]) -> Option<Ink> {
        let is_plain = self.shows(pattern, projector_idx, square) && !self.bit(pattern, projector_idx, square);
        (pattern >= self.n_patterns && is_plain).then(|| Ink::of_square(pattern, square, is_white(square)))
    }

    /// A pattern on the projectors of an output, which shows `part` of the spanning output: red, green and blue, row by
    /// row from the top left.
    pub fn draw(&self, pattern: u32, wall: &Wall, part: PixelRect) -> Vec<[u8; 3]> {
        let mut values = vec![[0; 3]; part.width as usize * part.height as usize];
        for (projector_idx, Projector { output, .. }) in wall.projectors().iter().enumerate() {
            if part.contains_rect(output) {
                let first = (output.y - part.y) as usize * part.width as usize + (output.x - part.x) as usize;
                self.draw_board(pattern, projector_idx, part.width as usize, &mut values[first..]);
            }
        }
        values
    }

    fn draw_board(&self, pattern: u32, projector_idx: usize, stride: usize, values: &mut [[u8; 3]]) {
        let board = &self.boards[projector_idx];
        for square in (0..board.squares[1]).flat_map(|row| (0..board.squares[0]).map(move |column| [column, row])) {
            if !self.shows(pattern, projector_idx, square) {
                continue;
            }
            let has_dot = self.bit(pattern, projector_idx, square);
            let ink = (pattern >= self.n_patterns).then(|| Ink::of_square(pattern, square, is_white(square)));
            let is_white = is_white(square);
            for (x, y) in (0..board.side).flat_map(|y| (0..board.side).map(move |x| (x, y))) {
                let from_centre = DVec2::new(f64::from(x), f64::from(y)) + 0.5 - f64::from(board.side) / 2.0;
                let is_dot = has_dot && from_centre.length() < DOT_RADIUS * f64::from(board.side);
                let [column, row] = [0, 1].map(|axis| board.origin[axis] + square[axis] * board.side);
                let index = (row + y) as usize * stride + (column + x) as usize;
                values[index] = match ink {
                    Some(ink) if !is_dot => ink.value([column + x, row + y]),
                    _ => [if is_white != is_dot { 255 } else { 0 }; 3],
                };
            }
        }
    }
}

impl Board {
    /// The number of crossings.
    pub(super) fn n_crossings(&self) -> usize {
        self.squares.iter().map(|n| n.saturating_sub(1) as usize).product()
    }

    /// The place of a corner of squares, in the projector's pixels.
    pub(super) fn corner_px(&self, [column, row]: [f64; 2]) -> DVec2 {
        let origin = DVec2::from(self.origin.map(f64::from));
        origin + f64::from(self.side) * DVec2::new(column, row)
    }

    /// The way back from [`Board::corner_px`].
    pub(super) fn corner_at(&self, px: DVec2) -> DVec2 {
        (px - DVec2::from(self.origin.map(f64::from))) / f64::from(self.side)
    }

    /// Columns and rows of the projector's pixels.
    pub(super) fn size_px(&self) -> DVec2 {
        DVec2::from(self.size.map(f64::from))
    }
}

pub(super) fn is_white([column, row]: [u32; 2]) -> bool {
    (column + row).is_multiple_of(2)
}

/// The finaliser of SplitMix64: Steele, Lea and Flood, "Fast Splittable Pseudorandom Number Generators" (2014).
fn mixed(value: u64) -> u64 {
    let value = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let value = (value ^ value >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let value = (value ^ value >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    value ^ value >> 31
}

fn size_of(shape: &Shape) -> DVec2 {
    DVec2::from(shape.size.map(f64::from))
}

/// Whether a point of the canvas may lie in a projector's pixels.
fn contains(shape: &Shape, on_canvas: DVec2) -> bool {
    apply(shape.canvas_from_raster.inverse(), on_canvas)
        .is_some_and(|raster| raster.cmpge(DVec2::splat(-SLACK)).all() && raster.cmple(DVec2::splat(1.0 + SLACK)).all())
}

/// Whether two projectors may light the same place.
fn meet(a: &Shape, b: &Shape) -> bool {
    let points = || (0..=16).flat_map(|row| (0..=16).map(move |column| DVec2::new(column.into(), row.into()) / 16.0));
    let lies_in = |from: &Shape, to: &Shape| {
        points().filter_map(|point| apply(from.canvas_from_raster, point)).any(|point| contains(to, point))
    };
    lies_in(a, b) || lies_in(b, a)
}
