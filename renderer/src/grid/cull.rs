//! From the triangles in a packet's way to its hits: gathers triangles, culls them many at a time, lets
//! [`crate::triangle`] decide the rest.
//!
//! Everything here may only drop pairs of ray and triangle that certainly miss, with rounding accounted for.
//! There are no closures over vectors: they would not be compiled for the caller's instruction set.

use glam::Vec3;

use super::{
    Grid,
    boxes::{Bounds, LeafBoxes},
    packet::{Leaf, Packet},
};
#[cfg(target_arch = "x86_64")]
use crate::simd::{Avx2, Avx512};
use crate::{
    ray::{Hit, Ray},
    simd::{Plain, Real, Simd},
    traced::TracedMesh,
    triangle,
};

/// What single precision can lose, relative: four roundings of 2⁻²⁴ in a slope, with as much again to spare.
const SLOPE_MARGIN: f32 = 1.0 / (1u32 << 20) as f32;

/// The same for the sides of edges, relative to the sum of absolute products: eight roundings, doubled.
pub(super) const SIDE_MARGIN: f32 = 1.0 / (1u32 << 20) as f32;

/// More than the absolute error where products leave the range of normal numbers.
pub(super) const UNDERFLOW_MARGIN: f32 = 1e-36;

/// From so many triangles for each ray on, a leaf's boxes are tested against its rays one by one: in a scan seen from
/// afar most triangles lie between the rays.
const MANY_TRIANGLES_PER_RAY: usize = 5;

/// Triangles remembered as already tested, a power of two.
const N_RECENT: usize = 256;

/// Triangles that can wait for their test, a power of two.
const N_WAITING: usize = 256;

/// The bounds of a group of rays: as many as a vector has lanes.
#[derive(Clone, Copy, Default)]
struct Group {
    u: [f32; 2],
    v: [f32; 2],
    /// The farthest of its rays' limits.
    limit: f32,
}

/// A packet on its way, with the nearest hits so far.
pub(super) struct Culler<'a> {
    mesh: &'a TracedMesh,
    /// Coordinates of all vertices.
    coordinates: &'a [f32],
    packet: &'a Packet,
    /// The major axis and the two others.
    pub(super) axes: [usize; 3],
    /// The sign of all directions along the major axis.
    pub(super) sign: f32,
    /// Finest cells in a world unit, rounded up.
    cells_per_unit: f32,
    /// Slopes of the rays against the major axis.
    u: [f32; 64],
    v: [f32; 64],
    /// Depth along the major axis beyond which a triangle cannot matter to a ray any more, in world units.
    limits: [f32; 64],
    /// The largest absolute components of all directions.
    reach: [f32; 3],
    groups: [Group; 8],
    /// Bounds of the slopes of all rays without a final answer: least and largest u, least and largest v.
    pub(super) slopes: [f32; 4],
    /// The farthest limit of all rays without a final answer, in finest cells.
    farthest: f32,
    /// A bit for each group that has rays without a final answer.
    live: u32,
    nearest_t: [f64; 64],
    nearest_triangle: [u32; 64],
    /// Triangles that wait until a vector is full.
    waiting: [u32; N_WAITING],
    n_waiting: usize,
    recent: [u32; N_RECENT],
    /// Pairs that wait for a decision: ray and triangle.
    candidates: [(u8, u32); 8],
    n_candidates: usize,
    /// Whether triangles were met since [`Culler::settle`].
    pub(super) touched: bool,
}

/// Triangles made ready for the rays, one in each lane.
#[repr(align(64))]
struct Prepared {
    /// Their places in the mesh.
    places: [u32; 16],
    /// Normals of the planes through the origin and the three edges.
    normals: [[[f32; 16]; 3]; 3],
    side_margin: [f32; 16],
    /// Bounds of the slopes.
    u: [[f32; 16]; 2],
    v: [[f32; 16]; 2],
    /// The least depth along the major axis.
    depth: [f32; 16],
}

