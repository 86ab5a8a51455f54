//! AVX2 and AVX-512.

use std::arch::x86_64::*;

use bytemuck::NoUninit;

use super::{
    Real, Simd, call_with_features, last_index,
    points::{EXPONENT_BITS, LARGEST_EXPONENT, LOADED, POINT, PointScale},
};

/// Eight lanes in an AVX2 register. Made only inside functions that enable `avx2` and `fma`.
#[derive(Clone, Copy, NoUninit)]
#[repr(transparent)]
pub(crate) struct Avx2(__m256);

#[derive(Clone, Copy)]
pub(crate) struct Avx2Double(__m256d);

/// Sixteen lanes in an AVX-512 register. Made only inside functions that enable `avx512f`.
#[derive(Clone, Copy, NoUninit)]
#[repr(transparent)]
pub(crate) struct Avx512(__m512);

#[derive(Clone, Copy)]
pub(crate) struct Avx512Double(__m512d);

/// Methods of one expression each, which may use the intrinsics of the type's instruction set.
macro_rules! intrinsics {
    ($(fn $name:ident($($argument:tt)*) -> $result:ty = $expression:expr;)*) => {
        $(#[inline(always)]
        fn $name($($argument)*) -> $result {
            // SAFETY: values of this type exist only where the instruction set was found at run time, and numbers are
            // loaded from arrays that hold them, and stored to arrays with room for them.
            unsafe { $expression }
        })*
    };
}

/// The first numbers of a slice, which has no fewer.
#[inline(always)]
fn first<const N: usize, T>(numbers: &[T]) -> &[T; N] {
    numbers[..N].try_into().expect("a slice of N numbers")
}

/// The same to write to.
#[inline(always)]
fn first_mut<const N: usize, T>(numbers: &mut [T]) -> &mut [T; N] {
    (&mut numbers[..N]).try_into().expect("a slice of N numbers")
}

/// All ones in the lanes whose bit is set in a mask.
#[inline(always)]
fn lane_masks(mask: u32) -> __m256i {
    // SAFETY: called only by methods of [`Avx2`].
    unsafe {
        let bits = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
        _mm256_cmpeq_epi32(_mm256_and_si256(_mm256_set1_epi32(mask as i32), bits), bits)
    }
}

/// The three coordinates of a vertex and the one that follows.
///
/// # Safety
///
/// `coordinates` has all four.
#[inline(always)]
unsafe fn vertex(coordinates: &[f32], vertex: u32) -> __m128 {
    let first = 3 * vertex as usize;
    debug_assert!(first + 4 <= coordinates.len(), "no vertex {vertex} in {} coordinates", coordinates.len());
    // SAFETY: the caller's.
    unsafe { _mm_loadu_ps(coordinates.as_ptr().add(first)) }
}

/// The significands of a packed point, three numbers, and its exponents.
///
/// # Safety
///
/// The point is there.
#[inline(always)]
unsafe fn packed_point(bytes: &[u8], point: u32) -> __m128 {
    let first = POINT * point as usize;
    debug_assert!(first + LOADED <= bytes.len(), "no point {point} in {} bytes", bytes.len());
    // SAFETY: the caller's, and the instruction sets of this module have SSSE3.
    unsafe {
        // Numbers of three bytes become numbers of four, and −1 makes zeros.
        let places = _mm_setr_epi8(0, 1, 2, -1, 3, 4, 5, -1, 6, 7, 8, -1, 9, 10, -1, -1);
        _mm_castsi128_ps(_mm_shuffle_epi8(_mm_loadu_si128(bytes.as_ptr().add(first).cast()), places))
    }
}

/// The four numbers of rows, one row a lane. Each vector holds rows that lie four apart.
///
/// # Safety
///
/// The instruction set is AVX2.
#[inline(always)]
unsafe fn transposed_256([a, b, c, d]: [__m256; 4]) -> [__m256; 4] {
    // SAFETY: the caller's.
    unsafe {
        let (xy_ab, zw_ab) = (_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b));
        let (xy_cd, zw_cd) = (_mm256_unpacklo_ps(c, d), _mm256_unpackhi_ps(c, d));
        [
            _mm256_shuffle_ps::<0x44>(xy_ab, xy_cd),
            _mm256_shuffle_ps::<0xee>(xy_ab, xy_cd),
            _mm256_shuffle_ps::<0x44>(zw_ab, zw_cd),
            _mm256_shuffle_ps::<0xee>(zw_ab, zw_cd),
        ]
    }
}

