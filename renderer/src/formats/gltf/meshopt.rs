//! Decodes compressed buffer views: `EXT_meshopt_compression`, and `KHR_meshopt_compression`, which names it anew.
//!
//! The formats are described in the extensions' specifications. Every read is checked, and memory is bounded by the encoded
//! bytes.

use std::array;

/// Vertices are decoded in blocks of at most this many bytes and rows.
const BLOCK_BYTES: usize = 8192;
const BLOCK_ROWS: usize = 256;
/// Bytes that are decoded together.
const GROUP: usize = 16;
/// A block of zeros takes no less than this part of its bytes.
const LARGEST_RATIO: usize = 1024;

/// The kind of data in a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub(super) enum Mode {
    Attributes,
    Triangles,
    Indices,
}

/// The filter over decoded rows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub(super) enum Filter {
    #[default]
    None,
    Octahedral,
    Quaternion,
    Exponential,
    Color,
}

/// Decodes `count` rows of `stride` bytes; `None` if the data is damaged.
pub(super) fn decode(data: &[u8], mode: Mode, filter: Filter, count: usize, stride: usize) -> Option<Vec<u8>> {
    let least_bytes = match mode {
        Mode::Attributes => count.checked_mul(stride)? / LARGEST_RATIO,
        Mode::Triangles => count / 3,
        Mode::Indices => count,
    };
    if least_bytes > data.len() {
        return None;
    }
    let pack = |indices: Vec<u32>| match stride {
        2 => Some(indices.iter().flat_map(|&index| (index as u16).to_le_bytes()).collect()),
        4 => Some(indices.iter().flat_map(|index| index.to_le_bytes()).collect()),
        _ => None,
    };
    match mode {
        Mode::Attributes => {
            let mut rows = attributes(data, count, stride)?;
            apply(filter, &mut rows, stride)?;
            Some(rows)
        }
        Mode::Triangles => pack(triangles(data, count)?),
        Mode::Indices => pack(sequence(data, count)?),
    }
}

/// Bytes that are read in order.
struct Bytes<'a>(&'a [u8]);

impl<'a> Bytes<'a> {
    fn take(&mut self, n: usize) -> Option<&'a [u8]> {
        let (taken, rest) = self.0.split_at_checked(n)?;
        self.0 = rest;
        Some(taken)
    }

    fn byte(&mut self) -> Option<u8> {
        self.take(1).map(|byte| byte[0])
    }

    /// Seven bits a byte, the lowest first; at most five bytes.
    fn variable(&mut self) -> Option<u32> {
        let mut result = 0;
        for shift in (0..35).step_by(7) {
            let byte = self.byte()?;
            result |= u32::from(byte & 127).wrapping_shl(shift);
            if byte < 128 {
                break;
            }
        }
        Some(result)
    }

    /// A difference to the last index.
    fn index(&mut self, last: u32) -> Option<u32> {
        Some(last.wrapping_add(unzigzag(self.variable()?)))
    }
}

fn unzigzag(value: u32) -> u32 {
    value >> 1 ^ (value & 1).wrapping_neg()
}

fn attributes(data: &[u8], count: usize, stride: usize) -> Option<Vec<u8>> {
    if stride == 0 || stride > 256 || !stride.is_multiple_of(4) {
        return None;
    }
    let (&header, data) = data.split_first()?;
    let is_new = match header {
        0xa0 => false,
        0xa1 => true,
        _ => return None,
    };
    let tail_bytes = stride + if is_new { stride / 4 } else { 0 };
    let tail_start = data.len().checked_sub(tail_bytes.max(if is_new { 24 } else { 32 }))?;
    let (mut data, tail) = (Bytes(&data[..tail_start]), &data[data.len() - tail_bytes..]);
    let (first, channels) = tail.split_at(stride);
    let mut last = first.to_vec();
    let mut rows = vec![0; count * stride];
    let block_rows = ((BLOCK_BYTES / stride) & !(GROUP - 1)).min(BLOCK_ROWS);
    for block in rows.chunks_mut(block_rows * stride) {
        let control = if is_new { data.take(stride / 4)? } else { &[] };
        for word in 0..stride / 4 {
            let control = control.get(word).copied().unwrap_or(0);
            let channel = channels.get(word).copied().unwrap_or(0);
            attribute(&mut data, block, stride, word, &mut last, is_new.then_some(control), channel)?;
        }
    }
    data.0.is_empty().then_some(rows)
}

