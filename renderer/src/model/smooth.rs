//! Smooth normals for meshes without normals of their own.
//!
//! Triangles that meet in a point belong to one surface there if their normals differ by at most the crease angle, or if
//! others between them do. The surface's normal is the mean of theirs, weighted by their angles in the point: it does not
//! depend on how the surface is cut into triangles (Thürmer and Wüthrich, "Computing Vertex Normals from Polygonal Facets",
//! 1998). A vertex that lies on several surfaces is split into one for each, unless all of them are flat.
//!
//! Only + − × ÷ √ are used, and each point's triangles are taken in file order: every machine, with any number of threads,
//! computes the same bits.

use std::{
    ops::Range,
    sync::atomic::{AtomicU32, Ordering::Relaxed},
};

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use shared::scene::Crease;

use crate::model::{mesh::Mesh, normal::Normal};

/// Triangles around one point beyond which each keeps its own normal: all pairs of them are compared.
const MOST_AROUND_POINT: usize = 256;

/// The cosine of 0.1 degrees. A surface whose triangles are all as near to its normal as this is flat: shades of light that
/// differ less are the same in eight bits.
const FLAT: f64 = 1.0 - 1.5e-6;

/// Points that one thread handles at a time.
const CHUNK: usize = 1 << 12;

/// The corners of all points take as much memory as the triangles, so large meshes are done in passes over the triangles:
/// at most so many, and none of fewer points than this, a multiple of [`CHUNK`].
const MOST_PASSES: usize = 8;
const FEWEST_OF_PASS: usize = 1 << 20;

impl Mesh {
    /// Gives normals to a mesh without any, unless all its surfaces are flat; takes all normals away if the crease is.
    ///
    /// May append vertices, in the place of others in triangles; positions stay the same, so hits do, too.
    #[must_use]
    pub fn smooth(mut self, crease: Crease) -> Self {
        if crease == Crease::FLAT {
            self.normals = Vec::new();
        } else if self.normals.is_empty() && u32::try_from(3 * self.triangles.len()).is_ok() {
            let normals: Vec<AtomicU32> = self.vertices.par_iter().map(|_| bits(Normal::OF_TRIANGLE).into()).collect();
            let n_of_pass = self.vertices.len().div_ceil(MOST_PASSES).next_multiple_of(CHUNK).max(FEWEST_OF_PASS);
            let splits = self.splits(&Limits::new(crease), &normals, n_of_pass);
            let is_smooth = |normal: &AtomicU32| normal.load(Relaxed) != bits(Normal::OF_TRIANGLE);
            if !splits.iter().all(|part| part.copies.is_empty()) || normals.par_iter().any(is_smooth) {
                self.normals = normals.into_iter().map(|normal| bytemuck::cast(normal.into_inner())).collect();
                self.split(&splits);
            }
        }
        self
    }

    /// Computes the normals of all vertices, and the vertices that need several, in passes of `n_of_pass` points, which is a
    /// multiple of [`CHUNK`].
    fn splits(&self, limits: &Limits, normals: &[AtomicU32], n_of_pass: usize) -> Vec<Splits> {
        let (points, n_points) = (points(self), self.vertices.len());
        let of_pass = |first: usize| {
            let corners = Corners::new(self, points.as_deref(), first..n_points.min(first + n_of_pass));
            corners.splits(self, limits, normals)
        };
        (0..n_points).step_by(n_of_pass).flat_map(of_pass).collect()
    }

    fn split(&mut self, splits: &[Splits]) {
        let n_copies = splits.iter().map(|part| part.copies.len()).sum();
        if u32::try_from(self.vertices.len() + n_copies).is_err() {
            return;
        }
        self.vertices.reserve_exact(n_copies);
        self.normals.reserve_exact(n_copies);
        for Splits { copies, corners } in splits {
            let first = self.vertices.len() as u32;
            for &(corner, copy) in corners {
                self.triangles.as_flattened_mut()[corner as usize] = first + copy;
            }
            for &(vertex, normal) in copies {
                let vertex = vertex as usize;
                self.vertices.push(self.vertices[vertex]);
                self.normals.push(normal);
                self.colors.extend(self.colors.get(vertex).copied());
                self.texture_coordinates.extend(self.texture_coordinates.get(vertex).copied());
            }
        }
    }
}

