//! Secondary rays: shadows of the key light and ambient occlusion.
//!
//! ARCHITECTURE.md ("Lighting") says which rays these are. Only + − × ÷ √ are used, in a fixed order: every machine computes
//! the same bits.

use glam::{DVec3, Vec3};
use shared::{
    appearance::ClipPlane,
    protocol::{FrameSpec, LightingMode, ShadingMode},
};

use crate::{
    grid::Grid,
    intersect::{
        MOST_PACKETS, Packet, PacketScratch, clip,
        ray::{Hit, Ray},
    },
    render::{
        blocks::SampleBlock,
        lift::{Lift, LiftedPoint},
        sampling::{fraction, hash_u32},
        surface::{N, get, set},
    },
    simd::{Kernel, Simd},
    texture::footprint::SampleRays,
};

/// The light that reaches one hit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LightVisibility {
    /// Direction to the key light, unit length, world space.
    pub key_direction: Vec3,
    /// Visible fraction of the key light, 0 or 1.
    pub key: f32,
    /// 1 − ambient occlusion.
    pub ambient_visibility: f32,
}

/// The secondary rays of one frame.
pub struct SecondaryRays<'a> {
    pub(super) grid: &'a Grid,
    /// Cuts the scene open: parts that it removes cast no shadow.
    pub(super) clip: Option<ClipPlane>,
    lighting_mode: LightingMode,
    /// Has single precision, as the origin of all rays.
    pub(super) eye: DVec3,
    /// Position of the key light, model space.
    pub key_light: Vec3,
    /// Direction to the key light from hits without a surface point, world space.
    key_direction: Vec3,
    lift: Lift<'a>,
    /// Length of the longest ambient occlusion ray, in world units.
    ao_radius: f32,
}

/// Ambient occlusion rays of each sample.
const N_AO_RAYS: usize = 4;

/// Length of the longest ambient occlusion ray, relative to the radius of the scene without strays.
const AO_RADIUS_RELATIVE: f64 = 0.1;

impl<'a> SecondaryRays<'a> {
    /// Prepares for one frame of a scene that a plane may cut open.
    pub fn new(grid: &'a Grid, spec: &FrameSpec, clip: Option<ClipPlane>) -> Self {
        // Other shading modes ignore the lights, and paths have their own.
        let lighting_mode = match (spec.view, spec.rays) {
            (ShadingMode::Shaded, LightingMode::Shadows | LightingMode::AmbientOcclusion) => spec.rays,
            _ => LightingMode::Primary,
        };
        // Strays must not change the light on all others.
        let [low, high] = grid.mesh().bulk_bounds().corners();
        let (centre, radius) = ((low + high) * 0.5, (high - low).length() * 0.5);
        let [back, to_light] = back_and_light(spec);
        let key_light = match lighting_mode {
            LightingMode::Primary | LightingMode::Path => Vec3::ZERO,
            LightingMode::Shadows | LightingMode::AmbientOcclusion => {
                key_light_position(grid, spec, clip.as_ref(), [back, to_light], (centre, radius))
            }
        };
        Self {
            grid,
            clip,
            lighting_mode,
            eye: spec.camera.eye().as_vec3().as_dvec3(),
            key_light,
            key_direction: to_light.as_vec3(),
            lift: Lift::new(grid.mesh(), clip, key_light),
            ao_radius: (radius * AO_RADIUS_RELATIVE) as f32,
        }
    }

