//! Parses a piece of an OBJ file, from the beginning of a line to the end of one.

use std::{borrow::Cow, io::BufRead};

use glam::{DVec3, Vec3};

use crate::formats::{decimal::Decimal, stl::printable};
use crate::model::normal::Normal;

/// Stands for a number of a corner that is not written.
pub(super) const NONE: i64 = i64::MAX;
/// Added to indices that count from the piece's first row: they are negative, all others are not.
const OF_PIECE: i64 = -1 << 40;

/// The rows of a piece in order.
#[derive(Default)]
pub(super) struct Piece {
    pub(super) positions: Vec<DVec3>,
    /// The first position with a coordinate that `f32` cannot hold to its last digit.
    pub(super) precise_from: Option<usize>,
    /// sRGB colours of the positions; empty, or as many.
    pub(super) colors: Vec<[u8; 3]>,
    pub(super) texture_coordinates: Vec<[f32; 2]>,
    pub(super) normals: Vec<Normal>,
    /// Indices of position, texture coordinates and normal; [`absolute`] resolves them.
    pub(super) corners: Vec<[i64; 3]>,
    /// The end of each polygon in `corners`.
    pub(super) polygons: Vec<usize>,
    /// Names of materials, each with the first polygon that has it.
    pub(super) materials: Vec<(usize, String)>,
    /// Files of materials.
    pub(super) libraries: Vec<String>,
    /// Points, lines, and curved surfaces.
    pub(super) n_left_out: usize,
    /// Faces that are no triangle.
    pub(super) n_short: usize,
    /// Whether it ends in the middle of a face.
    pub(super) is_cut: bool,
}

/// The fault of a row; `line` counts from 0.
pub(super) struct Fault {
    pub(super) line: usize,
    pub(super) what: String,
}

/// The index in the file, given the number of rows before the piece; `None` if the row does not exist.
pub(super) fn absolute(index: i64, n_before: usize) -> Option<u32> {
    let index = if index < 0 { index - OF_PIECE + n_before as i64 } else { index };
    u32::try_from(index).ok()
}

impl Piece {
    pub(super) fn parse(text: &[u8]) -> Result<Self, Fault> {
        let mut piece = Self::default();
        let mut rest = text;
        let mut n_lines = 0;
        let mut n_before_last = 0;
        while !rest.is_empty() {
            let (line, n_bytes, n_rows) = logical_line(rest);
            rest = &rest[n_bytes..];
            n_before_last = piece.polygons.len();
            let is_cut = rest.is_empty() && !text.ends_with(b"\n");
            let place = if is_cut { ", where the file ends: it may have been cut short" } else { "" };
            piece.parse_line(Words(line)).map_err(|what| Fault { line: n_lines, what: what + place })?;
            n_lines += n_rows;
        }
        // Many a whole file has no end of its last line.
        piece.is_cut = !text.ends_with(b"\n") && piece.polygons.len() > n_before_last && piece.ends_in_a_face();
        Ok(piece)
    }

    /// Whether the last face lacks corners, or its last corner has fewer numbers than its first.
    fn ends_in_a_face(&self) -> bool {
        let (start, end) = match *self.polygons {
            [.., start, end] => (start, end),
            [end] => (0, end),
            [] => return false,
        };
        let corners = &self.corners[start..end];
        let has = |corner: &[i64; 3]| corner.map(|index| index != NONE);
        corners.len() < 3 || corners.first().map(has) != corners.last().map(has)
    }

    fn parse_line(&mut self, mut words: Words<'_>) -> Result<(), String> {
        match words.next().unwrap_or_default() {
            b"v" => self.parse_position(words),
            b"vt" => {
                let u = words.number()?;
                let v = words.next().map(decimal).transpose()?.map_or(0.0, |decimal| decimal.value);
                // OBJ counts v from the lower edge.
                self.texture_coordinates.push([u as f32, (1.0 - v) as f32]);
                Ok(())
            }
            b"vn" => {
                let normal = [words.number()?, words.number()?, words.number()?];
                self.normals.push(Normal::new(Vec3::from(normal.map(|x| x as f32))));
                Ok(())
            }
            // `fo` is of older files.
            b"f" | b"fo" => {
                let n_before = self.corners.len();
                for word in words {
                    let corner = self.corner(word)?;
                    self.corners.push(corner);
                }
                self.n_short += usize::from(self.corners.len() < n_before + 3);
                self.polygons.push(self.corners.len());
                Ok(())
            }
            b"usemtl" => {
                self.materials.push((self.polygons.len(), words.rest()));
                Ok(())
            }
            b"mtllib" => {
                self.libraries.push(words.rest());
                Ok(())
            }
            b"p" | b"l" | b"curv" | b"curv2" | b"surf" => {
                self.n_left_out += 1;
                Ok(())
            }
            _ => Ok(()),
        }
    }

