//! Wall files: reads TOML, and writes it with every default filled in.

use std::{fmt::Write, ops::RangeInclusive};

use serde::{Deserialize, Serialize};
use shared::division::FrameSize;
use toml::Spanned;

use super::{CanvasRect, Flip, Gamma, InvalidWall, OnLoss, PixelRect, Projector, Rotation, Wall};

/// The byte of the file at fault, and the problem.
type Problem = (usize, String);

/// A wall file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WallFile {
    canvas_m: Spanned<[f64; 2]>,
    frame: Option<Spanned<[u32; 2]>>,
    #[serde(default)]
    on_loss: OnLoss,
    #[serde(default)]
    optics: OpticsSection,
    grid: Option<Spanned<GridSection>>,
    #[serde(default)]
    projector: Vec<Spanned<ProjectorSection>>,
}

/// Defaults for all projectors.
#[derive(Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct OpticsSection {
    rotation: Option<Spanned<u32>>,
    flip: Option<Flip>,
    gamma: Option<Spanned<Gamma>>,
    black_level: Option<Spanned<f64>>,
    gain: Option<Spanned<[f64; 3]>>,
}

/// `columns` × `rows` equal projectors.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct GridSection {
    columns: Spanned<u32>,
    rows: Spanned<u32>,
    pixels: Spanned<[u32; 2]>,
    overlap: Option<Spanned<[f64; 2]>>,
    bezel_m: Option<Spanned<[f64; 2]>>,
}

/// One projector; with a grid, the settings of one of the grid's projectors.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ProjectorSection {
    name: Spanned<String>,
    output: Option<Spanned<String>>,
    pixels: Option<Spanned<[u32; 2]>>,
    pixels_at: Option<Spanned<[u32; 2]>>,
    at_m: Option<Spanned<[f64; 2]>>,
    size_m: Option<Spanned<[f64; 2]>>,
    rotation: Option<Spanned<u32>>,
    flip: Option<Flip>,
    warp_px: Option<Spanned<[[f64; 2]; 4]>>,
    gamma: Option<Spanned<Gamma>>,
    black_level: Option<Spanned<f64>>,
    gain: Option<Spanned<[f64; 3]>>,
}

/// Plausible sides of canvases, in metres.
const CANVAS_SIDES_M: RangeInclusive<f64> = 0.01..=1000.0;
/// Plausible numbers of columns or rows.
const GRID_SIDES: RangeInclusive<u32> = 1..=64;
/// The most projectors of a wall; the largest grid has as many.
const MOST_PROJECTORS: usize = 4096;
/// The part of a projector's side that overlaps with the next: up to a half, so that no more than two share a point.
const OVERLAPS: RangeInclusive<f64> = 0.0..=0.5;
/// Exponents of projectors' and screens' light curves.
const GAMMAS: RangeInclusive<f64> = 1.0..=4.0;
/// Light of black as a part of white: the worst projectors reach 1/100.
const BLACK_LEVELS: RangeInclusive<f64> = 0.0..=0.25;
/// Factors by which a channel is dimmed.
const GAINS: RangeInclusive<f64> = 0.05..=1.0;

/// The wall that a file describes.
pub(super) fn parse(text: &str) -> Result<Wall, Problem> {
    toml::from_str::<WallFile>(text)
        .map_err(|error| (error.span().map_or(0, |span| span.start), error.message().to_owned()))
        .and_then(WallFile::wall)
}