fn bits(normal: Normal) -> u32 {
    bytemuck::cast(normal)
}

/// Cosines that decide which triangles are one surface.
struct Limits {
    crease: f64,
    half_crease: f64,
}

impl Limits {
    fn new(crease: Crease) -> Self {
        // The cosine's series for at most a right angle: the first term left out is below the last bit.
        let x = f64::from(crease.degrees()) * (std::f64::consts::PI / 360.0);
        let (mut half_crease, mut term) = (1.0, 1.0);
        for n in 1..=12 {
            term *= -x * x / f64::from((2 * n - 1) * (2 * n));
            half_crease += term;
        }
        Self { crease: 2.0 * half_crease * half_crease - 1.0, half_crease }
    }
}

/// The corners of triangles in each of some points; a corner's number is three times its triangle's, and 0, 1 or 2.
struct Corners {
    /// Ends of the points' parts of `corners`; a point has the number of its first vertex.
    ends: Vec<AtomicU32>,
    /// In any order within a point.
    corners: Vec<AtomicU32>,
}

/// Vertices to split.
#[derive(Default)]
struct Splits {
    /// Vertices to copy, and the copies' normals.
    copies: Vec<(u32, Normal)>,
    /// Corners that take a copy, by its place in `copies`.
    corners: Vec<(u32, u32)>,
}

impl Corners {
    /// Of the points in a range; `points` are the points of vertices, where some share one.
    fn new(mesh: &Mesh, points: Option<&[u32]>, range: Range<usize>) -> Self {
        let point = |vertex: u32| points.map_or(vertex, |points| points[vertex as usize]) as usize;
        let triangles = || mesh.triangles.par_iter().enumerate().filter(|(_, triangle)| **triangle != Mesh::REJECTED);

        // Count the corners in each point, then place each at the end of its point's part, which moves.
        let ends: Vec<AtomicU32> = range.clone().into_par_iter().map(|_| AtomicU32::new(0)).collect();
        let end = |vertex: u32| ends.get(point(vertex).wrapping_sub(range.start));
        triangles().for_each(|(_, triangle)| {
            triangle.iter().filter_map(|&vertex| end(vertex)).for_each(|end| _ = end.fetch_add(1, Relaxed));
        });
        let mut n_corners = 0;
        for end in &ends {
            n_corners += end.swap(n_corners, Relaxed);
        }
        let corners: Vec<AtomicU32> = (0..n_corners).into_par_iter().map(|_| AtomicU32::new(0)).collect();
        triangles().for_each(|(index, triangle)| {
            for (corner, &vertex) in (3 * index as u32..).zip(triangle) {
                if let Some(end) = end(vertex) {
                    corners[end.fetch_add(1, Relaxed) as usize].store(corner, Relaxed);
                }
            }
        });
        Self { ends, corners }
    }

    /// Computes the normals of the vertices in these points, and the vertices that need several.
    fn splits(&self, mesh: &Mesh, limits: &Limits, normals: &[AtomicU32]) -> Vec<Splits> {
        let of_chunk = |(chunk, ends): (usize, &[AtomicU32])| {
            let mut start = chunk.checked_sub(1).map_or(0, |last| self.ends[last * CHUNK + CHUNK - 1].load(Relaxed));
            let (mut splits, mut fan) = (Splits::default(), Fan::default());
            for end in ends {
                let end = end.load(Relaxed);
                fan.gather(mesh, &self.corners[start as usize..end as usize]);
                fan.find_surfaces(limits);
                fan.assign(normals, &mut splits);
                start = end;
            }
            splits
        };
        self.ends.par_chunks(CHUNK).enumerate().map(of_chunk).collect()
    }
}

