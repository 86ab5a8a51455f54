//! Secondary rays: which lights reach a hit.
//!
//! The key light is a point (from where it comes is [`shared::look::Light`]), so that the shadow rays of neighbouring samples, followed from the light to the hits, are
//! packets as coherent as the camera's. Surroundings are felt by short rays into the hemisphere above a hit.
//!
//! Points on surfaces are found in `f64` and lifted off them by more than rounding can take back, so that no surface
//! shades itself and nothing is skipped. Only + − × ÷ √ are used, in a fixed order: every machine computes the same bits.

use glam::{DVec3, Vec3};
use shared::{
    look::ClipPlane,
    protocol::{RayTree, View},
};

use crate::{
    clip,
    grid::{Grid, Packet, PacketScratch},
    ray::{Hit, Ray},
    tracer::{FrameRequest, hash, lane_places},
};

/// What reaches one hit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reach {
    /// Towards the key light, of unit length, in world space.
    pub key_direction: Vec3,
    /// How much of the key light arrives, 0 to 1.
    pub key: f32,
    /// How much of the surroundings is open, 0 to 1.
    pub open: f32,
}

/// The secondary rays of one frame.
pub struct SecondaryRays<'a> {
    grid: &'a Grid,
    /// What is cut away casts no shadow.
    clip: Option<ClipPlane>,
    tree: RayTree,
    eye: DVec3,
    /// Where the key light stands, in world space.
    key_light: Vec3,
    /// Towards it, where no point is known.
    key_direction: Vec3,
    /// How far points are lifted off their surfaces, in world units.
    lift: f64,
    /// The longest ambient ray, in world units.
    ambient_reach: f32,
}

/// Ambient rays of each sample.
const N_AMBIENT: u32 = 4;

/// The longest ambient ray, relative to the radius of the scene.
const AMBIENT_REACH: f64 = 0.1;

/// A point that a ray has hit.
struct Surface {
    /// Lifted off the surface.
    point: DVec3,
    /// Of unit length, towards the ray's origin.
    normal: DVec3,
}

impl<'a> SecondaryRays<'a> {
    /// Makes ready for one frame of a scene that a plane may cut open.
    pub fn new(grid: &'a Grid, request: &FrameRequest, clip: Option<ClipPlane>) -> Self {
        // Other views have no light.
        let tree = if request.view == View::Shaded { request.rays } else { RayTree::Primary };
        let bounds = grid.mesh().bounds();
        let [min, max] = [bounds.min, bounds.max].map(|corner| Vec3::from_array(corner).as_dvec3());
        let (centre, radius) = ((min + max) * 0.5, (max - min).length() * 0.5);
        let (right, up) = (request.camera.u().normalize(), request.camera.v().normalize());
        let back = right.cross(up).normalize();
        let light = request.look.light;
        let to_light = light.direction();
        let to_light = (right * to_light.x + up * to_light.y + back * to_light.z).normalize();
        let key_light = match tree {
            RayTree::Primary => Vec3::ZERO,
            RayTree::Shadows | RayTree::Ambient => {
                let place = KeyLight { eye: request.camera.eye(), back, to_light, centre, radius };
                place.find(grid, clip.as_ref(), light.is_on_eye_side())
            }
        };
        // No coordinate is larger, and no difference more than twice as large. Rounding a point or a direction to single
        // precision moves it by at most √3·2⁻²⁴ of that.
        let reach = min.abs().max(max.abs()).max(key_light.as_dvec3().abs()).max_element();
        Self {
            grid,
            clip,
            tree,
            eye: request.camera.eye().as_vec3().as_dvec3(),
            key_light,
            key_direction: to_light.as_vec3(),
            lift: reach * (8.0 * f64::from(f32::EPSILON)),
            ambient_reach: (radius * AMBIENT_REACH) as f32,
        }
    }

    /// The same with the key light in another place, for tests.
    #[must_use]
    pub(crate) fn with_key_light(self, key_light: Vec3) -> Self {
        Self { key_light, ..self }
    }

