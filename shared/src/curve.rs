//! A space-filling curve through a rectangle's tiles: consecutive tiles are neighbours.
//!
//! The generalised Hilbert curve of Červený ("gilbert", 2018, github.com/jakubcerveny/gilbert) cuts a rectangle into two
//! or three smaller ones, and each begins beside the end of the one before; a single row ends the recursion. Unlike
//! Hilbert's own curve, it fills a rectangle of any sides, each tile once. A run of the curve is a compact region, so its
//! rays meet the same part of the scene.

use glam::IVec2;

/// Consecutive tiles that are rendered together, counted from the curve's beginning: nearly always a square. Together they
/// cost less than one by one, so a cut within a square changes the costs of its tiles.
pub const TILES_PER_SQUARE: u32 = 4;

/// The column and row of the `index`-th tile along the curve through `columns` × `rows` tiles; `index` must be below their
/// product, and the product within `i32`. Takes O(log(columns + rows)) steps.
pub fn tile_at(index: u32, columns: u32, rows: u32) -> (u32, u32) {
    debug_assert!(index < columns * rows, "tile {index} of {columns}×{rows}");
    let mut index = index as i32;
    let (across, up) = (IVec2::X * columns as i32, IVec2::Y * rows as i32);
    // The rectangle that holds the tile: the corner where the curve enters, the side along which it leaves, the other side.
    let mut corner = IVec2::ZERO;
    let (mut along, mut beside) = if columns >= rows { (across, up) } else { (up, across) };
    let tile = loop {
        let (length, width) = (length_of(along), length_of(beside));
        if width == 1 {
            break corner + along.signum() * index;
        }
        if length == 1 {
            break corner + beside.signum() * index;
        }
        if 2 * length > 3 * width {
            // A long rectangle: two parts, one behind the other.
            let first = even_half(along);
            let n_first = length_of(first) * width;
            if index < n_first {
                along = first;
            } else {
                index -= n_first;
                corner += first;
                along -= first;
            }
        } else {
            // A stout rectangle, three parts: up, along, and down again.
            let half = along >> 1;
            let first = even_half(beside);
            let n_first = length_of(first) * length_of(half);
            let n_second = length * (width - length_of(first));
            if index < n_first {
                (along, beside) = (first, half);
            } else if index < n_first + n_second {
                index -= n_first;
                corner += first;
                beside -= first;
            } else {
                index -= n_first + n_second;
                corner += along - along.signum() + first - beside.signum();
                (along, beside) = (-first, half - along);
            }
        }
    };
    (tile.x as u32, tile.y as u32)
}

/// The index of a tile along the curve through `columns` × `rows` tiles: the inverse of [`tile_at`], with the same
/// recursion.
pub fn index_at(column: u32, row: u32, columns: u32, rows: u32) -> u32 {
    debug_assert!(column < columns && row < rows, "tile ({column}, {row}) of {columns}×{rows}");
    let tile = IVec2::new(column as i32, row as i32);
    let (across, up) = (IVec2::X * columns as i32, IVec2::Y * rows as i32);
    let (mut index, mut corner) = (0, IVec2::ZERO);
    let (mut along, mut beside) = if columns >= rows { (across, up) } else { (up, across) };
    let index = loop {
        let (length, width) = (length_of(along), length_of(beside));
        // The tile's offset in the rectangle along either side.
        let (a, b) = ((tile - corner).dot(along.signum()), (tile - corner).dot(beside.signum()));
        if width == 1 {
            break index + a;
        }
        if length == 1 {
            break index + b;
        }
        if 2 * length > 3 * width {
            let first = even_half(along);
            if a < length_of(first) {
                along = first;
            } else {
                index += length_of(first) * width;
                corner += first;
                along -= first;
            }
        } else {
            let half = along >> 1;
            let first = even_half(beside);
            let n_first = length_of(first) * length_of(half);
            if b >= length_of(first) {
                index += n_first;
                corner += first;
                beside -= first;
            } else if a < length_of(half) {
                (along, beside) = (first, half);
            } else {
                index += n_first + length * (width - length_of(first));
                corner += along - along.signum() + first - beside.signum();
                (along, beside) = (-first, half - along);
            }
        }
    };
    index as u32
}

/// The length of a side, which is parallel to an axis.
fn length_of(side: IVec2) -> i32 {
    (side.x + side.y).abs()
}

/// Half of a side, even if possible: the curve crosses even sides without a diagonal step.
fn even_half(whole: IVec2) -> IVec2 {
    let half = whole >> 1;
    if length_of(half) % 2 == 1 && length_of(whole) > 2 { half + whole.signum() } else { half }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_curve_of_two_by_two_is_hilbert_s() {
        let tiles: Vec<_> = (0..4).map(|index| tile_at(index, 2, 2)).collect();
        assert_eq!(tiles, [(0, 0), (0, 1), (1, 1), (1, 0)]);
    }

    #[test]
    fn every_tile_comes_once_and_beside_the_one_before() {
        for (columns, rows) in (1..=33).flat_map(|columns| (1..=33).map(move |rows| (columns, rows))) {
            let mut seen = vec![false; (columns * rows) as usize];
            let mut last: Option<(u32, u32)> = None;
            let mut n_diagonal = 0;
            for index in 0..columns * rows {
                let (x, y) = tile_at(index, columns, rows);
                assert_eq!(index_at(x, y, columns, rows), index, "{columns}×{rows}");
                assert!(x < columns && y < rows, "{columns}×{rows}");
                assert!(!std::mem::replace(&mut seen[(y * columns + x) as usize], true), "{columns}×{rows}: {x} {y}");
                let (dx, dy) = last.map_or((0, 1), |(i, j)| (x.abs_diff(i), y.abs_diff(j)));
                assert!(dx <= 1 && dy <= 1, "{columns}×{rows}: a jump to {x} {y}");
                n_diagonal += dx * dy;
                last = Some((x, y));
            }
            assert!(n_diagonal <= 1, "{columns}×{rows}: {n_diagonal} diagonal steps");
        }
    }

    #[test]
    fn the_largest_frame_has_a_last_tile() {
        for (columns, rows) in [(2048, 2048), (8192, 512), (1, 8192)] {
            let last = columns * rows - 1;
            let (x, y) = tile_at(last, columns, rows);
            assert!(x < columns && y < rows);
            assert_eq!(index_at(x, y, columns, rows), last);
        }
    }
}