    /// The light that reaches the hits of neighbouring blocks; undefined for misses.
    pub fn visibility(
        &self,
        blocks: &[SampleBlock<'_>],
        sample: u32,
        directions: &[[Vec3; 64]],
        hits: &[[Hit; 64]],
        scratch: &mut PacketScratch,
    ) -> [[LightVisibility; 64]; MOST_PACKETS] {
        let mut visibility = [[LightVisibility { key_direction: self.key_direction, key: 1.0, ambient_visibility: 1.0 };
            64]; MOST_PACKETS];
        if self.lighting_mode == LightingMode::Primary {
            return visibility;
        }
        let mut surfaces = [[None; 64]; MOST_PACKETS];
        for (index, block) in blocks.iter().enumerate() {
            let (directions, hits) = (&directions[index], &hits[index][..block.n_samples()]);
            let rays = SampleRays { eye: self.eye.as_vec3(), directions, sides: [Vec3::ZERO; 2] };
            self.lift.points(self.grid.instructions, rays, hits, &mut surfaces[index]);
        }
        self.cast_shadows(blocks, &surfaces, &mut visibility, scratch);
        if self.lighting_mode == LightingMode::AmbientOcclusion {
            for (index, block) in blocks.iter().enumerate() {
                self.look_around(block, sample, &surfaces[index], &mut visibility[index]);
            }
        }
        visibility
    }

    /// Casts shadow rays from the key light to all surfaces that face it.
    fn cast_shadows(
        &self,
        blocks: &[SampleBlock<'_>],
        surfaces: &[[Option<LiftedPoint>; 64]],
        visibility: &mut [[LightVisibility; 64]],
        scratch: &mut PacketScratch,
    ) {
        // Make a ray to each surface that faces the light; the others stay in shadow.
        let light = self.key_light.as_dvec3();
        let mut directions = [[None; 64]; MOST_PACKETS];
        for (index, block) in blocks.iter().enumerate() {
            for (direction, &sample_idx) in directions[index].iter_mut().zip(&block.sample_of_lane()) {
                let Some(LiftedPoint { point, normal }) = &surfaces[index][sample_idx] else { continue };
                let to_point = *point - light;
                visibility[index][sample_idx].key_direction = (-to_point * (1.0 / to_point.length())).as_vec3();
                visibility[index][sample_idx].key = 0.0;
                if normal.dot(to_point) < -self.lift.ray_offset {
                    *direction = Some(to_point.as_vec3());
                }
            }
        }
        // Trace them as packets, and light the surfaces that they reach.
        let directions = &directions[..blocks.len()];
        let occluded_lanes = occluded_lanes(self.grid, self.clip.as_ref(), self.key_light, directions, 1.0, scratch);
        for (index, block) in blocks.iter().enumerate() {
            for (lane, &sample_idx) in block.sample_of_lane().iter().enumerate() {
                if directions[index][lane].is_some() && occluded_lanes[index] >> lane & 1 == 0 {
                    visibility[index][sample_idx].key = 1.0;
                }
            }
        }
    }

    /// Ambient occlusion of a block: the fraction of each surface's short hemisphere rays that hit something.
    fn look_around(
        &self,
        block: &SampleBlock<'_>,
        sample: u32,
        surfaces: &[Option<LiftedPoint>; 64],
        visibility: &mut [LightVisibility; 64],
    ) {
        let (mut seen, mut sample_of_rays) = (Vec::with_capacity(64), Vec::with_capacity(64));
        for (sample_idx, pixel) in block.samples().enumerate() {
            if let Some(surface) = &surfaces[sample_idx] {
                seen.push(Seen { point: surface.point.as_vec3(), normal: surface.normal.as_vec3(), pixel });
                sample_of_rays.push(sample_idx);
            }
        }
        let mut rays = self.ambient_rays(&seen, sample);
        let mut occluded = [false; 64 * N_AO_RAYS];
        clip::occluded_rays(self.grid, self.clip.as_ref(), &mut rays, &mut occluded);
        for (sample_idx, occluded) in sample_of_rays.into_iter().zip(occluded.chunks(N_AO_RAYS)) {
            let n_unoccluded = occluded.iter().filter(|&&occluded| !occluded).count();
            visibility[sample_idx].ambient_visibility = n_unoccluded as f32 * (1.0 / N_AO_RAYS as f32);
        }
    }

    /// [`N_AO_RAYS`] ambient occlusion rays of each surface, one surface after the other.
    fn ambient_rays(&self, seen: &[Seen], sample: u32) -> Vec<Ray> {
        let mut rays = Vec::with_capacity(seen.len() * N_AO_RAYS);
        let kernel = AmbientRays { seen, sample, radius: self.ao_radius, rays: &mut rays };
        // SAFETY: a grid holds only an instruction set that `InstructionSet::available` has found.
        unsafe { self.grid.instructions.call(kernel) }
        rays
    }
}

/// A surface point that a sample shows.
#[derive(Clone, Copy)]
struct Seen {
    /// Lifted off the surface; model space.
    point: Vec3,
    /// Unit length.
    normal: Vec3,
    /// Column and row of the sample's pixel.
    pixel: (u32, u32),
}

/// Makes ambient occlusion rays of many surfaces at once: loops over arrays, which the compiler turns into vector instructions.
struct AmbientRays<'a> {
    seen: &'a [Seen],
    sample: u32,
    /// Length of the longest ray, in world units.
    radius: f32,
    /// To which rays are appended.
    rays: &'a mut Vec<Ray>,
}

impl Kernel for AmbientRays<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        for seen in self.seen.chunks(N) {
            let (mut normals, mut pixels) = ([[0.0; N]; 3], [[0; N]; 2]);
            for (lane, seen) in seen.iter().enumerate() {
                set(&mut normals, lane, seen.normal);
                (pixels[0][lane], pixels[1][lane]) = seen.pixel;
            }
            let (mut directions, mut lengths) = ([[[0.0; N]; 3]; N_AO_RAYS], [[0.0; N]; N_AO_RAYS]);
            for lane in 0..N {
                let pixel = [pixels[0][lane], pixels[1][lane]];
                let of_lane = ambient_directions(get(&normals, lane), pixel, self.sample);
                for ray in 0..N_AO_RAYS {
                    set(&mut directions[ray], lane, of_lane[ray].0);
                    lengths[ray][lane] = self.radius * of_lane[ray].1;
                }
            }
            for (lane, seen) in seen.iter().enumerate() {
                for ray in 0..N_AO_RAYS {
                    let (direction, t_max) = (get(&directions[ray], lane), lengths[ray][lane]);
                    self.rays.push(Ray { origin: seen.point, direction, t_min: 0.0, t_max });
                }
            }
        }
    }
}

