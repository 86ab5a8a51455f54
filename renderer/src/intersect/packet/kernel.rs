//! The steps of the packet kernel that are functions of their own, compiled once for each instruction set.
//!
//! They take their arguments one by one: gathered in a struct, as a closure would be, light views took 5 to 15 % longer.

use super::{
    PendingLeaf, Scratch,
    cull::Culler,
    ray_set::{Packet, RaySet},
};
#[cfg(target_arch = "x86_64")]
use crate::simd::{Avx2, Avx512};
use crate::{
    grid::{Grid, tree::Tree},
    intersect::ray::Hit,
    simd::{Portable, Simd},
};

/// An instruction set for which these steps are compiled.
pub(super) trait PacketKernel: Simd {
    /// [`Grid::march`].
    fn march<const N: usize>(
        grid: &Grid,
        tree: &Tree,
        packets: [&Packet; N],
        active: RaySet<N>,
        scratch: &mut Scratch<N>,
        hits: &mut [[Hit; 64]; N],
    ) -> bool;
    /// [`Tree::test_leaves`].
    fn test_leaves<const N: usize>(
        tree: &Tree,
        culler: &mut Culler<'_, N>,
        origin: &[f64; 3],
        leaves: &mut Vec<PendingLeaf<N>>,
    );
    /// [`Culler::test_waiting`].
    fn test_waiting<const N: usize>(culler: &mut Culler<'_, N>);
}

/// One step, compiled with target features.
macro_rules! step {
    ([$($features:literal)?] $name:ident($($argument:ident: $type:ty),*) -> $result:ty = $call:expr) => {
        #[inline(always)]
        fn $name<const N: usize>($($argument: $type),*) -> $result {
            $(#[target_feature(enable = $features)])?
            unsafe fn $name<const N: usize>($($argument: $type),*) -> $result {
                $call
            }
            // SAFETY: a grid holds only what `InstructionSet::available` has found.
            unsafe { $name($($argument),*) }
        }
    };
}

/// Compiles the steps with an instruction set's target features.
macro_rules! kernel {
    ($set:ident, $features:tt) => {
        impl PacketKernel for $set {
            step!($features march(grid: &Grid, tree: &Tree, packets: [&Packet; N], active: RaySet<N>,
                scratch: &mut Scratch<N>, hits: &mut [[Hit; 64]; N]) -> bool =
                grid.march::<$set, N>(tree, packets, active, scratch, hits));
            step!($features test_leaves(tree: &Tree, culler: &mut Culler<'_, N>, origin: &[f64; 3],
                leaves: &mut Vec<PendingLeaf<N>>) -> () = tree.test_leaves::<$set, N>(culler, origin, leaves));
            step!($features test_waiting(culler: &mut Culler<'_, N>) -> () = culler.test_waiting::<$set>());
        }
    };
}

kernel!(Portable, []);
#[cfg(target_arch = "x86_64")]
kernel!(Avx2, ["avx2,fma,bmi1,bmi2,popcnt,lzcnt"]);
#[cfg(target_arch = "x86_64")]
kernel!(Avx512, ["avx512f,avx512dq,avx2,fma,bmi1,bmi2,popcnt,lzcnt"]);
