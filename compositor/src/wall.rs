//! The wall's geometry: the projectors, their parts of the canvas, their pixels and their light.
//!
//! In reading order: [`projector`] is one projector, [`homography`] the warp of one that stands askew, [`mesh`] that of one
//! on a wall that is not flat, [`surface`] the shape of such a wall, [`fall_off`] the light within a projector's field,
//! [`blend`] that of several where they overlap;
//! [`outline`] is the layout of drawings, and `file` reads and writes wall files.

pub mod blend;
pub mod fall_off;
mod file;
pub mod homography;
pub mod mesh;
pub mod outline;
pub mod projector;
pub mod surface;

use std::path::Path;

use channel::files::{self, ReadError};
use glam::DVec2;
use renderer::formats::file::is_named_as_model;
use serde::{Deserialize, Serialize};
use shared::{division::FrameSize, toml_text::plain_problem};

use blend::Neighbour;
pub use fall_off::FallOff;
pub(crate) use file::CANVAS_SIDES_M;
pub use projector::{CanvasRect, Flip, Gamma, PixelRect, Projector, Rotation};
pub use surface::{Surface, Unrolling};

/// A canvas and the projectors that light it; each shows its own part of one frame, which covers the whole canvas.
///
/// Invariant: there is at least one projector, both sides of [`Wall::output_size`] are at most [`Wall::LARGEST_SIDE`], no
/// two projectors share a pixel or a name, each lies on the canvas, and its warped corners are convex.
#[derive(Clone, Debug, PartialEq)]
pub struct Wall {
    canvas_m: [f64; 2],
    frame_size: FrameSize,
    projectors: Vec<Projector>,
    neighbours: Vec<Vec<Neighbour>>,
    black: f64,
    on_loss: OnLoss,
    surface: Option<Surface>,
}

/// The wall's content while no render server is left, and between a crash and the restart.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum OnLoss {
    /// The last frame.
    #[default]
    LastFrame,
    /// Black.
    Black,
}

/// Why a wall file cannot be used.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum WallError {
    #[error("{path}: {cause}: a wall file is like those in wall-config/")]
    Unreadable { path: String, cause: ReadError },
    #[error("{path}:{line}: {problem}")]
    Invalid { path: String, line: usize, problem: String },
    #[error(
        "{path} is a model by its name, and a wall file is TOML, like those in wall-config/: --model {path} shows it"
    )]
    Model { path: String },
}

/// Why projectors do not make a wall: the projector at fault, or all of them, the key of the wall file to change, and the
/// problem with its cure.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{problem}")]
#[expect(missing_docs, reason = "said above")]
pub struct InvalidWall {
    pub projector_idx: Option<usize>,
    pub key: &'static str,
    pub problem: String,
}

impl Wall {
    /// The longest side of the spanning output in pixels, the same as of frames: seventeen displays of 3840.
    pub const LARGEST_SIDE: u32 = FrameSize::LARGEST;

    /// The paper's wall: 4×3 projectors of 1024×768 pixels on a canvas of 4.00 m × 2.25 m.
    pub fn paper() -> Self {
        let projectors = file::grid(4, 3, [1024, 768], [0.0; 2]);
        Self::new([4.0, 2.25], FrameSize::PAPER, projectors).expect("twelve projectors side by side")
    }