/// The directions of a surface's ambient occlusion rays, and the length of each as a part of the longest.
///
/// Directions follow a cosine distribution, so that all rays weigh the same. Lengths differ, so that near blockers
/// occlude more than far ones.
#[inline(always)]
fn ambient_directions(normal: Vec3, [i, j]: [u32; 2], sample: u32) -> [(Vec3, f32); N_AO_RAYS] {
    let [tangent, bitangent] = tangent_basis(normal);
    // One random offset for the strata of heights and of lengths, and one for the azimuths, per sample.
    let height = fraction(hash_u32(i ^ hash_u32(j ^ hash_u32(sample ^ 11))));
    let mut azimuth = unit_circle(hash_u32(i ^ hash_u32(j ^ hash_u32(sample ^ 12))));
    let length = fraction(hash_u32(i ^ hash_u32(j ^ hash_u32(sample ^ 13))));
    let mut rays = [(Vec3::ZERO, 0.0); N_AO_RAYS];
    for (index, ray) in rays.iter_mut().enumerate() {
        let r2 = (index as f32 + height) * (1.0 / N_AO_RAYS as f32);
        let (r, z) = (r2.sqrt(), (1.0 - r2).sqrt());
        let direction = (tangent * azimuth[0] + bitangent * azimuth[1]) * r + normal * z;
        // The strata of lengths come in another order than those of heights.
        let length = ((index * 3 + 1) % N_AO_RAYS) as f32 + length;
        *ray = (direction, length * (1.0 / N_AO_RAYS as f32));
        azimuth = [
            azimuth[0] * GOLDEN_ANGLE[0] - azimuth[1] * GOLDEN_ANGLE[1],
            azimuth[0] * GOLDEN_ANGLE[1] + azimuth[1] * GOLDEN_ANGLE[0],
        ];
    }
    rays
}

/// The unit vectors opposite to the camera's direction and to the key light, whose direction is relative to the camera.
pub(super) fn back_and_light(spec: &FrameSpec) -> [DVec3; 2] {
    let (right, up) = (spec.camera.u().normalize(), spec.camera.v().normalize());
    let back = right.cross(up).normalize();
    let to_light = spec.appearance.light.direction();
    [back, (right * to_light.x + up * to_light.y + back * to_light.z).normalize()]
}

/// Cosine and sine of the golden angle: repeated rotation by it spreads directions evenly.
const GOLDEN_ANGLE: [f32; 2] = [-0.737_368_9, 0.675_490_3];

/// Distance of the key light from the viewed point, relative to the eye's: the default light stands beside the eye.
const KEY_DISTANCE: f64 = 1.5;

