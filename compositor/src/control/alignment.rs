//! Aligns a wall: test patterns, and corners of projectors' images that are dragged into place and saved.
//!
//! Pure except for saving. Points are pixels of the spanning output. [`pattern`] draws, [`findings`] shows what a calibration
//! found, [`save`] edits the wall's file.

pub(crate) mod findings;
mod history;
pub(crate) mod pattern;
pub(crate) mod save;
mod sheet;

use std::path::PathBuf;

use anyhow::Context;
use glam::DVec2;
use winit::keyboard::NamedKey;

use self::history::{Corners, History};
pub(crate) use self::pattern::{Corner, Pattern, PatternImage};
use crate::wall::{Projector, Wall, homography::UNIT_SQUARE};

/// A wall, the test pattern on it, and the corner that is selected in the pattern.
#[derive(Clone, Debug)]
pub(crate) struct Alignment {
    /// With the corners as they are now.
    pub wall: Wall,
    /// The wall's file, where corners are saved.
    file: Option<PathBuf>,
    /// The projectors as they are in the file.
    saved: Vec<Projector>,
    pattern: Option<Pattern>,
    selected: Option<Corner>,
    drag: Option<Drag>,
    history: History,
    /// Whether the image on the wall is out of date.
    is_stale: bool,
}

#[derive(Clone, Copy, Debug)]
struct Drag {
    /// From the cursor to the corner.
    offset_px: DVec2,
    /// All moves of a drag are one step of the history.
    has_moved: bool,
}

/// Corners lie on multiples of this, in pixels: finer than the eye resolves.
const STEP_PX: f64 = 0.05;
/// The mouse grabs a corner within this distance, in pixels of the output.
const GRAB_RADIUS_PX: f64 = 60.0;
/// The distance that an arrow key moves a corner, in pixels: alone, and with Shift.
const NUDGE_PX: [f64; 2] = [1.0, 0.1];

/// Why corners cannot be saved, with the cure.
const NO_FILE: &str = "the wall was started without a file; copy a wall file, for example wall-config/blended-4x3.toml, and start with --wall FILE";

impl Alignment {
    /// No pattern, on a wall from this file.
    pub(crate) fn new(file: Option<PathBuf>, wall: Wall) -> Self {
        Self {
            saved: wall.projectors().to_vec(),
            wall,
            file,
            pattern: None,
            selected: None,
            drag: None,
            history: History::default(),
            is_stale: false,
        }
    }

    /// Shows the next pattern, and returns it; frames after the last.
    pub(crate) fn next_pattern(&mut self) -> Option<Pattern> {
        self.show(Pattern::next(self.pattern));
        self.pattern
    }

    /// A note on moved corners, for an operator who leaves the align pattern; `None` if they are saved, or still in hand.
    pub(crate) fn unsaved_note(&self) -> Option<String> {
        let cure = match &self.file {
            Some(file) => format!("Ctrl+S saves them in {}", file.display()),
            None => "they will be in a file of their own when the wall ends".to_owned(),
        };
        let is_left = !self.takes_corners() && self.has_unsaved();
        is_left.then(|| format!("The corners have moved and are not saved: {cure}"))
    }

    /// Whether corners differ from those of the file.
    pub(crate) fn has_unsaved(&self) -> bool {
        self.saved != self.wall.projectors()
    }

