//! Which vertices an ordered mesh keeps: each once for the triangles near it.
//!
//! Vertices that differ in nothing are one, and flat triangles take those of others whatever their normals are: along the rim
//! of a round hole, its smooth side and the flat surface around it share one row of vertices.

use crate::model::normal::Normal;

/// The latest vertices of each hash are remembered, so many of them.
const WAYS: usize = 4;

/// All that is remembered stays in a core's first cache.
const HASH_BITS: u32 = 8;

/// The attributes of a loaded mesh's vertices. Each array is empty, or has an item for each vertex.
pub(super) struct Vertices<'a> {
    pub(super) positions: &'a [[f32; 3]],
    pub(super) normals: &'a [Normal],
    pub(super) colors: &'a [[u8; 3]],
    pub(super) coordinates: &'a [[f32; 2]],
}

impl Vertices<'_> {
    /// Whether all corners have the triangle's normal.
    #[inline]
    pub(super) fn are_flat(&self, triangle: [u32; 3]) -> bool {
        let is_flat =
            |vertex: u32| self.normals.get(vertex as usize).is_none_or(|&normal| normal == Normal::OF_TRIANGLE);
        triangle.into_iter().all(is_flat)
    }

    /// Whether vertices are the same but for their normals.
    #[inline]
    fn are_twins(&self, one: u32, other: u32) -> bool {
        let [one, other] = [one as usize, other as usize];
        let coordinates = |vertex: usize| self.coordinates.get(vertex).map(|it: &[f32; 2]| it.map(f32::to_bits));
        self.positions[one].map(f32::to_bits) == self.positions[other].map(f32::to_bits)
            && self.colors.get(one) == self.colors.get(other)
            && coordinates(one) == coordinates(other)
    }

    #[inline]
    fn have_same_normal(&self, one: u32, other: u32) -> bool {
        self.normals.get(one as usize) == self.normals.get(other as usize)
    }

    /// A number that differs for most places.
    #[inline]
    fn place(&self, vertex: u32) -> u64 {
        let [x, y, z] = self.positions[vertex as usize].map(|x| u64::from(x.to_bits()));
        (x << 32 | y).wrapping_mul(0xd6e8_feb8_6659_fd93) ^ z
    }
}

/// Vertices that get numbers as triangles name them.
pub(super) struct Numbering<'a> {
    vertices: &'a Vertices<'a>,
    merges_twins: bool,
    kept: Vec<u32>,
    /// The first number that can still be named.
    start: u32,
    /// Those that were named lately, by hash: few of a window's have the same.
    recent: Vec<[Recent; WAYS]>,
}

/// A vertex that was named lately.
#[derive(Clone, Copy, Default)]
struct Recent {
    vertex: u32,
    /// One more than its number; 0 for none.
    count: u32,
    /// Whether only flat triangles have named it, to which its normal is all the same.
    is_of_flat: bool,
}

impl<'a> Numbering<'a> {
    /// Twins are merged, or each vertex of the mesh remains one, which takes less time.
    pub(super) fn new(vertices: &'a Vertices<'a>, merges_twins: bool, n_triangles: usize) -> Self {
        let recent = vec![[Recent::default(); WAYS]; 1 << HASH_BITS];
        Self { vertices, merges_twins, kept: Vec::with_capacity(n_triangles), start: 0, recent }
    }

    /// Names no vertex before this number any more.
    pub(super) fn begin_window(&mut self, start: u32) {
        self.start = start;
    }

    /// Whether all corners of a triangle have its own normal, and twins are merged.
    #[inline]
    pub(super) fn is_flat(&self, triangle: [u32; 3]) -> bool {
        self.merges_twins && self.vertices.are_flat(triangle)
    }

