//! The strength of each projector's red, green and blue, from squares that lack one of them.

use super::{super::fitting::solve_symmetric, levels::mean};

/// The part of what each channel of the camera sees of a projector's white that is its red, green and blue.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Shares {
    /// By the camera's channel, then the projector's.
    of_channel: [[f64; 3]; 3],
}

/// Parts of white with their errors, by the camera's channel and the projector's channel that the squares lack.
pub(super) type Lacking = [[Vec<[f64; 2]>; 3]; 3];

impl Shares {
    /// `None` if there are no squares that lack one of the three.
    pub(super) fn fit(lacking: &Lacking) -> Option<Self> {
        let mut of_channel = [[0.0; 3]; 3];
        for (seen, shown) in (0..3).flat_map(|seen| (0..3).map(move |shown| (seen, shown))) {
            of_channel[seen][shown] = 1.0 - mean(&lacking[seen][shown])?;
        }
        Some(Self { of_channel })
    }

    /// How much more light white has than red, green and blue together, as a part of it, where the camera sees most of it.
    pub(super) fn excess(&self) -> f64 {
        self.of_channel
            .iter()
            .map(|shares| 1.0 - shares.iter().sum::<f64>())
            .fold(0.0, |most, it| if f64::abs(it) > f64::abs(most) { it } else { most })
    }
}

/// Errors of the camera's view of white, which all bright squares tell, and of single colours, which few tell; as parts.
const WHITE_ERROR: f64 = 0.001;
const COLOUR_ERROR: f64 = 0.01;

/// The strengths of red, green and blue of projectors, in proportion to the mean of all. Each projector has its shares, and
/// the camera's red, green and blue of its white.
///
/// The camera's channels see more than one of the projector's each, so a projector's red is compared with others' red by
/// all that the camera sees of it. Strengths then add up to its white as well as the mean of all projectors' colours can.
pub(super) fn strengths(projectors: &[(Shares, [f64; 3])]) -> Vec<[f64; 3]> {
    let seen = |(shares, colour): &(Shares, [f64; 3]), shown: usize| -> [f64; 3] {
        std::array::from_fn(|channel| shares.of_channel[channel][shown] * colour[channel])
    };
    let mean_of = |shown: usize| -> [f64; 3] {
        let all = projectors.iter().map(|it| seen(it, shown));
        all.fold([0.0; 3], |sum, it| std::array::from_fn(|n| sum[n] + it[n] / projectors.len() as f64))
    };
    let means = [0, 1, 2].map(mean_of);
    let dot = |a: [f64; 3], b: [f64; 3]| (0..3).map(|n| a[n] * b[n]).sum::<f64>();
    let strengths = |it: &(Shares, [f64; 3])| {
        let alone =
            [0, 1, 2].map(|shown| dot(seen(it, shown), means[shown]) / dot(means[shown], means[shown]).max(1e-12));
        let mut normal = vec![0.0; 9];
        let mut right = alone.map(|strength| strength / COLOUR_ERROR.powi(2));
        (0..3).for_each(|n| normal[4 * n] = 1.0 / COLOUR_ERROR.powi(2));
        for (channel, white) in it.1.iter().enumerate() {
            let weight = 1.0 / (WHITE_ERROR * white).powi(2);
            for (row, own) in means.iter().enumerate() {
                for (column, other) in means.iter().enumerate() {
                    normal[3 * row + column] += weight * own[channel] * other[channel];
                }
                right[row] += weight * own[channel] * white;
            }
        }
        if solve_symmetric(&mut normal, &mut right) { right } else { alone }
    };
    projectors.iter().map(strengths).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_are_told_apart_although_the_camera_mixes_them() {
        // What the camera's channels see of red, green and blue.
        let camera = [[0.8, 0.25, 0.02], [0.15, 0.9, 0.1], [0.01, 0.2, 0.7]];
        let strong = [[1.0, 0.9, 0.7], [0.8, 1.0, 0.9]];
        let projector = |strength: [f64; 3]| {
            let white = camera.map(|row| (0..3).map(|n| row[n] * strength[n]).sum::<f64>());
            let lacking: Lacking = std::array::from_fn(|seen| {
                std::array::from_fn(|shown| vec![[1.0 - camera[seen][shown] * strength[shown] / white[seen], 0.01]; 9])
            });
            (Shares::fit(&lacking).expect("squares"), white)
        };
        let projectors = strong.map(projector);
        assert!(projectors.iter().all(|(shares, _)| shares.excess().abs() < 1e-9));
        let found = strengths(&projectors);
        for shown in 0..3 {
            let ratio = found[0][shown] / found[1][shown] / (strong[0][shown] / strong[1][shown]);
            assert!((ratio - 1.0).abs() < 1e-9, "{shown}: {ratio}");
        }
        // Errors of single colours hardly count: white tells more.
        let mut astray = projectors;
        astray[0].0.of_channel[1][1] += 0.01;
        astray[1].0.of_channel[0][0] -= 0.01;
        for (found, exact) in strengths(&astray).as_flattened().iter().zip(found.as_flattened()) {
            assert!((found / exact - 1.0).abs() < 0.012, "{found} {exact}");
        }
        let white = |of: &[[f64; 3]], n: usize| (0..3).map(|shown| of[n][shown] * camera[1][shown]).sum::<f64>();
        let [before, after] = [&found, &strengths(&astray)].map(|of| white(of, 0) / white(of, 1));
        assert!((before / after - 1.0).abs() < 0.003, "{before} {after}");
        let mut brilliant: Lacking = Default::default();
        brilliant.iter_mut().flatten().for_each(|parts| *parts = vec![[0.8, 0.01]; 5]);
        assert!((Shares::fit(&brilliant).expect("squares").excess() - 0.4).abs() < 1e-9);
        assert_eq!(Shares::fit(&Lacking::default()), None);
    }
}