/// [`transposed_256`] of sixteen rows.
///
/// # Safety
///
/// The instruction set is AVX-512.
#[inline(always)]
unsafe fn transposed_512([a, b, c, d]: [__m512; 4]) -> [__m512; 4] {
    // SAFETY: the caller's.
    unsafe {
        let (xy_ab, zw_ab) = (_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b));
        let (xy_cd, zw_cd) = (_mm512_unpacklo_ps(c, d), _mm512_unpackhi_ps(c, d));
        [
            _mm512_shuffle_ps::<0x44>(xy_ab, xy_cd),
            _mm512_shuffle_ps::<0xee>(xy_ab, xy_cd),
            _mm512_shuffle_ps::<0x44>(zw_ab, zw_cd),
            _mm512_shuffle_ps::<0xee>(zw_ab, zw_cd),
        ]
    }
}

/// The row at an index, or the last one if that is beyond it.
///
/// # Safety
///
/// The instruction set is AVX2.
#[inline(always)]
unsafe fn row_at(rows: &[[f32; 8]], index: u32) -> __m256 {
    // SAFETY: the caller's.
    unsafe { _mm256_loadu_ps(rows[(index as usize).min(rows.len() - 1)].as_ptr()) }
}

/// The eight bytes from a lattice point's first.
///
/// # Safety
///
/// `points` has them.
#[inline(always)]
unsafe fn lattice_point(points: &[u8], stride: usize, point: u32) -> i64 {
    let first = stride * point as usize;
    debug_assert!(first + 8 <= points.len(), "no point {point} in {} bytes", points.len());
    // SAFETY: the caller's.
    unsafe { points.as_ptr().add(first).cast::<i64>().read_unaligned() }
}

