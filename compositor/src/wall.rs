//! The wall's geometry: which projector lights which part of the canvas, from which pixels.

use std::io::Read;
use std::ops::RangeInclusive;
use std::path::Path;

use serde::Deserialize;
use shared::division::FrameSize;
use toml::Spanned;

/// A canvas and the projectors that light it.
///
/// Every projector shows its own part of one frame, which covers the whole canvas.
///
/// Invariant: there is at least one projector, [`Wall::output_size`] is at most [`Wall::LARGEST_SIDE`] either way, and
/// the canvas has an area.
#[derive(Clone, Debug, PartialEq)]
pub struct Wall {
    canvas_m: [f64; 2],
    projectors: Vec<Projector>,
}

/// One projector of the wall.
#[derive(Clone, Debug, PartialEq)]
pub struct Projector {
    /// What people call it, for messages.
    pub name: String,
    /// The part of the canvas that it lights.
    pub canvas: CanvasRect,
    /// Its pixels in the output that spans all projectors.
    pub output: PixelRect,
}

/// A rectangle of the canvas, whose lower-left corner is (0, 0) and whose upper-right corner is (1, 1).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CanvasRect {
    /// Left edge.
    pub left: f64,
    /// Lower edge.
    pub bottom: f64,
    /// Extent to the right.
    pub width: f64,
    /// Extent upwards.
    pub height: f64,
}

/// A rectangle of pixels, counted from the upper-left corner of a picture or a window.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PixelRect {
    /// Left edge.
    pub x: u32,
    /// Upper edge.
    pub y: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// Why a file makes no wall.
#[derive(Debug, thiserror::Error)]
pub enum WallError {
    /// The file cannot be read.
    #[error("{path}: {source}: --wall takes a file like those in wall-config/")]
    Unreadable {
        /// As given.
        path: String,
        /// Why not.
        source: std::io::Error,
    },
    /// The file is no TOML, has other keys, or describes a wall that cannot be.
    #[error("{path}:{line}: {problem}")]
    Invalid {
        /// As given.
        path: String,
        /// From 1.
        line: usize,
        /// What is wrong there, and what would be right.
        problem: String,
    },
}

impl Wall {
    /// The longest side of the spanning output in pixels: what GPUs take as one texture.
    pub const LARGEST_SIDE: u32 = 16384;

    /// The paper's wall: 4×3 projectors of 1024×768 pixels on a canvas of 4.00 m × 2.25 m.
    pub fn paper() -> Self {
        Self { canvas_m: [4.0, 2.25], projectors: grid(4, 3, [1024, 768]) }
    }

    /// Reads a wall file; see `wall-config/paper-4x3.toml`.
    pub fn load(path: &Path) -> Result<Self, WallError> {
        let name = path.display().to_string();
        let mut text = String::new();
        // A limit, for a device or a model named by mistake would be read for ever.
        let read = std::fs::File::open(path).and_then(|file| file.take(1 << 20).read_to_string(&mut text));
        match read {
            Ok(_) => Self::from_toml(&name, &text),
            Err(source) => Err(WallError::Unreadable { path: name, source }),
        }
    }

    /// Reads the text of a wall file; `path` is what messages call it.
    pub fn from_toml(path: &str, text: &str) -> Result<Self, WallError> {
        let wall = toml::from_str::<WallFile>(text)
            .map_err(|error| (error.span().map_or(0, |span| span.start), error.message().to_owned()))
            .and_then(WallFile::wall);
        wall.map_err(|(offset, problem)| {
            let before = text.get(..offset).unwrap_or(text);
            let problem = problem.trim().replace('\n', ", ");
            WallError::Invalid { path: path.to_owned(), line: 1 + before.matches('\n').count(), problem }
        })
    }

    /// Width and height of the canvas in metres.
    pub fn canvas_m(&self) -> [f64; 2] {
        self.canvas_m
    }

    /// The canvas's width over its height: the aspect of what the camera sees, whatever the shape of samples and pixels.
    pub fn aspect(&self) -> f64 {
        self.canvas_m[0] / self.canvas_m[1]
    }

    /// The projectors, row by row from the top left.
    pub fn projectors(&self) -> &[Projector] {
        &self.projectors
    }

    /// Width and height in pixels of the output that spans all projectors.
    pub fn output_size(&self) -> [u32; 2] {
        output_size(&self.projectors)
    }
}

/// Width and height in pixels of the smallest output that holds all `projectors`.
pub fn output_size(projectors: &[Projector]) -> [u32; 2] {
    projectors.iter().fold([0, 0], |[width, height], Projector { output, .. }| {
        [width.max(output.x + output.width), height.max(output.y + output.height)]
    })
}