    /// What reaches the hits of a block of samples, which are lanes of the arrays; lanes without a hit are undefined.
    pub fn reach(
        &self,
        block: &[(u32, u32)],
        sample: u32,
        directions: &[Vec3; 64],
        hits: &[Hit; 64],
        scratch: &mut PacketScratch,
    ) -> [Reach; 64] {
        let mut reach = [Reach { key_direction: self.key_direction, key: 1.0, open: 1.0 }; 64];
        if self.tree == RayTree::Primary {
            return reach;
        }
        let surfaces: [Option<Surface>; 64] =
            std::array::from_fn(
                |lane| {
                    if lane < block.len() { self.surface(directions[lane], hits[lane]) } else { None }
                },
            );
        self.cast_shadows(&lane_places(block), &surfaces, &mut reach, scratch);
        if self.tree == RayTree::Ambient {
            for (lane, surface) in surfaces.iter().enumerate() {
                if let Some(surface) = surface {
                    reach[lane].open = self.openness(surface, block[lane], sample);
                }
            }
        }
        reach
    }

    /// Where a hit is; `None` for a miss, and for slivers too thin to have a normal.
    fn surface(&self, direction: Vec3, hit: Hit) -> Option<Surface> {
        if hit.is_miss() {
            return None;
        }
        let [a, b, c] = self.grid.mesh().corners(hit.triangle).map(|corner| Vec3::from_array(corner).as_dvec3());
        let direction = direction.as_dvec3();
        let normal = (b - a).cross(c - a);
        let length = normal.length();
        let normal = if normal.dot(direction) > 0.0 { -normal } else { normal } * (1.0 / length);
        // The hit's t is rounded to single precision, too little for an eye far away.
        let t = normal.dot(a - self.eye) / normal.dot(direction);
        let point = self.eye + direction * t + normal * self.lift;
        (length > 0.0 && point.is_finite() && normal.is_finite()).then_some(Surface { point, normal })
    }

    /// Follows rays from the key light to all surfaces that face it.
    fn cast_shadows(
        &self,
        places: &[usize; 64],
        surfaces: &[Option<Surface>; 64],
        reach: &mut [Reach; 64],
        scratch: &mut PacketScratch,
    ) {
        let light = self.key_light.as_dvec3();
        let mut directions = [None; 64];
        for (direction, &place) in directions.iter_mut().zip(places) {
            let Some(Surface { point, normal }) = &surfaces[place] else { continue };
            let to_point = *point - light;
            reach[place].key_direction = (-to_point * (1.0 / to_point.length())).as_vec3();
            reach[place].key = 0.0;
            if normal.dot(to_point) < -self.lift {
                *direction = Some(to_point.as_vec3());
            }
        }
        let hidden = hidden(self.grid, self.clip.as_ref(), self.key_light, &directions, 1.0, scratch);
        for (lane, &place) in places.iter().enumerate() {
            if directions[lane].is_some() && hidden >> lane & 1 == 0 {
                reach[place].key = 1.0;
            }
        }
    }

    /// What part of some rays into the hemisphere above a surface reaches their end.
    ///
    /// They are distributed as the cosine to the normal, so that each counts alike, and of different lengths, so that
    /// what is near shades more than what is far.
    fn openness(&self, surface: &Surface, (i, j): (u32, u32), sample: u32) -> f32 {
        let normal = surface.normal.as_vec3();
        let [tangent, bitangent] = tangents(normal);
        let random = |seed: u32| hash(i ^ hash(j ^ hash(sample ^ seed)));
        let fraction = |bits: u32| ((bits >> 9) as f32 + 0.5) * (1.0 / 8_388_608.0);
        let (height, mut around) = (fraction(random(11)), unit_circle(random(12)));
        let length = fraction(random(13));
        let mut n_open = 0;
        for index in 0..N_AMBIENT {
            let r2 = (index as f32 + height) * (1.0 / N_AMBIENT as f32);
            let (r, z) = (r2.sqrt(), (1.0 - r2).sqrt());
            let direction = (tangent * around[0] + bitangent * around[1]) * r + normal * z;
            // Strata of length in another order than those of height.
            let length = ((index * 3 + 1) % N_AMBIENT) as f32 + length;
            let t_max = self.ambient_reach * (length * (1.0 / N_AMBIENT as f32));
            let ray = Ray { origin: surface.point.as_vec3(), direction, t_min: 0.0, t_max };
            n_open += u32::from(!clip::occluded(self.grid, self.clip.as_ref(), ray));
            around = [around[0] * GOLDEN[0] - around[1] * GOLDEN[1], around[0] * GOLDEN[1] + around[1] * GOLDEN[0]];
        }
        n_open as f32 * (1.0 / N_AMBIENT as f32)
    }
}

/// Cosine and sine of the golden angle: directions that are turned by it again and again keep apart.
const GOLDEN: [f32; 2] = [-0.737_368_9, 0.675_490_3];

