//! Least squares with unknowns of two kinds: many small blocks, of which each equation has one, and shared ones.
//!
//! Blocks are eliminated one by one (Schur complements), so the effort grows with their number only linearly.

use super::super::fitting::solve_symmetric;

/// Normal equations: blocks first, then what they share.
#[derive(Clone, Debug)]
pub(super) struct Arrow {
    n_local: usize,
    n_shared: usize,
    blocks: Vec<Block>,
    shared: Vec<f64>,
    right: Vec<f64>,
}

#[derive(Clone, Debug)]
struct Block {
    /// Local unknowns with themselves, and with the shared ones, row by row.
    normal: Vec<f64>,
    cross: Vec<f64>,
    right: Vec<f64>,
}

/// Coefficients of an equation, by the unknown's number.
pub(super) type Row<'a> = &'a [(usize, f64)];

/// The solution.
pub(super) struct Solved {
    /// For each block, its unknowns.
    pub local: Vec<Vec<f64>>,
    /// The shared unknowns.
    pub shared: Vec<f64>,
    /// The Schur complement: the inverse of the shared unknowns' covariance, for equations of weight 1 over variance.
    information: Vec<f64>,
}

impl Arrow {
    /// No equations yet. Every unknown has to be in one, also those that nothing measures: a weak one keeps it where it is.
    pub(super) fn new(n_blocks: usize, n_local: usize, n_shared: usize) -> Self {
        let block = Block {
            normal: vec![0.0; n_local * n_local],
            cross: vec![0.0; n_local * n_shared],
            right: vec![0.0; n_local],
        };
        let shared = vec![0.0; n_shared * n_shared];
        Self { n_local, n_shared, blocks: vec![block; n_blocks], shared, right: vec![0.0; n_shared] }
    }

    /// Adds an equation: local and shared terms add up to a value.
    pub(super) fn add(&mut self, block: usize, local: Row<'_>, shared: Row<'_>, value: f64, weight: f64) {
        let (n_local, n_shared) = (self.n_local, self.n_shared);
        let block = &mut self.blocks[block];
        for &(row, a) in local {
            let a = weight * a;
            local.iter().for_each(|&(column, b)| block.normal[row * n_local + column] += a * b);
            shared.iter().for_each(|&(column, b)| block.cross[row * n_shared + column] += a * b);
            block.right[row] += a * value;
        }
        self.add_shared(shared, value, weight);
    }

    /// Adds an equation of shared unknowns alone.
    pub(super) fn add_shared(&mut self, shared: Row<'_>, value: f64, weight: f64) {
        for &(row, a) in shared {
            shared.iter().for_each(|&(column, b)| self.shared[row * self.n_shared + column] += weight * a * b);
            self.right[row] += weight * a * value;
        }
    }

    /// Solves; `None` if something is not determined.
    pub(super) fn solve(mut self) -> Option<Solved> {
        let (n_local, n_shared) = (self.n_local, self.n_shared);
        // For each block: its unknowns without the shared ones, and how they follow each of these.
        let mut eliminated = Vec::with_capacity(self.blocks.len());
        for block in &self.blocks {
            let solve = |mut right: Vec<f64>| solve_symmetric(&mut block.normal.clone(), &mut right).then_some(right);
            let own = solve(block.right.clone())?;
            let is_used = |column: &usize| (0..n_local).any(|row| block.cross[row * n_shared + column] != 0.0);
            let mut follows = Vec::new();
            for column in (0..n_shared).filter(is_used) {
                follows.push((column, solve((0..n_local).map(|row| block.cross[row * n_shared + column]).collect())?));
            }
            for (column, by) in &follows {
                let dot = |with: &dyn Fn(usize) -> f64| (0..n_local).map(|row| by[row] * with(row)).sum::<f64>();
                for (other, _) in &follows {
                    self.shared[other * n_shared + column] -= dot(&|row| block.cross[row * n_shared + other]);
                }
                self.right[*column] -= dot(&|row| block.right[row]);
            }
            eliminated.push((own, follows));
        }
        let information = self.shared.clone();
        if !solve_symmetric(&mut self.shared, &mut self.right) {
            return None;
        }
        let shared = self.right;
        let local = eliminated.into_iter().map(|(mut own, follows)| {
            for (column, by) in follows {
                own.iter_mut().zip(by).for_each(|(own, by)| *own -= by * shared[column]);
            }
            own
        });
        Some(Solved { local: local.collect(), information, shared })
    }
}