impl<'a> Culler<'a> {
    /// Takes a packet whose active rays all have the sign `sign` along `axes[0]`, and duplicates in the other entries.
    #[inline(always)]
    pub(super) fn new<S: Simd>(grid: &'a Grid, packet: &'a Packet, axes: [usize; 3], sign: f32) -> Self {
        let mesh = &grid.mesh;
        let mut culler = Self {
            mesh,
            cells_per_unit: (grid.space.cells_per_unit() * (1.0 + 1e-6)) as f32,
            coordinates: mesh.coordinates(),
            packet,
            axes,
            sign,
            u: [0.0; 64],
            v: [0.0; 64],
            limits: [f32::INFINITY; 64],
            reach: [0.0; 3],
            groups: [Group::default(); 8],
            slopes: [0.0; 4],
            farthest: f32::INFINITY,
            live: 0,
            nearest_t: [f64::INFINITY; 64],
            nearest_triangle: [u32::MAX; 64],
            waiting: [0; N_WAITING],
            n_waiting: 0,
            recent: [u32::MAX; N_RECENT],
            candidates: [(0, 0); 8],
            n_candidates: 0,
            touched: false,
        };
        let directions = &packet.directions;
        for group in 0..64 / S::LANES {
            let first = group * S::LANES;
            let depth = S::load(&directions[axes[0]][first..]).abs();
            let u = S::load(&directions[axes[1]][first..]).div(depth);
            let v = S::load(&directions[axes[2]][first..]).div(depth);
            u.store(&mut culler.u[first..]);
            v.store(&mut culler.v[first..]);
            let limits = depth.mul(S::splat(packet.t_max * (1.0 + 1e-6)));
            limits.store(&mut culler.limits[first..]);
            culler.groups[group] =
                Group { u: [u.least(), u.greatest()], v: [v.least(), v.greatest()], limit: limits.greatest() };
            for axis in 0..3 {
                let reach = S::load(&directions[axis][first..]).abs().greatest();
                culler.reach[axis] = culler.reach[axis].max(reach);
            }
            let any = packet.active >> first & ((1 << S::LANES) - 1) != 0;
            culler.live |= u32::from(any) << group;
        }
        let mut inactive = !packet.active;
        while inactive != 0 {
            culler.limits[inactive.trailing_zeros() as usize] = f32::NEG_INFINITY;
            inactive &= inactive - 1;
        }
        culler.find_slopes::<S>();
        culler
    }

    /// Finds the bounds of the slopes of all rays without a final answer.
    #[inline(always)]
    fn find_slopes<S: Simd>(&mut self) {
        let mut bounds = [f32::INFINITY, f32::NEG_INFINITY, f32::INFINITY, f32::NEG_INFINITY];
        for group in 0..64 / S::LANES {
            if self.live >> group & 1 == 1 {
                let Group { u, v, .. } = &self.groups[group];
                bounds = [bounds[0].min(u[0]), bounds[1].max(u[1]), bounds[2].min(v[0]), bounds[3].max(v[1])];
            }
        }
        for index in [0, 2] {
            bounds[index] -= bounds[index].abs() * SLOPE_MARGIN;
            bounds[index + 1] += bounds[index + 1].abs() * SLOPE_MARGIN;
        }
        self.slopes = bounds;
    }

    /// A bit for each ray that may pass between these slopes and could still have a nearer hit beyond a depth.
    #[inline(always)]
    pub(super) fn passing<S: Simd>(&self, u: [f32; 2], v: [f32; 2], depth: f32) -> u64 {
        let (u_low, u_high) = (S::splat(u[0] - u[0].abs() * SLOPE_MARGIN), S::splat(u[1] + u[1].abs() * SLOPE_MARGIN));
        let (v_low, v_high) = (S::splat(v[0] - v[0].abs() * SLOPE_MARGIN), S::splat(v[1] + v[1].abs() * SLOPE_MARGIN));
        let depth = S::splat(depth);
        let mut rays = 0;
        for group in 0..64 / S::LANES {
            let first = group * S::LANES;
            let u = S::load(&self.u[first..]);
            let v = S::load(&self.v[first..]);
            let passing = u_low.up_to(u)
                & u.up_to(u_high)
                & v_low.up_to(v)
                & v.up_to(v_high)
                & depth.up_to(S::load(&self.limits[first..]));
            rays |= u64::from(passing) << first;
        }
        rays
    }

