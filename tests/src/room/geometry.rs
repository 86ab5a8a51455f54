//! Where a wall file has a projector's pixels on the canvas, by linear equations: no code of the wall's.

use compositor::wall::{Flip, Projector};

/// From metres on the canvas to columns and rows of a projector's pixels: a homogeneous matrix, row by row.
pub(crate) fn px_from_m(projector: &Projector, [width_m, height_m]: [f64; 2]) -> [[f64; 3]; 3] {
    let canvas = projector.canvas;
    let [left, bottom] = [canvas.left * width_m, canvas.bottom * height_m];
    let [right, top] = [left + canvas.width * width_m, bottom + canvas.height * height_m];
    let size = [projector.output.width, projector.output.height].map(f64::from);
    let [columns, rows] = if projector.rotation.degrees().is_multiple_of(180) { size } else { [size[1], size[0]] };
    // Upper left, upper right, lower right, lower left: on the canvas, and in the projector's pixels.
    let corners_m = [[left, top], [right, top], [right, bottom], [left, bottom]];
    let corners = [[0.0, 0.0], [columns, 0.0], [columns, rows], [0.0, rows]];
    let corners_px = std::array::from_fn(|index| {
        stored_px(projector, [0, 1].map(|axis| corners[index][axis] + projector.warp_px[index][axis]))
    });
    solve(corners_m, corners_px)
}

/// Columns and rows as stored, of a place in columns and rows as seen on the wall.
pub(crate) fn stored_px(projector: &Projector, [x, y]: [f64; 2]) -> [f64; 2] {
    let size = [projector.output.width, projector.output.height].map(f64::from);
    // Undo the rotation, then the flip.
    let [x, y] = match projector.rotation.degrees() {
        0 => [x, y],
        90 => [y, size[1] - x],
        180 => [size[0] - x, size[1] - y],
        _ => [size[0] - y, x],
    };
    match projector.flip {
        Flip::None => [x, y],
        Flip::Horizontal => [size[0] - x, y],
        Flip::Vertical => [x, size[1] - y],
    }
}

/// The image of a point under a homogeneous matrix; `None` behind the horizon.
pub(crate) fn image(matrix: &[[f64; 3]; 3], [x, y]: [f64; 2]) -> Option<[f64; 2]> {
    let [column, row, depth] = matrix.map(|[a, b, c]| a * x + b * y + c);
    (depth > 0.0).then(|| [column / depth, row / depth])
}

/// The projective map that takes four points to four others, by Gaussian elimination of its eight equations.
fn solve(from: [[f64; 2]; 4], to: [[f64; 2]; 4]) -> [[f64; 3]; 3] {
    let mut rows: Vec<[f64; 9]> = Vec::new();
    for ([x, y], [u, v]) in std::iter::zip(from, to) {
        rows.push([x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y, u]);
        rows.push([0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y, v]);
    }
    for column in 0..8 {
        let larger = |a: &usize, b: &usize| rows[*a][column].abs().total_cmp(&rows[*b][column].abs());
        let pivot = (column..8).max_by(larger).unwrap_or(column);
        rows.swap(column, pivot);
        for row in 0..8 {
            if row != column {
                let factor = rows[row][column] / rows[column][column];
                let pivot_row = rows[column];
                rows[row].iter_mut().zip(pivot_row).for_each(|(it, above)| *it -= factor * above);
            }
        }
    }
    let h: Vec<f64> = (0..8).map(|index| rows[index][8] / rows[index][index]).collect();
    [[h[0], h[1], h[2]], [h[3], h[4], h[5]], [h[6], h[7], 1.0]]
}
