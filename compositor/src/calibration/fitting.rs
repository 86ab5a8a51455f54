//! Homographies from many points, small systems of equations, and quantiles.

use glam::{DMat3, DVec2};

use crate::wall::homography::apply;

/// The homography that takes the first points of pairs to the second ones, by least squares in the second plane; pairs
/// that do not fit count little. `None` for fewer than four pairs, or if nearly all lie on a line.
///
/// Linear equations in centred and scaled coordinates (Hartley 1997), weighted anew by Cauchy's function of the distances.
pub(super) fn fitted(pairs: &[[DVec2; 2]]) -> Option<DMat3> {
    if pairs.len() < 4 {
        return None;
    }
    let [from, to] = [0, 1].map(|side| normalising(pairs.iter().map(|pair| pair[side])));
    let (from, to) = (from?, to?);
    let pairs: Vec<[DVec2; 2]> =
        pairs.iter().map(|[a, b]| [from.transform_point2(*a), to.transform_point2(*b)]).collect();
    let mut weights = vec![1.0; pairs.len()];
    let mut best = None;
    for _ in 0..8 {
        let map = weighted(&pairs, &weights)?;
        let distances: Vec<f64> =
            pairs.iter().map(|[a, b]| apply(map, *a).map_or(f64::INFINITY, |image| image.distance(*b))).collect();
        let scale = (3.0 * median(distances.clone())).max(1e-12);
        for ((weight, distance), [a, _]) in weights.iter_mut().zip(&distances).zip(&pairs) {
            // The equations are multiplied by the depth.
            let depth = (map * a.extend(1.0)).z;
            *weight = 1.0 / (1.0 + (distance / scale).powi(2)) / (depth * depth).max(1e-6);
        }
        best = Some(map);
    }
    let map = to.inverse() * best? * from;
    map.is_finite().then_some(map)
}

/// The map with a last entry of 1.
pub(super) fn with_unit_depth(map: DMat3) -> DMat3 {
    map * (1.0 / map.z_axis.z)
}

/// The median; infinite for none.
pub(super) fn median(mut values: Vec<f64>) -> f64 {
    quantile(&mut values, 0.5)
}

/// The value below which a part of the values lies; infinite for none.
pub(super) fn quantile(values: &mut [f64], part: f64) -> f64 {
    if values.is_empty() {
        return f64::INFINITY;
    }
    let index = ((values.len() - 1) as f64 * part).round() as usize;
    *values.select_nth_unstable_by(index, f64::total_cmp).1
}

/// Centres points and scales them to a mean distance of √2.
fn normalising(points: impl Iterator<Item = DVec2> + Clone) -> Option<DMat3> {
    let n = points.clone().count() as f64;
    let centre = points.clone().sum::<DVec2>() / n;
    let spread = points.map(|point| point.distance(centre)).sum::<f64>() / n;
    (spread > 0.0 && spread.is_finite())
        .then(|| DMat3::from_scale(DVec2::splat(std::f64::consts::SQRT_2 / spread)) * DMat3::from_translation(-centre))
}

fn weighted(pairs: &[[DVec2; 2]], weights: &[f64]) -> Option<DMat3> {
    let mut normal = vec![0.0; 64];
    let mut right = [0.0; 8];
    for ([from, to], weight) in pairs.iter().zip(weights) {
        let (x, y) = (from.x, from.y);
        let rows = [
            ([x, y, 1.0, 0.0, 0.0, 0.0, -to.x * x, -to.x * y], to.x),
            ([0.0, 0.0, 0.0, x, y, 1.0, -to.y * x, -to.y * y], to.y),
        ];
        for (row, value) in rows {
            for (i, a) in row.iter().enumerate() {
                for (j, b) in row.iter().enumerate() {
                    normal[8 * i + j] += weight * a * b;
                }
                right[i] += weight * a * value;
            }
        }
    }
    if !solve_symmetric(&mut normal, &mut right) {
        return None;
    }
    let [a, b, c, d, e, f, g, h] = right;
    Some(DMat3::from_cols_array(&[a, d, g, b, e, h, c, f, 1.0]))
}

/// Solves a symmetric positive definite system by Cholesky's method: `matrix` is row by row and is overwritten, `right`
/// becomes the solution. Returns whether the matrix is positive definite.
pub(super) fn solve_symmetric(matrix: &mut [f64], right: &mut [f64]) -> bool {
    let n = right.len();
    for row in 0..n {
        for column in 0..=row {
            let (above, here) = matrix.split_at(row * n);
            let dot: f64 = if column == row {
                here[..column].iter().map(|it| it * it).sum()
            } else {
                here[..column].iter().zip(&above[column * n..]).map(|(a, b)| a * b).sum()
            };
            let rest = matrix[row * n + column] - dot;
            if column == row {
                if rest.is_nan() || rest <= 0.0 {
                    return false;
                }
                matrix[row * n + row] = rest.sqrt();
            } else {
                matrix[row * n + column] = rest / matrix[column * n + column];
            }
        }
        let dot: f64 = (0..row).map(|column| matrix[row * n + column] * right[column]).sum();
        right[row] = (right[row] - dot) / matrix[row * n + row];
    }
    for row in (0..n).rev() {
        let dot: f64 = (row + 1..n).map(|below| matrix[below * n + row] * right[below]).sum();
        right[row] = (right[row] - dot) / matrix[row * n + row];
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_homography_is_found_among_points_that_are_far_off() {
        let map = DMat3::from_cols_array(&[1.1, -0.04, 2e-4, 0.07, 0.93, -1e-4, 30.0, -12.0, 1.0]);
        let point = |n: u32| DVec2::new(f64::from(n % 10) * 70.0, f64::from(n / 10) * 50.0);
        let pair = |n: u32| {
            let stray = if n % 7 == 3 { DVec2::new(40.0, -25.0) } else { DVec2::ZERO };
            [point(n), apply(map, point(n)).expect("before the horizon") + stray]
        };
        let found = fitted(&(0..100).map(pair).collect::<Vec<_>>()).expect("enough points");
        let away = |n: u32| apply(found, point(n)).expect("there").distance(apply(map, point(n)).expect("there"));
        assert!((0..100).map(away).fold(0.0, f64::max) < 0.3);
    }

    #[test]
    fn too_few_points_and_points_on_a_line_have_no_homography() {
        let pairs = |points: &[[f64; 2]]| points.iter().map(|it| [DVec2::from(*it); 2]).collect::<Vec<_>>();
        assert_eq!(fitted(&pairs(&[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])), None);
        assert_eq!(fitted(&pairs(&[[0.0, 0.0]; 9])), None);
        let line: Vec<[f64; 2]> = (0..9).map(|n| [f64::from(n), 2.0 * f64::from(n)]).collect();
        assert!(fitted(&pairs(&line)).is_none_or(|map| map.is_finite()));
    }

    #[test]
    fn quantiles_of_nothing_are_infinite() {
        assert_eq!(median(Vec::new()), f64::INFINITY);
        assert_eq!(quantile(&mut [3.0, 1.0, 2.0], 1.0), 3.0);
    }
}