    fn parse_position(&mut self, mut words: Words<'_>) -> Result<(), String> {
        let decimals = [words.decimal()?, words.decimal()?, words.decimal()?];
        if !decimals.iter().all(|decimal| decimal.fits_single) && self.precise_from.is_none() {
            self.precise_from = Some(self.positions.len());
        }
        self.positions.push(DVec3::from(decimals.map(|decimal| decimal.value)));
        // A fourth number is a weight; only six are a colour, or seven.
        let mut more = [0.0; 4];
        let mut n_more = 0;
        for (number, word) in more.iter_mut().zip(words) {
            // A remark may follow.
            let Some(decimal) = Decimal::parse(word) else { break };
            *number = decimal.value;
            n_more += 1;
        }
        if n_more >= 3 {
            let color = if n_more == 3 { [more[0], more[1], more[2]] } else { [more[1], more[2], more[3]] };
            self.colors.resize(self.positions.len() - 1, [u8::MAX; 3]);
            // `as` saturates, and takes NaN to 0.
            self.colors.push(color.map(|part| (part * 255.0).round() as u8));
        } else if !self.colors.is_empty() {
            self.colors.push([u8::MAX; 3]);
        }
        Ok(())
    }

    /// Parses `1`, `1/2`, `1//3` or `1/2/3`; negative numbers count back from the last row.
    fn corner(&self, word: &[u8]) -> Result<[i64; 3], String> {
        let counts = [self.positions.len(), self.texture_coordinates.len(), self.normals.len()];
        let mut corner = [NONE; 3];
        let mut rest = word;
        for (index, count) in corner.iter_mut().zip(counts) {
            let is_counted_back = rest.first() == Some(&b'-');
            rest = &rest[usize::from(is_counted_back)..];
            let (mut value, mut n_digits) = (0_i64, 0);
            while let Some(digit) = rest.get(n_digits).filter(|byte| byte.is_ascii_digit()) {
                // Larger than any index, and small enough for sums.
                value = (value * 10 + i64::from(digit - b'0')).min(1 << 36);
                n_digits += 1;
            }
            let is_whole = matches!(rest.get(n_digits), None | Some(b'/'));
            if !is_whole || n_digits == 0 && is_counted_back {
                return Err(format!("`{}` is not a corner", printable(word)));
            }
            *index = match value {
                _ if n_digits == 0 => NONE,
                // There is no row 0.
                0 => 1 << 36,
                _ if is_counted_back => OF_PIECE + count as i64 - value,
                _ => value - 1,
            };
            rest = rest.get(n_digits + 1..).unwrap_or_default();
        }
        Ok(corner)
    }
}

/// The first line, the bytes that it takes, and the rows; a line goes on behind a backslash.
fn logical_line(text: &[u8]) -> (&[u8], usize, usize) {
    let mut end = 0;
    let mut n_rows = 0;
    loop {
        let mut rest = &text[end..];
        // A slice never fails to be read; its search is the standard library's fastest.
        end += rest.skip_until(b'\n').unwrap_or(rest.len());
        n_rows += 1;
        let line = text[..end].strip_suffix(b"\n").unwrap_or(&text[..end]);
        if end == text.len() || !goes_on(line) {
            return (line, end, n_rows);
        }
    }
}

/// Whether a line that ends here goes on in the next. Remarks do not: they may end with the name of a folder.
pub(super) fn goes_on(text: &[u8]) -> bool {
    let line = || text.rsplit(|&byte| byte == b'\n').next().unwrap_or(text).trim_ascii_start();
    text.strip_suffix(b"\r").unwrap_or(text).ends_with(b"\\") && !line().starts_with(b"#")
}

/// The words of a line up to a remark.
struct Words<'a>(&'a [u8]);

impl<'a> Iterator for Words<'a> {
    type Item = &'a [u8];

    #[inline]
    fn next(&mut self) -> Option<&'a [u8]> {
        let is_space = |byte: u8| byte.is_ascii_whitespace() || byte == b'\\';
        let start = self.0.iter().position(|&byte| !is_space(byte))?;
        let rest = &self.0[start..];
        if rest[0] == b'#' {
            return None;
        }
        let end = rest.iter().position(|&byte| is_space(byte)).unwrap_or(rest.len());
        self.0 = &rest[end..];
        Some(&rest[..end])
    }
}

impl Words<'_> {
    fn decimal(&mut self) -> Result<Decimal, String> {
        self.next().ok_or_else(|| "a number is missing".to_owned()).and_then(decimal)
    }

    fn number(&mut self) -> Result<f64, String> {
        self.decimal().map(|decimal| decimal.value)
    }

    /// All that is left, which may contain spaces.
    fn rest(self) -> String {
        text(self.0).trim().to_owned()
    }
}

/// The text of bytes in UTF-8, or as old programs write it, where each byte is a letter.
pub(super) fn text(bytes: &[u8]) -> Cow<'_, str> {
    match str::from_utf8(bytes) {
        Ok(text) => text.into(),
        Err(_) => bytes.iter().copied().map(char::from).collect::<String>().into(),
    }
}

fn decimal(word: &[u8]) -> Result<Decimal, String> {
    Decimal::parse(word).ok_or_else(|| format!("`{}` is not a number", printable(word)))
}