/// Decodes four bytes of each row of a block; `last` is the row before it, and then its last one.
fn attribute(
    data: &mut Bytes<'_>,
    block: &mut [u8],
    stride: usize,
    word: usize,
    last: &mut [u8],
    control: Option<u8>,
    channel: u8,
) -> Option<()> {
    let mut planes = [[0; BLOCK_ROWS]; 4];
    let n_rows = block.len() / stride;
    for (byte, plane) in planes.iter_mut().enumerate() {
        let control = control.map(|control| control >> (2 * byte) & 3);
        match control {
            None => groups(data, plane, n_rows, [0, 2, 4, 8])?,
            Some(0) => groups(data, plane, n_rows, [0, 1, 2, 4])?,
            Some(1) => groups(data, plane, n_rows, [1, 2, 4, 8])?,
            Some(2) => {}
            Some(_) => plane[..n_rows].copy_from_slice(data.take(n_rows)?),
        }
    }
    let place = 4 * word..4 * word + 4;
    let mut previous: [u8; 4] = *last[place.clone()].first_chunk()?;
    for (index, row) in block.chunks_exact_mut(stride).enumerate() {
        let delta: [u8; 4] = array::from_fn(|byte| planes[byte][index]);
        previous = match channel & 3 {
            0 => {
                array::from_fn(|byte| previous[byte].wrapping_add(delta[byte] >> 1 ^ (delta[byte] & 1).wrapping_neg()))
            }
            1 => {
                let half = |at: usize| {
                    let [delta, previous] = [delta, previous].map(|it| u16::from_le_bytes([it[at], it[at + 1]]));
                    previous.wrapping_add(delta >> 1 ^ (delta & 1).wrapping_neg()).to_le_bytes()
                };
                let ([a, b], [c, d]) = (half(0), half(2));
                [a, b, c, d]
            }
            2 => {
                let turned = u32::from_le_bytes(delta).rotate_right(u32::from(channel >> 4));
                (turned ^ u32::from_le_bytes(previous)).to_le_bytes()
            }
            _ => return None,
        };
        row[place.clone()].copy_from_slice(&previous);
    }
    last[place].copy_from_slice(&previous);
    Some(())
}

/// Decodes bytes in groups, each with as many bits as its header says; all ones announce a whole byte.
fn groups(data: &mut Bytes<'_>, plane: &mut [u8; BLOCK_ROWS], n_rows: usize, widths: [usize; 4]) -> Option<()> {
    let n_groups = n_rows.div_ceil(GROUP);
    let header = data.take(n_groups.div_ceil(4))?;
    for (index, group) in plane.as_chunks_mut::<GROUP>().0.iter_mut().take(n_groups).enumerate() {
        let width = widths[usize::from(header[index / 4] >> (index % 4 * 2) & 3)];
        match width {
            0 => {}
            8 => group.copy_from_slice(data.take(GROUP)?),
            _ => {
                let packed = data.take(2 * width)?;
                let ones = ((1_u16 << width) - 1) as u8;
                for (k, value) in group.iter_mut().enumerate() {
                    let at = k * width;
                    // Single bits come lowest first, wider ones highest first.
                    let shift = if width == 1 { at % 8 } else { 8 - width - at % 8 };
                    let bits = packed[at / 8] >> shift & ones;
                    *value = if bits == ones { data.byte()? } else { bits };
                }
            }
        }
    }
    Some(())
}

/// The last sixteen edges or vertices.
struct Recent<T> {
    items: [T; 16],
    at: usize,
}

