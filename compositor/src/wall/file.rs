//! Wall files: reads TOML, and writes it with every default filled in.

use std::{io::Read, ops::RangeInclusive, path::Path, sync::Arc};

use channel::files;
use serde::{Deserialize, Serialize};
use shared::division::FrameSize;
use toml::{
    Value,
    de::{DeTable, DeValue},
};

use super::{
    CanvasRect, FallOff, Flip, Gamma, InvalidWall, OnLoss, PixelRect, Projector, Rotation, Surface, Wall, mesh::Mesh,
};

/// The path of the key at fault, for example `grid.pixels` or `projector.0.gamma`, and the problem.
type Problem = (String, String);

#[derive(Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct WallFile {
    canvas_m: [f64; 2],
    frame: Option<[u32; 2]>,
    #[serde(default)]
    on_loss: OnLoss,
    surface: Option<Surface>,
    #[serde(default, skip_serializing)]
    optics: OpticsSection,
    #[serde(skip_serializing)]
    grid: Option<GridSection>,
    #[serde(default)]
    projector: Vec<ProjectorSection>,
}

#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct OpticsSection {
    rotation: Option<u32>,
    flip: Option<Flip>,
    gamma: Option<Gamma>,
    black_level: Option<f64>,
    gain: Option<[f64; 3]>,
    fall_off: Option<FallOff>,
}

/// `columns` × `rows` equal projectors.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct GridSection {
    columns: u32,
    rows: u32,
    pixels: [u32; 2],
    overlap: Option<[f64; 2]>,
    bezel_m: Option<[f64; 2]>,
}

/// One projector; with a grid, the settings of one of the grid's projectors.
#[derive(Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct ProjectorSection {
    name: String,
    output: Option<String>,
    pixels: Option<[u32; 2]>,
    pixels_at: Option<[u32; 2]>,
    at_m: Option<[f64; 2]>,
    size_m: Option<[f64; 2]>,
    // The keys of `OpticsSection`. Serde would flatten it, but then errors have no line.
    rotation: Option<u32>,
    flip: Option<Flip>,
    warp_px: Option<[[f64; 2]; 4]>,
    mesh: Option<String>,
    gamma: Option<Gamma>,
    black_level: Option<f64>,
    gain: Option<[f64; 3]>,
    fall_off: Option<FallOff>,
}

/// Plausible sides of canvases, in metres.
pub(crate) const CANVAS_SIDES_M: RangeInclusive<f64> = 0.01..=1000.0;
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

/// The most control points of all meshes of a wall: they take 64 MB on the GPU.
const MOST_POINTS: usize = 8 << 20;
/// The longest mesh file in bytes: the largest mesh, and its header.
const LONGEST_MESH: u64 = 12 * (Mesh::MOST_POINTS_A_SIDE * Mesh::MOST_POINTS_A_SIDE) as u64 + 256;

/// Keys of lists with the points and the numbers of a point that they take.
const LENGTHS: [(&str, [usize; 2]); 10] = [
    ("canvas_m", [0, 2]),
    ("frame", [0, 2]),
    ("pixels", [0, 2]),
    ("pixels_at", [0, 2]),
    ("overlap", [0, 2]),
    ("bezel_m", [0, 2]),
    ("at_m", [0, 2]),
    ("size_m", [0, 2]),
    ("gain", [0, 3]),
    ("warp_px", [4, 2]),
];

/// The wall that the text of a file describes, with its meshes; or the byte of the file at fault, and the problem.
pub(super) fn parse(path: &Path, text: &str) -> Result<Wall, (usize, String)> {
    let file: WallFile = toml::from_str(text)
        .map_err(|error| (error.span().map_or(0, |span| span.start), error.message().to_owned()))?;
    check_lengths(text)?;
    file.wall(path).map_err(|(path, problem)| (offset_of(text, &path), problem))
}

/// Refuses lists with more numbers than their keys take: serde would leave out the last ones without a word.
fn check_lengths(text: &str) -> Result<(), (usize, String)> {
    fn check(key: &str, value: &DeValue<'_>, offset: usize) -> Result<(), (usize, String)> {
        match value {
            DeValue::Table(table) => {
                table.iter().try_for_each(|(key, value)| check(key.get_ref(), value.get_ref(), value.span().start))
            }
            DeValue::Array(array) => {
                let is_list = |value: &DeValue<'_>| matches!(value, DeValue::Array(_));
                let is_point =
                    array.iter().all(|it| !is_list(it.get_ref()) && !matches!(it.get_ref(), DeValue::Table(_)));
                let most = LENGTHS.iter().find(|(it, _)| *it == key).map(|(_, lengths)| lengths[usize::from(is_point)]);
                if most.is_some_and(|most| array.len() > most) {
                    let (n, most) = (array.len(), most.unwrap_or_default());
                    let what = if is_point { "numbers" } else { "points" };
                    return Err((offset, format!("{key} has {n} {what}, and takes {most}: leave out the others")));
                }
                array.iter().try_for_each(|it| check(key, it.get_ref(), it.span().start))
            }
            _ => Ok(()),
        }
    }
    let Ok(document) = DeTable::parse(text) else { return Ok(()) };
    check("", &DeValue::Table(document.into_inner()), 0)
}