impl Simd for Avx2 {
    const LANES: usize = 8;
    type Double = Avx2Double;
    call_with_features!(Avx2, "avx2,fma,bmi1,bmi2,popcnt,lzcnt");
    #[inline(always)]
    fn gather_columns(rows: &[[f32; 8]], indices: &[u32; 16]) -> [Self; 8] {
        // SAFETY: as above.
        unsafe {
            let mut of_rows = [[_mm256_setzero_ps(); 4]; 2];
            for row in 0..8 {
                of_rows[row / 4][row % 4] = row_at(rows, indices[row]);
            }
            // Columns 0 to 3 lie in the lower halves, the others in the upper ones.
            let (first, last) = (transposed_256(of_rows[0]), transposed_256(of_rows[1]));
            let mut columns = [Self(_mm256_setzero_ps()); 8];
            for column in 0..4 {
                columns[column].0 = _mm256_permute2f128_ps::<0x20>(first[column], last[column]);
                columns[column + 4].0 = _mm256_permute2f128_ps::<0x31>(first[column], last[column]);
            }
            columns
        }
    }
    #[inline(always)]
    unsafe fn load_bytes_at(from: *const u8) -> Self {
        // SAFETY: as above, and the caller's.
        unsafe { Self(_mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_loadl_epi64(from.cast())))) }
    }
    #[inline(always)]
    unsafe fn load_halves_at(from: *const u8, shift: u32) -> [Self; 2] {
        // SAFETY: as above, and the caller's.
        unsafe {
            let (bytes, lower) = (_mm256_cvtepu8_epi32(_mm_loadl_epi64(from.cast())), _mm256_set1_epi32(15));
            let first = _mm256_srlv_epi32(bytes, _mm256_set1_epi32(shift as i32));
            let other = _mm256_srlv_epi32(bytes, _mm256_set1_epi32(4 - shift as i32));
            [
                Self(_mm256_cvtepi32_ps(_mm256_and_si256(first, lower))),
                Self(_mm256_cvtepi32_ps(_mm256_and_si256(other, lower))),
            ]
        }
    }
    #[inline(always)]
    unsafe fn gather_xyz(coordinates: &[f32], vertices: &[u32; 16]) -> [Self; 3] {
        // SAFETY: as above, and the caller's: all vertices are there.
        unsafe {
            let mut rows = [_mm256_setzero_ps(); 4];
            for lane in 0..4 {
                let (low, high) = (vertex(coordinates, vertices[lane]), vertex(coordinates, vertices[lane + 4]));
                rows[lane] = _mm256_insertf128_ps::<1>(_mm256_castps128_ps256(low), high);
            }
            let [x, y, z, _] = transposed_256(rows);
            [Self(x), Self(y), Self(z)]
        }
    }
    #[inline(always)]
    unsafe fn gather_packed_points(bytes: &[u8], scale: PointScale, indices: &[u32; 16]) -> [Self; 3] {
        // SAFETY: as above, and the caller's: all points are there.
        unsafe {
            let mut rows = [_mm256_setzero_ps(); 4];
            for lane in 0..4 {
                let (low, high) = (packed_point(bytes, indices[lane]), packed_point(bytes, indices[lane + 4]));
                rows[lane] = _mm256_insertf128_ps::<1>(_mm256_castps128_ps256(low), high);
            }
            let [x, y, z, exponents] = transposed_256(rows);
            let (mut coordinates, exponents) = ([Self(x), Self(y), Self(z)], _mm256_castps_si256(exponents));
            let (mask, scale) = (_mm256_set1_epi32(LARGEST_EXPONENT as i32), _mm256_set1_ps(scale.0));
            for (axis, coordinate) in (0..).zip(&mut coordinates) {
                let shift = _mm_cvtsi32_si128((axis * EXPONENT_BITS) as i32);
                let exponent = _mm256_and_si256(_mm256_srl_epi32(exponents, shift), mask);
                let bits = _mm256_or_si256(_mm256_castps_si256(coordinate.0), _mm256_slli_epi32::<24>(exponent));
                // The sign, which is the lowest bit, becomes the highest.
                let bits = _mm256_or_si256(_mm256_srli_epi32::<1>(bits), _mm256_slli_epi32::<31>(bits));
                coordinate.0 = _mm256_mul_ps(_mm256_castsi256_ps(bits), scale);
            }
            coordinates
        }
    }
    #[inline(always)]
    unsafe fn gather_lattice_points(points: &[u8], stride: usize, n_bits: u32, indices: &[u32; 16]) -> [Self; 3] {
        // SAFETY: as above, and the caller's: all points are there.
        unsafe {
            let mut words = [_mm256_setzero_si256(); 2];
            for (half, words) in words.iter_mut().enumerate() {
                let first = 4 * half;
                *words = _mm256_setr_epi64x(
                    lattice_point(points, stride, indices[first]),
                    lattice_point(points, stride, indices[first + 1]),
                    lattice_point(points, stride, indices[first + 2]),
                    lattice_point(points, stride, indices[first + 3]),
                );
            }
            let mask = _mm256_set1_epi64x((1 << n_bits) - 1);
            // The lower halves of all lanes, in order, in the lower half of the register.
            let lower_halves = _mm256_setr_epi32(0, 2, 4, 6, 0, 2, 4, 6);
            let mut coordinates = [Self(_mm256_setzero_ps()); 3];
            for (axis, coordinates) in (0..).zip(&mut coordinates) {
                let shift = _mm_cvtsi32_si128((axis * n_bits) as i32);
                let low = _mm256_and_si256(_mm256_srl_epi64(words[0], shift), mask);
                let high = _mm256_and_si256(_mm256_srl_epi64(words[1], shift), mask);
                let low = _mm256_castsi256_si128(_mm256_permutevar8x32_epi32(low, lower_halves));
                let high = _mm256_castsi256_si128(_mm256_permutevar8x32_epi32(high, lower_halves));
                *coordinates = Self(_mm256_cvtepi32_ps(_mm256_set_m128i(high, low)));
            }
            coordinates
        }
    }
    #[inline(always)]
    fn gather_bits<T: NoUninit>(from: &[T], indices: &[u32]) -> Self {
        // SAFETY: as above; all indices are those of items.
        unsafe {
            let indices = _mm256_loadu_si256(first::<8, _>(indices).as_ptr().cast());
            let indices = _mm256_min_epu32(indices, _mm256_set1_epi32(last_index(from) as i32));
            Self(_mm256_i32gather_ps::<4>(from.as_ptr().cast(), indices))
        }
    }
    intrinsics! {
        fn splat(x: f32) -> Self = Self(_mm256_set1_ps(x));
        fn load(from: &[f32]) -> Self = Self(_mm256_loadu_ps(first::<8, _>(from).as_ptr()));
        fn pick(table: &[f32; 16], places: &[u32]) -> Self = {
            let places = _mm256_loadu_si256(first::<8, _>(places).as_ptr().cast());
            let (low, high) = (_mm256_loadu_ps(table.as_ptr()), _mm256_loadu_ps(table[8..].as_ptr()));
            // The fourth bit, as the sign, chooses the half.
            let is_high = _mm256_castsi256_ps(_mm256_slli_epi32::<28>(places));
            let [low, high] = [_mm256_permutevar8x32_ps(low, places), _mm256_permutevar8x32_ps(high, places)];
            Self(_mm256_blendv_ps(low, high, is_high))
        };
        fn load_bits(from: &[u32]) -> Self = Self(_mm256_loadu_ps(first::<8, _>(from).as_ptr().cast()));
        fn reflect(self, flip: u32) -> Self = {
            let lanes = _mm256_xor_si256(_mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7), _mm256_set1_epi32(flip as i32));
            Self(_mm256_permutevar8x32_ps(self.0, lanes))
        };
        fn compress_to(self, mask: u32, to: &mut [f32]) -> usize = {
            // A byte for each lane: all ones if it stays, then the numbers of those that stay.
            let stays = _pdep_u64(u64::from(mask), 0x0101_0101_0101_0101).wrapping_mul(0xff);
            let lanes = _mm256_cvtepu8_epi32(_mm_cvtsi64_si128(_pext_u64(0x0706_0504_0302_0100, stays) as i64));
            _mm256_storeu_ps(first_mut::<8, _>(to).as_mut_ptr(), _mm256_permutevar8x32_ps(self.0, lanes));
            (mask & 0xff).count_ones() as usize
        };
        fn store(self, to: &mut [f32]) -> () = _mm256_storeu_ps(first_mut::<8, _>(to).as_mut_ptr(), self.0);
        fn masked_fill(number: u32, mask: u32, to: &mut [u32]) -> () = {
            let to = first_mut::<8, _>(to);
            let all = _mm256_loadu_si256(to.as_ptr().cast());
            let all = _mm256_blendv_epi8(all, _mm256_set1_epi32(number as i32), lane_masks(mask));
            _mm256_storeu_si256(to.as_mut_ptr().cast(), all);
        };
        fn reduce_min(self) -> f32 = {
            let four = _mm_min_ps(_mm256_castps256_ps128(self.0), _mm256_extractf128_ps::<1>(self.0));
            let two = _mm_min_ps(four, _mm_movehl_ps(four, four));
            _mm_cvtss_f32(_mm_min_ss(two, _mm_shuffle_ps::<1>(two, two)))
        };
        fn reduce_max(self) -> f32 = {
            let four = _mm_max_ps(_mm256_castps256_ps128(self.0), _mm256_extractf128_ps::<1>(self.0));
            let two = _mm_max_ps(four, _mm_movehl_ps(four, four));
            _mm_cvtss_f32(_mm_max_ss(two, _mm_shuffle_ps::<1>(two, two)))
        };
        fn select(mask: u32, yes: Self, no: Self) -> Self =
            Self(_mm256_blendv_ps(no.0, yes.0, _mm256_castsi256_ps(lane_masks(mask))));
        fn add(self, other: Self) -> Self = Self(_mm256_add_ps(self.0, other.0));
        fn sub(self, other: Self) -> Self = Self(_mm256_sub_ps(self.0, other.0));
        fn mul(self, other: Self) -> Self = Self(_mm256_mul_ps(self.0, other.0));
        fn div(self, other: Self) -> Self = Self(_mm256_div_ps(self.0, other.0));
        fn min(self, other: Self) -> Self = Self(_mm256_min_ps(self.0, other.0));
        fn max(self, other: Self) -> Self = Self(_mm256_max_ps(self.0, other.0));
        fn mul_add(self, factor: Self, summand: Self) -> Self = Self(_mm256_fmadd_ps(self.0, factor.0, summand.0));
        fn mul_sub(self, factor: Self, subtrahend: Self) -> Self =
            Self(_mm256_fmsub_ps(self.0, factor.0, subtrahend.0));
        fn neg_mul_add(self, factor: Self, summand: Self) -> Self = Self(_mm256_fnmadd_ps(self.0, factor.0, summand.0));
        fn and(self, other: Self) -> Self = Self(_mm256_and_ps(self.0, other.0));
        fn or(self, other: Self) -> Self = Self(_mm256_or_ps(self.0, other.0));
        fn abs(self) -> Self = Self(_mm256_andnot_ps(_mm256_set1_ps(-0.0), self.0));
        fn sign_mask(self) -> u32 = _mm256_movemask_ps(self.0) as u32;
        fn eq_mask(numbers: &[u32], number: u32) -> u32 = _mm256_movemask_ps(_mm256_castsi256_ps(_mm256_cmpeq_epi32(
            _mm256_loadu_si256(first::<8, _>(numbers).as_ptr().cast()), _mm256_set1_epi32(number as i32)))) as u32;
        fn le(self, other: Self) -> u32 = _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(self.0, other.0)) as u32;
        fn lt(self, other: Self) -> u32 = _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0)) as u32;
    }
}