impl PixelRect {
    /// The largest rectangle of the shape of `content` that lies in a picture of size `target`, centred there.
    ///
    /// Sides and margins are whole pixels, and at least one pixel is left of a side when the target has any.
    pub fn fitted(content: [u32; 2], target: [u32; 2]) -> Self {
        let [content_width, content_height] = content.map(|side| u64::from(side.max(1)));
        let [target_width, target_height] = target.map(u64::from);
        let rounded = |numerator: u64, denominator: u64| (numerator + denominator / 2) / denominator;
        let (width, height) = if target_width * content_height <= target_height * content_width {
            let height = rounded(target_width * content_height, content_width);
            (target_width, height.clamp(1, target_height.max(1)).min(target_height))
        } else {
            let width = rounded(target_height * content_width, content_height);
            (width.clamp(1, target_width.max(1)).min(target_width), target_height)
        };
        let [x, y] = [(target_width - width) / 2, (target_height - height) / 2];
        // None exceeds the target's sides, which are u32.
        let [x, y, width, height] = [x, y, width, height].map(|side| side as u32);
        Self { x, y, width, height }
    }
}

/// What stands in a wall file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WallFile {
    canvas_m: Spanned<[f64; 2]>,
    grid: Spanned<GridSection>,
}

/// `columns` × `rows` equal projectors, edge to edge.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct GridSection {
    columns: Spanned<u32>,
    rows: Spanned<u32>,
    pixels: Spanned<[u32; 2]>,
}

/// Sides of canvases that are not slips of the pen, in metres.
const CANVAS_SIDES_M: RangeInclusive<f64> = 0.01..=1000.0;
/// Columns or rows that are not slips of the pen.
const GRID_SIDES: RangeInclusive<u32> = 1..=64;

impl WallFile {
    /// The wall, or what is wrong at which byte of the file.
    fn wall(self) -> Result<Wall, (usize, String)> {
        let canvas_m = *self.canvas_m.get_ref();
        if !canvas_m.iter().all(|side_m| CANVAS_SIDES_M.contains(side_m)) {
            let (least, most) = (CANVAS_SIDES_M.start(), CANVAS_SIDES_M.end());
            let problem = format!("canvas_m = {canvas_m:?}: width and height in metres must be from {least} to {most}");
            return Err((self.canvas_m.span().start, problem));
        }
        let GridSection { columns, rows, pixels } = self.grid.get_ref();
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
                     the whole wall is one picture of at most {} pixels a side",
                    pixels.get_ref(),
                    Wall::LARGEST_SIDE
                );
                return Err((pixels.span().start, problem));
            }
        }
        Ok(Wall { canvas_m, projectors: grid(n_columns, n_rows, *pixels.get_ref()) })
    }
}

/// `columns` × `rows` projectors of `pixels` each, edge to edge, row by row from the top left.
fn grid(columns: u32, rows: u32, [width, height]: [u32; 2]) -> Vec<Projector> {
    let projector = |column: u32, row: u32| Projector {
        name: format!("row {} column {}", row + 1, column + 1),
        canvas: CanvasRect {
            left: f64::from(column) / f64::from(columns),
            bottom: f64::from(rows - 1 - row) / f64::from(rows),
            width: 1.0 / f64::from(columns),
            height: 1.0 / f64::from(rows),
        },
        output: PixelRect { x: column * width, y: row * height, width, height },
    };
    (0..rows).flat_map(|row| (0..columns).map(move |column| projector(column, row))).collect()
}