/// The byte of a file at which a value begins, or the innermost table of its path that is there.
fn offset_of(text: &str, path: &str) -> usize {
    let Ok(document) = DeTable::parse(text) else { return 0 };
    let mut value = &DeValue::Table(document.into_inner());
    let mut offset = 0;
    for key in path.split('.') {
        let found = key.parse().map_or_else(|_| value.get(key), |index: usize| value.get(index));
        let Some(found) = found else { break };
        (offset, value) = (found.span().start, found.get_ref());
    }
    offset
}

impl WallFile {
    fn wall(self, file: &Path) -> Result<Wall, Problem> {
        let Self { canvas_m, frame, on_loss, surface, optics, grid, projector: sections } = self;
        if !canvas_m.iter().all(|side_m| CANVAS_SIDES_M.contains(side_m)) {
            let (least, most) = (CANVAS_SIDES_M.start(), CANVAS_SIDES_M.end());
            let problem = format!("canvas_m = {canvas_m:?}: width and height in metres must be from {least} to {most}");
            return Err(("canvas_m".into(), problem));
        }
        let frame_size = frame.map_or(Ok(FrameSize::PAPER), |[xres, yres]| {
            FrameSize::new(xres, yres).map_err(|error| ("frame".into(), format!("frame = [{xres}, {yres}]: {error}")))
        })?;
        let mut projectors = grid.as_ref().map_or(Ok(Vec::new()), |grid| grid.projectors(canvas_m))?;
        for projector in &mut projectors {
            optics.apply_to(projector, "optics")?;
        }
        let mut n_points = 0;
        // The path of each projector's own table.
        let mut paths: Vec<Option<String>> = vec![None; projectors.len()];
        for (section_idx, section) in sections.iter().enumerate() {
            let path = format!("projector.{section_idx}");
            let index = if grid.is_some() {
                section.index_in_grid(&projectors, &path)?
            } else if projectors.len() == MOST_PROJECTORS {
                return Err((path, format!("a wall has at most {MOST_PROJECTORS} projectors")));
            } else {
                let mut projector = section.projector(canvas_m, &projectors, &path)?;
                optics.apply_to(&mut projector, "optics")?;
                projectors.push(projector);
                paths.push(None);
                projectors.len() - 1
            };
            if paths[index].replace(path.clone()).is_some() {
                let problem = format!("there are two tables for \"{}\": make them one", section.name);
                return Err((format!("{path}.name"), problem));
            }
            section.apply_to(&mut projectors[index], &path)?;
            if let Some(mesh) = section.mesh(file, canvas_m, &path)? {
                n_points += mesh.size().into_iter().product::<usize>();
                if n_points > MOST_POINTS {
                    let problem = format!("all meshes have more than {MOST_POINTS} control points: leave out some");
                    return Err((format!("{path}.mesh"), problem));
                }
                projectors[index] = projectors[index].clone().with_mesh(mesh);
            }
        }
        let whole = if grid.is_some() { "grid" } else { "canvas_m" };
        let wall =
            Wall::new(canvas_m, frame_size, projectors).map_err(|InvalidWall { projector_idx, key, problem }| {
                let own = projector_idx.and_then(|index| paths[index].as_ref());
                (own.map_or(whole.into(), |path| format!("{path}.{key}")), problem)
            })?;
        surface.map_or(Ok(()), |surface| surface.check(canvas_m)).map_err(|problem| ("surface".into(), problem))?;
        Ok(wall.with_on_loss(on_loss).with_surface(surface))
    }
}