/// What says where the key light stands, in world space.
struct KeyLight {
    eye: DVec3,
    /// From what is looked at to the eye's side, of unit length.
    back: DVec3,
    /// From what is looked at to the light, of unit length.
    to_light: DVec3,
    /// The middle of the scene.
    centre: DVec3,
    /// Half the diagonal of the scene's bounds.
    radius: f64,
}

/// How far the key light is from what is looked at, in distances of the eye: over its shoulder it is beside the eye.
const KEY_DISTANCE: f64 = 1.5;

impl KeyLight {
    /// In its direction from the point before the eye that is as far away as the middle of the scene. A light on the eye's
    /// side stays inside the room that the eye is in; others are where they are, whatever hides them.
    fn find(&self, grid: &Grid, clip: Option<&ClipPlane>, is_on_eye_side: bool) -> Vec3 {
        let Self { eye, back, to_light, centre, radius } = *self;
        // An eye far away is replaced by one nearer: there lies nothing in between.
        let distance = (eye - centre).length();
        let base = if distance > 4.0 * radius { centre + (eye - centre) * (4.0 * radius / distance) } else { eye };
        let distance = (base - centre).length().max(0.5 * radius);
        let step = to_light * (KEY_DISTANCE * distance) - back * distance;
        if !is_on_eye_side {
            return (base + step).as_vec3();
        }
        let ray = Ray { t_max: 1.0, ..Ray::new(base.as_vec3(), step.as_vec3()) };
        let wall = clip::intersect(grid, clip, ray);
        let part = if wall.is_miss() { 1.0 } else { 0.5 * f64::from(wall.t) };
        (base + step * part).as_vec3()
    }
}

/// A bit for each ray from `origin` that hits something up to `t_max`, of what a plane keeps.
pub(crate) fn hidden(
    grid: &Grid,
    clip: Option<&ClipPlane>,
    origin: Vec3,
    directions: &[Option<Vec3>; 64],
    t_max: f32,
    scratch: &mut PacketScratch,
) -> u64 {
    let Some(mut next) = directions.iter().rev().find_map(|direction| *direction) else { return 0 };
    let mut packet = Packet { origin, directions: [[0.0; 64]; 3], active: 0, t_min: 0.0, t_max, any_hit: true };
    for (lane, direction) in directions.iter().enumerate().rev() {
        // Entries of no ray repeat the next, which lies close to them.
        next = direction.unwrap_or(next);
        for axis in 0..3 {
            packet.directions[axis][lane] = next[axis];
        }
        packet.active |= u64::from(direction.is_some()) << lane;
    }
    let hits = clip::intersect_packet(grid, clip, &packet, scratch);
    (0..64).filter(|&lane| !hits[lane].is_miss()).fold(0, |hidden, lane| hidden | 1 << lane) & packet.active
}

/// Two vectors of unit length at right angles to a normal and to each other: Duff et al., "Building an Orthonormal Basis,
/// Revisited" (2017).
fn tangents(n: Vec3) -> [Vec3; 2] {
    let sign = 1.0f32.copysign(n.z);
    let a = -1.0 / (sign + n.z);
    let b = n.x * n.y * a;
    [Vec3::new(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x), Vec3::new(b, sign + n.y * n.y * a, -n.y)]
}

/// A point of the unit circle: one of eight arcs, and within it the tangent of half the angle.
fn unit_circle(bits: u32) -> [f32; 2] {
    const TANGENT_OF_PI_8: f32 = 0.414_213_57;
    let s = (bits >> 9) as f32 * (TANGENT_OF_PI_8 / 8_388_608.0);
    let scale = 1.0 / (1.0 + s * s);
    let (cosine, sine) = ((1.0 - s * s) * scale, 2.0 * s * scale);
    let (x, y) = if bits & 1 == 0 { (cosine, sine) } else { (sine, cosine) };
    [if bits & 2 == 0 { x } else { -x }, if bits & 4 == 0 { y } else { -y }]
}

#[cfg(test)]
mod tests {
    use shared::{
        camera::Camera,
        division::FrameSize,
        look::{Light, Look},
        protocol::SampleRange,
    };

    use super::*;
    use crate::{
        mesh::Mesh,
        statue,
        tracer::{Scene, SceneOptions},
    };

    fn request(eye: DVec3, target: DVec3, rays: RayTree) -> FrameRequest {
        FrameRequest {
            camera: Camera::look_at(eye, target, DVec3::Y, 0.7, 2.0).unwrap(),
            size: FrameSize::new(128, 64).unwrap(),
            view: View::Shaded,
            rays,
            samples: SampleRange::CENTRE,
            look: Look::default(),
        }
    }

