//! The vertices of triangles, in a byte for each corner.
//!
//! Triangles lie in the order of the grid's cells, and vertices in the order in which triangles name them, so neighbours
//! have vertices that lie close together. Each [`TRIANGLES_PER_WINDOW`] triangles have a window of 256 vertices, and their
//! corners count from the window's start. A vertex that far triangles share is there twice.

use rayon::prelude::*;

use crate::{
    grid::traced::numbering::{Numbering, Vertices},
    model::normal::Normal,
    scene_file::{
        fault::{Damage, Fault},
        section::Section,
        sections::{SectionVisitor, expect},
    },
    simd::Simd,
};

const TRIANGLES_PER_WINDOW: usize = 16;
const CORNERS_PER_WINDOW: usize = 3 * TRIANGLES_PER_WINDOW;

/// As many as a byte can tell apart.
const VERTICES_PER_WINDOW: usize = 256;

/// Triangles that are numbered one after the other; parts of so many are numbered in parallel, and share no vertices.
const TRIANGLES_PER_PART: usize = 1 << 16;

/// One of so many triangles is looked at for whether some are flat.
const SAMPLED_TRIANGLES: usize = 16;

/// Triangles whose bits share a word.
const TRIANGLES_PER_WORD: usize = u32::BITS as usize;

/// Bytes after the last corner, so that four can be loaded from any triangle's first.
const PADDING: usize = 1;

/// The corners of all triangles, by vertex.
#[derive(Debug, Default)]
pub(super) struct Corners {
    /// Three for each triangle: its vertices, from the start of its window. With [`PADDING`].
    bytes: Section<u8>,
    /// The first vertex of each window.
    window_starts: Section<u32>,
    /// A bit for each triangle: whether it is flat, whatever normals its vertices have. Empty if none is.
    flat: Section<u32>,
}

impl Corners {
    /// Bytes for each triangle, rounded up.
    pub(super) const BYTES_PER_TRIANGLE: u64 = 4;

    /// Numbers the vertices of triangles in this order, in parallel. Returns the kept ones too, part after part, by their
    /// number in `vertices`.
    ///
    /// # Panics
    ///
    /// If that takes more vertices than 32 bits can number.
    pub(super) fn new(order: &[u32], triangles: &[[u32; 3]], vertices: &Vertices) -> (Self, Vec<Vec<u32>>) {
        let mut bytes = vec![0; 3 * order.len() + PADDING];
        let mut window_starts = vec![0; order.len().div_ceil(TRIANGLES_PER_WINDOW)];
        let mut flat = vec![0; order.len().div_ceil(TRIANGLES_PER_WORD)];
        let are_some_flat = are_some_flat(order, triangles, vertices);
        let kept: Vec<Vec<u32>> = order
            .par_chunks(TRIANGLES_PER_PART)
            .zip(bytes.par_chunks_mut(3 * TRIANGLES_PER_PART))
            .zip(window_starts.par_chunks_mut(TRIANGLES_PER_PART / TRIANGLES_PER_WINDOW))
            .zip(flat.par_chunks_mut(TRIANGLES_PER_PART / TRIANGLES_PER_WORD))
            .map(|(((order, bytes), window_starts), flat)| {
                let numbering = Numbering::new(vertices, are_some_flat, order.len());
                number_part(numbering, order.iter().map(|&idx| triangles[idx as usize]), bytes, window_starts, flat)
            })
            .collect();

        // Windows of a part begin behind the vertices of those before it.
        let mut n_before = 0;
        for (of_part, window_starts) in
            kept.iter().zip(window_starts.chunks_mut(TRIANGLES_PER_PART / TRIANGLES_PER_WINDOW))
        {
            window_starts.iter_mut().for_each(|start| *start += n_before);
            n_before = u32::try_from(of_part.len() as u64 + u64::from(n_before)).expect("vertices have 32-bit numbers");
        }
        if !are_some_flat || vertices.normals.is_empty() {
            flat = Vec::new();
        }
        (Self { bytes: bytes.into(), window_starts: window_starts.into(), flat: flat.into() }, kept)
    }

    /// The vertices of a triangle.
    #[inline(always)]
    pub(super) fn of(&self, triangle_idx: u32) -> [u32; 3] {
        let triangle_idx = triangle_idx as usize;
        let start = self.window_starts[triangle_idx / TRIANGLES_PER_WINDOW];
        let &[a, b, c, _] = self.bytes[3 * triangle_idx..].first_chunk().expect("padding follows the last triangle");
        [start + u32::from(a), start + u32::from(b), start + u32::from(c)]
    }

