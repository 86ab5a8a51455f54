//! SIMD vectors: AVX-512, AVX2, and a portable form for any machine.
//!
//! Single precision decides only with margins to spare, so its `mul_add` may round once or twice. Double precision
//! decides the rest and computes t: [`Real`] has no fused operations, so all sets give the bits of `f64`.

mod instructions;
pub(crate) mod points;
#[cfg(test)]
mod tests;
#[cfg(target_arch = "x86_64")]
mod x86;

use std::slice;

use bytemuck::NoUninit;
pub use instructions::InstructionSet;
use points::PointScale;
#[cfg(target_arch = "x86_64")]
pub(crate) use x86::{Avx2, Avx512};

/// A vector of double-precision numbers, of one lane or several.
pub(crate) trait Real: Copy {
    const LANES: usize;
    fn splat(x: f64) -> Self;
    /// Loads the first [`Real::LANES`] numbers of a slice as doubles.
    fn load(from: &[f32]) -> Self;
    /// Writes all lanes to the beginning of a slice.
    fn store(self, to: &mut [f64]);
    /// The same, each rounded to the nearest `f32`.
    fn store_rounded(self, to: &mut [f32]);
    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn mul(self, other: Self) -> Self;
    fn div(self, other: Self) -> Self;
    /// self where it is less, else other: other if either is NaN.
    fn min(self, other: Self) -> Self;
    /// self where it is greater, else other: other if either is NaN.
    fn max(self, other: Self) -> Self;
    fn abs(self) -> Self;
    /// A bit for each lane where self < other; 0 for NaN.
    fn lt(self, other: Self) -> u32;
    /// A bit for each lane where self ≤ other; 0 for NaN.
    fn le(self, other: Self) -> u32;
}

macro_rules! methods {
    ($(fn $name:ident($($argument:tt)*) -> $result:ty = $expression:expr;)*) => {
        $(#[inline(always)]
        fn $name($($argument)*) -> $result {
            $expression
        })*
    };
}

impl Real for f64 {
    const LANES: usize = 1;
    methods! {
        fn store(self, to: &mut [f64]) -> () = to[0] = self;
        fn store_rounded(self, to: &mut [f32]) -> () = to[0] = self as f32;
        fn splat(x: f64) -> Self = x;
        fn load(from: &[f32]) -> Self = f64::from(from[0]);
        fn add(self, other: Self) -> Self = self + other;
        fn sub(self, other: Self) -> Self = self - other;
        fn mul(self, other: Self) -> Self = self * other;
        fn div(self, other: Self) -> Self = self / other;
        fn min(self, other: Self) -> Self = if self < other { self } else { other };
        fn max(self, other: Self) -> Self = if self > other { self } else { other };
        fn abs(self) -> Self = f64::abs(self);
        fn lt(self, other: Self) -> u32 = u32::from(self < other);
        fn le(self, other: Self) -> u32 = u32::from(self <= other);
    }
}

/// A function that is compiled once for each instruction set.
///
/// Its body must not hold closures over vectors: they would not be compiled for the caller's instruction set.
pub(crate) trait Kernel {
    type Output;
    /// Body of the function; it must be `#[inline(always)]`, as all that it calls with vectors.
    fn run<S: Simd>(self) -> Self::Output;
}

/// Implements [`Simd::call`] for an instruction set with these target features.
macro_rules! call_with_features {
    ($set:ident $(, $features:literal)?) => {
        #[inline(always)]
        fn call<K: $crate::simd::Kernel>(kernel: K) -> K::Output {
            $(#[target_feature(enable = $features)])?
            unsafe fn call<K: $crate::simd::Kernel>(kernel: K) -> K::Output {
                kernel.run::<$set>()
            }
            // SAFETY: an instruction set is used only where it was found at run time.
            unsafe { call(kernel) }
        }
    };
}
#[cfg(target_arch = "x86_64")]
use call_with_features;

/// The index of the last item, or the largest that gathers can use.
///
/// # Panics
///
/// If there is none. Items that have not four bytes do not compile.
#[inline(always)]
fn last_index<T>(items: &[T]) -> u32 {
    const { assert!(size_of::<T>() == 4, "items of four bytes") };
    items.len().checked_sub(1).expect("items to gather").min(i32::MAX as usize) as u32
}

/// The numbers from `first` on, for the lanes of [`Simd::load_bits`].
#[inline(always)]
pub(crate) fn consecutive(first: u32) -> [u32; 16] {
    let mut numbers = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];
    for number in &mut numbers {
        *number = first.wrapping_add(*number);
    }
    numbers
}