// Frames and walls meet in the same textures.
const _: () = assert!(Wall::LARGEST_SIDE == FrameSize::LARGEST);

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn config(name: &str) -> Wall {
        Wall::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../wall-config").join(name)).expect("shipped wall file")
    }

    fn problem(text: &str) -> String {
        Wall::from_toml("a.toml", text).expect_err(text).to_string()
    }

    #[test]
    fn the_default_is_the_paper_s_file() {
        assert_eq!(config("paper-4x3.toml"), Wall::paper());
        assert_eq!(Wall::paper().output_size(), [4096, 2304]);
        assert_eq!(Wall::paper().projectors().len(), 12);
        assert_eq!(Wall::paper().aspect(), 16.0 / 9.0);
    }

    #[test]
    fn the_laptop_s_file_fits_a_laptop() {
        assert_eq!(config("laptop.toml").output_size(), [1280, 720]);
    }

    #[test]
    fn projectors_cover_canvas_and_output_once() {
        let wall = config("laptop.toml");
        let [upper_left, upper_right, lower_left, _] = wall.projectors() else { panic!("four projectors") };
        assert_eq!(upper_left.output, PixelRect { x: 0, y: 0, width: 640, height: 360 });
        assert_eq!(upper_right.output, PixelRect { x: 640, y: 0, width: 640, height: 360 });
        assert_eq!(upper_left.canvas, CanvasRect { left: 0.0, bottom: 0.5, width: 0.5, height: 0.5 });
        assert_eq!(lower_left.canvas, CanvasRect { left: 0.0, bottom: 0.0, width: 0.5, height: 0.5 });
        let area: f64 = Wall::paper().projectors().iter().map(|p| p.canvas.width * p.canvas.height).sum();
        assert!((area - 1.0).abs() < 1e-12);
    }

    #[test]
    fn what_cannot_be_a_wall_is_refused_with_line_and_cure() {
        let grid = |columns: &str, rows: &str, pixels: &str| {
            format!("canvas_m = [4.0, 2.25]\n[grid]\ncolumns = {columns}\nrows = {rows}\npixels = {pixels}\n")
        };
        let cases = [
            (grid("0", "3", "[1024, 768]"), 3, "columns = 0: a wall has from 1 to 64"),
            (grid("4", "65", "[1024, 768]"), 4, "rows = 65"),
            (grid("4", "-3", "[1024, 768]"), 4, "invalid value"),
            (grid("4", "4294967296", "[1024, 768]"), 4, "invalid value"),
            (grid("4", "3", "[0, 768]"), 5, "each may have from 1 to 4096"),
            (grid("4", "3", "[4097, 768]"), 5, "each may have from 1 to 4096"),
            (grid("4", "3", "[1024, 4294967295]"), 5, "each may have from 1 to 5461"),
            (grid("4", "3", "[1024]"), 5, "invalid length 1"),
            (grid("4", "3", "\"1024x768\""), 5, "invalid type"),
            (grid("4", "3", "[1024, 768]\nbezel = 3"), 6, "unknown field `bezel`, expected one of `columns`"),
            (
                "canvas_m = [nan, 2.25]\n[grid]\ncolumns=4\nrows=3\npixels=[4,4]".into(),
                1,
                "in metres must be from 0.01",
            ),
            ("canvas_m = [4.0, inf]\n[grid]\ncolumns=4\nrows=3\npixels=[4,4]".into(), 1, "in metres"),
            ("canvas_m = [4.0, -1.0]\n[grid]\ncolumns=4\nrows=3\npixels=[4,4]".into(), 1, "in metres"),
            ("canvas_m = [4.0, 2.25]\n".into(), 1, "missing field `grid`"),
            ("canvas_m = [4.0, 2.25]\n\n[grid\n".into(), 3, ""),
            ("ply\nformat ascii 1.0\n".into(), 1, ""),
            (String::new(), 1, "missing field `canvas_m`"),
        ];
        for (text, line, expected) in cases {
            let problem = problem(&text);
            assert!(problem.starts_with(&format!("a.toml:{line}: ")), "{text}\n{problem}");
            assert!(problem.contains(expected) && !problem.contains('\n'), "{text}\n{problem}");
        }
    }

    #[test]
    fn a_missing_file_names_the_cure() {
        let error = Wall::load(Path::new("no/such.toml")).expect_err("no such file").to_string();
        assert!(error.contains("no/such.toml") && error.contains("wall-config/"), "{error}");
    }

    #[test]
    fn a_wall_is_fitted_whole_centred_and_never_empty() {
        let fitted = |content, target| {
            let PixelRect { x, y, width, height } = PixelRect::fitted(content, target);
            (x, y, width, height)
        };
        assert_eq!(fitted([4096, 2304], [4096, 2304]), (0, 0, 4096, 2304));
        assert_eq!(fitted([4096, 2304], [1024, 768]), (0, 96, 1024, 576));
        assert_eq!(fitted([4096, 2304], [2000, 720]), (360, 0, 1280, 720));
        assert_eq!(fitted([4096, 2304], [1, 1]), (0, 0, 1, 1));
        assert_eq!(fitted([4096, 2304], [1, 700]), (0, 349, 1, 1));
        assert_eq!(fitted([16384, 1], [100, 100]), (0, 49, 100, 1));
        assert_eq!(fitted([4096, 2304], [0, 0]), (0, 0, 0, 0));
        assert_eq!(fitted([1, 1], [u32::MAX, 7]), (2_147_483_644, 0, 7, 7));
    }

    proptest! {
        #[test]
        fn any_text_is_a_wall_or_an_error(text in "[\\[\\]a-z_=0-9.,\" \n\u{e9}-]{0,80}") {
            let _ = Wall::from_toml("a.toml", &text);
            let _ = Wall::from_toml("a.toml", &format!("canvas_m = [4.0, 2.25]\n[grid]\n{text}"));
        }

        #[test]
        fn any_grid_is_refused_or_covers_its_output_once(
            columns in 0_u32..80, rows in 0_u32..80, width in 0_u32..20_000, height in 0_u32..20_000,
        ) {
            let text = format!(
                "canvas_m = [4.0, 2.25]\n[grid]\ncolumns = {columns}\nrows = {rows}\npixels = [{width}, {height}]"
            );
            if let Ok(wall) = Wall::from_toml("a.toml", &text) {
                let [output_width, output_height] = wall.output_size();
                prop_assert!(output_width.max(output_height) <= Wall::LARGEST_SIDE);
                let n_pixels = |rect: PixelRect| u64::from(rect.width) * u64::from(rect.height);
                let covered: u64 = wall.projectors().iter().map(|projector| n_pixels(projector.output)).sum();
                prop_assert_eq!(covered, u64::from(output_width) * u64::from(output_height));
            }
        }

        #[test]
        fn a_fitted_wall_lies_in_its_target_and_touches_two_edges(
            content in any::<[u32; 2]>(), target in prop::array::uniform2(1_u32..100_000),
        ) {
            let PixelRect { x, y, width, height } = PixelRect::fitted(content, target);
            prop_assert!(width >= 1 && height >= 1);
            prop_assert!(x + width <= target[0] && y + height <= target[1]);
            prop_assert!(width == target[0] || height == target[1]);
        }
    }
}