    /// A wall of these projectors on a canvas of this width and height in metres.
    pub fn new(canvas_m: [f64; 2], frame_size: FrameSize, projectors: Vec<Projector>) -> Result<Self, InvalidWall> {
        let wrong = |projector_idx, key, problem| Err(InvalidWall { projector_idx, key, problem });
        if projectors.is_empty() {
            return wrong(None, "projector", "a wall has at least one projector: add [grid] or [[projector]]".into());
        }
        check_pixels(&projectors)?;
        check_monitors(&projectors)?;
        for (index, projector) in projectors.iter().enumerate() {
            let Projector { name, canvas, warp_px, .. } = projector;
            if projectors[..index].iter().any(|other| other.name == *name) {
                return wrong(
                    Some(index),
                    "name",
                    format!("there are two projectors \"{name}\": give one another name"),
                );
            }
            // A little tolerance for rounded metres.
            let on_canvas = |from: f64, extent: f64| from >= -1e-6 && extent >= 1e-4 && from + extent <= 1.0 + 1e-6;
            if !on_canvas(canvas.left, canvas.width) || !on_canvas(canvas.bottom, canvas.height) {
                let [width_m, height_m] = canvas_m;
                let problem = format!(
                    "\"{name}\" does not lie on the canvas of {width_m} m × {height_m} m: at_m is its lower-left corner, \
                     size_m its width and height, both from the canvas's lower-left corner"
                );
                return wrong(Some(index), "at_m", problem);
            }
            let corners = projector.raster_corners_in_image();
            if !corners
                .is_some_and(|corners| corners.iter().all(|corner| corner.abs().max_element() <= FARTHEST_CORNER))
            {
                let problem = format!(
                    "\"{name}\" with warp_px = {warp_px:?} is impossible: its corners (upper left, upper right, lower \
                     right, lower left, each moved to the right and down) must keep their order and a sensible distance"
                );
                return wrong(Some(index), "warp_px", problem);
            }
        }
        let neighbours = blend::neighbours(&projectors).map_err(|(index, n_neighbours)| InvalidWall {
            projector_idx: Some(index),
            key: "at_m",
            problem: format!(
                "\"{}\" overlaps {n_neighbours} others, and {} are possible: move them apart",
                projectors[index].name,
                blend::MOST_NEIGHBOURS
            ),
        })?;
        let black = blend::wall_black(&projectors, &neighbours);
        if black > MOST_BLACK {
            let problem = format!(
                "where most projectors overlap, their black adds up to {black:.3} of white, and at most {MOST_BLACK} leaves \
                 enough contrast: measure black_level again"
            );
            return wrong(None, "black_level", problem);
        }
        let on_loss = OnLoss::default();
        Ok(Self { canvas_m, frame_size, projectors, neighbours, black, on_loss, surface: None })
    }

    /// One uncorrected projector.
    pub fn of_one_output([width, height]: [u32; 2]) -> Self {
        let projectors =
            file::grid(1, 1, [width.clamp(1, Self::LARGEST_SIDE), height.clamp(1, Self::LARGEST_SIDE)], [0.0; 2]);
        Self::new([1.0; 2], FrameSize::PAPER, projectors).expect("one projector of any size")
    }

    /// Reads a wall file; see `wall-config/`.
    pub fn load(path: &Path) -> Result<Self, WallError> {
        let name = path.display().to_string();
        let wall = match read_text(path) {
            Ok(text) => Self::from_toml(&name, &text),
            Err(cause) => Err(WallError::Unreadable { path: name.clone(), cause }),
        };
        wall.map_err(
            |error| if is_named_as_model(path) && path.is_file() { WallError::Model { path: name } } else { error },
        )
    }

    /// Reads the text of a wall file; messages name it `path`, and the meshes that it names lie beside `path`.
    pub fn from_toml(path: &str, text: &str) -> Result<Self, WallError> {
        file::parse(Path::new(path), text).map_err(|(offset, problem)| {
            let before = text.get(..offset).unwrap_or(text);
            let mut problem = plain_problem(text, offset, &problem);
            if problem.starts_with("missing field") {
                problem += ": the files in wall-config/ show every key; copy the one that is most like yours";
            }
            WallError::Invalid { path: path.to_owned(), line: 1 + before.matches('\n').count(), problem }
        })
    }

    /// The text of a wall file in which every default is filled in.
    pub fn to_toml(&self) -> String {
        file::write(self)
    }

    /// The same wall with other corners of some projectors, by index; see [`Projector::warp_px`].
    pub fn with_warps(&self, warps: &[(usize, [[f64; 2]; 4])]) -> Result<Self, InvalidWall> {
        let mut projectors = self.projectors.clone();
        for &(projector_idx, warp_px) in warps {
            if let Some(projector) = projectors.get_mut(projector_idx) {
                projector.warp_px = warp_px;
            }
        }
        self.with_projectors(projectors)
    }

    /// The same wall with other projectors.
    pub fn with_projectors(&self, projectors: Vec<Projector>) -> Result<Self, InvalidWall> {
        let wall = Self::new(self.canvas_m, self.frame_size, projectors)?;
        Ok(Self { surface: self.surface, ..wall.with_on_loss(self.on_loss) })
    }