/// An instruction set: a vector of [`Simd::LANES`] single-precision numbers, and operations on vectors and slices.
pub(crate) trait Simd: NoUninit {
    /// Number of lanes: 8 or 16.
    const LANES: usize;
    /// Double-precision vectors of the same instruction set.
    type Double: Real;
    /// Runs a kernel in a function that is compiled for this instruction set.
    fn call<K: Kernel>(kernel: K) -> K::Output;
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
    /// Loads the first [`Simd::LANES`] numbers of a slice.
    fn load(from: &[f32]) -> Self;
    /// The lanes from `first` on, as many as [`Simd::Double`] has.
    #[inline(always)]
    fn widen(&self, first: usize) -> Self::Double {
        Self::Double::load(&bytemuck::cast_slice(slice::from_ref(self))[first..])
    }
    /// Gathers the columns of the rows at the first [`Simd::LANES`] indices, a row a lane; those beyond the last row give it.
    /// There must be one.
    fn gather_columns(rows: &[[f32; 8]], indices: &[u32; 16]) -> [Self; 8];
    /// Loads [`Simd::LANES`] numbers, converted to `f32`, without a check: with checks, rays that go alone take a fifth more
    /// instructions.
    ///
    /// # Safety
    ///
    /// [`Simd::LANES`] bytes can be read.
    unsafe fn load_bytes_at(from: *const u8) -> Self;
    /// Loads the halves of [`Simd::LANES`] bytes, converted to `f32`, without a check, as above: first those from bit `shift`
    /// on, 0 or 4, then the others.
    ///
    /// # Safety
    ///
    /// [`Simd::LANES`] bytes can be read.
    unsafe fn load_halves_at(from: *const u8, shift: u32) -> [Self; 2];
    /// Writes all lanes to the beginning of a slice.
    fn store(self, to: &mut [f32]);
    /// Takes each lane from `yes` where its bit is set in `mask`, else from `no`.
    fn select(mask: u32, yes: Self, no: Self) -> Self;
    /// Writes the lanes that have their bit set in `mask`, each to its own index, to a slice with room for all lanes.
    #[inline(always)]
    fn masked_store(self, mask: u32, to: &mut [f32]) {
        // No masked store: a load after it would stall.
        Self::select(mask, self, Self::load(to)).store(to);
    }
    /// Writes a number at the indices of the bits in `mask`, to a slice with room for all lanes.
    fn masked_fill(number: u32, mask: u32, to: &mut [u32]);
    /// A bit for each of the first [`Simd::LANES`] numbers of a slice that equals `number`.
    fn eq_mask(numbers: &[u32], number: u32) -> u32;
    fn reduce_min(self) -> f32;
    fn reduce_max(self) -> f32;
    /// Gathers x, y and z of the first [`Simd::LANES`] vertices; `coordinates` has three numbers a vertex.
    ///
    /// Four numbers are loaded for each vertex and three are kept: several times as fast as the gather instructions.
    /// Loads are unchecked: checks would take up to 5 % of a frame's time.
    ///
    /// # Safety
    ///
    /// `coordinates` has at least `3 * vertex + 4` numbers for each of the first [`Simd::LANES`] vertices.
    unsafe fn gather_xyz(coordinates: &[f32], vertices: &[u32; 16]) -> [Self; 3];
    /// Gathers x, y and z of the first [`Simd::LANES`] points, which [`PointScale`] has packed one after the other. Loads are
    /// unchecked, as above.
    ///
    /// # Safety
    ///
    /// [`points::LOADED`] bytes follow the first one of each of these points.
    unsafe fn gather_packed_points(bytes: &[u8], scale: PointScale, indices: &[u32; 16]) -> [Self; 3];
    /// Gathers x, y and z of the first [`Simd::LANES`] points, which are whole numbers of `n_bits` bits, x in the lowest; points
    /// lie `stride` bytes apart. Loads are unchecked, as above.
    ///
    /// # Safety
    ///
    /// `points` has at least `stride * point + 8` bytes for each of the first [`Simd::LANES`] points; three numbers have at most 64
    /// bits, and each at most 24.
    unsafe fn gather_lattice_points(points: &[u8], stride: usize, n_bits: u32, indices: &[u32; 16]) -> [Self; 3];
    /// Gathers items of four bytes as they are, at the first [`Simd::LANES`] indices; those beyond the last give it. There must
    /// be items.
    fn gather_bits<T: NoUninit>(from: &[T], indices: &[u32]) -> Self;
    /// Takes the numbers at the first [`Simd::LANES`] places of a table; only the lowest four bits of a place count.
    fn pick(table: &[f32; 16], places: &[u32]) -> Self;
    /// [`Simd::pick`] for numbers as they are.
    #[inline(always)]
    fn pick_bits(table: &[u32; 16], places: &[u32]) -> Self {
        Self::pick(bytemuck::cast_ref(table), places)
    }
    /// Loads the first [`Simd::LANES`] numbers of a slice as they are, without conversion.
    fn load_bits(from: &[u32]) -> Self;
    /// Writes all lanes as they are to the beginning of a slice.
    #[inline(always)]
    fn store_bits(self, to: &mut [u32]) {
        self.store(bytemuck::cast_slice_mut(to));
    }
    /// Moves each lane i to lane i ^ `flip`, which is less than [`Simd::LANES`].
    fn reflect(self, flip: u32) -> Self;
    /// Writes the lanes with a bit in `mask` in order to a slice with room for all lanes. Returns how many there are; numbers
    /// after them are undefined.
    fn compress_to(self, mask: u32, to: &mut [f32]) -> usize;
    /// [`Simd::compress_to`] for lanes of [`Simd::load_bits`].
    #[inline(always)]
    fn compress_bits_to(self, mask: u32, to: &mut [u32]) -> usize {
        self.compress_to(mask, bytemuck::cast_slice_mut(to))
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
    /// Bitwise and: negative where both are.
    fn and(self, other: Self) -> Self;
    /// Bitwise or: negative where either is.
    fn or(self, other: Self) -> Self;
    /// The sign bit of each lane.
    ///
    /// Box tests read sign bits of differences: a Zen 5 compares one vector a cycle, but subtracts two.
    fn sign_mask(self) -> u32;
    /// A bit for each lane where self ≤ other; 0 for NaN.
    fn le(self, other: Self) -> u32;
    /// A bit for each lane where self < other; 0 for NaN.
    fn lt(self, other: Self) -> u32;
}

/// Eight lanes without special instructions.
#[derive(Clone, Copy, NoUninit)]
#[repr(transparent)]
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
    call_with_features!(Portable);
    #[inline(always)]
    fn select(mask: u32, yes: Self, no: Self) -> Self {
        // Bits are tested in place and all lanes are written, so that the compiler vectorises it.
        Self(std::array::from_fn(|lane| if mask & 1 << lane != 0 { yes.0[lane] } else { no.0[lane] }))
    }
    #[inline(always)]
    fn gather_columns(rows: &[[f32; 8]], indices: &[u32; 16]) -> [Self; 8] {
        let mut columns = [Self([0.0; 8]); 8];
        for lane in 0..8 {
            for column in 0..8 {
                columns[column].0[lane] = rows[(indices[lane] as usize).min(rows.len() - 1)][column];
            }
        }
        columns
    }
    #[inline(always)]
    unsafe fn load_bytes_at(from: *const u8) -> Self {
        // SAFETY: the caller's.
        let bytes = unsafe { slice::from_raw_parts(from, Self::LANES) };
        Self(std::array::from_fn(|lane| f32::from(bytes[lane])))
    }
    #[inline(always)]
    unsafe fn load_halves_at(from: *const u8, shift: u32) -> [Self; 2] {
        // SAFETY: the caller's.
        let bytes = unsafe { slice::from_raw_parts(from, Self::LANES) };
        [shift, 4 - shift].map(|shift| Self(std::array::from_fn(|lane| f32::from(bytes[lane] >> shift & 15))))
    }
    #[inline(always)]
    fn compress_to(self, mask: u32, to: &mut [f32]) -> usize {
        let to: &mut [f32; 8] = (&mut to[..8]).try_into().expect("eight numbers");
        let mut n = 0;
        for lane in 0..8 {
            to[n & 7] = self.0[lane];
            n += (mask >> lane & 1) as usize;
        }
        n
    }
    #[inline(always)]
    fn masked_fill(number: u32, mask: u32, to: &mut [u32]) {
        let to: &mut [u32; 8] = (&mut to[..8]).try_into().expect("eight numbers");
        *to = std::array::from_fn(|lane| if mask & 1 << lane != 0 { number } else { to[lane] });
    }
    #[inline(always)]
    unsafe fn gather_xyz(coordinates: &[f32], vertices: &[u32; 16]) -> [Self; 3] {
        std::array::from_fn(|axis| Self(std::array::from_fn(|lane| coordinates[3 * vertices[lane] as usize + axis])))
    }
    #[inline(always)]
    unsafe fn gather_packed_points(bytes: &[u8], scale: PointScale, indices: &[u32; 16]) -> [Self; 3] {
        let mut gathered = [Self([0.0; 8]); 3];
        for lane in 0..8 {
            let packed = bytes[points::POINT * indices[lane] as usize..].first_chunk();
            let point = scale.unpack(packed.expect("all bytes of the point"));
            for axis in 0..3 {
                gathered[axis].0[lane] = point[axis];
            }
        }
        gathered
    }
    #[inline(always)]
    unsafe fn gather_lattice_points(points: &[u8], stride: usize, n_bits: u32, indices: &[u32; 16]) -> [Self; 3] {
        let words: [u64; 8] = std::array::from_fn(|lane| {
            let bytes = &points[stride * indices[lane] as usize..];
            u64::from_le_bytes(bytes[..8].try_into().expect("eight bytes"))
        });
        let number = |word: u64, axis: u32| (word >> (axis * n_bits)) & ((1 << n_bits) - 1);
        [0, 1, 2].map(|axis| Self(words.map(|word| number(word, axis) as f32)))
    }
    #[inline(always)]
    fn gather_bits<T: NoUninit>(from: &[T], indices: &[u32]) -> Self {
        let mut gathered = Self([0.0; 8]);
        for lane in 0..8 {
            gathered.0[lane] = f32::from_bits(bytemuck::cast(from[indices[lane].min(last_index(from)) as usize]));
        }
        gathered
    }
    methods! {
        fn store(self, to: &mut [f32]) -> () = to[..8].copy_from_slice(&self.0);
        fn splat(x: f32) -> Self = Self([x; 8]);
        fn pick(table: &[f32; 16], places: &[u32]) -> Self =
            Self(std::array::from_fn(|lane| table[places[lane] as usize % 16]));
        fn load(from: &[f32]) -> Self = Self(std::array::from_fn(|lane| from[lane]));
        fn load_bits(from: &[u32]) -> Self = Self(std::array::from_fn(|lane| f32::from_bits(from[lane])));
        fn reflect(self, flip: u32) -> Self = Self(std::array::from_fn(|lane| self.0[lane ^ (flip & 7) as usize]));
        fn eq_mask(numbers: &[u32], number: u32) -> u32 =
            (0..8).fold(0, |mask, lane| mask | u32::from(numbers[lane] == number) << lane);
        fn reduce_min(self) -> f32 = self.0.into_iter().fold(f32::INFINITY, f32::min);
        fn reduce_max(self) -> f32 = self.0.into_iter().fold(f32::NEG_INFINITY, f32::max);
        fn add(self, other: Self) -> Self = self.zip(other, |a, b| a + b);
        fn sub(self, other: Self) -> Self = self.zip(other, |a, b| a - b);
        fn mul(self, other: Self) -> Self = self.zip(other, |a, b| a * b);
        fn div(self, other: Self) -> Self = self.zip(other, |a, b| a / b);
        fn min(self, other: Self) -> Self = self.zip(other, |a, b| if a < b { a } else { b });
        fn max(self, other: Self) -> Self = self.zip(other, |a, b| if a > b { a } else { b });
        fn abs(self) -> Self = Self(self.0.map(f32::abs));
        fn mul_add(self, factor: Self, summand: Self) -> Self = self.mul(factor).add(summand);
        fn mul_sub(self, factor: Self, subtrahend: Self) -> Self = self.mul(factor).sub(subtrahend);
        fn neg_mul_add(self, factor: Self, summand: Self) -> Self = summand.sub(self.mul(factor));
        fn and(self, other: Self) -> Self = self.zip(other, |a, b| f32::from_bits(a.to_bits() & b.to_bits()));
        fn or(self, other: Self) -> Self = self.zip(other, |a, b| f32::from_bits(a.to_bits() | b.to_bits()));
        fn sign_mask(self) -> u32 = (0..8).fold(0, |mask, lane| mask | self.0[lane].to_bits() >> 31 << lane);
        fn le(self, other: Self) -> u32 = self.compare(other, |a, b| a <= b);
        fn lt(self, other: Self) -> u32 = self.compare(other, |a, b| a < b);
    }
}