    /// What reaches every hit of a frame, with the ray's direction and the hit.
    fn reach(scene: &Scene, request: &FrameRequest) -> Vec<(Vec3, Hit, Reach)> {
        let secondary = SecondaryRays::new(scene.grid(), request, scene.clip_plane(&request.camera, request.look.clip));
        let rays = request.camera.rays(request.size);
        let mut scratch = PacketScratch::default();
        let mut all = Vec::new();
        for (first_i, first_j) in (0..8).flat_map(|row| (0..16).map(move |column| (8 * column, 8 * row))) {
            let block: Vec<_> = (0..64).map(|place| (first_i + place % 8, first_j + place / 8)).collect();
            let directions: [Vec3; 64] = std::array::from_fn(|lane| rays.direction(block[lane].0, block[lane].1));
            let hits = directions.map(|direction| scene.grid().intersect(&Ray::new(rays.eye, direction)));
            let reach = secondary.reach(&block, 0, &directions, &hits, &mut scratch);
            all.extend((0..64).map(|lane| (directions[lane], hits[lane], reach[lane])));
        }
        all.retain(|(_, hit, _)| !hit.is_miss());
        all
    }

    fn ball(centre: Vec3, radius: f32) -> Mesh {
        let mut mesh = Mesh::default();
        let (rows, columns) = (40u32, 80u32);
        for row in 0..=rows {
            for column in 0..columns {
                let (sin, cos) = (std::f32::consts::PI * row as f32 / rows as f32).sin_cos();
                let (sin_around, cos_around) = (std::f32::consts::TAU * column as f32 / columns as f32).sin_cos();
                let normal = Vec3::new(sin * cos_around, cos, sin * sin_around);
                mesh.vertices.push((centre + normal * radius).to_array());
                if row < rows {
                    let right = (column + 1) % columns;
                    let [a, b] = [column, right].map(|column| row * columns + column);
                    mesh.triangles.extend([[a, b, a + columns], [b, b + columns, a + columns]]);
                }
            }
        }
        mesh
    }

    #[test]
    fn a_ball_does_not_shade_itself() {
        let places = [(0.0, 1.0), (1000.0, 1.0), (0.0, 1e-6), (-1e6, 1e6), (3.0, 1e6), (50.0, 1e-1)];
        for (centre, radius) in places {
            let scene = Scene::build(ball(Vec3::splat(centre), radius), &SceneOptions::default(), &|_| ());
            let (centre, radius) = (DVec3::splat(f64::from(centre)), f64::from(radius));
            for distance in [1.5, 4.0, 1e4] {
                let eye = centre + DVec3::new(0.5, 0.6, 1.0).normalize() * (distance * radius);
                let mut request = request(eye, centre, RayTree::Ambient);
                if distance > 1e3 {
                    let (eye, u, v) = (request.camera.eye(), request.camera.u(), request.camera.v());
                    let (u, v) = (u * (4.0 / distance), v * (4.0 / distance));
                    request.camera = Camera::new(eye, centre - (u + v) * 0.5, u, v).unwrap();
                }
                let secondary = SecondaryRays::new(scene.grid(), &request, None);
                let all = reach(&scene, &request);
                assert!(all.len() > 1000, "the ball is seen");
                for (direction, hit, reach) in all {
                    let Surface { point, normal } = secondary.surface(direction, hit).unwrap();
                    let facing = normal.dot(secondary.key_light.as_dvec3() - point) > secondary.lift;
                    let expected = f32::from(u8::from(facing));
                    assert_eq!((reach.key, reach.open), (expected, 1.0), "{centre} {radius} {distance} {point}");
                }
            }
        }
    }

    #[test]
    fn the_light_comes_from_where_it_is_asked_to() {
        let scene = Scene::build(ball(Vec3::ZERO, 1.0), &SceneOptions::default(), &|_| ());
        for (name, light) in Light::PRESETS {
            // The eye is on the z axis: its right, up and back are the world's axes.
            let look = Look { light, ..Look::default() };
            let request = FrameRequest { look, ..request(DVec3::Z * 5.0, DVec3::ZERO, RayTree::Shadows) };
            let secondary = SecondaryRays::new(scene.grid(), &request, None);
            let expected = light.direction().as_vec3();
            assert!((secondary.key_direction - expected).length() < 1e-6, "{name}");
            assert!((secondary.key_light.normalize() - expected).length() < 1e-6, "{name}: {}", secondary.key_light);
            // What turns away from the light is dark, and nothing else: a ball throws no shadow on itself.
            for (direction, hit, reach) in reach(&scene, &request) {
                let Surface { point, normal } = secondary.surface(direction, hit).unwrap();
                let cosine = normal.dot((secondary.key_light.as_dvec3() - point).normalize());
                assert!(cosine.abs() < 0.05 || (cosine > 0.0) == (reach.key > 0.0), "{name}: {cosine} {reach:?}");
            }
        }
    }

