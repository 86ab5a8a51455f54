//! Aligns a wall: test patterns, and corners of projectors' images that are dragged into place and saved.
//!
//! Pure except for saving. Points are pixels of the spanning output. [`pattern`] draws, [`save`] edits the wall's file.

pub mod pattern;
pub mod save;
mod sheet;

use std::path::PathBuf;

use anyhow::Context;
use glam::DVec2;

pub use self::pattern::{Corner, Pattern, PatternImage};
use crate::wall::{Projector, Wall, homography::UNIT_SQUARE};

/// The test pattern on the wall, and the corner that is selected in it.
#[derive(Clone, Debug, Default)]
pub struct Alignment {
    /// The wall's file, where corners are saved.
    file: Option<PathBuf>,
    pattern: Option<Pattern>,
    selected: Option<Corner>,
    /// Vector from the cursor to the corner that it drags.
    drag_offset_px: Option<DVec2>,
}

/// Corners lie on multiples of this, in pixels: finer than the eye resolves.
const STEP_PX: f64 = 0.05;
/// The mouse grabs a corner within this distance, in pixels of the output.
const GRAB_RADIUS_PX: f64 = 60.0;

impl Alignment {
    /// No pattern, on a wall from this file.
    pub fn new(file: Option<PathBuf>) -> Self {
        Self { file, ..Self::default() }
    }

    /// The test pattern in place of frames.
    pub fn pattern(&self) -> Option<Pattern> {
        self.pattern
    }

    /// Whether a corner follows the cursor.
    pub fn is_dragging(&self) -> bool {
        self.drag_offset_px.is_some()
    }

    /// Shows the next pattern; frames after the last.
    pub fn next_pattern(&mut self) {
        self.show(Pattern::next(self.pattern));
    }

    /// Shows a pattern, or frames again.
    pub fn show(&mut self, pattern: Option<Pattern>) {
        self.pattern = pattern;
        self.drag_offset_px = None;
        self.selected = None;
    }

    /// The pattern's image; `None` for frames.
    pub fn shown(&self, wall: &Wall) -> Option<anyhow::Result<PatternImage>> {
        self.pattern.map(|pattern| pattern.shown(wall, self.selected))
    }

    /// Whether mouse and arrow keys move corners now.
    pub fn takes_corners(&self) -> bool {
        self.pattern == Some(Pattern::Align)
    }

    /// Grabs the corner near a point of the output. Returns whether there is one.
    pub fn press(&mut self, wall: &Wall, at: DVec2) -> bool {
        let away_from = |(corner, corner_px): (Corner, DVec2)| {
            let away = corner_px - at;
            // Where corners of two projectors meet, prefer the projector under the cursor.
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

    /// The wall with the grabbed corner at the cursor; `None` without one, or if it cannot be there.
    pub fn drag_to(&self, wall: &Wall, at: DVec2) -> Option<Wall> {
        let Corner { projector_idx, corner_idx } = self.selected?;
        let projector = wall.projectors().get(projector_idx)?;
        let wanted = at + self.drag_offset_px?;
        self.moved(wall, seen_from_stored(projector, wanted - corner_px(projector, corner_idx)?))
    }

    /// Releases the corner, which stays selected.
    pub fn release(&mut self) {
        self.drag_offset_px = None;
    }

    /// The wall with the selected corner moved by pixels right and down, as seen on the wall.
    pub fn moved(&self, wall: &Wall, by_px: DVec2) -> Option<Wall> {
        let Corner { projector_idx, corner_idx } = self.selected?;
        let mut warp_px = wall.projectors().get(projector_idx)?.warp_px;
        let moved = (DVec2::from(warp_px[corner_idx]) + by_px) / STEP_PX;
        // Divide by a whole number, which gives the double nearest to each decimal.
        warp_px[corner_idx] = moved.to_array().map(|steps| steps.round() / (1.0 / STEP_PX));
        // A warp whose edges would cross is refused.
        wall.with_warp(projector_idx, warp_px).ok()
    }

    /// Selects the next corner of the wall.
    pub fn next_corner(&mut self, wall: &Wall) {
        let all: Vec<Corner> = corners(wall).map(|(corner, _)| corner).collect();
        let position = self.selected.and_then(|selected| all.iter().position(|&corner| corner == selected));
        self.selected = all.get(position.map_or(0, |position| (position + 1) % all.len().max(1))).copied();
    }

    /// Writes all corners to the wall's file. Returns a note for the operator.
    pub fn save(&self, wall: &Wall) -> anyhow::Result<String> {
        let file = self.file.as_deref().context(
            "the corners cannot be saved: the wall was started without a file; copy a wall file, for example \
             wall-config/blended-4x3.toml, and start with --wall FILE",
        )?;
        save::save_warps(file, wall)?;
        Ok(format!("saved the corners in {}", file.display()))
    }
}

/// All corners, with their places in pixels of the output.
fn corners(wall: &Wall) -> impl Iterator<Item = (Corner, DVec2)> {
    wall.projectors().iter().enumerate().flat_map(|(projector_idx, projector)| {
        let at = move |corner_idx| Some((Corner { projector_idx, corner_idx }, corner_px(projector, corner_idx)?));
        (0..4).filter_map(at)
    })
}

/// The place of a corner of a projector's image, in pixels of the spanning output.
fn corner_px(projector: &Projector, corner_idx: usize) -> Option<DVec2> {
    pattern::to_output(projector, UNIT_SQUARE[corner_idx])
}

/// Converts a step in stored pixels to pixels as seen on the wall.
fn seen_from_stored(projector: &Projector, step: DVec2) -> DVec2 {
    let upright = Projector { warp_px: [[0.0; 2]; 4], ..projector.clone() };
    // Without a warp, the rectangle and its pixels as seen differ only by scale.
    let Some(stored_from_seen) = upright.raster_from_rect() else { return step };
    let stored_size = DVec2::new(f64::from(projector.output.width), f64::from(projector.output.height));
    let seen_size = DVec2::from(projector.upright_size().map(f64::from));
    stored_from_seen.inverse().transform_vector2(step / stored_size) * seen_size
}

#[cfg(test)]
mod tests;