impl WallFile {
    fn wall(self) -> Result<Wall, Problem> {
        let canvas_m = *self.canvas_m.get_ref();
        if !canvas_m.iter().all(|side_m| CANVAS_SIDES_M.contains(side_m)) {
            let (least, most) = (CANVAS_SIDES_M.start(), CANVAS_SIDES_M.end());
            let problem = format!("canvas_m = {canvas_m:?}: width and height in metres must be from {least} to {most}");
            return Err((self.canvas_m.span().start, problem));
        }
        let frame_size = match &self.frame {
            Some(frame) => {
                let [xres, yres] = *frame.get_ref();
                FrameSize::new(xres, yres)
                    .map_err(|error| (frame.span().start, format!("frame = [{xres}, {yres}]: {error}")))?
            }
            None => FrameSize::PAPER,
        };
        let mut projectors = match &self.grid {
            Some(grid) => grid.get_ref().projectors(canvas_m)?,
            None => Vec::new(),
        };
        for projector in &mut projectors {
            self.optics.apply_to(projector)?;
        }
        // The [[projector]] table of each projector.
        let mut sections: Vec<Option<&Spanned<ProjectorSection>>> = vec![None; projectors.len()];
        for spanned in &self.projector {
            let section = spanned.get_ref();
            let index = if self.grid.is_some() {
                section.index_in_grid(&projectors)?
            } else if projectors.len() == MOST_PROJECTORS {
                return Err((spanned.span().start, format!("a wall has at most {MOST_PROJECTORS} projectors")));
            } else {
                let mut projector = section.projector(canvas_m, &projectors)?;
                self.optics.apply_to(&mut projector)?;
                projectors.push(projector);
                sections.push(None);
                projectors.len() - 1
            };
            if sections[index].replace(spanned).is_some() {
                let problem = format!("there are two tables for \"{}\": make them one", section.name.get_ref());
                return Err((section.name.span().start, problem));
            }
            section.apply_to(&mut projectors[index])?;
        }
        let wall =
            Wall::new(canvas_m, frame_size, projectors).map_err(|InvalidWall { projector_idx, key, problem }| {
                let section = projector_idx.and_then(|index| sections[index]);
                let own = section.map(|section| section.get_ref().offset_of(key).unwrap_or(section.span().start));
                let grid = self.grid.as_ref().map(|grid| grid.span().start);
                (own.or(grid).unwrap_or(self.canvas_m.span().start), problem)
            })?;
        Ok(wall.with_on_loss(self.on_loss))
    }
}

impl GridSection {
    fn projectors(&self, canvas_m: [f64; 2]) -> Result<Vec<Projector>, Problem> {
        let Self { columns, rows, pixels, overlap, bezel_m } = self;
        for (key, count) in [("columns", columns), ("rows", rows)] {
            if !GRID_SIDES.contains(count.get_ref()) {
                let (least, most) = (GRID_SIDES.start(), GRID_SIDES.end());
                let problem = format!("{key} = {}: a wall has from {least} to {most} of them", count.get_ref());
                return Err((count.span().start, problem));
            }
        }
        let [n_columns, n_rows] = [*columns.get_ref(), *rows.get_ref()];
        for (n_projectors, side) in [n_columns, n_rows].into_iter().zip(*pixels.get_ref()) {
            let largest = Wall::LARGEST_SIDE / n_projectors;
            if !(1..=largest).contains(&side) {
                let problem = format!(
                    "pixels = {:?}: {n_projectors} of these side by side, so each may have from 1 to {largest} pixels: \
                     the spanning output has at most {} pixels a side",
                    pixels.get_ref(),
                    Wall::LARGEST_SIDE
                );
                return Err((pixels.span().start, problem));
            }
        }
        let shared = match (overlap, bezel_m) {
            (Some(overlap), None) => {
                if !overlap.get_ref().iter().all(|part| OVERLAPS.contains(part)) {
                    let problem = format!(
                        "overlap = {:?}: the parts of its width and height that a projector shares with the next are \
                         from {} to {}",
                        overlap.get_ref(),
                        OVERLAPS.start(),
                        OVERLAPS.end()
                    );
                    return Err((overlap.span().start, problem));
                }
                *overlap.get_ref()
            }
            (None, Some(bezel_m)) => {
                let mut shared = [0.0; 2];
                for (axis, n_screens) in [n_columns, n_rows].map(f64::from).into_iter().enumerate() {
                    let gap_m = bezel_m.get_ref()[axis];
                    let side_m = (canvas_m[axis] - (n_screens - 1.0) * gap_m) / n_screens;
                    if !(gap_m >= 0.0 && side_m >= 0.001 * canvas_m[axis]) {
                        let problem = format!(
                            "bezel_m = {:?}: the dark gaps between two columns and two rows must be positive and leave \
                             room for screens on a canvas of {} m × {} m",
                            bezel_m.get_ref(),
                            canvas_m[0],
                            canvas_m[1]
                        );
                        return Err((bezel_m.span().start, problem));
                    }
                    shared[axis] = -gap_m / side_m;
                }
                shared
            }
            (None, None) => [0.0; 2],
            (Some(_), Some(bezel_m)) => {
                let problem = "a grid has an overlap or a bezel: leave one out".to_owned();
                return Err((bezel_m.span().start, problem));
            }
        };
        Ok(grid(n_columns, n_rows, *pixels.get_ref(), shared))
    }
}