    /// Tests the triangles of a leaf soon that the rays may hit, unless they were tested lately.
    ///
    /// `rays` are those that may pass the leaf, or all.
    #[inline(always)]
    pub(super) fn add<S: Kernel>(&mut self, boxes: &LeafBoxes<'_>, triangles: &[u32], rays: u64) {
        let ray_by_ray = triangles.len() >= MANY_TRIANGLES_PER_RAY * rays.count_ones() as usize;
        let mut first = 0;
        while first < triangles.len() {
            let n = (triangles.len() - first).min(S::LANES);
            if self.n_waiting + n > N_WAITING {
                S::test(self);
            }
            let bounds = boxes.bounds::<S>(first);
            let mut passed = bounds.passed_by(self.slopes, self.farthest) & (u32::MAX >> (32 - n));
            if ray_by_ray && passed != 0 {
                passed &= self.passed_by_any(&bounds, rays);
            }
            let mut n_waiting = self.n_waiting;
            while passed != 0 {
                let triangle = triangles[first + passed.trailing_zeros() as usize];
                passed &= passed - 1;
                // Without a branch: whether a triangle was met before cannot be predicted.
                let recent = &mut self.recent[triangle as usize % N_RECENT];
                self.mesh.prefetch::<S>(triangle);
                self.waiting[n_waiting % N_WAITING] = triangle;
                n_waiting += usize::from(*recent != triangle);
                *recent = triangle;
            }
            self.n_waiting = n_waiting;
            first += S::LANES;
        }
    }

    /// A bit for each box that one of some rays may pass.
    #[inline(always)]
    fn passed_by_any<S: Simd>(&self, bounds: &Bounds<S>, rays: u64) -> u32 {
        let mut passed = 0;
        let mut left = rays;
        while left != 0 {
            let ray = left.trailing_zeros() as usize;
            left &= left - 1;
            let (u, v) = (self.u[ray], self.v[ray]);
            passed |= bounds.passed_by([u, u, v, v], self.limits[ray] * self.cells_per_unit);
        }
        passed
    }

    /// Ends the search up to a depth along the major axis, in world units. Returns true when no ray needs more.
    #[inline(always)]
    pub(super) fn settle<S: Kernel>(&mut self, depth: f64) -> bool {
        self.touched = false;
        if self.n_waiting > 0 {
            S::test(self);
        }
        let reached = S::splat((depth * (1.0 - 1e-6)) as f32);
        let mut farthest = f32::NEG_INFINITY;
        for group in 0..64 / S::LANES {
            if self.live >> group & 1 == 0 {
                continue;
            }
            let limits = S::load(&self.limits[group * S::LANES..]);
            let all = ((1u64 << S::LANES) - 1) as u32;
            if limits.up_to(reached) == all {
                self.live &= !(1 << group);
            } else {
                self.groups[group].limit = limits.greatest();
                farthest = farthest.max(limits.greatest());
            }
        }
        self.farthest = farthest * self.cells_per_unit;
        self.live == 0
    }

    /// The hits, when all is settled.
    #[inline(always)]
    pub(super) fn hits(&self) -> [Hit; 64] {
        let mut hits = [Hit::MISS; 64];
        for lane in 0..64 {
            if self.nearest_triangle[lane] != u32::MAX {
                hits[lane] = Hit { triangle: self.nearest_triangle[lane], t: self.nearest_t[lane] as f32 };
            }
        }
        hits
    }

    /// Tests the waiting triangles against all rays.
    #[inline(always)]
    fn test_waiting<S: Simd>(&mut self) {
        let mut prepared = Prepared {
            places: [0; 16],
            normals: [[[0.0; 16]; 3]; 3],
            side_margin: [0.0; 16],
            u: [[0.0; 16]; 2],
            v: [[0.0; 16]; 2],
            depth: [0.0; 16],
        };
        let n_waiting = self.n_waiting;
        self.n_waiting = 0;
        for &triangle in &self.waiting[..n_waiting] {
            self.mesh.prefetch_corners::<S>(triangle);
        }
        let mut first = 0;
        while first < n_waiting {
            let n = (n_waiting - first).min(S::LANES);
            for lane in 0..S::LANES {
                prepared.places[lane] = self.waiting[first + if lane < n { lane } else { 0 }];
            }
            first += n;
            let left = self.prepare::<S>(&mut prepared) & ((1 << n) - 1);
            if left == 0 {
                continue;
            }
            for group in 0..64 / S::LANES {
                if self.live >> group & 1 == 1 {
                    self.test_group::<S>(&prepared, left, group);
                }
            }
        }
        if self.n_candidates > 0 {
            self.decide::<S>();
        }
    }