impl GridSection {
    fn projectors(&self, canvas_m: [f64; 2]) -> Result<Vec<Projector>, Problem> {
        let Self { columns, rows, pixels, overlap, bezel_m } = *self;
        let wrong = |key: &str, problem: String| Err((format!("grid.{key}"), problem));
        for (key, count) in [("columns", columns), ("rows", rows)] {
            if !GRID_SIDES.contains(&count) {
                let (least, most) = (GRID_SIDES.start(), GRID_SIDES.end());
                return wrong(key, format!("{key} = {count}: a wall has from {least} to {most} of them"));
            }
        }
        for (n_projectors, side) in [columns, rows].into_iter().zip(pixels) {
            let largest = Wall::LARGEST_SIDE / n_projectors;
            if !(1..=largest).contains(&side) {
                let problem = format!(
                    "pixels = {pixels:?}: {n_projectors} of these side by side, so each may have from 1 to {largest} \
                     pixels: the spanning output has at most {} pixels a side",
                    Wall::LARGEST_SIDE
                );
                return wrong("pixels", problem);
            }
        }
        let mut shared = overlap.unwrap_or_default();
        if !shared.iter().all(|part| OVERLAPS.contains(part)) {
            let problem = format!(
                "overlap = {shared:?}: the parts of its width and height that a projector shares with the next are from \
                 {} to {}",
                OVERLAPS.start(),
                OVERLAPS.end()
            );
            return wrong("overlap", problem);
        }
        if let Some(bezel_m) = bezel_m {
            if overlap.is_some() {
                return wrong("bezel_m", "a grid has an overlap or a bezel: leave one out".into());
            }
            for (axis, n_screens) in [columns, rows].map(f64::from).into_iter().enumerate() {
                let gap_m = bezel_m[axis];
                let side_m = (canvas_m[axis] - (n_screens - 1.0) * gap_m) / n_screens;
                if !(gap_m >= 0.0 && side_m >= 0.001 * canvas_m[axis]) {
                    let problem = format!(
                        "bezel_m = {bezel_m:?}: the dark gaps between two columns and two rows must be positive and leave \
                         room for screens on a canvas of {} m × {} m",
                        canvas_m[0], canvas_m[1]
                    );
                    return wrong("bezel_m", problem);
                }
                shared[axis] = -gap_m / side_m;
            }
        }
        Ok(grid(columns, rows, pixels, shared))
    }
}

impl OpticsSection {
    fn apply_to(&self, projector: &mut Projector, path: &str) -> Result<(), Problem> {
        let in_range = |key: &str, value: f64, range: RangeInclusive<f64>, meaning: &str| match range.contains(&value) {
            true => Ok(value),
            false => {
                let (least, most) = (range.start(), range.end());
                Err((format!("{path}.{key}"), format!("{key} = {value}: {meaning}, must be from {least} to {most}")))
            }
        };
        if let Some(degrees) = self.rotation {
            projector.rotation = Rotation::from_degrees(degrees).ok_or_else(|| {
                let problem = format!("rotation = {degrees}: degrees clockwise, 0, 90, 180 or 270");
                (format!("{path}.rotation"), problem)
            })?;
        }
        projector.flip = self.flip.unwrap_or(projector.flip);
        projector.gamma = self.gamma.unwrap_or(projector.gamma);
        if let Some(Gamma::Power(exponent)) = self.gamma {
            in_range("gamma", exponent, GAMMAS, "the exponent of its light curve, or \"srgb\"")?;
        }
        if let Some(level) = self.black_level {
            projector.black_level =
                in_range("black_level", level, BLACK_LEVELS, "the light of black as a part of white")?;
        }
        projector.gain = self.gain.unwrap_or(projector.gain);
        projector.fall_off = self.fall_off.clone().or(projector.fall_off.take());
        for channel in self.gain.into_iter().flatten() {
            in_range("gain", channel, GAINS, "the factors of red, green and blue")?;
        }
        Ok(())
    }
}

impl ProjectorSection {
    /// A projector of a wall without a grid; its pixels are to the right of those before, unless it says where.
    fn projector(&self, canvas_m: [f64; 2], before: &[Projector], path: &str) -> Result<Projector, Problem> {
        let name = &self.name;
        let missing =
            |key: &str, what: &str| (format!("{path}.name"), format!("\"{name}\" needs {key} = [..., ...]: {what}"));
        let [width, height] = self.pixels.ok_or_else(|| missing("pixels", "its columns and rows"))?;
        let (mut at_m, mut size_m) = (self.at_m, self.size_m);
        if self.mesh.is_some() {
            // Both follow from the mesh.
            (at_m, size_m) = (Some([0.0; 2]), Some(canvas_m));
        }
        let at_m = at_m.ok_or_else(|| missing("at_m", "its lower-left corner on the canvas, in metres"))?;
        let size_m = size_m.ok_or_else(|| missing("size_m", "its width and height in metres"))?;
        let right = before.iter().map(|projector| projector.output.x.saturating_add(projector.output.width)).max();
        let [x, y] = self.pixels_at.unwrap_or([right.unwrap_or(0), 0]);
        let canvas = CanvasRect {
            left: at_m[0] / canvas_m[0],
            bottom: at_m[1] / canvas_m[1],
            width: size_m[0] / canvas_m[0],
            height: size_m[1] / canvas_m[1],
        };
        Ok(Projector::plain(name.clone(), canvas, PixelRect { x, y, width, height }))
    }