    /// The vertices of triangles, one triangle per lane, by corner. Lanes from [`Simd::LANES`] on hold none.
    //
    // No closures: they are not compiled for the caller's instruction set.
    #[inline(always)]
    pub(super) fn of_lanes<S: Simd>(&self, triangle_indices: &[u32; 16]) -> [[u32; 16]; 3] {
        // Check all lanes at once: a check for each took 2 to 4 % of the time of bounces.
        let (window_starts, bytes) = (&*self.window_starts, &*self.bytes);
        let mut greatest_idx = 0;
        for &triangle_idx in &triangle_indices[..S::LANES] {
            greatest_idx = greatest_idx.max(triangle_idx);
        }
        let greatest_idx = greatest_idx as usize;
        let has_all = greatest_idx / TRIANGLES_PER_WINDOW < window_starts.len() && greatest_idx < bytes.len() / 3;
        assert!(has_all, "no triangle {greatest_idx}");
        let mut vertices = [[0; 16]; 3];
        for lane in 0..S::LANES {
            let triangle_idx = triangle_indices[lane] as usize;
            // SAFETY: the greatest index has a window and three corners, so all have.
            let (start, corners) = unsafe {
                let start = *window_starts.get_unchecked(triangle_idx / TRIANGLES_PER_WINDOW);
                (start, bytes.as_ptr().add(3 * triangle_idx).cast::<[u8; 3]>().read())
            };
            for corner in 0..3 {
                vertices[corner][lane] = start + u32::from(corners[corner]);
            }
        }
        vertices
    }

    /// Replaces the bits of normals where triangles are flat, one triangle per lane. Lanes from [`Simd::LANES`] on keep theirs.
    #[inline(always)]
    pub(super) fn flatten<S: Simd>(&self, triangle_indices: &[u32; 16], normals: [&mut [u32]; 3]) {
        if self.flat.is_empty() {
            return;
        }
        let mut words = [0; 16];
        for (word, triangle_idx) in words.iter_mut().zip(triangle_indices) {
            *word = triangle_idx / TRIANGLES_PER_WORD as u32;
        }
        let mut bits = [0; 16];
        S::gather_bits(&self.flat, &words).store_bits(&mut bits);
        for normals in normals {
            for ((normal, bits), triangle_idx) in normals[..S::LANES].iter_mut().zip(&bits).zip(triangle_indices) {
                let is_flat = bits >> (triangle_idx % TRIANGLES_PER_WORD as u32) & 1 != 0;
                *normal = if is_flat { Normal::OF_TRIANGLE_BITS } else { *normal };
            }
        }
    }

    /// Hints that a triangle will be read soon.
    #[inline(always)]
    pub(super) fn prefetch<S: Simd>(&self, triangle_idx: u32) {
        S::prefetch(&self.bytes, 3 * triangle_idx as usize);
        S::prefetch(&self.window_starts, triangle_idx as usize / TRIANGLES_PER_WINDOW);
    }

    pub(super) fn n_bytes(&self) -> usize {
        size_of_val(&*self.bytes) + size_of_val(&*self.window_starts) + size_of_val(&*self.flat)
    }

    pub(super) fn visit_sections<'a>(&'a mut self, visitor: &mut impl SectionVisitor<'a>) -> Result<(), Fault> {
        visitor.visit("corners", &mut self.bytes)?;
        visitor.visit("windows", &mut self.window_starts)?;
        visitor.visit("flat triangles", &mut self.flat)
    }

    /// Checks that so many triangles have corners.
    pub(super) fn check_sizes(&self, n_triangles: usize) -> Result<(), Damage> {
        expect(self.bytes.len() == 3 * n_triangles + PADDING, "corners")?;
        expect(self.window_starts.len() == n_triangles.div_ceil(TRIANGLES_PER_WINDOW), "windows")?;
        let n_words = n_triangles.div_ceil(TRIANGLES_PER_WORD);
        expect(self.flat.is_empty() || self.flat.len() == n_words, "flat triangles")
    }

    /// Checks that all corners are among so many vertices.
    pub(super) fn check_contents(&self, n_vertices: usize) -> Result<(), Damage> {
        let n_corners = self.bytes.len() - PADDING;
        let windows = self.bytes[..n_corners].par_chunks(CORNERS_PER_WINDOW).zip(self.window_starts.par_iter());
        let exist = |(bytes, &start): (&[u8], &u32)| {
            let last = bytes.iter().max().copied().unwrap_or_default();
            (start as usize + usize::from(last)) < n_vertices
        };
        expect(windows.all(exist), "corners")
    }
}

