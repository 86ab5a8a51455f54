//! The parts of a packet's way that are compiled once for each instruction set.

use super::{cull::Culler, packet::Leaf, tree::Tree};
#[cfg(target_arch = "x86_64")]
use crate::simd::{Avx2, Avx512};
use crate::simd::{Plain, Simd};

/// An instruction set with the test compiled for it, once, whoever calls it.
pub(super) trait Kernel: Simd {
    /// [`Culler::test_waiting`].
    fn test<const N: usize>(culler: &mut Culler<'_, N>);
    /// [`Tree::test_leaves`].
    fn test_leaves<const N: usize>(
        tree: &Tree,
        culler: &mut Culler<'_, N>,
        origin: &[f64; 3],
        leaves: &mut Vec<Leaf<N>>,
    );
}

impl Kernel for Plain {
    fn test<const N: usize>(culler: &mut Culler<'_, N>) {
        culler.test_waiting::<Self>();
    }

    fn test_leaves<const N: usize>(
        tree: &Tree,
        culler: &mut Culler<'_, N>,
        origin: &[f64; 3],
        leaves: &mut Vec<Leaf<N>>,
    ) {
        tree.test_leaves::<Self, N>(culler, origin, leaves);
    }
}

#[cfg(target_arch = "x86_64")]
impl Kernel for Avx2 {
    #[inline(always)]
    fn test<const N: usize>(culler: &mut Culler<'_, N>) {
        #[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
        fn test<const N: usize>(culler: &mut Culler<'_, N>) {
            culler.test_waiting::<Avx2>();
        }
        // SAFETY: this type is used only where the instructions were found.
        unsafe { test(culler) }
    }

    #[inline(always)]
    fn test_leaves<const N: usize>(
        tree: &Tree,
        culler: &mut Culler<'_, N>,
        origin: &[f64; 3],
        leaves: &mut Vec<Leaf<N>>,
    ) {
        #[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
        fn test_leaves<const N: usize>(
            tree: &Tree,
            culler: &mut Culler<'_, N>,
            origin: &[f64; 3],
            leaves: &mut Vec<Leaf<N>>,
        ) {
            tree.test_leaves::<Avx2, N>(culler, origin, leaves);
        }
        // SAFETY: as above.
        unsafe { test_leaves(tree, culler, origin, leaves) }
    }
}

#[cfg(target_arch = "x86_64")]
impl Kernel for Avx512 {
    #[inline(always)]
    fn test<const N: usize>(culler: &mut Culler<'_, N>) {
        #[target_feature(enable = "avx512f,avx512dq,avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
        fn test<const N: usize>(culler: &mut Culler<'_, N>) {
            culler.test_waiting::<Avx512>();
        }
        // SAFETY: this type is used only where the instructions were found.
        unsafe { test(culler) }
    }

    #[inline(always)]
    fn test_leaves<const N: usize>(
        tree: &Tree,
        culler: &mut Culler<'_, N>,
        origin: &[f64; 3],
        leaves: &mut Vec<Leaf<N>>,
    ) {
        #[target_feature(enable = "avx512f,avx512dq,avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
        fn test_leaves<const N: usize>(
            tree: &Tree,
            culler: &mut Culler<'_, N>,
            origin: &[f64; 3],
            leaves: &mut Vec<Leaf<N>>,
        ) {
            tree.test_leaves::<Avx512, N>(culler, origin, leaves);
        }
        // SAFETY: as above.
        unsafe { test_leaves(tree, culler, origin, leaves) }
    }
}
