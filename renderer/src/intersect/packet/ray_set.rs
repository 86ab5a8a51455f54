//! Packets of rays, and sets of the rays of packets that are traced together.

use glam::Vec3;
use shared::appearance::ClipPlane;

use crate::intersect::{clip, ray::Ray};

/// Up to 64 rays with a common origin, in model space.
///
/// Aligned as all vectors of the kernel are: a vector that crosses a cache line is read twice.
#[repr(C, align(64))]
pub struct Packet {
    /// Directions, one array per component. Lanes 16·n to 16·n + 15 (or 8·n to 8·n + 7) form a group that is culled
    /// together: they should lie close to each other. Inactive lanes must repeat the direction of another.
    pub directions: [[f32; 64]; 3],
    /// Common origin.
    pub origin: Vec3,
    /// A bit for each lane that holds a ray.
    pub active: u64,
    /// Start of all rays' interval, in units of their directions.
    pub t_min: f32,
    /// End of all rays' interval.
    pub t_max: f32,
    /// Cuts each ray's interval.
    pub clip: Option<ClipPlane>,
    /// Whether any hit of a ray will do in place of the nearest, as for shadows; its t means nothing.
    pub any_hit: bool,
}

impl Packet {
    /// No rays.
    pub const NONE: Self = Self {
        directions: [[0.0; 64]; 3],
        origin: Vec3::ZERO,
        active: 0,
        t_min: 0.0,
        t_max: f32::MAX,
        clip: None,
        any_hit: false,
    };

    /// The ray of one lane, as far as the plane keeps it; where it keeps nothing, any ray with an empty interval.
    pub fn ray(&self, lane: usize) -> Ray {
        clip::clip_ray(self.clip.as_ref(), self.whole_ray(lane)).unwrap_or(clip::NOTHING)
    }

    /// The ray of one lane, without a plane.
    pub(in crate::intersect) fn whole_ray(&self, lane: usize) -> Ray {
        let [x, y, z] = &self.directions;
        let direction = Vec3::new(x[lane], y[lane], z[lane]);
        Ray { origin: self.origin, direction, t_min: self.t_min, t_max: self.t_max }
    }
}

/// Packets that can be traced together.
pub const MOST_PACKETS: usize = 4;

/// Some of the rays of packets that are traced together.
#[derive(Clone, Copy)]
pub(super) struct RaySet<const N: usize> {
    /// A bit for each ray of each packet.
    pub(super) masks: [u64; N],
}

impl<const N: usize> RaySet<N> {
    pub(super) const NONE: Self = Self { masks: [0; N] };

    #[inline(always)]
    pub(super) fn count(&self) -> u32 {
        let mut count = 0;
        for packet in 0..N {
            count += self.masks[packet].count_ones();
        }
        count
    }

    #[inline(always)]
    pub(super) fn is_empty(&self) -> bool {
        let mut any = 0;
        for packet in 0..N {
            any |= self.masks[packet];
        }
        any == 0
    }

    #[inline(always)]
    pub(super) fn and(mut self, other: &Self) -> Self {
        for packet in 0..N {
            self.masks[packet] &= other.masks[packet];
        }
        self
    }
}
