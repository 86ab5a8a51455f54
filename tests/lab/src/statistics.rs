//! Quantiles, medians and means, and durations as numbers.

use std::time::Duration;

/// Quantiles at some fractions, by the nearest rank; 0 without values.
pub fn quantiles<const N: usize>(values: impl IntoIterator<Item = f64>, parts: [f64; N]) -> [f64; N] {
    let mut sorted: Vec<f64> = values.into_iter().collect();
    sorted.sort_by(f64::total_cmp);
    let nearest_rank = |part: f64| (sorted.len().saturating_sub(1) as f64 * part).round() as usize;
    parts.map(|part| sorted.get(nearest_rank(part)).copied().unwrap_or(0.0))
}

/// One quantile, by the nearest rank; 0 without values.
pub fn quantile(values: impl IntoIterator<Item = f64>, part: f64) -> f64 {
    let [value] = quantiles(values, [part]);
    value
}

/// The median, of an even number the upper one; 0 without values.
pub fn median(values: impl IntoIterator<Item = f64>) -> f64 {
    quantile(values, 0.5)
}

/// The arithmetic mean; NaN without values.
pub fn mean(values: impl IntoIterator<Item = f64>) -> f64 {
    let (sum, n) = values.into_iter().fold((0.0, 0), |(sum, n), value| (sum + value, n + 1));
    sum / f64::from(n)
}

/// A duration in milliseconds.
pub fn milliseconds(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_values_of_the_nearest_rank() {
        assert_eq!(quantiles([3.0, 1.0, 2.0], [0.0, 0.5, 0.95]), [1.0, 2.0, 3.0]);
        assert_eq!(quantile([], 0.5), 0.0);
        assert_eq!(median([4.0, 1.0, 2.0, 3.0]), 3.0);
        assert_eq!(mean([1.0, 2.0, 6.0]), 3.0);
    }
}