/// The first vertex with each vertex's position; `None` if all positions differ.
fn points(mesh: &Mesh) -> Option<Vec<u32>> {
    // Adding 0 makes −0 equal to 0.
    let position = |vertex: u32| mesh.vertices[vertex as usize].map(|x| (x + 0.0).to_bits());
    let hash = |vertex: u32| {
        let [x, y, z] = position(vertex).map(u64::from);
        let bits = (x | y << 32).wrapping_mul(0xd6e8_feb8_6659_fd93) ^ z.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        (bits ^ bits >> 32).wrapping_mul(0xd6e8_feb8_6659_fd93) >> 32
    };
    // Neighbours in this order have equal hashes; those of equal positions are sorted by position, then by number.
    let n_vertices = mesh.vertices.len() as u32;
    let mut keys: Vec<u64> =
        (0..n_vertices).into_par_iter().map(|vertex| hash(vertex) << 32 | u64::from(vertex)).collect();
    keys.par_sort_unstable();
    let mut points = None;
    for run in keys.chunk_by_mut(|a, b| a >> 32 == b >> 32).filter(|run| run.len() > 1) {
        run.sort_unstable_by_key(|&key| (position(key as u32), key));
        for same in run.chunk_by(|&a, &b| position(a as u32) == position(b as u32)).filter(|same| same.len() > 1) {
            let points: &mut Vec<u32> = points.get_or_insert_with(|| (0..n_vertices).collect());
            same.iter().for_each(|&vertex| points[vertex as u32 as usize] = same[0] as u32);
        }
    }
    points
}

/// The triangles with an area around one point, in file order.
#[derive(Default)]
struct Fan {
    corners: Vec<FanCorner>,
    /// The normals of the surfaces.
    normals: Vec<Normal>,
}

struct FanCorner {
    number: u32,
    vertex: u32,
    /// Unit length.
    normal: DVec3,
    /// In radians.
    angle: f64,
    surface: usize,
}

impl Fan {
    fn gather(&mut self, mesh: &Mesh, numbers: &[AtomicU32]) {
        let numbers = numbers.iter().map(|number| number.load(Relaxed));
        self.corners.clear();
        self.corners.extend(numbers.filter_map(|number| FanCorner::new(mesh, number)));
        self.corners.sort_unstable_by_key(|corner| corner.number);
    }

    /// Groups the corners into surfaces, and computes these surfaces' normals.
    fn find_surfaces(&mut self, limits: &Limits) {
        self.normals.clear();
        if self.corners.len() > MOST_AROUND_POINT {
            self.normals.push(Normal::OF_TRIANGLE);
            return;
        }
        // Mostly all are one.
        let (normal, least_cosine) = self.mean(0);
        if least_cosine >= limits.half_crease {
            self.normals.push(shading_normal(normal, least_cosine));
            return;
        }
        (0..self.corners.len()).for_each(|index| self.corners[index].surface = index);
        for (index, other) in (0..self.corners.len()).flat_map(|index| (0..index).map(move |other| (index, other))) {
            let [a, b] = [&self.corners[index], &self.corners[other]];
            if a.surface != b.surface && a.normal.dot(b.normal) >= limits.crease {
                let (from, to) = (a.surface, b.surface);
                self.corners.iter_mut().filter(|corner| corner.surface == from).for_each(|corner| corner.surface = to);
            }
        }
        for surface in 0..self.corners.len() {
            let (normal, least_cosine) = self.mean(surface);
            self.normals.push(shading_normal(normal, least_cosine));
        }
    }

    /// The normal of a surface, and the cosine of its largest angle with a triangle's; undefined without triangles.
    fn mean(&self, surface: usize) -> (DVec3, f64) {
        let corners = || self.corners.iter().filter(|corner| corner.surface == surface);
        let sum = corners().fold(DVec3::ZERO, |sum, corner| sum + corner.normal * corner.angle);
        let normal = sum * (1.0 / sum.length());
        (
            normal,
            corners().fold(
                1.0,
                |least, corner| if normal.dot(corner.normal) >= least { least } else { normal.dot(corner.normal) },
            ),
        )
    }