impl OpticsSection {
    fn apply_to(&self, projector: &mut Projector) -> Result<(), Problem> {
        if let Some(rotation) = &self.rotation {
            let degrees = *rotation.get_ref();
            projector.rotation = Rotation::from_degrees(degrees).ok_or_else(|| {
                (rotation.span().start, format!("rotation = {degrees}: degrees clockwise, 0, 90, 180 or 270"))
            })?;
        }
        projector.flip = self.flip.unwrap_or(projector.flip);
        if let Some(gamma) = &self.gamma {
            projector.gamma = *gamma.get_ref();
            if let Gamma::Power(exponent) = projector.gamma {
                check_range(
                    "gamma",
                    exponent,
                    &GAMMAS,
                    "the exponent of its light curve, or \"srgb\"",
                    gamma.span().start,
                )?;
            }
        }
        if let Some(black_level) = &self.black_level {
            projector.black_level = *black_level.get_ref();
            let offset = black_level.span().start;
            check_range(
                "black_level",
                projector.black_level,
                &BLACK_LEVELS,
                "the light of black as a part of white",
                offset,
            )?;
        }
        if let Some(gain) = &self.gain {
            projector.gain = *gain.get_ref();
            for channel in projector.gain {
                check_range("gain", channel, &GAINS, "the factors of red, green and blue", gain.span().start)?;
            }
        }
        Ok(())
    }
}

impl ProjectorSection {
    /// A projector of a wall without a grid; its pixels are to the right of those before, unless it says where.
    fn projector(&self, canvas_m: [f64; 2], before: &[Projector]) -> Result<Projector, Problem> {
        let name = self.name.get_ref();
        let missing =
            |key: &str, what: &str| (self.name.span().start, format!("\"{name}\" needs {key} = [..., ...]: {what}"));
        let pixels = self.pixels.as_ref().ok_or_else(|| missing("pixels", "its columns and rows"))?;
        let at_m =
            self.at_m.as_ref().ok_or_else(|| missing("at_m", "its lower-left corner on the canvas, in metres"))?;
        let size_m = self.size_m.as_ref().ok_or_else(|| missing("size_m", "its width and height in metres"))?;
        let right = before.iter().map(|projector| projector.output.x.saturating_add(projector.output.width)).max();
        let [x, y] = self.pixels_at.as_ref().map_or([right.unwrap_or(0), 0], |at| *at.get_ref());
        let [width, height] = *pixels.get_ref();
        let canvas = CanvasRect {
            left: at_m.get_ref()[0] / canvas_m[0],
            bottom: at_m.get_ref()[1] / canvas_m[1],
            width: size_m.get_ref()[0] / canvas_m[0],
            height: size_m.get_ref()[1] / canvas_m[1],
        };
        Ok(Projector::plain(name.clone(), canvas, PixelRect { x, y, width, height }))
    }

    /// The index of the grid's projector that this table names.
    fn index_in_grid(&self, grid: &[Projector]) -> Result<usize, Problem> {
        let fixed = [
            ("pixels", self.pixels.as_ref().map(Spanned::span)),
            ("pixels_at", self.pixels_at.as_ref().map(Spanned::span)),
            ("at_m", self.at_m.as_ref().map(Spanned::span)),
            ("size_m", self.size_m.as_ref().map(Spanned::span)),
        ];
        if let Some((key, span)) = fixed.into_iter().find_map(|(key, span)| Some((key, span?))) {
            return Err((span.start, format!("{key} follows from [grid]: leave one of them out")));
        }
        let name = self.name.get_ref();
        grid.iter().position(|projector| projector.name == *name).ok_or_else(|| {
            let last = grid.last().map_or("", |projector| &projector.name);
            let problem =
                format!("no projector is named \"{name}\": those of the grid are \"row 1 column 1\" to \"{last}\"");
            (self.name.span().start, problem)
        })
    }

    fn apply_to(&self, projector: &mut Projector) -> Result<(), Problem> {
        if let Some(output) = &self.output {
            projector.monitor = Some(output.get_ref().clone());
        }
        if let Some(warp_px) = &self.warp_px {
            projector.warp_px = *warp_px.get_ref();
        }
        OpticsSection {
            rotation: self.rotation.clone(),
            flip: self.flip,
            gamma: self.gamma.clone(),
            black_level: self.black_level.clone(),
            gain: self.gain.clone(),
        }
        .apply_to(projector)
    }

    fn offset_of(&self, key: &str) -> Option<usize> {
        let span = match key {
            "name" => Some(self.name.span()),
            "output" => self.output.as_ref().map(Spanned::span),
            "pixels" => self.pixels.as_ref().map(Spanned::span),
            "pixels_at" => self.pixels_at.as_ref().map(Spanned::span),
            "at_m" => self.at_m.as_ref().map(Spanned::span),
            "warp_px" => self.warp_px.as_ref().map(Spanned::span),
            _ => None,
        };
        span.map(|span| span.start)
    }
}