    /// The same wall of another shape; `None` is flat, or unknown.
    pub fn with_surface(self, surface: Option<Surface>) -> Self {
        Self { surface, ..self }
    }

    /// Its shape, as the wall file says; `None` is flat, or unknown. Only its calibration asks for it.
    pub fn surface(&self) -> Option<Surface> {
        self.surface
    }

    /// The same wall with frames of another resolution.
    pub fn with_frame_size(self, frame_size: FrameSize) -> Self {
        Self { frame_size, ..self }
    }

    /// The same wall with other content while no render server is left.
    pub fn with_on_loss(self, on_loss: OnLoss) -> Self {
        Self { on_loss, ..self }
    }

    /// The same wall on one output that spans all projectors.
    pub fn without_monitors(mut self) -> Self {
        self.projectors.iter_mut().for_each(|projector| projector.monitor = None);
        self
    }

    /// Width and height of the canvas in metres.
    pub fn canvas_m(&self) -> [f64; 2] {
        self.canvas_m
    }

    /// The canvas's width over its height: the camera's aspect ratio, independent of the shape of samples and pixels.
    pub fn aspect(&self) -> f64 {
        self.canvas_m[0] / self.canvas_m[1]
    }

    /// The wall file's resolution of frames.
    pub fn frame_size(&self) -> FrameSize {
        self.frame_size
    }

    /// The resolution at which a frame has one sample for each pixel where projectors' pixels are densest; coarser if that
    /// exceeds the limits of frames.
    pub fn native_size(&self) -> FrameSize {
        let densest = self.projectors.iter().fold([1.0f64; 2], |[across, up], projector| {
            let density = projector.density();
            [across.max(density[0]), up.max(density[1])]
        });
        let largest = f64::from(FrameSize::LARGEST) / densest[0].max(densest[1]);
        let most = (f64::from(FrameSize::MOST_SAMPLES) / (densest[0] * densest[1])).sqrt();
        let scale = largest.min(most);
        // A little tolerance for rounded metres.
        let side = |side: f64| match scale < 1.0 {
            true => (side * scale).max(1.0) as u32,
            false => (side - 1e-3).ceil() as u32,
        };
        FrameSize::new(side(densest[0]), side(densest[1])).unwrap_or(self.frame_size)
    }

    /// The content while no render server is left.
    pub fn on_loss(&self) -> OnLoss {
        self.on_loss
    }

    /// The projectors; those of a grid row by row from the top left.
    pub fn projectors(&self) -> &[Projector] {
        &self.projectors
    }

    /// The projectors that light a part of this projector's rectangle, itself first.
    pub fn neighbours(&self, projector_idx: usize) -> &[Neighbour] {
        &self.neighbours[projector_idx]
    }

    /// The light of black everywhere, as a part of white: the greatest sum of black levels where projectors overlap.
    pub fn black(&self) -> f64 {
        self.black
    }

    /// Whether a projector shows its part of the frame uncorrected: it is upright, alone there, and its light is sRGB's.
    pub fn is_plain(&self, projector_idx: usize) -> bool {
        let Projector { gamma, gain, fall_off, .. } = &self.projectors[projector_idx];
        self.projectors[projector_idx].is_upright()
            && self.neighbours[projector_idx].len() == 1
            && self.black == 0.0
            && *gamma == Gamma::Srgb
            && *gain == [1.0; 3]
            && fall_off.is_none()
    }

    /// Width and height of the spanning output in pixels.
    pub fn output_size(&self) -> [u32; 2] {
        self.projectors.iter().fold([0, 0], |[width, height], Projector { output, .. }| {
            [width.max(output.x + output.width), height.max(output.y + output.height)]
        })
    }

    /// All of the spanning output.
    pub fn whole_output(&self) -> PixelRect {
        let [width, height] = self.output_size();
        PixelRect { x: 0, y: 0, width, height }
    }