impl<T: Copy> Recent<T> {
    fn new(item: T) -> Self {
        Self { items: [item; 16], at: 0 }
    }

    fn push(&mut self, item: T) {
        self.items[self.at] = item;
        self.at = (self.at + 1) % 16;
    }

    /// The item that was pushed `back` items ago; 1 is the last.
    fn get(&self, back: u8) -> T {
        self.items[self.at.wrapping_sub(usize::from(back)) & 15]
    }
}

fn triangles(data: &[u8], count: usize) -> Option<Vec<u32>> {
    if !count.is_multiple_of(3) {
        return None;
    }
    let (&header, data) = data.split_first()?;
    let most_recent = match header {
        0xe0 => 15,
        0xe1 => 13,
        _ => return None,
    };
    let (codes, data) = data.split_at_checked(count / 3)?;
    let (data, table) = data.split_at_checked(data.len().checked_sub(16)?)?;
    let mut data = Bytes(data);
    let mut edges = Recent::new([u32::MAX; 2]);
    let mut vertices = Recent::new(u32::MAX);
    let (mut next, mut last) = (0_u32, 0_u32);
    let mut indices = Vec::with_capacity(count);
    for &code in codes {
        let [a, b, c];
        if code < 0xf0 {
            [a, b] = edges.get((code >> 4) + 1);
            let kind = code & 15;
            if kind != 0 && kind < most_recent {
                c = vertices.get(kind + 1);
            } else {
                c = match kind {
                    0 => new(&mut next),
                    15 => data.index(last)?,
                    13 => last.wrapping_sub(1),
                    _ => last.wrapping_add(1),
                };
                if kind != 0 {
                    last = c;
                }
                vertices.push(c);
            }
        } else {
            let aux = if code < 0xfe { table[usize::from(code & 15)] } else { data.byte()? };
            let kinds = [if code == 0xff { 15 } else { 0 }, aux >> 4, aux & 15];
            if code >= 0xfe && aux == 0 {
                next = 0;
            }
            // New vertices are counted before free ones are read.
            let mut corners = kinds.map(|kind| if kind == 0 { new(&mut next) } else { vertices.get(kind) });
            for (corner, kind) in corners.iter_mut().zip(kinds) {
                if kind == 15 && code >= 0xfe {
                    last = data.index(last)?;
                    *corner = last;
                }
            }
            [a, b, c] = corners;
            for (corner, kind) in corners.into_iter().zip(kinds) {
                if kind == 0 || kind == 15 && code >= 0xfe {
                    vertices.push(corner);
                }
            }
            edges.push([b, a]);
        }
        edges.push([c, b]);
        edges.push([a, c]);
        indices.extend([a, b, c]);
    }
    data.0.is_empty().then_some(indices)
}

fn new(next: &mut u32) -> u32 {
    let vertex = *next;
    *next = next.wrapping_add(1);
    vertex
}

fn sequence(data: &[u8], count: usize) -> Option<Vec<u32>> {
    let (&header, data) = data.split_first()?;
    let mut data = Bytes(data.get(..data.len().checked_sub(4)?)?);
    let mut last = [0_u32; 2];
    let mut next = || {
        let value = data.variable()?;
        let last = &mut last[(value & 1) as usize];
        *last = last.wrapping_add(unzigzag(value >> 1));
        Some(*last)
    };
    matches!(header, 0xd0 | 0xd1).then(|| (0..count).map(|_| next()).collect())?
}

