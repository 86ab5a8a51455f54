//! Keys, "Cubic Convolution Interpolation for Digital Image Processing" (1981): between points of a lattice, through all
//! of them, without a kink, with an error of the third order.

use std::ops::{Add, Mul, Sub};

use glam::DVec4;

/// The weights of four points at a part of the way from the second to the third, and their slopes.
pub(crate) fn weights(t: f64) -> [DVec4; 2] {
    let (t2, t3) = (t * t, t * t * t);
    let weights = DVec4::new(2.0 * t2 - t - t3, 2.0 - 5.0 * t2 + 3.0 * t3, t + 4.0 * t2 - 3.0 * t3, t3 - t2) / 2.0;
    let slopes =
        DVec4::new(4.0 * t - 1.0 - 3.0 * t2, 9.0 * t2 - 10.0 * t, 1.0 + 8.0 * t - 9.0 * t2, 3.0 * t2 - 2.0 * t) / 2.0;
    [weights, slopes]
}

/// Points, row by row, in a border that continues them as quadratic curves do (section V), or straight if there are only
/// two.
pub(crate) fn padded<T>([columns, rows]: [usize; 2], points: &[T]) -> Vec<T>
where
    T: Copy + Add<Output = T> + Sub<Output = T> + Mul<f64, Output = T>,
{
    let before = |line: [T; 3]| line[0] * 3.0 - line[1] * 3.0 + line[2];
    let continued = |line: &[T]| -> Vec<T> {
        let third = |first: T, second: T| second * 2.0 - first;
        let n = line.len();
        let start = before([line[0], line[1], line.get(2).copied().unwrap_or(third(line[0], line[1]))]);
        let last = if n > 2 { line[n - 3] } else { third(line[n - 1], line[n - 2]) };
        let end = before([line[n - 1], line[n - 2], last]);
        [&[start], line, &[end]].concat()
    };
    let wide: Vec<T> = points.chunks(columns).flat_map(continued).collect();
    let mut padded = vec![points[0]; (columns + 2) * (rows + 2)];
    for column in 0..columns + 2 {
        let line: Vec<T> = wide.iter().skip(column).step_by(columns + 2).copied().collect();
        for (row, point) in continued(&line).into_iter().enumerate() {
            padded[row * (columns + 2) + column] = point;
        }
    }
    padded
}