    /// Gives each vertex the normal of its first corner, and splits those whose other corners have another.
    fn assign(&self, normals: &[AtomicU32], splits: &mut Splits) {
        let first_copy = splits.copies.len();
        for corner in &self.corners {
            let normal = self.normals[corner.surface];
            let own = &normals[corner.vertex as usize];
            let is_first = || {
                self.corners
                    .iter()
                    .find(|other| other.vertex == corner.vertex)
                    .is_some_and(|first| first.number == corner.number)
            };
            if own.load(Relaxed) == bits(normal) {
                continue;
            }
            if is_first() {
                own.store(bits(normal), Relaxed);
                continue;
            }
            let copy = (corner.vertex, normal);
            let known = splits.copies[first_copy..].iter().position(|&known| known == copy);
            let place = known.map_or(splits.copies.len(), |known| first_copy + known);
            if known.is_none() {
                splits.copies.push(copy);
            }
            splits.corners.push((corner.number, place as u32));
        }
    }
}

/// A surface's normal in four bytes, if its triangles do not have the same.
fn shading_normal(normal: DVec3, least_cosine: f64) -> Normal {
    if least_cosine >= FLAT { Normal::OF_TRIANGLE } else { Normal::new(normal.as_vec3()) }
}

impl FanCorner {
    /// `None` for a triangle without area.
    fn new(mesh: &Mesh, number: u32) -> Option<Self> {
        let (triangle, corner) = (mesh.triangles[number as usize / 3], number as usize % 3);
        let [vertex, next, last] = [0, 1, 2].map(|step| triangle[(corner + step) % 3]);
        let position = |vertex: u32| Vec3::from_array(mesh.vertices[vertex as usize]).as_dvec3();
        let (to_next, to_last) = (position(next) - position(vertex), position(last) - position(vertex));
        let cross = to_next.cross(to_last);
        let area = cross.length();
        let normal = cross * (1.0 / area);
        (area > 0.0 && normal.is_finite()).then(|| Self {
            number,
            vertex,
            normal,
            angle: angle(to_next.dot(to_last), area),
            surface: 0,
        })
    }
}

