//! AVX2 and AVX-512.

use std::arch::x86_64::*;

use super::{Real, Simd, call_with_features};

/// Eight lanes in an AVX2 register. Made only inside functions that enable `avx2` and `fma`.
#[derive(Clone, Copy)]
pub(crate) struct Avx2(__m256);

/// Four lanes in an AVX2 register.
#[derive(Clone, Copy)]
pub(crate) struct Avx2Double(__m256d);

/// Sixteen lanes in an AVX-512 register. Made only inside functions that enable `avx512f`.
#[derive(Clone, Copy)]
pub(crate) struct Avx512(__m512);

/// Eight lanes in an AVX-512 register.
#[derive(Clone, Copy)]
pub(crate) struct Avx512Double(__m512d);

/// Methods of one instruction each.
macro_rules! instructions {
    ($($name:ident($($argument:ident),*) = $intrinsic:expr;)*) => {
        $(#[inline(always)]
        fn $name(self $(, $argument: Self)*) -> Self {
            // SAFETY: values of this type exist only where the instruction set was found at run time.
            Self(unsafe { $intrinsic(self.0 $(, $argument.0)*) })
        })*
    };
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

impl Simd for Avx2 {
    const LANES: usize = 8;
    type Double = Avx2Double;
    call_with_features!(Avx2, "avx2,fma,bmi1,bmi2,popcnt,lzcnt");
    #[inline(always)]
    fn splat(x: f32) -> Self {
        // SAFETY: as above.
        Self(unsafe { _mm256_set1_ps(x) })
    }
    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        let from: &[f32; 8] = from[..8].try_into().expect("eight numbers");
        // SAFETY: as above, and eight numbers are there.
        Self(unsafe { _mm256_loadu_ps(from.as_ptr()) })
    }
    #[inline(always)]
    fn load_bytes(from: &[u8]) -> Self {
        let from: &[u8; 16] = from[..16].try_into().expect("sixteen numbers");
        // SAFETY: as above, and eight numbers are there.
        Self(unsafe { _mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_loadl_epi64(from.as_ptr().cast()))) })
    }
    #[inline(always)]
    fn select(mask: u32, yes: Self, no: Self) -> Self {
        // SAFETY: as above.
        Self(unsafe { _mm256_blendv_ps(no.0, yes.0, _mm256_castsi256_ps(lane_masks(mask))) })
    }
    #[inline(always)]
    fn masked_fill(number: u32, mask: u32, to: &mut [u32]) {
        let to: &mut [u32; 8] = (&mut to[..8]).try_into().expect("eight numbers");
        // SAFETY: as above, and there is room for eight.
        unsafe {
            let all = _mm256_loadu_si256(to.as_ptr().cast());
            let all = _mm256_blendv_epi8(all, _mm256_set1_epi32(number as i32), lane_masks(mask));
            _mm256_storeu_si256(to.as_mut_ptr().cast(), all);
        }
    }
    #[inline(always)]
    fn eq_mask(numbers: &[u32], number: u32) -> u32 {
        let numbers: &[u32; 8] = numbers[..8].try_into().expect("eight numbers");
        // SAFETY: as above, and eight numbers are there.
        unsafe {
            let numbers = _mm256_loadu_si256(numbers.as_ptr().cast());
            let equal = _mm256_cmpeq_epi32(numbers, _mm256_set1_epi32(number as i32));
            _mm256_movemask_ps(_mm256_castsi256_ps(equal)) as u32
        }
    }
    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        let to: &mut [f32; 8] = (&mut to[..8]).try_into().expect("eight numbers");
        // SAFETY: as above, and there is room for eight.
        unsafe { _mm256_storeu_ps(to.as_mut_ptr(), self.0) };
    }
    #[inline(always)]
    fn reduce_min(self) -> f32 {
        // SAFETY: as above.
        unsafe {
            let four = _mm_min_ps(_mm256_castps256_ps128(self.0), _mm256_extractf128_ps::<1>(self.0));
            let two = _mm_min_ps(four, _mm_movehl_ps(four, four));
            _mm_cvtss_f32(_mm_min_ss(two, _mm_shuffle_ps::<1>(two, two)))
        }
    }
    #[inline(always)]
    fn reduce_max(self) -> f32 {
        // SAFETY: as above.
        unsafe {
            let four = _mm_max_ps(_mm256_castps256_ps128(self.0), _mm256_extractf128_ps::<1>(self.0));
            let two = _mm_max_ps(four, _mm_movehl_ps(four, four));
            _mm_cvtss_f32(_mm_max_ss(two, _mm_shuffle_ps::<1>(two, two)))
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
            let [a, b, c, d] = rows;
            let (xy_ab, zw_ab) = (_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b));
            let (xy_cd, zw_cd) = (_mm256_unpacklo_ps(c, d), _mm256_unpackhi_ps(c, d));
            [
                Self(_mm256_shuffle_ps::<0x44>(xy_ab, xy_cd)),
                Self(_mm256_shuffle_ps::<0xee>(xy_ab, xy_cd)),
                Self(_mm256_shuffle_ps::<0x44>(zw_ab, zw_cd)),
            ]
        }
    }
    instructions! {
        add(other) = _mm256_add_ps;
        sub(other) = _mm256_sub_ps;
        mul(other) = _mm256_mul_ps;
        div(other) = _mm256_div_ps;
        min(other) = _mm256_min_ps;
        max(other) = _mm256_max_ps;
        mul_add(factor, summand) = _mm256_fmadd_ps;
        mul_sub(factor, subtrahend) = _mm256_fmsub_ps;
        neg_mul_add(factor, summand) = _mm256_fnmadd_ps;
        and(other) = _mm256_and_ps;
        or(other) = _mm256_or_ps;
    }
    #[inline(always)]
    fn abs(self) -> Self {
        // SAFETY: as above.
        Self(unsafe { _mm256_andnot_ps(_mm256_set1_ps(-0.0), self.0) })
    }
    #[inline(always)]
    fn sign_mask(self) -> u32 {
        // SAFETY: as above.
        unsafe { _mm256_movemask_ps(self.0) as u32 }
    }
    #[inline(always)]
    fn le(self, other: Self) -> u32 {
        // SAFETY: as above.
        unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(self.0, other.0)) as u32 }
    }
    #[inline(always)]
    fn lt(self, other: Self) -> u32 {
        // SAFETY: as above.
        unsafe { _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0)) as u32 }
    }
}