/// The key light's position, for unit vectors opposite to the camera's direction and to the light, and the centre of the
/// scene's bounds with half their diagonal; all in model space.
///
/// The light stands in its direction from the viewed point: the point in front of the eye that is as far away as the
/// centre of the scene. A light on the eye's side stays within the eye's room; another may stand behind walls.
fn key_light_position(
    grid: &Grid,
    spec: &FrameSpec,
    clip: Option<&ClipPlane>,
    [back, to_light]: [DVec3; 2],
    (centre, radius): (DVec3, f64),
) -> Vec3 {
    let eye = spec.camera.eye();
    // Replace a far eye by a nearer one: the space between them is empty.
    let distance = (eye - centre).length();
    let base = if distance > 4.0 * radius { centre + (eye - centre) * (4.0 * radius / distance) } else { eye };
    let distance = (base - centre).length().max(0.5 * radius);
    let step = to_light * (KEY_DISTANCE * distance) - back * distance;
    if !spec.appearance.light.is_on_eye_side() {
        return (base + step).as_vec3();
    }
    // Stop halfway to an obstacle between eye and light.
    let ray = Ray { t_max: 1.0, ..Ray::new(base.as_vec3(), step.as_vec3()) };
    let obstacle = clip::intersect(grid, clip, ray);
    let part = if obstacle.is_miss() { 1.0 } else { 0.5 * f64::from(obstacle.t) };
    (base + step * part).as_vec3()
}

/// For each of up to [`MOST_PACKETS`] neighbouring blocks, a bit for each ray from `origin` that hits something within
/// `t_max` in the part of the scene that `clip` keeps.
pub fn occluded_lanes(
    grid: &Grid,
    clip: Option<&ClipPlane>,
    origin: Vec3,
    directions: &[[Option<Vec3>; 64]],
    t_max: f32,
    scratch: &mut PacketScratch,
) -> [u64; MOST_PACKETS] {
    let mut packets = Vec::with_capacity(MOST_PACKETS);
    let mut blocks = Vec::with_capacity(MOST_PACKETS);
    for (block, directions) in directions.iter().enumerate() {
        let Some(mut next) = directions.iter().rev().find_map(|direction| *direction) else { continue };
        let mut packet = Packet { origin, t_max, clip: clip.copied(), any_hit: true, ..Packet::NONE };
        for (lane, direction) in directions.iter().enumerate().rev() {
            // Inactive lanes repeat the next ray, to keep the packet coherent.
            next = direction.unwrap_or(next);
            for axis in 0..3 {
                packet.directions[axis][lane] = next[axis];
            }
            packet.active |= u64::from(direction.is_some()) << lane;
        }
        packets.push(packet);
        blocks.push(block);
    }
    let mut hits = [[Hit::MISS; 64]; MOST_PACKETS];
    let mut occluded_lanes = [0; MOST_PACKETS];
    if packets.is_empty() {
        return occluded_lanes;
    }
    grid.intersect_packets(&packets, scratch, &mut hits[..packets.len()]);
    for ((block, packet), hits) in blocks.into_iter().zip(&packets).zip(&hits) {
        let hit = (0..64).filter(|&lane| !hits[lane].is_miss()).fold(0, |hit, lane| hit | 1 << lane);
        occluded_lanes[block] = hit & packet.active;
    }
    occluded_lanes
}

/// Completes a unit normal to an orthonormal basis: Duff et al., "Building an Orthonormal Basis, Revisited" (2017).
#[inline(always)]
pub(super) fn tangent_basis(n: Vec3) -> [Vec3; 2] {
    let sign = 1.0f32.copysign(n.z);
    let a = -1.0 / (sign + n.z);
    let b = n.x * n.y * a;
    [Vec3::new(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x), Vec3::new(b, sign + n.y * n.y * a, -n.y)]
}

/// A point of the unit circle: the low bits choose one of eight arcs, the high bits the half-angle tangent within it.
#[inline(always)]
fn unit_circle(bits: u32) -> [f32; 2] {
    const TANGENT_OF_PI_8: f32 = 0.414_213_57;
    let s = (bits >> 9) as i32 as f32 * (TANGENT_OF_PI_8 / 8_388_608.0);
    let scale = 1.0 / (1.0 + s * s);
    let (cosine, sine) = ((1.0 - s * s) * scale, 2.0 * s * scale);
    let (x, y) = if bits & 1 == 0 { (cosine, sine) } else { (sine, cosine) };
    [if bits & 2 == 0 { x } else { -x }, if bits & 4 == 0 { y } else { -y }]
}

#[cfg(test)]
mod tests;