impl Real for Avx2Double {
    const LANES: usize = 4;
    intrinsics! {
        fn store(self, to: &mut [f64]) -> () = _mm256_storeu_pd(first_mut::<4, _>(to).as_mut_ptr(), self.0);
        fn store_rounded(self, to: &mut [f32]) -> () =
            _mm_storeu_ps(first_mut::<4, _>(to).as_mut_ptr(), _mm256_cvtpd_ps(self.0));
        fn splat(x: f64) -> Self = Self(_mm256_set1_pd(x));
        fn load(from: &[f32]) -> Self = Self(_mm256_cvtps_pd(_mm_loadu_ps(first::<4, _>(from).as_ptr())));
        fn add(self, other: Self) -> Self = Self(_mm256_add_pd(self.0, other.0));
        fn sub(self, other: Self) -> Self = Self(_mm256_sub_pd(self.0, other.0));
        fn mul(self, other: Self) -> Self = Self(_mm256_mul_pd(self.0, other.0));
        fn div(self, other: Self) -> Self = Self(_mm256_div_pd(self.0, other.0));
        fn min(self, other: Self) -> Self = Self(_mm256_min_pd(self.0, other.0));
        fn max(self, other: Self) -> Self = Self(_mm256_max_pd(self.0, other.0));
        fn abs(self) -> Self = Self(_mm256_andnot_pd(_mm256_set1_pd(-0.0), self.0));
        fn lt(self, other: Self) -> u32 = _mm256_movemask_pd(_mm256_cmp_pd::<_CMP_LT_OQ>(self.0, other.0)) as u32;
        fn le(self, other: Self) -> u32 = _mm256_movemask_pd(_mm256_cmp_pd::<_CMP_LE_OQ>(self.0, other.0)) as u32;
    }
}

