//! Scenes and rays with integer coordinates, where the truth is exact: rays along axes, planes and edges, through corners,
//! from surfaces and from far away.

use glam::Vec3;
use renderer::{
    grid::{Grid, GridOptions},
    intersect::ray::Ray,
    model::mesh::Mesh,
};

use super::{
    contenders::{RayBundle, Tally, tally},
    exact,
    solids::{self, Lattice},
};
use crate::{random::Random, vector::sub};

#[derive(Clone, Copy, Debug)]
pub(super) enum Aim {
    /// Along an axis; the other two components are +0 or −0.
    Axes,
    /// Along an edge of a triangle, and from the same origin at other corners.
    Edges,
    /// At corners and edge midpoints.
    Corners,
    /// From a corner, an edge midpoint, or within a triangle, in any direction.
    FromSurfaces,
    /// From a million scene sizes away, at corners, edge midpoints, and anywhere.
    Far,
    All,
}

const SIZE: i32 = 16;

/// Random soups, and boxes with integer corners.
pub(super) fn solids_and_soups(aim: Aim, n_rays: u64) -> Tally {
    let soups = (0..12).map(|seed| soup(seed, 4 + 3 * seed as usize));
    let boxes = [1, 2, 4].map(|n| scaled(&solids::cube(n), SIZE / n));
    let scenes: Vec<_> = soups.chain(boxes).collect();
    many(&scenes, 1.0, aim, n_rays)
}

/// Tries some scenes, with an equal number of rays for each.
pub(super) fn many(scenes: &[Lattice], unit: f32, aim: Aim, n_rays: u64) -> Tally {
    let n_rays = n_rays / scenes.len() as u64;
    let of_scene = |(scene, seed)| one(scene, solids::mesh_of(scene, unit), unit, aim, n_rays, seed);
    scenes.iter().zip(0..).map(of_scene).sum()
}

/// Rays at a mesh that begins with the triangles of `scene`; rays must not hit its other triangles.
pub(super) fn one(scene: &Lattice, mesh: Mesh, unit: f32, aim: Aim, n_rays: u64, seed: u64) -> Tally {
    let grid = Grid::build(mesh, &GridOptions::default(), &|_| ());
    let whole = |vector: Vec3| (vector / unit).to_array().map(|x| x as i32);
    tally(
        &grid,
        n_rays.div_ceil(N_DIRECTIONS as u64),
        |index| bundle(scene, unit, aim, &mut Random::new(index << 8 | seed)),
        |ray: &Ray| exact::truth(scene, whole(ray.origin), whole(ray.direction)),
        |_, truth, answer| truth.allows(answer),
    )
}

/// Packets from outside whose rays reach all over the scene. Neighbouring groups of rays settle far from each other.
pub(super) fn wide_packets(n_rays: u64) -> Tally {
    const N_RAYS: usize = 64;
    let scenes: Vec<_> = (0..6).map(|seed| soup(800 + seed, 8 + 8 * seed as usize)).collect();
    let n_bundles = n_rays.div_ceil((N_RAYS * scenes.len()) as u64);
    let whole = |vector: Vec3| vector.to_array().map(|x| x as i32);
    let of_scene = |(scene, seed): (&Lattice, u64)| {
        let from_outside = |index: u64| {
            let mut random = Random::new(index << 8 | seed);
            let mut anywhere = || [(); 3].map(|()| random.whole(-2, SIZE + 2));
            let (mut origin, mut targets) = (anywhere(), [(); N_RAYS].map(|()| anywhere()));
            targets.sort_unstable();
            let distance = random.whole(3, 3 * SIZE);
            origin[random.whole(0, 2) as usize] = *random.choose(&[-2 - distance, SIZE + 2 + distance]);
            let direction = |target: [i32; 3]| Vec3::from([0, 1, 2].map(|axis| (target[axis] - origin[axis]) as f32));
            RayBundle { origin: Vec3::from(origin.map(|x| x as f32)), directions: targets.map(direction).to_vec() }
        };
        tally(
            &Grid::build(solids::mesh_of(scene, 1.0), &GridOptions::default(), &|_| ()),
            n_bundles,
            from_outside,
            |ray: &Ray| exact::truth(scene, whole(ray.origin), whole(ray.direction)),
            |_, truth, answer| truth.allows(answer),
        )
    };
    scenes.iter().zip(0..).map(of_scene).sum()
}

/// Rays of a bundle: few, because many cases depend on the origin.
const N_DIRECTIONS: usize = 8;