impl Real for Avx2Double {
    const LANES: usize = 4;
    #[inline(always)]
    fn splat(x: f64) -> Self {
        // SAFETY: as above.
        Self(unsafe { _mm256_set1_pd(x) })
    }
    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        let from: &[f32; 4] = from[..4].try_into().expect("four numbers");
        // SAFETY: as above, and four numbers are there.
        Self(unsafe { _mm256_cvtps_pd(_mm_loadu_ps(from.as_ptr())) })
    }
    #[inline(always)]
    fn store(self, to: &mut [f64; 8]) {
        // SAFETY: as above, and there is room for eight.
        unsafe { _mm256_storeu_pd(to.as_mut_ptr(), self.0) };
    }
    instructions! {
        add(other) = _mm256_add_pd;
        sub(other) = _mm256_sub_pd;
        mul(other) = _mm256_mul_pd;
        div(other) = _mm256_div_pd;
        max(other) = _mm256_max_pd;
    }
    #[inline(always)]
    fn abs(self) -> Self {
        // SAFETY: as above.
        Self(unsafe { _mm256_andnot_pd(_mm256_set1_pd(-0.0), self.0) })
    }
    #[inline(always)]
    fn lt(self, other: Self) -> u32 {
        // SAFETY: as above.
        unsafe { _mm256_movemask_pd(_mm256_cmp_pd::<_CMP_LT_OQ>(self.0, other.0)) as u32 }
    }
}