impl Solved {
    /// The standard deviation of a linear function of the shared unknowns, for equations of weight 1 over variance.
    pub(super) fn deviation(&self, of: Row<'_>) -> f64 {
        let mut right = vec![0.0; self.shared.len()];
        of.iter().for_each(|&(index, factor)| right[index] += factor);
        let factors = right.clone();
        if !solve_symmetric(&mut self.information.clone(), &mut right) {
            return f64::INFINITY;
        }
        right.iter().zip(factors).map(|(a, b)| a * b).sum::<f64>().max(0.0).sqrt()
    }
}

/// Weights for a next round, by Cauchy's function: equations that are far off count little. `away` are their errors in
/// units of their own deviations, up to a common factor, which is returned.
pub(super) fn robust_weights(away: &[f64]) -> (Vec<f64>, f64) {
    robust_weights_above(away, 1e-9)
}

/// The same for errors whose deviation is known to be no smaller.
pub(super) fn robust_weights_above(away: &[f64], least: f64) -> (Vec<f64>, f64) {
    // The median of the absolute values is 0.67 standard deviations of normal errors.
    let sigma = super::super::fitting::median(away.iter().map(|it| it.abs()).collect()) / 0.6745;
    let sigma = if sigma.is_finite() { sigma.max(least) } else { 1.0 };
    (away.iter().map(|it| 1.0 / (1.0 + (it / (2.5 * sigma)).powi(2))).collect(), sigma)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Straight lines of one slope: a block has an offset.
    #[test]
    fn blocks_and_what_they_share_are_found() {
        let mut arrow = Arrow::new(3, 2, 1);
        for (block, x) in (0..3).flat_map(|block| (0..5).map(move |x| (block, f64::from(x)))) {
            let value = block as f64 + 0.5 * (block as f64 - 1.0) * x * x + 0.25 * x;
            arrow.add(block, &[(0, 1.0), (1, x * x)], &[(0, x)], value, 2.0);
        }
        let solved = arrow.clone().solve().expect("determined");
        for (block, local) in solved.local.iter().enumerate() {
            assert!((local[0] - block as f64).abs() < 1e-9, "{local:?}");
            assert!((local[1] - 0.5 * (block as f64 - 1.0)).abs() < 1e-9, "{local:?}");
        }
        assert!((solved.shared[0] - 0.25).abs() < 1e-9);
        // Three times as much data, a third of the variance.
        let once = solved.deviation(&[(0, 1.0)]);
        for (block, x) in (0..6).map(|n| n % 3).flat_map(|block| (0..5).map(move |x| (block, f64::from(x)))) {
            arrow.add(block, &[(0, 1.0), (1, x * x)], &[(0, x)], 0.0, 2.0);
        }
        let thrice = arrow.solve().expect("determined").deviation(&[(0, 1.0)]);
        assert!((once / thrice - 3.0_f64.sqrt()).abs() < 1e-9, "{once} {thrice}");
    }

    #[test]
    fn what_nothing_measures_is_not_solved() {
        let mut arrow = Arrow::new(1, 1, 1);
        arrow.add(0, &[(0, 1.0)], &[(0, 1.0)], 1.0, 1.0);
        assert!(arrow.solve().is_none_or(|solved| solved.deviation(&[(0, 1.0)]) > 1e6));
    }

    #[test]
    fn strays_count_little() {
        let mut away = vec![0.1, -0.1, 0.12, -0.09, 0.11, 9.0];
        let (weights, sigma) = robust_weights(&away);
        assert!(weights[5] < 0.01 && weights[0] > 0.8 && sigma < 0.2, "{weights:?} {sigma}");
        away.clear();
        assert!(robust_weights(&away).0.is_empty());
    }
}