impl Simd for Avx512 {
    const LANES: usize = 16;
    type Double = Avx512Double;
    call_with_features!(Avx512, "avx512f,avx512dq,avx2,fma,bmi1,bmi2,popcnt,lzcnt");
    #[inline(always)]
    fn gather_columns(rows: &[[f32; 8]], indices: &[u32; 16]) -> [Self; 8] {
        // SAFETY: as above.
        unsafe {
            let mut of_rows = [[_mm512_setzero_ps(); 4]; 2];
            for row in 0..8 {
                // Rows that lie four apart share a vector.
                let (half, row) = (row / 4, row % 4);
                let low = row_at(rows, indices[8 * half + row]);
                let high = row_at(rows, indices[8 * half + row + 4]);
                let (low, high) = (_mm512_castps_pd(_mm512_castps256_ps512(low)), _mm256_castps_pd(high));
                of_rows[half][row] = _mm512_castpd_ps(_mm512_insertf64x4::<1>(low, high));
            }
            // Columns 0 to 3 lie in the even quarters, the others in the odd ones.
            let (first, last) = (transposed_512(of_rows[0]), transposed_512(of_rows[1]));
            let mut columns = [Self(_mm512_setzero_ps()); 8];
            for column in 0..4 {
                columns[column].0 = _mm512_shuffle_f32x4::<0x88>(first[column], last[column]);
                columns[column + 4].0 = _mm512_shuffle_f32x4::<0xdd>(first[column], last[column]);
            }
            columns
        }
    }
    #[inline(always)]
    unsafe fn load_bytes_at(from: *const u8) -> Self {
        // SAFETY: as above, and the caller's.
        unsafe { Self(_mm512_cvtepi32_ps(_mm512_cvtepu8_epi32(_mm_loadu_si128(from.cast())))) }
    }
    #[inline(always)]
    unsafe fn load_halves_at(from: *const u8, shift: u32) -> [Self; 2] {
        // SAFETY: as above, and the caller's.
        unsafe {
            let (bytes, lower) = (_mm512_cvtepu8_epi32(_mm_loadu_si128(from.cast())), _mm512_set1_epi32(15));
            let first = _mm512_srlv_epi32(bytes, _mm512_set1_epi32(shift as i32));
            let other = _mm512_srlv_epi32(bytes, _mm512_set1_epi32(4 - shift as i32));
            [
                Self(_mm512_cvtepi32_ps(_mm512_and_si512(first, lower))),
                Self(_mm512_cvtepi32_ps(_mm512_and_si512(other, lower))),
            ]
        }
    }
    #[inline(always)]
    unsafe fn gather_xyz(coordinates: &[f32], vertices: &[u32; 16]) -> [Self; 3] {
        // SAFETY: as above, and the caller's: all vertices are there.
        unsafe {
            let mut rows = [_mm512_setzero_ps(); 4];
            for lane in 0..4 {
                let first = _mm512_castps128_ps512(vertex(coordinates, vertices[lane]));
                let second = _mm512_insertf32x4::<1>(first, vertex(coordinates, vertices[lane + 4]));
                let third = _mm512_insertf32x4::<2>(second, vertex(coordinates, vertices[lane + 8]));
                rows[lane] = _mm512_insertf32x4::<3>(third, vertex(coordinates, vertices[lane + 12]));
            }
            let [x, y, z, _] = transposed_512(rows);
            [Self(x), Self(y), Self(z)]
        }
    }
    #[inline(always)]
    unsafe fn gather_packed_points(bytes: &[u8], scale: PointScale, indices: &[u32; 16]) -> [Self; 3] {
        // SAFETY: as above, and the caller's: all points are there.
        unsafe {
            let mut rows = [_mm512_setzero_ps(); 4];
            for lane in 0..4 {
                let first = _mm512_castps128_ps512(packed_point(bytes, indices[lane]));
                let second = _mm512_insertf32x4::<1>(first, packed_point(bytes, indices[lane + 4]));
                let third = _mm512_insertf32x4::<2>(second, packed_point(bytes, indices[lane + 8]));
                rows[lane] = _mm512_insertf32x4::<3>(third, packed_point(bytes, indices[lane + 12]));
            }
            let [x, y, z, exponents] = transposed_512(rows);
            let (mut coordinates, exponents) = ([Self(x), Self(y), Self(z)], _mm512_castps_si512(exponents));
            let (mask, scale) = (_mm512_set1_epi32(LARGEST_EXPONENT as i32), _mm512_set1_ps(scale.0));
            for (axis, coordinate) in (0..).zip(&mut coordinates) {
                let shift = _mm_cvtsi32_si128((axis * EXPONENT_BITS) as i32);
                let exponent = _mm512_and_si512(_mm512_srl_epi32(exponents, shift), mask);
                let bits = _mm512_or_si512(_mm512_castps_si512(coordinate.0), _mm512_slli_epi32::<24>(exponent));
                // The sign, which is the lowest bit, becomes the highest.
                let bits = _mm512_ror_epi32::<1>(bits);
                coordinate.0 = _mm512_mul_ps(_mm512_castsi512_ps(bits), scale);
            }
            coordinates
        }
    }
    #[inline(always)]
    unsafe fn gather_lattice_points(points: &[u8], stride: usize, n_bits: u32, indices: &[u32; 16]) -> [Self; 3] {
        // SAFETY: as above, and the caller's: all points are there.
        unsafe {
            let mut words = [_mm512_setzero_si512(); 2];
            for (half, words) in words.iter_mut().enumerate() {
                let first = 8 * half;
                *words = _mm512_setr_epi64(
                    lattice_point(points, stride, indices[first]),
                    lattice_point(points, stride, indices[first + 1]),
                    lattice_point(points, stride, indices[first + 2]),
                    lattice_point(points, stride, indices[first + 3]),
                    lattice_point(points, stride, indices[first + 4]),
                    lattice_point(points, stride, indices[first + 5]),
                    lattice_point(points, stride, indices[first + 6]),
                    lattice_point(points, stride, indices[first + 7]),
                );
            }
            let mask = _mm512_set1_epi64((1 << n_bits) - 1);
            let mut coordinates = [Self(_mm512_setzero_ps()); 3];
            for (axis, coordinates) in (0..).zip(&mut coordinates) {
                let shift = _mm_cvtsi32_si128((axis * n_bits) as i32);
                let low = _mm512_cvtepi64_epi32(_mm512_and_si512(_mm512_srl_epi64(words[0], shift), mask));
                let high = _mm512_cvtepi64_epi32(_mm512_and_si512(_mm512_srl_epi64(words[1], shift), mask));
                let numbers = _mm512_inserti64x4::<1>(_mm512_castsi256_si512(low), high);
                *coordinates = Self(_mm512_cvtepi32_ps(numbers));
            }
            coordinates
        }
    }
    #[inline(always)]
    fn gather_bits<T: NoUninit>(from: &[T], indices: &[u32]) -> Self {
        // SAFETY: as above; all indices are those of items.
        unsafe {
            let indices = _mm512_loadu_epi32(first::<16, _>(indices).as_ptr().cast());
            let indices = _mm512_min_epu32(indices, _mm512_set1_epi32(last_index(from) as i32));
            Self(_mm512_i32gather_ps::<4>(indices, from.as_ptr().cast()))
        }
    }
    intrinsics! {
        fn splat(x: f32) -> Self = Self(_mm512_set1_ps(x));
        fn load(from: &[f32]) -> Self = Self(_mm512_loadu_ps(first::<16, _>(from).as_ptr()));
        fn pick(table: &[f32; 16], places: &[u32]) -> Self = {
            let places = _mm512_loadu_epi32(first::<16, _>(places).as_ptr().cast());
            Self(_mm512_permutexvar_ps(places, _mm512_loadu_ps(table.as_ptr())))
        };
        fn load_bits(from: &[u32]) -> Self = Self(_mm512_loadu_ps(first::<16, _>(from).as_ptr().cast()));
        fn reflect(self, flip: u32) -> Self = {
            let lanes = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
            Self(_mm512_permutexvar_ps(_mm512_xor_si512(lanes, _mm512_set1_epi32(flip as i32)), self.0))
        };
        fn compress_to(self, mask: u32, to: &mut [f32]) -> usize = {
            _mm512_storeu_ps(first_mut::<16, _>(to).as_mut_ptr(), _mm512_maskz_compress_ps(mask as u16, self.0));
            (mask & 0xffff).count_ones() as usize
        };
        fn store(self, to: &mut [f32]) -> () = _mm512_storeu_ps(first_mut::<16, _>(to).as_mut_ptr(), self.0);
        fn masked_fill(number: u32, mask: u32, to: &mut [u32]) -> () = {
            let to = first_mut::<16, _>(to);
            let all = _mm512_loadu_epi32(to.as_ptr().cast());
            let all = _mm512_mask_mov_epi32(all, mask as u16, _mm512_set1_epi32(number as i32));
            _mm512_storeu_epi32(to.as_mut_ptr().cast(), all);
        };
        fn select(mask: u32, yes: Self, no: Self) -> Self = Self(_mm512_mask_blend_ps(mask as u16, no.0, yes.0));
        fn reduce_min(self) -> f32 = _mm512_reduce_min_ps(self.0);
        fn reduce_max(self) -> f32 = _mm512_reduce_max_ps(self.0);
        fn add(self, other: Self) -> Self = Self(_mm512_add_ps(self.0, other.0));
        fn sub(self, other: Self) -> Self = Self(_mm512_sub_ps(self.0, other.0));
        fn mul(self, other: Self) -> Self = Self(_mm512_mul_ps(self.0, other.0));
        fn div(self, other: Self) -> Self = Self(_mm512_div_ps(self.0, other.0));
        fn min(self, other: Self) -> Self = Self(_mm512_min_ps(self.0, other.0));
        fn max(self, other: Self) -> Self = Self(_mm512_max_ps(self.0, other.0));
        fn abs(self) -> Self = Self(_mm512_abs_ps(self.0));
        fn mul_add(self, factor: Self, summand: Self) -> Self = Self(_mm512_fmadd_ps(self.0, factor.0, summand.0));
        fn mul_sub(self, factor: Self, subtrahend: Self) -> Self =
            Self(_mm512_fmsub_ps(self.0, factor.0, subtrahend.0));
        fn neg_mul_add(self, factor: Self, summand: Self) -> Self = Self(_mm512_fnmadd_ps(self.0, factor.0, summand.0));
        fn and(self, other: Self) -> Self = Self(_mm512_and_ps(self.0, other.0));
        fn or(self, other: Self) -> Self = Self(_mm512_or_ps(self.0, other.0));
        fn sign_mask(self) -> u32 = u32::from(_mm512_movepi32_mask(_mm512_castps_si512(self.0)));
        fn eq_mask(numbers: &[u32], number: u32) -> u32 = u32::from(_mm512_cmpeq_epi32_mask(
            _mm512_loadu_epi32(first::<16, _>(numbers).as_ptr().cast()), _mm512_set1_epi32(number as i32)));
        fn le(self, other: Self) -> u32 = u32::from(_mm512_cmp_ps_mask::<_CMP_LE_OQ>(self.0, other.0));
        fn lt(self, other: Self) -> u32 = u32::from(_mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, other.0));
    }
}