    /// The number of a vertex of a triangle, which may be flat.
    #[inline]
    pub(super) fn number(&mut self, vertex: u32, is_flat: bool) -> u32 {
        let key = if self.merges_twins { self.vertices.place(vertex) } else { vertex.into() };
        // Fibonacci hashing: Knuth, "The Art of Computer Programming", volume 3, 6.4.
        let hash = key.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> (u64::BITS - HASH_BITS);
        let ways = &mut self.recent[hash as usize];

        // The vertex itself. Its way is chosen without branches, which are hard to predict.
        let mut way = WAYS;
        for (n, recent) in ways.iter().enumerate() {
            way = if recent.vertex == vertex && recent.count > self.start { n } else { way };
        }
        if let Some(recent) = ways.get_mut(way) {
            recent.is_of_flat &= is_flat;
            return recent.count - 1;
        }

        // A twin.
        let is_near_twin =
            |recent: &&mut Recent| recent.count > self.start && self.vertices.are_twins(recent.vertex, vertex);
        for recent in ways.iter_mut().filter(|_| self.merges_twins).filter(is_near_twin) {
            if !is_flat && recent.is_of_flat {
                self.kept[recent.count as usize - 1] = vertex;
                (recent.vertex, recent.is_of_flat) = (vertex, false);
            }
            if is_flat || self.vertices.have_same_normal(recent.vertex, vertex) {
                return recent.count - 1;
            }
        }

        self.kept.push(vertex);
        let count = self.kept.len() as u32;
        let oldest = ways.iter_mut().min_by_key(|recent| recent.count).expect("there are several ways");
        *oldest = Recent { vertex, count, is_of_flat: is_flat };
        count - 1
    }

    /// The vertices so far, in the order of their numbers.
    pub(super) fn kept(&self) -> &[u32] {
        &self.kept
    }

    pub(super) fn into_kept(mut self) -> Vec<u32> {
        self.kept.shrink_to_fit();
        self.kept
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn flat_triangles_share_the_vertices_of_smooth_ones_in_any_order() {
        let positions = [[1.0, 2.0, 3.0]; 4];
        let [up, across] = [Vec3::Z, Vec3::X].map(Normal::new);
        let normals = [Normal::OF_TRIANGLE, up, across, Normal::OF_TRIANGLE];
        let vertices = Vertices { positions: &positions, normals: &normals, colors: &[], coordinates: &[] };
        let kept = |named: &[(u32, bool)]| {
            let mut numbering = Numbering::new(&vertices, true, 2);
            let numbers: Vec<u32> = named.iter().map(|&(vertex, is_flat)| numbering.number(vertex, is_flat)).collect();
            (numbers, numbering.into_kept())
        };
        assert_eq!(kept(&[(0, true), (1, false), (3, true)]), (vec![0, 0, 0], vec![1]));
        assert_eq!(kept(&[(1, false), (0, true), (2, false), (3, true)]), (vec![0, 0, 1, 0], vec![1, 2]));
        // A corner without a normal of its own in a triangle that is not flat.
        assert_eq!(kept(&[(0, true), (3, false), (1, false)]), (vec![0, 0, 1], vec![3, 1]));
        assert_eq!(kept(&[(0, false), (0, true), (3, false)]), (vec![0, 0, 0], vec![0]));
    }

    proptest! {
        #[test]
        fn a_corner_keeps_all_but_the_normals_of_flat_triangles(
            looks in prop::collection::vec((0..9u8, 0..3u8, 0..2u8, 0..2u8), 1..200),
            named in prop::collection::vec((0..200usize, any::<bool>()), 1..600),
            window in 1..200usize,
            merges_twins in any::<bool>(),
        ) {
            let positions: Vec<_> = looks.iter().map(|&(place, ..)| [f32::from(place), 1.0, 2.0]).collect();
            let normals: Vec<_> = looks.iter().map(|&(_, n, ..)| Normal::new(Vec3::X * f32::from(n) + Vec3::Y)).collect();
            let colors: Vec<_> = looks.iter().map(|&(_, _, color, _)| [color; 3]).collect();
            let coordinates: Vec<_> = looks.iter().map(|&(.., at)| [0.0, f32::from(at)]).collect();
            let vertices =
                Vertices { positions: &positions, normals: &normals, colors: &colors, coordinates: &coordinates };
            let mut numbering = Numbering::new(&vertices, merges_twins, 200);
            let mut numbers = Vec::new();
            for (idx, &(vertex, is_flat)) in named.iter().enumerate() {
                if idx % window == 0 {
                    numbering.begin_window(numbering.kept().len().saturating_sub(50) as u32);
                }
                let vertex = (vertex % looks.len()) as u32;
                let number = numbering.number(vertex, is_flat);
                prop_assert!(number >= numbering.start);
                numbers.push((number, vertex, is_flat));
            }
            let kept = numbering.into_kept();
            for (number, vertex, is_flat) in numbers {
                let [(place, normal, color, at), kept] = [vertex, kept[number as usize]].map(|it| looks[it as usize]);
                prop_assert_eq!((place, color, at), (kept.0, kept.2, kept.3));
                prop_assert!(is_flat || normal == kept.1);
            }
        }
    }
}