    /// The index of the grid's projector that this table names.
    fn index_in_grid(&self, grid: &[Projector], path: &str) -> Result<usize, Problem> {
        let fixed = [
            ("pixels", self.pixels.is_some()),
            ("pixels_at", self.pixels_at.is_some()),
            ("at_m", self.at_m.is_some()),
            ("size_m", self.size_m.is_some()),
        ];
        if let Some((key, _)) = fixed.into_iter().find(|(_, is_given)| *is_given) {
            return Err((format!("{path}.{key}"), format!("{key} follows from [grid]: leave one of them out")));
        }
        let name = &self.name;
        grid.iter().position(|projector| projector.name == *name).ok_or_else(|| {
            let last = grid.last().map_or("", |projector| &projector.name);
            let problem =
                format!("no projector is named \"{name}\": those of the grid are \"row 1 column 1\" to \"{last}\"");
            (format!("{path}.name"), problem)
        })
    }

    fn apply_to(&self, projector: &mut Projector, path: &str) -> Result<(), Problem> {
        projector.monitor.clone_from(&self.output);
        projector.warp_px = self.warp_px.unwrap_or(projector.warp_px);
        let Self { rotation, flip, gamma, black_level, gain, .. } = *self;
        let fall_off = self.fall_off.clone();
        OpticsSection { rotation, flip, gamma, black_level, gain, fall_off }.apply_to(projector, path)
    }

    /// The mesh that a file beside the wall file holds.
    fn mesh(&self, file: &Path, canvas_m: [f64; 2], path: &str) -> Result<Option<Arc<Mesh>>, Problem> {
        let Some(name) = &self.mesh else { return Ok(None) };
        let fault = |problem: String| (format!("{path}.mesh"), format!("mesh = {name:?}: {problem}"));
        if Path::new(name).file_name().is_none_or(|plain| plain != name.as_str()) {
            return Err(fault("a mesh file lies beside the wall file: name it without a folder".to_owned()));
        }
        let mut bytes = Vec::new();
        let mesh_file = files::open(&file.with_file_name(name)).map_err(|it| fault(it.to_string()))?;
        // A longer file is cut, and then its length is wrong.
        mesh_file.take(LONGEST_MESH).read_to_end(&mut bytes).map_err(|it| fault(it.to_string()))?;
        let mesh = Mesh::from_pfm(name.clone(), &bytes, canvas_m).map_err(|it| fault(it.to_string()))?;
        Ok(Some(Arc::new(mesh)))
    }

    /// The table of a projector, complete.
    fn of(projector: &Projector, [width_m, height_m]: [f64; 2]) -> Self {
        let Projector { name, monitor, canvas, output, rotation, flip, warp_px, mesh, .. } = projector;
        let Projector { gamma, black_level, gain, fall_off, .. } = projector;
        // To the nanometre: hides the rounding error of thirds.
        let metres = |fraction: f64, side_m: f64| (fraction * side_m * 1e9).round() / 1e9;
        let place = mesh.is_none().then(|| {
            let at_m = [metres(canvas.left, width_m), metres(canvas.bottom, height_m)];
            (at_m, [metres(canvas.width, width_m), metres(canvas.height, height_m)])
        });
        Self {
            name: name.clone(),
            output: monitor.clone(),
            pixels: Some([output.width, output.height]),
            pixels_at: Some([output.x, output.y]),
            at_m: place.map(|(at_m, _)| at_m),
            size_m: place.map(|(_, size_m)| size_m),
            rotation: Some(rotation.degrees()),
            flip: Some(*flip),
            warp_px: Some(*warp_px),
            mesh: mesh.as_ref().map(|mesh| mesh.file().to_owned()),
            gamma: Some(*gamma),
            black_level: Some(*black_level),
            gain: Some(*gain),
            fall_off: fall_off.clone(),
        }
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

pub(super) fn write(wall: &Wall) -> String {
    let frame = wall.frame_size();
    let file = WallFile {
        canvas_m: wall.canvas_m(),
        frame: Some([frame.xres(), frame.yres()]),
        on_loss: wall.on_loss(),
        surface: wall.surface(),
        optics: OpticsSection::default(),
        grid: None,
        projector: wall.projectors().iter().map(|it| ProjectorSection::of(it, wall.canvas_m())).collect(),
    };
    toml::to_string(&file).expect("numbers and texts are TOML")
}

impl TryFrom<Value> for Gamma {
    type Error = String;

    fn try_from(value: Value) -> Result<Self, String> {
        match value {
            Value::Float(exponent) => Ok(Self::Power(exponent)),
            Value::Integer(exponent) => Ok(Self::Power(exponent as f64)),
            Value::String(name) if name == "srgb" => Ok(Self::Srgb),
            other => Err(format!("gamma = {other}: expected a number such as 2.2, or \"srgb\"")),
        }
    }
}

impl From<Gamma> for Value {
    fn from(gamma: Gamma) -> Self {
        match gamma {
            Gamma::Srgb => "srgb".into(),
            Gamma::Power(exponent) => exponent.into(),
        }
    }
}
