//! The exact sign of a sum of products, for the few decisions that rounding could change.
//!
//! After Shewchuk, "Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates" (1997).

/// An exact sum, kept as numbers whose bits do not overlap, from the smallest to the largest.
#[derive(Default)]
pub(super) struct ExactSum {
    components: Vec<f64>,
}

impl ExactSum {
    /// Adds a·b·c exactly. The factors have single precision, so no part leaves the range of `f64`.
    pub(super) fn add_product(&mut self, a: f32, b: f32, c: f32) {
        let ab = f64::from(a) * f64::from(b);
        // The product has at most 48 bits: split it into parts of at most 27, whose products with 24 bits are exact.
        let high = f64::from_bits(ab.to_bits() & !((1 << 27) - 1));
        let low = ab - high;
        self.add(high * f64::from(c));
        self.add(low * f64::from(c));
    }

    /// Shewchuk's GROW-EXPANSION, without zero components.
    fn add(&mut self, summand: f64) {
        let mut sum = summand;
        let mut n_kept = 0;
        for index in 0..self.components.len() {
            let (rounded, error) = two_sum(sum, self.components[index]);
            sum = rounded;
            if error != 0.0 {
                self.components[n_kept] = error;
                n_kept += 1;
            }
        }
        self.components.truncate(n_kept);
        if sum != 0.0 {
            self.components.push(sum);
        }
    }

    pub(super) fn value(&self) -> f64 {
        self.components.iter().sum()
    }

    /// A number with the sign of the sum; zero only if the sum is.
    pub(super) fn signum(&self) -> f64 {
        self.components.last().map_or(0.0, |largest| largest.signum())
    }
}

/// a + b rounded, and the rounding error (Knuth).
fn two_sum(a: f64, b: f64) -> (f64, f64) {
    let sum = a + b;
    let b_part = sum - a;
    let error = (a - (sum - b_part)) + (b - b_part);
    (sum, error)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sign(products: &[[f32; 3]]) -> f64 {
        let mut sum = ExactSum::default();
        for &[a, b, c] in products {
            sum.add_product(a, b, c);
        }
        sum.signum()
    }

    #[test]
    fn cancelled_sums_are_zero_and_others_keep_their_sign() {
        let x = [1.234_567_8e10, 9.876_543e-9, 2.345_678];
        let minus_x = [-x[0], x[2], x[1]];
        let tiny = [1e-30, 1e-3, 1e-3];
        assert_eq!(sign(&[]), 0.0);
        assert_eq!(sign(&[x, minus_x]), 0.0);
        assert_eq!(sign(&[x, tiny, minus_x]), 1.0);
        assert_eq!(sign(&[tiny.map(|f| -f), x, minus_x, [0.0; 3]]), -1.0);
    }

    #[test]
    fn integers_beyond_53_bits_are_summed_exactly() {
        // (2²⁴−1)³ has 72 bits; against i128.
        let m = 16_777_215.0f32;
        let terms = [[m, m, m], [-m, m, m - 1.0], [-m, m - 2.0, 1.0], [-m, 1.0, 2.0]];
        for n in 1..=terms.len() {
            let exact: i128 = terms[..n].iter().map(|t| t.iter().map(|&f| f as i128).product::<i128>()).sum();
            assert_eq!(sign(&terms[..n]), exact.signum() as f64, "{n} terms");
        }
    }
}