    /// Gathers triangles; returns a bit for each that some ray may hit.
    #[inline(always)]
    fn prepare<S: Simd>(&self, prepared: &mut Prepared) -> u32 {
        let [k, u, v] = self.axes;
        let corners = self.mesh.corners_in_lanes::<S>(&prepared.places);
        let mut from_origin = corners;
        for corner in 0..3 {
            for axis in 0..3 {
                from_origin[corner][axis] = corners[corner][axis].sub(S::splat(self.packet.origin[axis]));
            }
        }
        let zero = S::splat(0.0);
        let [a, b, c] = &from_origin;

        // Bounds in slopes and depth.
        let sign = S::splat(self.sign);
        let depths = [a[k].mul(sign), b[k].mul(sign), c[k].mul(sign)];
        let nearest = depths[0].min(depths[1]).min(depths[2]);
        let farthest = depths[0].max(depths[1]).max(depths[2]);
        let one = S::splat(1.0);
        let inverse = [one.div(depths[0]), one.div(depths[1]), one.div(depths[2])];
        let u_bounds = slope_bounds([a[u], b[u], c[u]], inverse);
        let v_bounds = slope_bounds([a[v], b[v], c[v]], inverse);
        // Triangles that reach behind the origin have no such bounds.
        let unbounded = nearest.below(S::splat(1e-30));
        let [u_low, u_high, v_low, v_high] = self.slopes;
        let within = u_bounds[0].up_to(S::splat(u_high))
            & S::splat(u_low).up_to(u_bounds[1])
            & v_bounds[0].up_to(S::splat(v_high))
            & S::splat(v_low).up_to(v_bounds[1]);
        let left = (within | unbounded) & zero.up_to(farthest);
        if left == 0 {
            return 0;
        }
        u_bounds[0].store(&mut prepared.u[0]);
        u_bounds[1].store(&mut prepared.u[1]);
        v_bounds[0].store(&mut prepared.v[0]);
        v_bounds[1].store(&mut prepared.v[1]);
        nearest.mul(S::splat(1.0 - SLOPE_MARGIN)).store(&mut prepared.depth);
        let mut without_bounds = left & unbounded;
        while without_bounds != 0 {
            let lane = without_bounds.trailing_zeros() as usize;
            without_bounds &= without_bounds - 1;
            for bounds in [&mut prepared.u, &mut prepared.v] {
                bounds[0][lane] = f32::NEG_INFINITY;
                bounds[1][lane] = f32::INFINITY;
            }
            prepared.depth[lane] = 0.0;
        }

        // The planes through the origin and the edges: p × (q − p) for the edge from p to q.
        let mut reach_of_corners = [zero; 3];
        let mut reach_of_edges = [zero; 3];
        for edge in 0..3 {
            let (from, to) = (edge, (edge + 1) % 3);
            let mut e = [zero; 3];
            for axis in 0..3 {
                e[axis] = corners[to][axis].sub(corners[from][axis]);
                reach_of_edges[axis] = reach_of_edges[axis].max(e[axis].abs());
                reach_of_corners[axis] = reach_of_corners[axis].max(from_origin[from][axis].abs());
            }
            let p = &from_origin[from];
            p[1].mul_sub(e[2], p[2].mul(e[1])).store(&mut prepared.normals[edge][0]);
            p[2].mul_sub(e[0], p[0].mul(e[2])).store(&mut prepared.normals[edge][1]);
            p[0].mul_sub(e[1], p[1].mul(e[0])).store(&mut prepared.normals[edge][2]);
        }
        let mut products = zero;
        for axis in 0..3 {
            let (next, last) = ((axis + 1) % 3, (axis + 2) % 3);
            let minor =
                reach_of_corners[next].mul_add(reach_of_edges[last], reach_of_corners[last].mul(reach_of_edges[next]));
            products = minor.mul_add(S::splat(self.reach[axis]), products);
        }
        let underflow = UNDERFLOW_MARGIN * (1.0 + self.reach[0] + self.reach[1] + self.reach[2]);
        products.mul_add(S::splat(SIDE_MARGIN), S::splat(underflow)).store(&mut prepared.side_margin);
        left
    }