/// Undoes a filter in place; `None` if the stride is not one of the filter's.
fn apply(filter: Filter, rows: &mut [u8], stride: usize) -> Option<()> {
    match (filter, stride) {
        (Filter::None, _) => {}
        (Filter::Exponential, _) => rows.as_chunks_mut().0.iter_mut().for_each(|row| *row = exponential(*row)),
        (Filter::Octahedral, 4) => {
            for row in rows.as_chunks_mut::<4>().0 {
                let [x, y, z] = octahedral([row[0], row[1], row[2]].map(|part| f32::from(part as i8)), 127.0);
                [row[0], row[1], row[2]] = [x, y, z].map(|part| part as i8 as u8);
            }
        }
        (Filter::Octahedral, 8) => {
            for row in rows.as_chunks_mut::<8>().0 {
                let part = |at: usize| f32::from(i16::from_le_bytes([row[at], row[at + 1]]));
                let unit = octahedral([part(0), part(2), part(4)], 32767.0);
                row[..6].copy_from_slice(unit.map(|part| (part as i16).to_le_bytes()).as_flattened());
            }
        }
        (Filter::Quaternion, 8) => {
            for row in rows.as_chunks_mut::<8>().0 {
                *row = *quaternion(halves(row).map(|half| half as i16))
                    .map(i16::to_le_bytes)
                    .as_flattened()
                    .first_chunk()?;
            }
        }
        (Filter::Color, 4) => {
            for row in rows.as_chunks_mut::<4>().0 {
                let [luma, orange, green, coverage] = *row;
                let parts = [luma.into(), (orange as i8).into(), (green as i8).into(), coverage.into()];
                *row = color(parts, 255.0).map(|part| part as u8);
            }
        }
        (Filter::Color, 8) => {
            for row in rows.as_chunks_mut::<8>().0 {
                let [luma, orange, green, coverage] = halves(row);
                let parts = [luma.into(), (orange as i16).into(), (green as i16).into(), coverage.into()];
                let parts = color(parts, 65535.0).map(|part| (part as u16).to_le_bytes());
                *row = *parts.as_flattened().first_chunk()?;
            }
        }
        _ => return None,
    }
    Some(())
}

fn halves(row: &[u8; 8]) -> [u16; 4] {
    array::from_fn(|k| u16::from_le_bytes([row[2 * k], row[2 * k + 1]]))
}

/// A turn as x, y, z and w times 32767, from the three of them that are not the largest. The last number holds their scale,
/// and in two bits the place of the largest.
fn quaternion(row: [i16; 4]) -> [i16; 4] {
    let scale = f32::from(row[3] | 3);
    let [x, y, z] = [row[0], row[1], row[2]].map(f32::from);
    let largest = (2.0 * scale * scale - x * x - y * y - z * z).max(0.0).sqrt();
    let parts = [largest, x, y, z].map(|part| {
        let part = part * (32767.0 / std::f32::consts::SQRT_2 / scale);
        (part + if part >= 0.0 { 0.5 } else { -0.5 }) as i16
    });
    let place = row[3] as usize & 3;
    array::from_fn(|k| parts[k.wrapping_sub(place) & 3])
}

/// Red, green, blue and coverage up to `largest`, from luma, two differences, and coverage, whose highest bit tells how many
/// bits all of them have.
fn color([luma, orange, green, coverage]: [i32; 4], largest: f32) -> [f32; 4] {
    let ones = ((1_u32 << (32 - coverage.leading_zeros())) - 1).max(1) as i32;
    let whole = (coverage << 1) & ones | coverage & 1;
    let parts = [luma + orange - green, luma + green, luma - orange - green, whole];
    parts.map(|part| (part as f32 * (largest / ones as f32) + 0.5).trunc())
}

/// A number with a mantissa of 24 bits and an exponent of 8.
fn exponential(row: [u8; 4]) -> [u8; 4] {
    let value = i32::from_le_bytes(row);
    let power = f32::from_bits((((value >> 24) + 127) as u32) << 23);
    (power * (value << 8 >> 8) as f32).to_le_bytes()
}

/// A unit vector times `largest`, rounded, from its point on an octahedron.
fn octahedral([x, y, one]: [f32; 3], largest: f32) -> [f32; 3] {
    let z = one - x.abs() - y.abs();
    let fold = z.min(0.0);
    let [x, y] = [x, y].map(|part| part + if part >= 0.0 { fold } else { -fold });
    let scale = largest / (x * x + y * y + z * z).sqrt();
    [x, y, z].map(|part| (part * scale + if part >= 0.0 { 0.5 } else { -0.5 }).trunc())
}