    /// The point of the canvas, from (0, 0) lower left to (1, 1), that a point of the spanning output lights; in pixels.
    ///
    /// A point outside of all projectors' pixels is extrapolated from the nearest projector.
    pub fn canvas_at(&self, output_px: DVec2) -> DVec2 {
        let away = |projector: &&Projector| projector.output.nearest(output_px).distance_squared(output_px);
        let nearest = self.projectors.iter().min_by(|a, b| away(a).total_cmp(&away(b)));
        let lit = |projector: &Projector, output_px: DVec2| {
            let raster = (output_px - projector.output.origin()) / projector.output.size();
            let image = homography::apply(projector.raster_from_image()?.inverse(), raster)?;
            Some(projector.canvas.canvas_from_rect(projector.rect_at(image)))
        };
        // Beyond a warped projector's horizon, take the nearest of its own pixels.
        nearest
            .and_then(|nearest| lit(nearest, output_px).or_else(|| lit(nearest, nearest.output.nearest(output_px))))
            .unwrap_or(DVec2::splat(0.5))
    }

    /// The part of the spanning output that each output shows: each monitor's, or all of it.
    pub fn output_parts(&self) -> Vec<PixelRect> {
        let of_monitors: Vec<_> = self.monitors().into_iter().map(|(_, part)| part).collect();
        if of_monitors.is_empty() { vec![self.whole_output()] } else { of_monitors }
    }

    /// The monitors that projectors name, and the part of the spanning output that each shows.
    pub fn monitors(&self) -> Vec<(&str, PixelRect)> {
        monitors(&self.projectors)
    }
}

/// A warped corner's greatest coordinate, in sides of the projector's rectangle.
const FARTHEST_CORNER: f64 = 10.0;
/// Above this sum of black levels, an image has too little contrast.
const MOST_BLACK: f64 = 0.5;
/// Larger files are not walls; bytes.
const LARGEST_FILE: u64 = 1 << 20;

pub(crate) fn read_text(path: &Path) -> Result<String, ReadError> {
    files::read_text(path, LARGEST_FILE)
}

/// Checks that every projector has pixels, that all of them fit into the largest output, and that no pixel has two projectors.
fn check_pixels(projectors: &[Projector]) -> Result<(), InvalidWall> {
    for (index, Projector { name, output, .. }) in projectors.iter().enumerate() {
        let wrong = |key, problem| Err(InvalidWall { projector_idx: Some(index), key, problem });
        let fits = |from: u32, extent: u32| {
            extent >= 1 && from.checked_add(extent).is_some_and(|end| end <= Wall::LARGEST_SIDE)
        };
        if !fits(output.x, output.width) || !fits(output.y, output.height) {
            let problem = format!(
                "\"{name}\" has {}×{} pixels from column {} and row {} of the spanning output: each needs at least one, \
                 and that output has at most {} a side",
                output.width,
                output.height,
                output.x,
                output.y,
                Wall::LARGEST_SIDE
            );
            return wrong("pixels", problem);
        }
        if let Some(other) = projectors[..index].iter().find(|other| other.output.overlaps(output)) {
            let problem = format!("\"{name}\" and \"{}\" have pixels in common: change pixels_at of one", other.name);
            return wrong("pixels_at", problem);
        }
    }
    Ok(())
}

fn monitors(projectors: &[Projector]) -> Vec<(&str, PixelRect)> {
    let mut all: Vec<(&str, PixelRect)> = Vec::new();
    for projector in projectors {
        let Some(monitor) = projector.monitor.as_deref() else { continue };
        match all.iter_mut().find(|(name, _)| *name == monitor) {
            Some((_, part)) => *part = part.union(&projector.output),
            None => all.push((monitor, projector.output)),
        }
    }
    all
}

/// Checks that all projectors name a monitor or none does, and that no pixel lies in another monitor's part.
fn check_monitors(projectors: &[Projector]) -> Result<(), InvalidWall> {
    let all = monitors(projectors);
    for (index, Projector { name, monitor, output, .. }) in projectors.iter().enumerate() {
        let wrong = |problem| Err(InvalidWall { projector_idx: Some(index), key: "output", problem });
        if monitor.is_none() && !all.is_empty() {
            return wrong(format!("\"{name}\" has no output, others have: give one to all, or to none"));
        }
        let is_within =
            |(other, part): &&(&str, PixelRect)| monitor.as_deref() != Some(*other) && part.overlaps(output);
        if let Some((other, _)) = all.iter().find(is_within) {
            return wrong(format!(
                "\"{name}\" has pixels in the rectangle that output \"{other}\" shows: change its pixels_at"
            ));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