    /// Tests prepared triangles against one group of rays.
    #[inline(always)]
    fn test_group<S: Simd>(&mut self, prepared: &Prepared, triangles: u32, group: usize) {
        let bounds = self.groups[group];
        let mut left = triangles
            & S::load(&prepared.u[0]).up_to(S::splat(bounds.u[1]))
            & S::splat(bounds.u[0]).up_to(S::load(&prepared.u[1]))
            & S::load(&prepared.v[0]).up_to(S::splat(bounds.v[1]))
            & S::splat(bounds.v[0]).up_to(S::load(&prepared.v[1]))
            & S::load(&prepared.depth).up_to(S::splat(bounds.limit));
        if left == 0 {
            return;
        }
        let first = group * S::LANES;
        let limits = S::load(&self.limits[first..]);
        let directions = &self.packet.directions;
        let direction =
            [S::load(&directions[0][first..]), S::load(&directions[1][first..]), S::load(&directions[2][first..])];
        while left != 0 {
            let lane = left.trailing_zeros() as usize;
            left &= left - 1;
            let mut sides = [direction[0]; 3];
            for edge in 0..3 {
                let normal = &prepared.normals[edge];
                sides[edge] = direction[0].mul_add(
                    S::splat(normal[0][lane]),
                    direction[1].mul_add(S::splat(normal[1][lane]), direction[2].mul(S::splat(normal[2][lane]))),
                );
            }
            let margin = prepared.side_margin[lane];
            let low = sides[0].min(sides[1]).min(sides[2]);
            let high = sides[0].max(sides[1]).max(sides[2]);
            let mut rays = S::splat(prepared.depth[lane]).up_to(limits)
                & !(low.below(S::splat(-margin)) & S::splat(margin).below(high));
            while rays != 0 {
                let ray = first + rays.trailing_zeros() as usize;
                rays &= rays - 1;
                self.candidates[self.n_candidates] = (ray as u8, prepared.places[lane]);
                self.n_candidates += 1;
                if self.n_candidates == S::Double::LANES {
                    self.decide::<S>();
                }
            }
        }
    }

    /// Lets the canonical routine decide the candidates, and keeps the nearest hits.
    #[inline(always)]
    fn decide<S: Simd>(&mut self) {
        let mut directions = [[0.0; 8]; 3];
        let mut corners = [[[0.0; 8]; 3]; 3];
        for (slot, &(ray, triangle)) in self.candidates[..self.n_candidates].iter().enumerate() {
            for axis in 0..3 {
                directions[axis][slot] = self.packet.directions[axis][ray as usize];
            }
            let indices = self.mesh.indices(triangle);
            for corner in 0..3 {
                let vertex = 3 * indices[corner] as usize;
                for axis in 0..3 {
                    corners[corner][axis][slot] = self.coordinates[vertex + axis];
                }
            }
        }
        let mut vectors = [[S::Double::splat(0.0); 3]; 5];
        for axis in 0..3 {
            vectors[3][axis] = S::Double::load(&directions[axis]);
            vectors[4][axis] = S::Double::splat(f64::from(self.packet.origin[axis]));
            for corner in 0..3 {
                vectors[corner][axis] = S::Double::load(&corners[corner][axis]);
            }
        }
        let [a, b, c, direction, origin] = vectors;
        let decision = triangle::decide(origin, direction, [a, b, c]);
        let mut all_t = [0.0; 8];
        decision.t.store(&mut all_t);
        let range = f64::from(self.packet.t_min)..=f64::from(self.packet.t_max);
        let mut left = !decision.certain_miss & ((1 << self.n_candidates) - 1);
        while left != 0 {
            let slot = left.trailing_zeros() as usize;
            left &= left - 1;
            let (ray, triangle) = self.candidates[slot];
            let mut t = all_t[slot];
            if decision.uncertain >> slot & 1 == 1 {
                let direction = Vec3::new(directions[0][slot], directions[1][slot], directions[2][slot]);
                match self.decide_exactly(direction, triangle) {
                    Some(exact) => t = exact,
                    None => continue,
                }
            }
            let ray = ray as usize;
            let nearest = self.nearest_t[ray];
            if range.contains(&t)
                && (t < nearest
                    || t == nearest
                        && triangle != self.nearest_triangle[ray]
                        && self.is_before(triangle, self.nearest_triangle[ray]))
            {
                self.nearest_t[ray] = t;
                self.nearest_triangle[ray] = triangle;
                let depth = t * f64::from(self.packet.directions[self.axes[0]][ray].abs());
                let limit = (depth * (1.0 + 1e-6)) as f32;
                if self.packet.any_hit {
                    self.limits[ray] = f32::NEG_INFINITY;
                } else if limit < self.limits[ray] {
                    self.limits[ray] = limit;
                }
            }
        }
        self.n_candidates = 0;
    }