/// The angle of a vector whose second coordinate is positive with the first axis, within 1e-5 radians: Abramowitz and
/// Stegun, "Handbook of Mathematical Functions" (1964), 4.4.49.
fn angle(x: f64, y: f64) -> f64 {
    use std::f64::consts::{FRAC_PI_2, PI};
    let (small, large) = if x.abs() < y { (x.abs(), y) } else { (y, x.abs()) };
    let slope = small / large;
    let square = slope * slope;
    let arc = slope
        * (0.999_866_0
            + square * (-0.330_299_5 + square * (0.180_141_0 + square * (-0.085_133_0 + square * 0.020_835_1))));
    let acute = if x.abs() < y { FRAC_PI_2 - arc } else { arc };
    if x < 0.0 { PI - acute } else { acute }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::statue;

    fn crease(degrees: u8) -> Crease {
        Crease::try_from(degrees).unwrap()
    }

    /// A ball of radius 1 without its poles, in rings of triangles that face out.
    fn ball(n_rings: u32, n_columns: u32) -> Mesh {
        let mut mesh = Mesh::default();
        for (row, column) in (0..=n_rings).flat_map(|row| (0..n_columns).map(move |column| (row, column))) {
            let (sin, cos) = (0.2 + 2.7 * row as f32 / n_rings as f32).sin_cos();
            let (sin_around, cos_around) = (std::f32::consts::TAU * column as f32 / n_columns as f32).sin_cos();
            mesh.vertices.push([sin * cos_around, cos, sin * sin_around]);
            let [a, b] = [column, (column + 1) % n_columns].map(|column| row * n_columns + column);
            if row < n_rings {
                mesh.triangles.extend([[a, b, a + n_columns], [b, b + n_columns, a + n_columns]]);
            }
        }
        mesh
    }

    /// The same surface as files without shared vertices have it.
    fn unshared(mesh: &Mesh) -> Mesh {
        let corners = mesh.triangles.as_flattened().iter();
        Mesh {
            vertices: corners.map(|&vertex| mesh.vertices[vertex as usize]).collect(),
            triangles: (0..mesh.triangles.len() as u32).map(|n| [3 * n, 3 * n + 1, 3 * n + 2]).collect(),
            ..Mesh::default()
        }
    }

    /// A cube; each side has two triangles.
    fn cube() -> Mesh {
        let vertices = (0..8u8).map(|n| [n & 1, n >> 1 & 1, n >> 2].map(f32::from)).collect();
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let triangles = quads.into_iter().flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        Mesh { vertices, triangles, ..Mesh::default() }
    }

    fn corner_normals(mesh: &Mesh) -> Vec<Option<Vec3>> {
        let normal = |&vertex: &u32| mesh.normals[vertex as usize].vector();
        mesh.triangles.as_flattened().iter().map(normal).collect()
    }

    #[test]
    fn normals_of_a_ball_point_away_from_its_centre() {
        for mesh in [ball(40, 80), unshared(&ball(40, 80))] {
            let n_vertices = mesh.vertices.len();
            let smooth = mesh.smooth(crease(30));
            assert_eq!((smooth.vertices.len(), smooth.normals.len()), (n_vertices, n_vertices));
            for (vertex, normal) in smooth.vertices.iter().zip(&smooth.normals) {
                let cosine = normal.vector().unwrap().dot(Vec3::from_array(*vertex));
                assert!(cosine > if vertex[1].abs() > 0.9 { 0.998 } else { 0.9999 }, "{vertex:?}: {cosine}");
            }
        }
    }

    #[test]
    fn passes_change_no_bit() {
        // Without shared vertices, a vertex and its point are often done in different passes.
        for mesh in [statue::generate(60_000, &|_| ()), unshared(&ball(60, 90))] {
            let of_passes = |n_of_pass: usize| {
                let normals: Vec<AtomicU32> = mesh.vertices.iter().map(|_| AtomicU32::new(0)).collect();
                let mut passed = mesh.clone();
                passed.normals = vec![Normal::OF_TRIANGLE; mesh.vertices.len()];
                passed.split(&mesh.splits(&Limits::new(crease(20)), &normals, n_of_pass));
                (passed, normals.into_iter().map(AtomicU32::into_inner).collect::<Vec<_>>())
            };
            let n_chunks = mesh.vertices.len().div_ceil(CHUNK);
            assert!(n_chunks > 3, "{n_chunks}");
            let whole = of_passes(n_chunks * CHUNK);
            assert!(whole.0.vertices.len() > mesh.vertices.len() || whole.1.iter().any(|&normal| normal != 0));
            for n_of_pass in [CHUNK, 2 * CHUNK] {
                assert!(of_passes(n_of_pass) == whole);
            }
        }
    }

    #[test]
    fn flat_sides_need_no_normals_and_no_more_vertices() {
        for mesh in [cube(), unshared(&cube()), Mesh::default()] {
            assert_eq!(mesh.clone().smooth(crease(40)), mesh);
        }
        // Beyond right angles a cube is round: each corner's normal is its diagonal, however its sides are cut.
        let round = cube().smooth(crease(91));
        assert_eq!(round.vertices.len(), 8);
        for (vertex, normal) in round.vertices.iter().zip(&round.normals) {
            let diagonal = (Vec3::from_array(*vertex) - 0.5).normalize();
            assert!(normal.vector().unwrap().dot(diagonal) > 1.0 - 1e-6, "{vertex:?}");
        }
    }

    #[test]
    fn the_rim_of_a_cylinder_is_split_and_its_lid_is_flat() {
        let n = 24;
        let point = |k: u32, y: f32| {
            let (sin, cos) = (std::f32::consts::TAU * k as f32 / n as f32).sin_cos();
            [cos, y, sin]
        };
        let mut mesh =
            Mesh { vertices: (0..n).flat_map(|k| [point(k, 0.0), point(k, 1.0)]).collect(), ..Mesh::default() };
        for k in 0..n {
            let [a, b, c, d] = [2 * k, 2 * k + 1, 2 * ((k + 1) % n), 2 * ((k + 1) % n) + 1];
            mesh.triangles.extend([[a, b, c], [c, b, d], [1, d, b]]);
        }
        mesh.colors = (0..2 * n as u8).map(|n| [n; 3]).collect();
        let smooth = mesh.clone().smooth(crease(40));
        assert_eq!(smooth.vertices.len(), 3 * n as usize);
        for (corner, normal) in corner_normals(&smooth).into_iter().enumerate() {
            let vertex = smooth.triangles.as_flattened()[corner] as usize;
            let original = mesh.triangles.as_flattened()[corner] as usize;
            assert_eq!(
                (smooth.vertices[vertex], smooth.colors[vertex]),
                (mesh.vertices[original], mesh.colors[original])
            );
            let is_lid =
                corner / 3 % 3 == 2 && mesh.triangles[corner / 3][1] != 1 && mesh.triangles[corner / 3][2] != 1;
            if is_lid {
                assert_eq!(normal, None, "{corner}");
            } else if let Some(normal) = normal {
                let [x, _, z] = smooth.vertices[vertex];
                assert!(normal.dot(Vec3::new(x, 0.0, z)) > 0.9999, "{corner}: {normal}");
            }
        }
        assert_eq!(mesh.clone().smooth(crease(10)), mesh, "sides 15 degrees apart are facets");
    }

    #[test]
    fn any_number_of_threads_computes_the_same_bits() {
        let smooth = |n_threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().unwrap();
            pool.install(|| statue::generate(40_000, &|_| ()).smooth(crease(20)))
        };
        let mesh = smooth(1);
        assert!(mesh.vertices.len() > statue::generate(40_000, &|_| ()).vertices.len(), "some vertices are split");
        assert_eq!(mesh, smooth(3));
    }

    #[test]
    fn normals_of_the_file_stay_unless_everything_is_flat() {
        let normals = vec![Normal::new(Vec3::new(1.0, 2.0, 3.0)); 8];
        let mesh = Mesh { normals: normals.clone(), ..cube() };
        assert_eq!(mesh.clone().smooth(crease(40)).normals, normals);
        assert!(mesh.smooth(Crease::FLAT).normals.is_empty());
    }

    #[test]
    fn triangles_without_area_or_corners_change_nothing() {
        let mut mesh = ball(10, 20);
        let smooth = mesh.clone().smooth(crease(40));
        mesh.triangles.extend([[1, 1, 2], [7; 3], Mesh::REJECTED]);
        mesh.vertices.push([f32::NAN; 3]);
        let others = mesh.smooth(crease(40));
        assert_eq!(
            (&others.normals[..smooth.normals.len()], others.vertices.len()),
            (&*smooth.normals, smooth.vertices.len() + 1)
        );
    }

    #[test]
    fn a_point_of_very_many_triangles_is_flat() {
        let n = 20_000;
        let rim = (0..n).map(|k| [(k as f32 * 0.1).cos(), 1.0, (k as f32 * 0.1).sin()]);
        let vertices = std::iter::once([0.0; 3]).chain(rim).collect();
        let mesh = Mesh { vertices, triangles: (1..n).map(|k| [0, k, k + 1]).collect(), ..Mesh::default() };
        let smooth = mesh.smooth(crease(40));
        assert_eq!(smooth.normals[0], Normal::OF_TRIANGLE);
        assert_ne!(smooth.normals[7], Normal::OF_TRIANGLE);
    }

    #[test]
    fn angles_and_their_limits_are_those_of_the_plane() {
        for degrees in 1..=180u8 {
            let radians = f64::from(degrees).to_radians();
            let Limits { crease, half_crease } = Limits::new(Crease::try_from(degrees).unwrap());
            assert!((crease - radians.cos()).abs() < 1e-14 && (half_crease - (radians / 2.0).cos()).abs() < 1e-14);
            let error = angle(7e-20 * radians.cos(), 7e-20 * radians.sin()) - radians;
            assert!(error.abs() < 2e-5, "{degrees}: {error}");
        }
    }
}
