//! Vectors of numbers for the packet kernel: AVX-512, AVX2, and a plain form of the same for any machine.
//!
//! Single precision tells only what its margins leave certain, so its `mul_add` may round once or twice. Double precision
//! decides the rest and finds t: [`Real`] has no fused operation, and every implementation of it gives the bits that
//! `f64` gives.

/// Numbers of double precision, one or several at once.
pub(crate) trait Real: Copy {
    /// How many.
    const LANES: usize;
    fn splat(x: f64) -> Self;
    /// The first [`Real::LANES`] numbers of a slice that has as many, made double.
    fn load(from: &[f32]) -> Self;
    fn store(self, to: &mut [f64; 8]);
    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn mul(self, other: Self) -> Self;
    fn div(self, other: Self) -> Self;
    fn max(self, other: Self) -> Self;
    fn abs(self) -> Self;
    /// A bit for each lane where self < other; not for NaN.
    fn lt(self, other: Self) -> u32;
}

impl Real for f64 {
    const LANES: usize = 1;
    #[inline(always)]
    fn splat(x: f64) -> Self {
        x
    }
    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        f64::from(from[0])
    }
    #[inline(always)]
    fn store(self, to: &mut [f64; 8]) {
        to[0] = self;
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self + other
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self - other
    }
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self * other
    }
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        self / other
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        if self > other { self } else { other }
    }
    #[inline(always)]
    fn abs(self) -> Self {
        f64::abs(self)
    }
    #[inline(always)]
    fn lt(self, other: Self) -> u32 {
        u32::from(self < other)
    }
}

/// An instruction set: single-precision vectors of [`Simd::LANES`] numbers, and what goes with them.
pub(crate) trait Simd: Copy {
    /// How many numbers in a vector: 8 or 16.
    const LANES: usize;
    /// Double-precision numbers of the same machine.
    type Double: Real;
    /// Hints that `slice[index]` will be read soon.
    #[inline(always)]
    fn prefetch<T>(slice: &[T], index: usize) {
        #[cfg(target_arch = "x86_64")]
        // SAFETY: a hint, which never faults; SSE is part of the architecture.
        unsafe {
            use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
            _mm_prefetch::<_MM_HINT_T0>(slice.as_ptr().wrapping_add(index).cast());
        }
    }
    fn splat(x: f32) -> Self;
    /// The first [`Simd::LANES`] numbers of a slice that has as many.
    fn load(from: &[f32]) -> Self;
    /// The first [`Simd::LANES`] numbers of a slice of at least 16, as they are.
    fn load_bytes(from: &[u8]) -> Self;
    /// Writes to the beginning of a slice that has room.
    fn store(self, to: &mut [f32]);
    /// For each lane the number of `yes` where its bit is set in `mask`, else of `no`.
    fn select(mask: u32, yes: Self, no: Self) -> Self;
    /// Writes those that have their bit set in `mask` to their places in a slice that has room for all.
    #[inline(always)]
    fn masked_store(self, mask: u32, to: &mut [f32]) {
        // Not a masked store, after which a load must wait.
        Self::select(mask, self, Self::load(to)).store(to);
    }
    /// Writes a number where `mask` has bits, to the same places in a slice that has room for all lanes.
    fn masked_fill(number: u32, mask: u32, to: &mut [u32]);
    /// A bit for each of the first [`Simd::LANES`] numbers of a slice that equals another.
    fn eq_mask(numbers: &[u32], number: u32) -> u32;
    /// The least of all.
    fn reduce_min(self) -> f32;
    /// The greatest of all.
    fn reduce_max(self) -> f32;
    /// x, y and z of [`Simd::LANES`] vertices, from the coordinates of all, three for each and at least one number more.
    ///
    /// Four coordinates are loaded for each vertex and three kept: several times as fast as the gathering instructions.
    /// Vectors are loaded without a check, which would take up to 5 % of a frame's time.
    ///
    /// # Safety
    ///
    /// There are at least `3 * vertex + 4` coordinates for each of the first [`Simd::LANES`] vertices.
    unsafe fn gather_xyz(coordinates: &[f32], vertices: &[u32; 16]) -> [Self; 3];
    /// Writes those of up to [`Simd::LANES`] numbers that have their bit set in `mask` to the beginning of a slice with
    /// room for all lanes, in their order; what follows them there is noise. Returns how many they are.
    #[inline(always)]
    fn compress(from: &[u32], mask: u32, to: &mut [u32]) -> usize {
        let mut n = 0;
        for (lane, &number) in from.iter().enumerate() {
            to[n] = number;
            n += (mask >> lane & 1) as usize;
        }
        n
    }
    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn mul(self, other: Self) -> Self;
    fn div(self, other: Self) -> Self;
    fn min(self, other: Self) -> Self;
    fn max(self, other: Self) -> Self;
    fn abs(self) -> Self;
    /// self·factor + summand, rounded once or twice.
    fn mul_add(self, factor: Self, summand: Self) -> Self;
    /// self·factor − subtrahend, rounded once or twice.
    fn mul_sub(self, factor: Self, subtrahend: Self) -> Self;
    /// summand − self·factor, rounded once or twice.
    fn neg_mul_add(self, factor: Self, summand: Self) -> Self;
    /// The bits that are set in both: a minus where both have one.
    fn and(self, other: Self) -> Self;
    /// The bits that are set in either: a minus where one of them has one.
    fn or(self, other: Self) -> Self;
    /// A bit for each lane with a minus.
    ///
    /// Several conditions are cheaper to find as signs of differences than by comparisons: a Zen 5 compares one vector a
    /// cycle, but subtracts two, and puts the bits of four together.
    fn sign_mask(self) -> u32;
    /// A bit for each lane where self ≤ other; not for NaN.
    fn le(self, other: Self) -> u32;
    /// A bit for each lane where self < other; not for NaN.
    fn lt(self, other: Self) -> u32;
}