    #[test]
    fn what_stands_on_the_ground_touches_its_shadow() {
        // A wall on a floor, seen along the light: the floor behind the wall is dark up to its foot.
        for offset in [0.0, 100.0f32] {
            let quad = |a: [f32; 3], b: [f32; 3], c: [f32; 3], d: [f32; 3]| [a, b, c, d].map(|p| p.map(|x| x + offset));
            let floor = quad([-2.0, 0.0, -2.0], [2.0, 0.0, -2.0], [2.0, 0.0, 2.0], [-2.0, 0.0, 2.0]);
            let wall = quad([-2.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 1.0, 0.0], [-2.0, 1.0, 0.0]);
            let mesh = Mesh {
                vertices: [floor, wall].concat(),
                triangles: vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]],
                ..Mesh::default()
            };
            let scene = Scene::build(mesh, &SceneOptions::default(), &|_| ());
            let at = |p: [f64; 3]| DVec3::from_array(p) + DVec3::splat(f64::from(offset));
            let request = request(at([0.0, 1.0, 5.0]), at([0.0; 3]), RayTree::Shadows);
            let mut secondary = SecondaryRays::new(scene.grid(), &request, None);
            secondary.key_light = at([0.3, 1.5, 3.0]).as_vec3();
            // Contact begins within a few units in the last place of the largest coordinate.
            let nearest = 100.0 * f64::from(f32::EPSILON) * (f64::from(offset) + 2.0);
            for (z, expected) in [(-nearest, 0.0), (-1e-2, 0.0), (-0.5, 0.0), (nearest, 1.0), (0.5, 1.0)] {
                let point = at([0.1, 0.0, z]) + DVec3::Y * secondary.lift;
                let surfaces: [Option<Surface>; 64] =
                    std::array::from_fn(|lane| (lane == 7).then_some(Surface { point, normal: DVec3::Y }));
                let mut reach = [Reach { key_direction: Vec3::Y, key: 0.5, open: 1.0 }; 64];
                let places = std::array::from_fn(|lane| lane);
                secondary.cast_shadows(&places, &surfaces, &mut reach, &mut PacketScratch::default());
                assert_eq!(reach[7].key, expected, "{z} beside the wall, {offset} away");
            }
        }
    }

    #[test]
    fn what_is_cut_away_casts_no_shadow() {
        let sheet = |y: f32| [[-2.0, y, -2.0], [2.0, y, -2.0], [2.0, y, 2.0], [-2.0, y, 2.0]];
        let mesh = Mesh {
            vertices: [sheet(0.0), sheet(1.0)].concat(),
            triangles: vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]],
            ..Mesh::default()
        };
        let scene = Scene::build(mesh, &SceneOptions::default(), &|_| ());
        // Of a floor under a lid, the light above it, the whole floor is dark, or without the lid lit.
        for (clip, key) in [(None, 0.0), ("y:50".parse().ok(), 1.0), ("-y:0".parse().ok(), 0.0)] {
            let look = Look { clip, ..Look::default() };
            let eye = DVec3::new(0.1, 0.5, 1.5);
            let request = FrameRequest { look, ..request(eye, DVec3::new(0.0, 0.0, -0.3), RayTree::Ambient) };
            let plane = scene.clip_plane(&request.camera, clip);
            let secondary = SecondaryRays::new(scene.grid(), &request, plane).with_key_light(Vec3::new(0.2, 3.0, 0.1));
            let surface = Surface { point: DVec3::new(0.3, secondary.lift, 0.2), normal: DVec3::Y };
            let surfaces = std::array::from_fn(|_| Some(Surface { ..surface }));
            let mut reach = [Reach { key_direction: Vec3::Y, key: 0.5, open: 1.0 }; 64];
            secondary.cast_shadows(
                &std::array::from_fn(|lane| lane),
                &surfaces,
                &mut reach,
                &mut PacketScratch::default(),
            );
            assert!(reach.iter().all(|reach| reach.key == key), "{clip:?}");
            assert_eq!(secondary.openness(&surface, (1, 2), 3), 1.0, "the lid is too far away");
        }
    }

    /// Whether a segment meets any triangle: Möller and Trumbore in `f64`, triangle by triangle.
    fn is_blocked(mesh: &Mesh, from: DVec3, to: DVec3) -> bool {
        let direction = to - from;
        (0..mesh.triangles.len()).filter_map(|triangle| mesh.corners(triangle)).any(|corners| {
            let [a, b, c] = corners.map(|corner| Vec3::from_array(corner).as_dvec3());
            let (edge_ab, edge_ac, to_origin) = (b - a, c - a, from - a);
            let p = direction.cross(edge_ac);
            let determinant = edge_ab.dot(p);
            let q = to_origin.cross(edge_ab);
            let (u, v) = (to_origin.dot(p) / determinant, direction.dot(q) / determinant);
            let t = edge_ac.dot(q) / determinant;
            u >= 0.0 && v >= 0.0 && u + v <= 1.0 && (0.0..=1.0).contains(&t)
        })
    }

    #[test]
    fn shadows_are_where_a_search_of_all_triangles_finds_them() {
        let mesh = statue::generate(2000, &|_| ());
        let scene = Scene::build(mesh.clone(), &SceneOptions::default(), &|_| ());
        let request = request(DVec3::new(0.5, 1.2, 3.0), DVec3::Y, RayTree::Shadows);
        let secondary = SecondaryRays::new(scene.grid(), &request, None);
        let light = secondary.key_light.as_dvec3();
        let (mut n_dark, mut n_lit, mut n_wrong) = (0, 0, 0);
        for (direction, hit, reach) in reach(&scene, &request) {
            let Surface { point, normal } = secondary.surface(direction, hit).unwrap();
            if normal.dot(light - point) < 2.0 * secondary.lift {
                continue;
            }
            let blocked = is_blocked(&mesh, point, light);
            n_wrong += u32::from(blocked != (reach.key == 0.0));
            n_dark += u32::from(blocked);
            n_lit += u32::from(!blocked);
        }
        assert!(n_dark > 20 && n_lit > 500 && n_wrong == 0, "{n_dark} dark, {n_lit} lit, {n_wrong} wrong");
    }

    #[test]
    fn a_corner_is_less_open_than_a_plain() {
        let quad = [[-2.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 4.0, 0.0], [-2.0, 4.0, 0.0]];
        let floor = [[-2.0, 0.0, 4.0], [2.0, 0.0, 4.0]];
        let mesh = Mesh {
            vertices: [&quad[..], &floor[..]].concat(),
            triangles: vec![[0, 1, 2], [0, 2, 3], [0, 1, 5], [0, 5, 4]],
            ..Mesh::default()
        };
        let scene = Scene::build(mesh, &SceneOptions::default(), &|_| ());
        let request = request(DVec3::new(0.0, 3.0, 6.0), DVec3::Y, RayTree::Ambient);
        let secondary = SecondaryRays::new(scene.grid(), &request, None);
        let openness = |height: f64| {
            let surface = Surface { point: DVec3::new(0.0, height, secondary.lift), normal: DVec3::Z };
            let samples = (0..256).map(|sample| secondary.openness(&surface, (3, 4), sample));
            samples.sum::<f32>() / 256.0
        };
        assert_eq!(openness(2.0), 1.0);
        // At the foot of the wall the floor hides half the hemisphere, of which rays by the cosine meet half.
        assert!((openness(1e-3) - 0.5).abs() < 0.03, "{}", openness(1e-3));
        assert!((0.5..1.0).contains(&openness(0.1)), "{}", openness(0.1));
    }

    #[test]
    fn bases_and_circles_have_unit_length() {
        for bits in (0..1000u32).map(|n| n.wrapping_mul(0x9e37_79b9)) {
            let [x, y] = unit_circle(bits);
            assert!((x * x + y * y - 1.0).abs() < 1e-6);
            let [other, ..] = unit_circle(bits.rotate_left(13));
            let normal = Vec3::new(x, y, other - 0.5).normalize();
            let [a, b] = tangents(normal);
            let products = [a.dot(b), a.dot(normal), b.dot(normal), a.dot(a) - 1.0, b.dot(b) - 1.0];
            assert!(products.iter().all(|product| product.abs() < 1e-5), "{normal} {products:?}");
        }
        let [a, b] = tangents(Vec3::NEG_Z);
        assert!(a.is_finite() && b.is_finite());
    }
}