/// Rays at a scene whose integer step is `unit`.
pub(super) fn bundle(scene: &Lattice, unit: f32, aim: Aim, random: &mut Random) -> RayBundle {
    let aim = match aim {
        Aim::All => *random.choose(&[Aim::Axes, Aim::Edges, Aim::Corners, Aim::FromSurfaces]),
        aim => aim,
    };
    let no_triangle = [[0; 3]; 3];
    let triangle = |random: &mut Random| if scene.is_empty() { no_triangle } else { *random.choose(scene) };
    let anywhere = |random: &mut Random| [(); 3].map(|()| random.whole(-2, SIZE + 2));
    let [a, b, c] = triangle(random);
    let origin = match aim {
        Aim::Axes | Aim::Corners | Aim::All => {
            // Often in an axis-parallel plane through a corner.
            let mut origin = anywhere(random);
            let axis = random.whole(0, 5) as usize;
            if axis < 3 {
                origin[axis] = a[axis];
            }
            origin
        }
        Aim::Edges => along(a, b, random.whole(-3, 1)),
        Aim::FromSurfaces => match random.whole(0, 2) {
            0 => a,
            1 => middle(a, b),
            _ => middle(middle(a, b), c),
        },
        Aim::Far => {
            let step = [(); 3].map(|()| random.whole(-16, 16));
            [0, 1, 2].map(|axis| a[axis] + step[axis] * 1_000_000)
        }
    };
    let directions = (0..N_DIRECTIONS).map(|lane| {
        let [p, q, _] = triangle(random);
        let direction = match aim {
            Aim::Axes => {
                let mut direction = [0; 3];
                direction[random.whole(0, 2) as usize] = *random.choose(&[-3, -1, 1, 2]);
                direction
            }
            Aim::Edges if lane == 0 => sub(b, a),
            Aim::Edges if lane == 1 => sub(a, b),
            Aim::FromSurfaces => [(); 3].map(|()| random.whole(-8, 8)),
            Aim::Far if lane % 4 == 3 => sub(anywhere(random), origin),
            _ if lane % 2 == 0 => sub(p, origin),
            _ => sub(middle(p, q), origin),
        };
        let direction = if direction == [0; 3] { [0, 0, 1] } else { direction };
        let signed = direction.map(|x| if x == 0 && random.bits() & 1 == 1 { -0.0 } else { x as f32 * unit });
        Vec3::from_array(signed)
    });
    let directions = directions.collect();
    RayBundle { origin: Vec3::from_array(origin.map(|x| x as f32 * unit)), directions }
}

/// `n` random triangles. Multiples of four: midpoints of edges and triangles are integers.
pub(super) fn soup(seed: u64, n: usize) -> Lattice {
    scaled(&solids::soup(&mut Random::new(seed), n, SIZE / 4), 4)
}

fn scaled(lattice: &Lattice, factor: i32) -> Lattice {
    lattice.iter().map(|triangle| triangle.map(|corner| corner.map(|x| x * factor))).collect()
}

fn along(a: [i32; 3], b: [i32; 3], steps: i32) -> [i32; 3] {
    [0, 1, 2].map(|axis| a[axis] + steps * (b[axis] - a[axis]))
}

fn middle(a: [i32; 3], b: [i32; 3]) -> [i32; 3] {
    [0, 1, 2].map(|axis| (a[axis] + b[axis]) / 2)
}

/// Scenes without extent along some axes.
pub(super) fn flat(axes: &[usize], n_rays: u64) -> Tally {
    let scenes = (0..8).map(|seed| {
        let mut soup = soup(100 + seed, 20);
        for corner in soup.iter_mut().flatten() {
            axes.iter().for_each(|&axis| corner[axis] = 8);
        }
        soup
    });
    many(&scenes.collect::<Vec<_>>(), 1.0, Aim::All, n_rays)
}

pub(super) fn few(n_rays: u64) -> Tally {
    let ones = (0..15).map(|seed| soup(200 + seed, 1));
    many(&[vec![]].into_iter().chain(ones).collect::<Vec<_>>(), 1.0, Aim::All, n_rays)
}

/// Repeated triangles, among them some without area.
pub(super) fn duplicates(n_rays: u64) -> Tally {
    let scenes = (0..8).map(|seed| {
        let soup = soup(300 + seed, 12);
        let no_area = soup.iter().map(|&[a, b, _]| [a, b, middle(a, b)]);
        let points = soup.iter().map(|&[a, _, _]| [a; 3]);
        [&*soup, &*no_area.collect::<Vec<_>>(), &*soup, &*points.collect::<Vec<_>>()].concat()
    });
    many(&scenes.collect::<Vec<_>>(), 1.0, Aim::All, n_rays)
}

/// Scenes with coordinates below the smallest normal number.
pub(super) fn denormal(n_rays: u64) -> Tally {
    let scenes = (0..8).map(|seed| soup(400 + seed, 20));
    many(&scenes.collect::<Vec<_>>(), DENORMAL_UNIT, Aim::All, n_rays)
}

/// 2⁻¹⁴⁰: the largest coordinate is 2⁻¹³⁶.
const DENORMAL_UNIT: f32 = f32::from_bits(1 << 9);