/// Numbers the vertices of some triangles from 0 on, and returns them in the order of these numbers.
fn number_part(
    mut numbering: Numbering,
    triangles: impl Iterator<Item = [u32; 3]>,
    bytes: &mut [u8],
    window_starts: &mut [u32],
    flat: &mut [u32],
) -> Vec<u32> {
    let mut start = 0;
    for (idx, (triangle, bytes)) in triangles.zip(bytes.as_chunks_mut().0).enumerate() {
        if idx.is_multiple_of(TRIANGLES_PER_WINDOW) {
            // A window has room for as many new vertices as its triangles can have.
            start = numbering.kept().len().saturating_sub(VERTICES_PER_WINDOW - CORNERS_PER_WINDOW) as u32;
            numbering.begin_window(start);
            window_starts[idx / TRIANGLES_PER_WINDOW] = start;
        }
        let is_flat = numbering.is_flat(triangle);
        flat[idx / TRIANGLES_PER_WORD] |= u32::from(is_flat) << (idx % TRIANGLES_PER_WORD);
        *bytes = triangle.map(|vertex| (numbering.number(vertex, is_flat) - start) as u8);
    }
    numbering.into_kept()
}

/// Whether enough triangles are flat for their bits to pay: a frame of a scan without them takes 1 % less time.
fn are_some_flat(order: &[u32], triangles: &[[u32; 3]], vertices: &Vertices) -> bool {
    let sample = || order.iter().step_by(SAMPLED_TRIANGLES).map(|&triangle| triangles[triangle as usize]);
    let n_flat = sample().filter(|&triangle| vertices.are_flat(triangle)).count();
    n_flat > sample().count() / 64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Vertices in places of their own.
    fn places(n_vertices: u32) -> Vec<[f32; 3]> {
        (0..n_vertices).map(|n| [n as f32, 1.0, 2.0]).collect()
    }

    fn without_normals(positions: &[[f32; 3]]) -> Vertices<'_> {
        Vertices { positions, normals: &[], colors: &[], coordinates: &[] }
    }

    /// The vertices that corners name, by their number as loaded.
    fn named(corners: &Corners, vertices: &[Vec<u32>], n_triangles: usize) -> Vec<[u32; 3]> {
        let vertices = vertices.concat();
        (0..n_triangles as u32).map(|triangle| corners.of(triangle).map(|vertex| vertices[vertex as usize])).collect()
    }

    #[test]
    fn corners_name_the_same_vertices_as_the_triangles_whatever_their_order() {
        let n_triangles = 2 * TRIANGLES_PER_PART as u32 + 7;
        let positions = places(n_triangles + 2);
        // A strip, whose vertices are near; triangles with far vertices; and both in turns.
        let strip = |n: u32| [n, n + 1, n + 2];
        let far = |n: u32| [n, n.wrapping_mul(2_654_435_761) % n_triangles, (n * 31) % n_triangles];
        let mixed = |n: u32| if n.is_multiple_of(3) { far(n) } else { strip(n) };
        for triangle in [&strip as &dyn Fn(u32) -> [u32; 3], &far, &mixed] {
            let triangles: Vec<_> = (0..n_triangles).map(triangle).collect();
            let forward: Vec<u32> = (0..n_triangles).collect();
            let scattered: Vec<u32> = (0..n_triangles).map(|n| n.wrapping_mul(40_503) % n_triangles).collect();
            for order in [forward, scattered] {
                let (corners, vertices) = Corners::new(&order, &triangles, &without_normals(&positions));
                let in_order: Vec<_> = order.iter().map(|&triangle| triangles[triangle as usize]).collect();
                assert!(named(&corners, &vertices, order.len()) == in_order);
                let n_vertices = vertices.iter().map(Vec::len).sum();
                corners.check_sizes(order.len()).unwrap();
                corners.check_contents(n_vertices).unwrap();
                assert!(corners.check_contents(n_vertices - 1).is_err(), "the last vertex is named");
            }
        }
    }

    #[test]
    fn neighbours_share_vertices() {
        let strip: Vec<_> = (0..1000).map(|n| [n, n + 1, n + 2]).collect();
        let order: Vec<u32> = (0..1000).collect();
        let (_, vertices) = Corners::new(&order, &strip, &without_normals(&places(1002)));
        assert_eq!(vertices, [(0..1002).collect::<Vec<u32>>()]);
    }

    #[test]
    fn no_triangles_have_no_corners() {
        let (corners, vertices) = Corners::new(&[], &[], &without_normals(&[]));
        assert!(vertices.is_empty());
        corners.check_sizes(0).unwrap();
        corners.check_contents(0).unwrap();
    }
}