impl Simd for Avx512 {
    const LANES: usize = 16;
    type Double = Avx512Double;
    call_with_features!(Avx512, "avx512f,avx512dq,avx2,fma,bmi1,bmi2,popcnt,lzcnt");
    #[inline(always)]
    fn splat(x: f32) -> Self {
        // SAFETY: as above.
        Self(unsafe { _mm512_set1_ps(x) })
    }
    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        let from: &[f32; 16] = from[..16].try_into().expect("sixteen numbers");
        // SAFETY: as above, and sixteen numbers are there.
        Self(unsafe { _mm512_loadu_ps(from.as_ptr()) })
    }
    #[inline(always)]
    fn load_bytes(from: &[u8]) -> Self {
        let from: &[u8; 16] = from[..16].try_into().expect("sixteen numbers");
        // SAFETY: as above, and sixteen numbers are there.
        Self(unsafe { _mm512_cvtepi32_ps(_mm512_cvtepu8_epi32(_mm_loadu_si128(from.as_ptr().cast()))) })
    }
    #[inline(always)]
    fn store(self, to: &mut [f32]) {
        let to: &mut [f32; 16] = (&mut to[..16]).try_into().expect("sixteen numbers");
        // SAFETY: as above, and there is room for sixteen.
        unsafe { _mm512_storeu_ps(to.as_mut_ptr(), self.0) };
    }
    #[inline(always)]
    fn select(mask: u32, yes: Self, no: Self) -> Self {
        // SAFETY: as above.
        Self(unsafe { _mm512_mask_blend_ps(mask as u16, no.0, yes.0) })
    }
    #[inline(always)]
    fn masked_fill(number: u32, mask: u32, to: &mut [u32]) {
        let to: &mut [u32; 16] = (&mut to[..16]).try_into().expect("sixteen numbers");
        // SAFETY: as above, and there is room for sixteen.
        unsafe {
            let all = _mm512_loadu_epi32(to.as_ptr().cast());
            let all = _mm512_mask_mov_epi32(all, mask as u16, _mm512_set1_epi32(number as i32));
            _mm512_storeu_epi32(to.as_mut_ptr().cast(), all);
        }
    }
    #[inline(always)]
    fn eq_mask(numbers: &[u32], number: u32) -> u32 {
        let numbers: &[u32; 16] = numbers[..16].try_into().expect("sixteen numbers");
        // SAFETY: as above, and sixteen numbers are there.
        u32::from(unsafe {
            _mm512_cmpeq_epi32_mask(_mm512_loadu_epi32(numbers.as_ptr().cast()), _mm512_set1_epi32(number as i32))
        })
    }
    #[inline(always)]
    fn reduce_min(self) -> f32 {
        // SAFETY: as above.
        unsafe { _mm512_reduce_min_ps(self.0) }
    }
    #[inline(always)]
    fn reduce_max(self) -> f32 {
        // SAFETY: as above.
        unsafe { _mm512_reduce_max_ps(self.0) }
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
            let [a, b, c, d] = rows;
            let (xy_ab, zw_ab) = (_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b));
            let (xy_cd, zw_cd) = (_mm512_unpacklo_ps(c, d), _mm512_unpackhi_ps(c, d));
            [
                Self(_mm512_shuffle_ps::<0x44>(xy_ab, xy_cd)),
                Self(_mm512_shuffle_ps::<0xee>(xy_ab, xy_cd)),
                Self(_mm512_shuffle_ps::<0x44>(zw_ab, zw_cd)),
            ]
        }
    }
    #[inline(always)]
    fn compress(from: &[u32], mask: u32, to: &mut [u32]) -> usize {
        let to: &mut [u32; 16] = (&mut to[..16]).try_into().expect("sixteen numbers");
        let mask = mask & (u32::from(u16::MAX) >> (16 - from.len()));
        // SAFETY: as above; only numbers are read that are there, and there is room for sixteen.
        unsafe {
            let numbers = _mm512_maskz_loadu_epi32(mask as u16, from.as_ptr().cast());
            _mm512_storeu_epi32(to.as_mut_ptr().cast(), _mm512_maskz_compress_epi32(mask as u16, numbers));
        }
        mask.count_ones() as usize
    }
    instructions! {
        add(other) = _mm512_add_ps;
        sub(other) = _mm512_sub_ps;
        mul(other) = _mm512_mul_ps;
        div(other) = _mm512_div_ps;
        min(other) = _mm512_min_ps;
        max(other) = _mm512_max_ps;
        abs() = _mm512_abs_ps;
        mul_add(factor, summand) = _mm512_fmadd_ps;
        mul_sub(factor, subtrahend) = _mm512_fmsub_ps;
        neg_mul_add(factor, summand) = _mm512_fnmadd_ps;
        and(other) = _mm512_and_ps;
        or(other) = _mm512_or_ps;
    }
    #[inline(always)]
    fn sign_mask(self) -> u32 {
        // SAFETY: as above.
        u32::from(unsafe { _mm512_movepi32_mask(_mm512_castps_si512(self.0)) })
    }
    #[inline(always)]
    fn le(self, other: Self) -> u32 {
        // SAFETY: as above.
        u32::from(unsafe { _mm512_cmp_ps_mask::<_CMP_LE_OQ>(self.0, other.0) })
    }
    #[inline(always)]
    fn lt(self, other: Self) -> u32 {
        // SAFETY: as above.
        u32::from(unsafe { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, other.0) })
    }
}

impl Real for Avx512Double {
    const LANES: usize = 8;
    #[inline(always)]
    fn splat(x: f64) -> Self {
        // SAFETY: as above.
        Self(unsafe { _mm512_set1_pd(x) })
    }
    #[inline(always)]
    fn load(from: &[f32]) -> Self {
        let from: &[f32; 8] = from[..8].try_into().expect("eight numbers");
        // SAFETY: as above, and eight numbers are there.
        Self(unsafe { _mm512_cvtps_pd(_mm256_loadu_ps(from.as_ptr())) })
    }
    #[inline(always)]
    fn store(self, to: &mut [f64; 8]) {
        // SAFETY: as above, and there is room for eight.
        unsafe { _mm512_storeu_pd(to.as_mut_ptr(), self.0) };
    }
    instructions! {
        add(other) = _mm512_add_pd;
        sub(other) = _mm512_sub_pd;
        mul(other) = _mm512_mul_pd;
        div(other) = _mm512_div_pd;
        max(other) = _mm512_max_pd;
        abs() = _mm512_abs_pd;
    }
    #[inline(always)]
    fn lt(self, other: Self) -> u32 {
        // SAFETY: as above.
        u32::from(unsafe { _mm512_cmp_pd_mask::<_CMP_LT_OQ>(self.0, other.0) })
    }
}