impl Real for Avx512Double {
    const LANES: usize = 8;
    intrinsics! {
        fn store(self, to: &mut [f64]) -> () = _mm512_storeu_pd(first_mut::<8, _>(to).as_mut_ptr(), self.0);
        fn store_rounded(self, to: &mut [f32]) -> () =
            _mm256_storeu_ps(first_mut::<8, _>(to).as_mut_ptr(), _mm512_cvtpd_ps(self.0));
        fn splat(x: f64) -> Self = Self(_mm512_set1_pd(x));
        fn load(from: &[f32]) -> Self = Self(_mm512_cvtps_pd(_mm256_loadu_ps(first::<8, _>(from).as_ptr())));
        fn add(self, other: Self) -> Self = Self(_mm512_add_pd(self.0, other.0));
        fn sub(self, other: Self) -> Self = Self(_mm512_sub_pd(self.0, other.0));
        fn mul(self, other: Self) -> Self = Self(_mm512_mul_pd(self.0, other.0));
        fn div(self, other: Self) -> Self = Self(_mm512_div_pd(self.0, other.0));
        fn min(self, other: Self) -> Self = Self(_mm512_min_pd(self.0, other.0));
        fn max(self, other: Self) -> Self = Self(_mm512_max_pd(self.0, other.0));
        fn abs(self) -> Self = Self(_mm512_abs_pd(self.0));
        fn lt(self, other: Self) -> u32 = u32::from(_mm512_cmp_pd_mask::<_CMP_LT_OQ>(self.0, other.0));
        fn le(self, other: Self) -> u32 = u32::from(_mm512_cmp_pd_mask::<_CMP_LE_OQ>(self.0, other.0));
    }
}
