//! Several paths share a camera ray, the surface that it finds, and its ray to the sun: splitting.
//!
//! Where the surfaces of a pixel are lit alike, its noise comes from the directions of its paths, and more camera rays would
//! hardly lessen it. Arvo and Kirk, "Particle Transport and Image Synthesis" (1990).

/// The most paths that share a camera ray.
pub(in crate::render) const MOST_PATHS: u32 = 4;

/// The number of a sample's camera ray, and the number of its path among the `n_paths` of the ray.
///
/// A sample whose number is a power of two has a ray of the same number; the next rays have the numbers that follow. Camera rays
/// fill a pixel evenly where their numbers follow each other, but not where they are multiples of two or four.
pub(in crate::render) fn camera_ray(sample: u32, n_paths: u32) -> (u32, u32) {
    let first = if sample == 0 { 0 } else { 1 << sample.ilog2() };
    let after = sample - first;
    (first + after / n_paths, after % n_paths)
}

/// The number of paths for each camera ray that gives the least noise for the rays, rounded down to a power of two, at most
/// `most`.
///
/// Camera rays and paths have a variance each, C and P, and take c and p rays each. With n paths for each camera ray, a path takes
/// c/n + p rays, and its variance is C n + P: their product is least at n² = c P / (p C).
pub(in crate::render) fn best_n_paths(variances: [f64; 2], n_rays: [f64; 2], most: u32) -> u32 {
    let best = (n_rays[0] * variances[1] / (n_rays[1] * variances[0])).sqrt();
    // No number if there is no noise.
    if best < f64::from(most) { 1 << (best as u32).max(1).ilog2() } else { most }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_follow_each_other_and_share_rays_that_follow_each_other() {
        for n_paths in [1, 2, 4] {
            for log in 3..8u32 {
                let (first, most) = (1 << log, (1 << log) / n_paths);
                let rays: Vec<_> = (first..2 * first).map(|sample| camera_ray(sample, n_paths)).collect();
                let expected = (first..first + most).flat_map(|ray| (0..n_paths).map(move |path| (ray, path)));
                assert!(rays.iter().copied().eq(expected), "{n_paths} paths from {first} on");
            }
        }
        assert_eq!([0, 1, 2, 3].map(|sample| camera_ray(sample, 1)), [(0, 0), (1, 0), (2, 0), (3, 0)]);
    }

    #[test]
    fn the_number_of_paths_takes_the_fewest_rays_for_the_noise() {
        let cost = |n: u32, [camera, path]: [f64; 2], [of_camera, of_path]: [f64; 2]| {
            (of_camera / f64::from(n) + of_path) * (camera * f64::from(n) + path)
        };
        for (variances, n_rays) in
            [([1.0, 1.0], [1.0, 2.0]), ([1.0, 4.0], [1.0, 1.0]), ([1.0, 8.0], [2.0, 1.0]), ([0.1, 9.0], [1.5, 1.5])]
        {
            let n = best_n_paths(variances, n_rays, 64);
            // The best lies between it and its double.
            let costs = [1, 2, 4].map(|factor| cost(factor * n, variances, n_rays));
            assert!(costs[0].min(costs[1]) <= costs[2], "{n}: {costs:?}");
            assert!(n == 1 || cost(n, variances, n_rays) <= cost(n / 2, variances, n_rays), "{n} of {variances:?}");
        }
        let none = [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]].map(|variances| best_n_paths(variances, [1.0, 1.0], 4));
        assert_eq!(none, [4, 4, 1]);
        assert_eq!(best_n_paths([1.0, 1.0], [1.0, 0.0], 2), 2);
    }
}
