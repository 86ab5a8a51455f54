//! The vector instructions that a machine has.

#[cfg(target_arch = "x86_64")]
use super::{Avx2, Avx512};
use super::{Kernel, Portable, Simd};

/// Vector instructions that rays are traced with. They change the time, never a hit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InstructionSet {
    /// The instructions of every machine.
    Portable,
    /// AVX2, FMA and older ones.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// AVX-512 F and DQ, and older ones.
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl InstructionSet {
    /// Runs a kernel with these instructions.
    ///
    /// # Safety
    ///
    /// This machine has them.
    #[inline(always)]
    pub(crate) unsafe fn call<K: Kernel>(self, kernel: K) -> K::Output {
        match self {
            Self::Portable => Portable::call(kernel),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => Avx2::call(kernel),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => Avx512::call(kernel),
        }
    }

    /// The instruction sets of this machine, the fastest last.
    pub fn available() -> Vec<Self> {
        let mut available = vec![Self::Portable];
        #[cfg(target_arch = "x86_64")]
        {
            // All features that kernels are compiled with.
            let has_avx2 = is_x86_feature_detected!("avx2")
                && is_x86_feature_detected!("fma")
                && is_x86_feature_detected!("bmi1")
                && is_x86_feature_detected!("bmi2")
                && is_x86_feature_detected!("popcnt")
                && is_x86_feature_detected!("lzcnt");
            if has_avx2 {
                available.push(Self::Avx2);
            }
            if has_avx2 && is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512dq") {
                available.push(Self::Avx512);
            }
        }
        available
    }

    /// The fastest instruction set of this machine.
    pub fn best() -> Self {
        Self::available().pop().unwrap_or(Self::Portable)
    }
}
