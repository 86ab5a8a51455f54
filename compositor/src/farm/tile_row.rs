//! Stores a row of a tile: from three bytes a sample, as on the wire, to four, as the GPU reads it.

#[cfg(target_arch = "x86_64")]
use std::arch::{
    asm,
    x86_64::{
        __m128i, __m256i, _mm256_castsi256_si128, _mm256_extracti128_si256, _mm256_or_si256, _mm256_set_m128i,
        _mm256_set1_epi32, _mm256_setr_epi8, _mm256_shuffle_epi8,
    },
};
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use shared::division::TILE_SIZE;

/// Samples in a row.
const N: usize = TILE_SIZE as usize;

/// A row's samples in the frame buffer.
pub(super) type RowCells = [AtomicU32; N];

/// Red, green and blue of each sample of a row.
pub(super) type RowRgb = [u8; 3 * N];

/// Stores a row, on any machine.
#[inline(always)]
pub(super) fn store_row(cells: &RowCells, rgb: &RowRgb) {
    // Read four bytes at a time: the fourth is the next sample's red, and becomes alpha.
    for x in 0..N - 1 {
        let with_next: u32 = bytemuck::pod_read_unaligned(&rgb[3 * x..3 * x + 4]);
        cells[x].store(with_next | u32::from_ne_bytes([0, 0, 0, 255]), Relaxed);
    }
    let [.., r, g, b] = *rgb;
    cells[N - 1].store(u32::from_ne_bytes([r, g, b, 255]), Relaxed);
}

/// The same with one store. A tile's rows lie in different pages, so nearly every store waits for memory: eight stores a
/// row fill the core's store buffer, and placing a frame takes twice as long.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
#[inline]
pub(super) fn store_row_avx2(cells: &RowCells, rgb: &RowRgb) {
    // SAFETY: the store writes the 32 bytes of the cells and no others. Another thread may store the same bits at the same
    // time. A plain store would then be a data race; in assembly it stands for eight relaxed stores, as on the machine.
    unsafe {
        asm!(
            "vmovdqu ymmword ptr [{cells}], {rgba}",
            cells = in(reg) cells.as_ptr(), rgba = in(ymm_reg) rgba_avx2(rgb),
            options(nostack, preserves_flags)
        );
    }
}

/// The same past the caches, if the row is aligned. Other threads may see the old samples until [`fence_non_temporal`].
///
/// A row is half a cache line: storing through the cache reads the line from memory first, often twice.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
#[inline]
pub(super) fn store_row_non_temporal(cells: &RowCells, rgb: &RowRgb) {
    if !cells.as_ptr().addr().is_multiple_of(16) {
        return store_row_avx2(cells, rgb);
    }
    let rgba = rgba_avx2(rgb);
    // SAFETY: as above, and both addresses are multiples of 16.
    unsafe {
        asm!(
            "vmovntdq xmmword ptr [{cells}], {left}",
            "vmovntdq xmmword ptr [{cells} + 16], {right}",
            cells = in(reg) cells.as_ptr(),
            left = in(xmm_reg) _mm256_castsi256_si128(rgba),
            right = in(xmm_reg) _mm256_extracti128_si256::<1>(rgba),
            options(nostack, preserves_flags)
        );
    }
}

/// Orders this thread's non-temporal stores before its later stores.
#[cfg(target_arch = "x86_64")]
pub(super) fn fence_non_temporal() {
    // SAFETY: the fence only orders stores.
    unsafe { asm!("sfence", options(nostack, preserves_flags)) };
}

/// A row's samples with alpha 255.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
#[inline]
fn rgba_avx2(rgb: &RowRgb) -> __m256i {
    let [left, right]: [__m128i; 2] = [0, 8].map(|at| bytemuck::pod_read_unaligned(&rgb[at..at + 16]));
    #[rustfmt::skip]
    let sample_stride = _mm256_setr_epi8(
        0, 1, 2, -1, 3, 4, 5, -1, 6, 7, 8, -1, 9, 10, 11, -1,
        4, 5, 6, -1, 7, 8, 9, -1, 10, 11, 12, -1, 13, 14, 15, -1,
    );
    let rgb0 = _mm256_shuffle_epi8(_mm256_set_m128i(right, left), sample_stride);
    _mm256_or_si256(rgb0, _mm256_set1_epi32(i32::from_ne_bytes([0, 0, 0, 255])))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_ways_to_store_a_row_give_the_same_bits() {
        let rgb: RowRgb = std::array::from_fn(|byte| 200 - 7 * byte as u8);
        let expected: [u32; N] =
            std::array::from_fn(|x| u32::from_ne_bytes([rgb[3 * x], rgb[3 * x + 1], rgb[3 * x + 2], 255]));
        let check = |store_row: &dyn Fn(&RowCells, &RowRgb)| {
            // Neighbouring cells must not change, wherever a row begins.
            let cells: [AtomicU32; N + 3] = std::array::from_fn(|_| AtomicU32::new(5));
            for start in 0..=3 {
                cells.iter().for_each(|cell| cell.store(5, Relaxed));
                store_row(cells[start..start + N].try_into().unwrap(), &rgb);
                let cells = cells.each_ref().map(|cell| cell.load(Relaxed));
                assert_eq!(cells[start..start + N], expected);
                assert!(cells[..start].iter().chain(&cells[start + N..]).all(|&cell| cell == 5));
            }
        };
        check(&store_row);
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            // SAFETY: the machine has AVX2.
            check(&|cells, rgb| unsafe { store_row_avx2(cells, rgb) });
            // SAFETY: as above.
            check(&|cells, rgb| unsafe { store_row_non_temporal(cells, rgb) });
        }
    }
}