    /// Writes corners that are not saved to a new file, when the wall ends. Returns a line for the log; `None` if all are
    /// saved.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub(crate) fn save_aside(&self) -> anyhow::Result<Option<String>> {
        if !self.has_unsaved() {
            return Ok(None);
        }
        let kept = save::save_aside(self.file.as_deref(), &self.wall)?.display().to_string();
        Ok(Some(format!("the corners have moved and were not saved; they are in {kept}: --wall {kept} shows them")))
    }

    /// Shows a pattern, or frames again.
    pub(crate) fn show(&mut self, pattern: Option<Pattern>) {
        self.pattern = pattern;
        self.drag = None;
        self.selected = None;
        self.is_stale = true;
    }

    /// The pattern's images, none for frames, if it has changed since the last call.
    pub(crate) fn take_shown(&mut self) -> Option<anyhow::Result<Vec<PatternImage>>> {
        let is_stale = std::mem::take(&mut self.is_stale);
        is_stale.then(|| self.pattern.map_or(Ok(Vec::new()), |pattern| pattern.shown(&self.wall, self.selected)))
    }

    /// Whether a test pattern is on the wall.
    pub(crate) fn has_pattern(&self) -> bool {
        self.pattern.is_some()
    }

    /// Whether mouse and arrow keys move corners now.
    pub(crate) fn takes_corners(&self) -> bool {
        self.pattern == Some(Pattern::Align)
    }

    /// Moves or resets the selected corner, selects the next, or ends the pattern; `false` for keys that do none of that now.
    pub(crate) fn press_key(&mut self, key: NamedKey, has_shift: bool) -> bool {
        let arrow = match key {
            NamedKey::ArrowUp => DVec2::NEG_Y,
            NamedKey::ArrowDown => DVec2::Y,
            NamedKey::ArrowLeft => DVec2::NEG_X,
            NamedKey::ArrowRight => DVec2::X,
            _ => DVec2::ZERO,
        };
        match key {
            NamedKey::Escape if self.pattern.is_some() => self.show(None),
            NamedKey::Tab if self.takes_corners() => self.next_corner(),
            NamedKey::Backspace if self.takes_corners() => self.reset(has_shift),
            _ if self.takes_corners() && arrow != DVec2::ZERO => {
                self.move_by(arrow * NUDGE_PX[usize::from(has_shift)]);
            }
            _ => return false,
        }
        true
    }

    /// Grabs the corner near a point of the output. Returns whether there is one.
    pub(crate) fn press(&mut self, at: DVec2) -> bool {
        let away_from = |(corner, corner_px): (Corner, DVec2)| {
            let away = corner_px - at;
            // Where corners of two projectors meet, prefer the projector under the cursor.
            let is_elsewhere = !self.wall.projectors()[corner.projector_idx].output.contains(at);
            (corner, away, (is_elsewhere, away.length_squared()))
        };
        let near = corners(&self.wall).map(away_from).filter(|(_, away, _)| away.length() <= GRAB_RADIUS_PX);
        let grabbed = near.min_by(|(_, _, a), (_, _, b)| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
        let drag = |away| Drag { offset_px: away, has_moved: false };
        (self.selected, self.drag) = grabbed.map(|(corner, away, _)| (corner, drag(away))).unzip();
        self.is_stale = true;
        self.selected.is_some()
    }

    /// Moves the grabbed corner to the cursor, unless it cannot be there. Returns whether one is grabbed.
    pub(crate) fn drag_to(&mut self, at: DVec2) -> bool {
        let (Some(corner), Some(Drag { offset_px, .. })) = (self.selected, self.drag) else { return false };
        let projector = &self.wall.projectors()[corner.projector_idx];
        if let Some(corner_px) = corner_px(projector, corner.corner_idx) {
            self.move_by(seen_from_stored(projector, at + offset_px - corner_px));
        }
        true
    }

    /// Releases the corner, which stays selected.
    pub(crate) fn release(&mut self) {
        self.drag = None;
    }

    /// Moves the selected corner by pixels right and down, as seen on the wall. Returns whether it can be there.
    pub(crate) fn move_by(&mut self, by_px: DVec2) -> bool {
        let Some(Corner { projector_idx, corner_idx }) = self.selected else { return false };
        let mut warp_px = self.wall.projectors()[projector_idx].warp_px;
        let moved = (DVec2::from(warp_px[corner_idx]) + by_px) / STEP_PX;
        // Divide by a whole number, which gives the double nearest to each decimal.
        warp_px[corner_idx] = moved.to_array().map(|steps| steps.round() / (1.0 / STEP_PX));
        self.change(vec![(projector_idx, warp_px)])
    }

    /// Returns the selected corner, or all corners, to those of the projectors' pixels.
    fn reset(&mut self, resets_all: bool) {
        let projectors = self.wall.projectors();
        let corners = if resets_all {
            (0..projectors.len()).map(|projector_idx| (projector_idx, [[0.0; 2]; 4])).collect()
        } else {
            let Some(Corner { projector_idx, corner_idx }) = self.selected else { return };
            let mut warp_px = projectors[projector_idx].warp_px;
            warp_px[corner_idx] = [0.0; 2];
            vec![(projector_idx, warp_px)]
        };
        self.change(corners);
    }

    /// Takes the last change of corners back. Returns a note for the operator.
    pub(crate) fn undo(&mut self) -> &'static str {
        self.drag = None;
        let step = self.history.done.pop_back();
        let Some(replaced) = step.and_then(|corners| self.replace(corners)) else { return "No corner was moved" };
        self.history.undone.push(replaced);
        "The last move of corners is taken back: Ctrl+Shift+Z moves them again"
    }

    /// Makes the change again that was taken back last. Returns a note for the operator.
    pub(crate) fn redo(&mut self) -> &'static str {
        self.drag = None;
        let step = self.history.undone.pop();
        let Some(replaced) = step.and_then(|corners| self.replace(corners)) else {
            return "No move of corners was taken back";
        };
        self.history.add_done(replaced);
        "The corners are moved again"
    }

    /// Changes corners, which can be undone. Returns whether they can be there.
    fn change(&mut self, corners: Corners) -> bool {
        let Some(replaced) = self.replace(corners) else { return false };
        if replaced.is_empty() {
            return true;
        }
        let is_continued = self.drag.as_mut().is_some_and(|drag| std::mem::replace(&mut drag.has_moved, true));
        if !is_continued {
            self.history.add(replaced);
        }
        true
    }

    /// Sets corners, and returns those that were different; `None` for a warp whose edges would cross.
    fn replace(&mut self, mut corners: Corners) -> Option<Corners> {
        let current = |projector_idx: usize| self.wall.projectors()[projector_idx].warp_px;
        corners.retain(|&(projector_idx, warp_px)| warp_px != current(projector_idx));
        let replaced = corners.iter().map(|&(projector_idx, _)| (projector_idx, current(projector_idx))).collect();
        self.wall = self.wall.with_warps(&corners).ok()?;
        self.is_stale = true;
        Some(replaced)
    }

    pub(crate) fn next_corner(&mut self) {
        let all: Vec<Corner> = corners(&self.wall).map(|(corner, _)| corner).collect();
        let position = self.selected.and_then(|selected| all.iter().position(|&corner| corner == selected));
        self.selected = all.get(position.map_or(0, |position| (position + 1) % all.len().max(1))).copied();
        self.is_stale = true;
    }

    /// A line on the use of a pattern on this wall.
    pub(crate) fn help(&self, pattern: Pattern) -> String {
        let lacks_file = pattern == Pattern::Align && self.file.is_none();
        // Told before the work, not after it.
        let file = if lacks_file { format!("; here nothing can be saved: {NO_FILE}") } else { String::new() };
        format!("{pattern}: {}{file}", pattern.help())
    }

    /// Writes all corners to the wall's file, if any has moved. Returns a note for the operator.
    pub(crate) fn save(&mut self) -> anyhow::Result<String> {
        if !self.has_unsaved() {
            return Ok("No corner has moved: there is nothing to save".to_owned());
        }
        let file = self.file.as_deref().with_context(|| format!("the corners cannot be saved: {NO_FILE}"))?;
        save::save_projectors(file, &self.wall)?;
        self.saved = self.wall.projectors().to_vec();
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
    pattern::on_output(projector, UNIT_SQUARE[corner_idx])
}

/// Converts a step in stored pixels to pixels as seen on the wall.
fn seen_from_stored(projector: &Projector, step: DVec2) -> DVec2 {
    let upright = Projector { warp_px: [[0.0; 2]; 4], ..projector.clone() };
    // Without a warp, the image and its pixels as seen differ only by scale.
    let Some(stored_from_seen) = upright.raster_from_image() else { return step };
    let seen_size = DVec2::from(projector.upright_size().map(f64::from));
    stored_from_seen.inverse().transform_vector2(step / projector.output.size()) * seen_size
}

#[cfg(test)]
mod tests;