/// Eight numbers in plain code.
#[derive(Clone, Copy)]
pub(crate) struct Portable([f32; 8]);

impl Portable {
    #[inline(always)]
    fn zip(self, other: Self, f: impl Fn(f32, f32) -> f32) -> Self {
        Self(std::array::from_fn(|lane| f(self.0[lane], other.0[lane])))
    }

    #[inline(always)]
    fn compare(self, other: Self, f: impl Fn(f32, f32) -> bool) -> u32 {
        (0..8).fold(0, |mask, lane| mask | u32::from(f(self.0[lane], other.0[lane])) << lane)
    }
}

impl Simd for Portable {
    const LANES: usize = 8;
    type Double = f64;
    #[inline(always)]
    fn splat(x: f32) -> Self {
        Self([x; 8])
    }
    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        Self(std::array::from_fn(|lane| from[lane]))
    }
    #[inline(always)]
    fn load_bytes(from: &[u8]) -> Self {
        Self(std::array::from_fn(|lane| f32::from(from[lane])))
    }
    #[inline(always)]
    fn select(mask: u32, yes: Self, no: Self) -> Self {
        // Bits are tested where they are, and all lanes written: compilers make vectors of that.
        Self(std::array::from_fn(|lane| if mask & 1 << lane != 0 { yes.0[lane] } else { no.0[lane] }))
    }
    #[inline(always)]
    fn masked_fill(number: u32, mask: u32, to: &mut [u32]) {
        let to: &mut [u32; 8] = (&mut to[..8]).try_into().expect("eight numbers");
        *to = std::array::from_fn(|lane| if mask & 1 << lane != 0 { number } else { to[lane] });
    }
    #[inline(always)]
    fn eq_mask(numbers: &[u32], number: u32) -> u32 {
        (0..8).fold(0, |mask, lane| mask | u32::from(numbers[lane] == number) << lane)
    }
    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        to[..8].copy_from_slice(&self.0);
    }
    #[inline(always)]
    fn reduce_min(self) -> f32 {
        self.0.into_iter().fold(f32::INFINITY, f32::min)
    }
    #[inline(always)]
    fn reduce_max(self) -> f32 {
        self.0.into_iter().fold(f32::NEG_INFINITY, f32::max)
    }
    #[inline(always)]
    unsafe fn gather_xyz(coordinates: &[f32], vertices: &[u32; 16]) -> [Self; 3] {
        std::array::from_fn(|axis| Self(std::array::from_fn(|lane| coordinates[3 * vertices[lane] as usize + axis])))
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.zip(other, |a, b| a + b)
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.zip(other, |a, b| a - b)
    }
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.zip(other, |a, b| a * b)
    }
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        self.zip(other, |a, b| a / b)
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        self.zip(other, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        self.zip(other, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(self.0.map(f32::abs))
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, summand: Self) -> Self {
        self.mul(factor).add(summand)
    }
    #[inline(always)]
    fn mul_sub(self, factor: Self, subtrahend: Self) -> Self {
        self.mul(factor).sub(subtrahend)
    }
    #[inline(always)]
    fn neg_mul_add(self, factor: Self, summand: Self) -> Self {
        summand.sub(self.mul(factor))
    }
    #[inline(always)]
    fn and(self, other: Self) -> Self {
        self.zip(other, |a, b| f32::from_bits(a.to_bits() & b.to_bits()))
    }
    #[inline(always)]
    fn or(self, other: Self) -> Self {
        self.zip(other, |a, b| f32::from_bits(a.to_bits() | b.to_bits()))
    }
    #[inline(always)]
    fn sign_mask(self) -> u32 {
        (0..8).fold(0, |mask, lane| mask | self.0[lane].to_bits() >> 31 << lane)
    }
    #[inline(always)]
    fn le(self, other: Self) -> u32 {
        self.compare(other, |a, b| a <= b)
    }
    #[inline(always)]
    fn lt(self, other: Self) -> u32 {
        self.compare(other, |a, b| a < b)
    }
}

#[cfg(target_arch = "x86_64")]
pub(crate) use x86::{Avx2, Avx512};

#[cfg(target_arch = "x86_64")]
mod x86;