fn check_range(key: &str, value: f64, range: &RangeInclusive<f64>, what: &str, offset: usize) -> Result<(), Problem> {
    if range.contains(&value) {
        Ok(())
    } else {
        Err((offset, format!("{key} = {value}: {what}, must be from {} to {}", range.start(), range.end())))
    }
}

/// `columns` × `rows` projectors of `pixels` each, row by row from the top left.
///
/// Each overlaps with the next by the parts `shared` of its width and height; negative parts are gaps between them.
pub(super) fn grid(columns: u32, rows: u32, [width, height]: [u32; 2], shared: [f64; 2]) -> Vec<Projector> {
    // Distance from the canvas's left or lower edge, and extent.
    let extent = |index: u32, n_projectors: u32, shared: f64| {
        let n_sides = f64::from(n_projectors) - f64::from(n_projectors - 1) * shared;
        (f64::from(index) * (1.0 - shared) / n_sides, 1.0 / n_sides)
    };
    let projector = |column: u32, row: u32| {
        let (left, canvas_width) = extent(column, columns, shared[0]);
        let (bottom, canvas_height) = extent(rows - 1 - row, rows, shared[1]);
        Projector::plain(
            format!("row {} column {}", row + 1, column + 1),
            CanvasRect { left, bottom, width: canvas_width, height: canvas_height },
            PixelRect { x: column * width, y: row * height, width, height },
        )
    };
    (0..rows).flat_map(|row| (0..columns).map(move |column| projector(column, row))).collect()
}

/// The text of a complete wall file.
pub(super) fn write(wall: &Wall) -> String {
    let [width_m, height_m] = wall.canvas_m();
    let frame = wall.frame_size();
    let (xres, yres, on_loss) = (frame.xres(), frame.yres(), quoted(wall.on_loss()));
    let mut text = format!("canvas_m = [{width_m}, {height_m}]\nframe = [{xres}, {yres}]\non_loss = {on_loss}\n");
    for projector in wall.projectors() {
        // Writing to a string cannot fail.
        let _ = write_projector(&mut text, projector, wall.canvas_m());
    }
    text
}

fn write_projector(text: &mut String, projector: &Projector, [width_m, height_m]: [f64; 2]) -> std::fmt::Result {
    let Projector { name, monitor, canvas, output, rotation, flip, warp_px, gamma, black_level, gain } = projector;
    writeln!(text, "\n[[projector]]\nname = {}", quoted(name))?;
    if let Some(monitor) = monitor {
        writeln!(text, "output = {}", quoted(monitor))?;
    }
    let PixelRect { x, y, width, height } = output;
    writeln!(text, "pixels = [{width}, {height}]\npixels_at = [{x}, {y}]")?;
    // To the nanometre: hides the rounding error of thirds.
    let metres = |fraction: f64, side_m: f64| (fraction * side_m * 1e9).round() / 1e9;
    writeln!(text, "at_m = [{}, {}]", metres(canvas.left, width_m), metres(canvas.bottom, height_m))?;
    writeln!(text, "size_m = [{}, {}]", metres(canvas.width, width_m), metres(canvas.height, height_m))?;
    writeln!(text, "rotation = {}\nflip = {}\nwarp_px = {warp_px:?}", rotation.degrees(), quoted(flip))?;
    match gamma {
        Gamma::Srgb => writeln!(text, "gamma = \"srgb\"")?,
        Gamma::Power(exponent) => writeln!(text, "gamma = {exponent}")?,
    }
    writeln!(text, "black_level = {black_level}\ngain = {gain:?}")
}

/// A text, or the name of an enum's value, as TOML writes it.
fn quoted(value: impl Serialize) -> String {
    toml::Value::try_from(value).expect("a string is TOML").to_string()
}

impl<'de> Deserialize<'de> for Gamma {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Visitor;
        impl serde::de::Visitor<'_> for Visitor {
            type Value = Gamma;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("a number such as 2.2, or \"srgb\"")
            }

            fn visit_f64<E: serde::de::Error>(self, exponent: f64) -> Result<Gamma, E> {
                Ok(Gamma::Power(exponent))
            }

            fn visit_i64<E: serde::de::Error>(self, exponent: i64) -> Result<Gamma, E> {
                Ok(Gamma::Power(exponent as f64))
            }

            fn visit_str<E: serde::de::Error>(self, name: &str) -> Result<Gamma, E> {
                if name == "srgb" {
                    Ok(Gamma::Srgb)
                } else {
                    Err(E::invalid_value(serde::de::Unexpected::Str(name), &self))
                }
            }
        }
        deserializer.deserialize_any(Visitor)
    }
}
