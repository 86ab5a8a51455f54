//! Rows of an ASCII PLY, one on each line.
//!
//! As in other readers, rows may go on in the next line, and blank lines and the rest of a row's last line are skipped.

use std::io::BufRead;

use ply_rs::ply::{ElementDef, Property, PropertyAccess, PropertyType, ScalarType};

use crate::formats::{assembly::index_from_f64, decimal::Decimal, ply::ENDS_HERE};

pub(super) struct Rows<'a, R> {
    reader: &'a mut R,
    line_end: u8,
    line: Vec<u8>,
    /// Position in `line` from which the next token is searched.
    at: usize,
    /// Whether a coordinate declared `float` had more digits than that holds.
    is_precise: bool,
}

impl<'a, R: BufRead> Rows<'a, R> {
    pub(super) fn new(reader: &'a mut R, line_end: u8) -> Self {
        Self { reader, line_end, line: Vec::new(), at: 0, is_precise: false }
    }

    pub(super) fn next<E: PropertyAccess>(&mut self, def: &ElementDef) -> Result<E, String> {
        self.at = self.line.len();
        let mut row = E::new();
        let mut doubles = [None; 3];
        for (role, property) in &def.properties {
            match &property.data_type {
                PropertyType::Scalar(_) if role.starts_with('_') => drop(self.token()?),
                PropertyType::Scalar(ScalarType::Float) if let Some(axis) = axis(role) => {
                    let token = self.token()?;
                    let Decimal { value, fits_single } = decimal(token)?;
                    row.set_property(role, Property::Float(value as f32));
                    doubles[axis] = Some((role, value));
                    self.is_precise |= !fits_single;
                }
                PropertyType::Scalar(scalar) => {
                    row.set_property(role, scalar_from_token(self.token()?, scalar)?);
                }
                PropertyType::List(..) => {
                    let length = self.token()?;
                    let length: u32 =
                        index(length)?.ok_or_else(|| format!("`{length}` is not the length of a list"))?;
                    let (mut indices, mut numbers) = (Vec::new(), Vec::new());
                    for _ in 0..length {
                        let token = self.token()?;
                        match role.as_str() {
                            "i" => indices.push(index(token)?.unwrap_or(u32::MAX)),
                            "c" => numbers.push(real(token)? as f32),
                            _ => {}
                        }
                    }
                    if role == "c" {
                        row.set_property(role, Property::ListFloat(numbers));
                    } else {
                        row.set_list_uint(role, indices);
                    }
                }
            }
        }
        // All coordinates from the first row on that needs it: zeros at a number's end are often left out.
        for (role, double) in doubles.into_iter().flatten().filter(|_| self.is_precise) {
            row.set_property(role, Property::Double(double));
        }
        Ok(row)
    }

    fn token(&mut self) -> Result<&str, String> {
        loop {
            let rest = &self.line[self.at..];
            if let Some(start) = rest.iter().position(|byte| !byte.is_ascii_whitespace()) {
                let rest = &rest[start..];
                let length = rest.iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len());
                let begin = self.at + start;
                self.at = begin + length;
                let token = &self.line[begin..self.at];
                return str::from_utf8(token).map_err(|_| not_a_number(&String::from_utf8_lossy(token)));
            }
            self.line.clear();
            self.at = 0;
            if self.reader.read_until(self.line_end, &mut self.line).map_err(|error| error.to_string())? == 0 {
                return Err(ENDS_HERE.to_owned());
            }
        }
    }
}

fn scalar_from_token(token: &str, scalar: &ScalarType) -> Result<Property, String> {
    Ok(match scalar {
        ScalarType::Float => Property::Float(real(token)? as f32),
        ScalarType::Double => Property::Double(real(token)?),
        ScalarType::UInt => Property::UInt(real(token)? as u32),
        // Wide integers keep their values: only `ushort` colours are scaled.
        ScalarType::UShort => Property::UShort(real(token)? as u16),
        _ => Property::Int(real(token)? as i32),
    })
}

fn axis(role: &str) -> Option<usize> {
    ["x", "y", "z"].iter().position(|axis| *axis == role)
}

/// Parses a vertex index or a length; `None` if it is not a `u32`.
fn index(token: &str) -> Result<Option<u32>, String> {
    match token.parse::<u32>() {
        Ok(value) => Ok(Some(value)),
        Err(_) => Ok(index_from_f64(real(token)?)),
    }
}

fn decimal(token: &str) -> Result<Decimal, String> {
    Decimal::parse(token.as_bytes()).ok_or_else(|| not_a_number(token))
}

fn real(token: &str) -> Result<f64, String> {
    decimal(token).map(|decimal| decimal.value)
}

fn not_a_number(token: &str) -> String {
    format!("`{}` is not a number", token.chars().take(40).collect::<String>())
}
