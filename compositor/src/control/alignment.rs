//! Setting a wall up: test patterns, and the corners of pictures dragged to where they belong and saved.
//!
//! Pure but for the saving: who owns a window tells it of keys and mouse, in pixels of the output that spans all
//! projectors, and shows what it says. [`pattern`] draws, [`save`] changes the wall's file.

pub mod pattern;
pub mod save;
mod sheet;

use std::path::PathBuf;

use anyhow::Context;
use glam::DVec2;

use crate::wall::{Projector, Wall};
pub use pattern::{Pattern, PatternImage};

/// What an operator is doing to align the wall, if anything.
#[derive(Clone, Debug, Default)]
pub struct Alignment {
    /// Where the wall came from, and its corners are saved.
    file: Option<PathBuf>,
    pattern: Option<Pattern>,
    selected: Option<Corner>,
    /// From the cursor to the corner that it drags.
    drag_offset_px: Option<DVec2>,
}

/// A corner of a projector's picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Corner {
    /// Which of the wall's projectors.
    pub projector_idx: usize,
    /// Upper left, upper right, lower right, lower left, as seen on the wall.
    pub corner_idx: usize,
}

/// Corners lie on multiples of this, in pixels: finer than anybody sees.
const STEP_PX: f64 = 0.05;
/// A corner is grabbed from so many pixels of the output away.
const GRAB_RADIUS_PX: f64 = 60.0;

impl Alignment {
    /// Nothing yet, for a wall from this file.
    pub fn new(file: Option<PathBuf>) -> Self {
        Self { file, ..Self::default() }
    }

    /// The test pattern that is shown instead of frames.
    pub fn pattern(&self) -> Option<Pattern> {
        self.pattern
    }

    /// The corner that keys move.
    pub fn selected(&self) -> Option<Corner> {
        self.selected
    }

    /// Whether a corner follows the cursor.
    pub fn is_dragging(&self) -> bool {
        self.drag_offset_px.is_some()
    }

    /// Shows the next pattern, and after the last none.
    pub fn next_pattern(&mut self) {
        self.show(Pattern::next(self.pattern));
    }

    /// Shows a pattern, or frames again.
    pub fn show(&mut self, pattern: Option<Pattern>) {
        self.pattern = pattern;
        self.drag_offset_px = None;
        self.selected = None;
    }

    /// What is to be on the wall; `None` for frames.
    pub fn shown(&self, wall: &Wall) -> Option<anyhow::Result<PatternImage>> {
        self.pattern.map(|pattern| pattern.shown(wall, self.selected))
    }

    /// Whether mouse and arrow keys move corners now.
    pub fn takes_corners(&self) -> bool {
        self.pattern == Some(Pattern::Align)
    }

    /// Grabs the corner near a point of the output, and says whether there is one.
    pub fn press(&mut self, wall: &Wall, at: DVec2) -> bool {
        let away_from = |(corner, place): (Corner, DVec2)| {
            let away = place - at;
            // Where corners of two projectors meet, that of the projector under the cursor is meant.
            let is_elsewhere = !wall.projectors()[corner.projector_idx].output.contains(at);
            (corner, away, (is_elsewhere, away.length_squared()))
        };
        let near = corners(wall).map(away_from).filter(|(_, away, _)| away.length() <= GRAB_RADIUS_PX);
        let grabbed = near
            .min_by(|(_, _, a), (_, _, b)| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)))
            .map(|(corner, away, _)| (corner, away));
        self.selected = grabbed.map(|(corner, _)| corner);
        self.drag_offset_px = grabbed.map(|(_, away)| away);
        self.selected.is_some()
    }

    /// The wall with the grabbed corner at the cursor; `None` if none is grabbed, or it cannot be there.
    pub fn drag_to(&self, wall: &Wall, at: DVec2) -> Option<Wall> {
        let Corner { projector_idx, corner_idx } = self.selected?;
        let projector = wall.projectors().get(projector_idx)?;
        let wanted = at + self.drag_offset_px?;
        self.moved(wall, seen_from_stored(projector, wanted - corner_px(projector, corner_idx)?))
    }

    /// Lets go of the corner, which stays selected.
    pub fn release(&mut self) {
        self.drag_offset_px = None;
    }

    /// The wall with the selected corner so many pixels farther right and down, as seen on the wall.
    pub fn moved(&self, wall: &Wall, by_px: DVec2) -> Option<Wall> {
        let Corner { projector_idx, corner_idx } = self.selected?;
        let mut warp_px = wall.projectors().get(projector_idx)?.warp_px;
        let moved = (DVec2::from(warp_px[corner_idx]) + by_px) / STEP_PX;
        // Decimal places, not what binary fractions make of them.
        warp_px[corner_idx] = moved.to_array().map(|steps| steps.round() / (1.0 / STEP_PX));
        // A picture that would cross itself stays as it is.
        wall.with_warp(projector_idx, warp_px).ok()
    }

    /// Selects the next corner of all.
    pub fn next_corner(&mut self, wall: &Wall) {
        let all: Vec<Corner> = corners(wall).map(|(corner, _)| corner).collect();
        let position = self.selected.and_then(|selected| all.iter().position(|&corner| corner == selected));
        self.selected = all.get(position.map_or(0, |position| (position + 1) % all.len().max(1))).copied();
    }

    /// Writes all corners into the wall's file, and says what was done.
    pub fn save(&self, wall: &Wall) -> anyhow::Result<String> {
        let file = self.file.as_deref().context(
            "the corners cannot be saved: the wall was started without a file; copy wall-config/blended-4x3.toml, say, \
             and start with --wall FILE",
        )?;
        save::save_warps(file, wall)?;
        Ok(format!("saved the corners in {}", file.display()))
    }
}

/// All corners, and where they are in pixels of the output.
fn corners(wall: &Wall) -> impl Iterator<Item = (Corner, DVec2)> {
    wall.projectors().iter().enumerate().flat_map(|(projector_idx, projector)| {
        let at = move |corner_idx| Some((Corner { projector_idx, corner_idx }, corner_px(projector, corner_idx)?));
        (0..4).filter_map(at)
    })
}

/// Where a corner of a projector's picture is, in pixels of the output that spans all projectors.
fn corner_px(projector: &Projector, corner_idx: usize) -> Option<DVec2> {
    pattern::to_output(projector, crate::wall::homography::UNIT_SQUARE[corner_idx])
}

/// A step in pixels as they are stored, as it is seen on the wall.
fn seen_from_stored(projector: &Projector, step: DVec2) -> DVec2 {
    let upright = Projector { warp_px: [[0.0; 2]; 4], ..projector.clone() };
    // Without a warp a place and its pixels as seen differ by scale alone.
    let Some(stored_from_seen) = upright.raster_from_rect() else { return step };
    let stored_size = DVec2::new(f64::from(projector.output.width), f64::from(projector.output.height));
    let seen_size = DVec2::from(projector.upright_size().map(f64::from));
    stored_from_seen.inverse().transform_vector2(step / stored_size) * seen_size
}

#[cfg(test)]
mod tests;