    /// Of triangles at the same t the first in the file wins.
    #[cold]
    #[inline(never)]
    fn is_before(&self, triangle: u32, other: u32) -> bool {
        self.mesh.number(triangle) < self.mesh.number(other)
    }

    #[cold]
    #[inline(never)]
    fn decide_exactly(&self, direction: Vec3, triangle: u32) -> Option<f64> {
        triangle::intersect_exactly(&Ray::new(self.packet.origin, direction), &self.mesh.corners(triangle))
    }
}

/// Bounds of three corners' slopes, from their places along an axis and their inverse depths.
#[inline(always)]
fn slope_bounds<S: Simd>(places: [S; 3], inverse_depths: [S; 3]) -> [S; 2] {
    let slopes = [places[0].mul(inverse_depths[0]), places[1].mul(inverse_depths[1]), places[2].mul(inverse_depths[2])];
    let low = slopes[0].min(slopes[1]).min(slopes[2]);
    let high = slopes[0].max(slopes[1]).max(slopes[2]);
    let margin = low.abs().max(high.abs()).mul_add(S::splat(SLOPE_MARGIN), S::splat(UNDERFLOW_MARGIN));
    [low.sub(margin), high.add(margin)]
}

/// An instruction set with the test compiled for it, once, whoever calls it.
pub(super) trait Kernel: Simd {
    /// [`Culler::test_waiting`].
    fn test(culler: &mut Culler<'_>);
    /// [`Grid::test_leaves`].
    fn test_leaves(grid: &Grid, culler: &mut Culler<'_>, origin: &[f64; 3], leaves: &mut Vec<Leaf>);
}

impl Kernel for Plain {
    fn test(culler: &mut Culler<'_>) {
        culler.test_waiting::<Self>();
    }

    fn test_leaves(grid: &Grid, culler: &mut Culler<'_>, origin: &[f64; 3], leaves: &mut Vec<Leaf>) {
        grid.test_leaves::<Self>(culler, origin, leaves);
    }
}

#[cfg(target_arch = "x86_64")]
impl Kernel for Avx2 {
    #[inline(always)]
    fn test(culler: &mut Culler<'_>) {
        #[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
        fn test(culler: &mut Culler<'_>) {
            culler.test_waiting::<Avx2>();
        }
        // SAFETY: this type is used only where the instructions were found.
        unsafe { test(culler) }
    }

    #[inline(always)]
    fn test_leaves(grid: &Grid, culler: &mut Culler<'_>, origin: &[f64; 3], leaves: &mut Vec<Leaf>) {
        #[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
        fn test_leaves(grid: &Grid, culler: &mut Culler<'_>, origin: &[f64; 3], leaves: &mut Vec<Leaf>) {
            grid.test_leaves::<Avx2>(culler, origin, leaves);
        }
        // SAFETY: as above.
        unsafe { test_leaves(grid, culler, origin, leaves) }
    }
}

#[cfg(target_arch = "x86_64")]
impl Kernel for Avx512 {
    #[inline(always)]
    fn test(culler: &mut Culler<'_>) {
        #[target_feature(enable = "avx512f,avx512dq,avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
        fn test(culler: &mut Culler<'_>) {
            culler.test_waiting::<Avx512>();
        }
        // SAFETY: this type is used only where the instructions were found.
        unsafe { test(culler) }
    }

    #[inline(always)]
    fn test_leaves(grid: &Grid, culler: &mut Culler<'_>, origin: &[f64; 3], leaves: &mut Vec<Leaf>) {
        #[target_feature(enable = "avx512f,avx512dq,avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
        fn test_leaves(grid: &Grid, culler: &mut Culler<'_>, origin: &[f64; 3], leaves: &mut Vec<Leaf>) {
            grid.test_leaves::<Avx512>(culler, origin, leaves);
        }
        // SAFETY: as above.
        unsafe { test_leaves(grid, culler, origin, leaves) }
    }
}
