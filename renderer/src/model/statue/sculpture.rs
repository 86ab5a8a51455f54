//! The figure: the signed distance of a smooth union of simple solids, and the stone's relief on it.
//!
//! Distances and smooth unions after Quilez, "Distance functions" and "Smooth minimum" (iquilezles.org).

use glam::Vec3;

use crate::model::statue::{BoxPoint, noise::gradient};

/// The point of the figure on a box point's ray, in world space.
pub(super) fn surface(box_point: BoxPoint) -> [f32; 3] {
    let (origin_y, direction) = ray(box_point);
    let point = |t: f32| Vec3::new(direction.x * t, origin_y + direction.y * t, direction.z * t);

    // Add up the stone along the ray: behind a gap it moves up, so no ray jumps over an undercut.
    let (mut t, mut d, mut stone) = (FARTHEST, distance(point(FARTHEST)), NEAREST);
    while t > NEAREST {
        // Smooth unions and ellipsoids overestimate distances a little.
        let next_t = max(t - max(d.abs() * 0.8, 0.5 * SOFTNESS), NEAREST);
        let next_d = distance(point(next_t));
        stone += (t - next_t) * mean_density(d, next_d);
        (t, d) = (next_t, next_d);
    }
    // Fade the relief where the ray grazes the figure: it would stretch into streaks.
    let slope = (distance(point(stone + PROBE)) - distance(point(stone))) / PROBE;
    point(stone + relief(point(stone)) * slope.clamp(0.0, 1.0)).to_array()
}

/// Half the width of the stone's edge, where its density falls from 1 to 0: outlines become slopes that a mesh can show.
const SOFTNESS: f32 = 0.02;

/// Mean density of the stone between two points, for a distance that changes evenly from `a` to `b`.
fn mean_density(a: f32, b: f32) -> f32 {
    let integral = |d: f32| {
        let x = (d / SOFTNESS).clamp(-1.0, 1.0);
        min(d + SOFTNESS, 0.0) + SOFTNESS * (0.5 * x - 0.25 * x * x)
    };
    if (a - b).abs() > 1e-4 {
        (integral(a) - integral(b)) / (a - b)
    } else {
        (0.5 - 0.25 * (a + b) / SOFTNESS).clamp(0.0, 1.0)
    }
}

/// Step of the slope's difference quotient: small against the solids, large against the rounding of distances.
const PROBE: f32 = 0.01;

/// Every solid lies within this distance of the axis, along any ray.
const FARTHEST: f32 = 1.4;
/// Rays end here at the latest, so that the surface stays closed.
const NEAREST: f32 = 0.05;

/// The ray of a box point: the origin's height on the y axis, and the direction, unit length.
fn ray(box_point: BoxPoint) -> (f32, Vec3) {
    let [lowest, .., highest] = FAN;
    let (along, [_, origin_y, rise]) = match box_point {
        BoxPoint::Side(along, height) => (along, fan(height)),
        BoxPoint::Top(along) => (along, highest),
        BoxPoint::Bottom(along) => (along, lowest),
    };
    // Distance from the middle on top and bottom; 1 on the sides.
    let spread = max(along[0].abs(), along[1].abs());
    let around = if spread > 0.0 { along.map(|x| even_angle(x / spread)) } else { [0.0; 2] };
    let outwards = if spread > 0.0 { spread / (around[0] * around[0] + around[1] * around[1]).sqrt() } else { 0.0 };
    // The face gets more columns than the back.
    (origin_y, Vec3::new(around[0] * outwards, rise, (around[1] + 0.3 * spread) * outwards).normalize())
}

/// The fan of rays from the bottom of the box's sides to their top: height on the box, height of the ray's origin in the
/// world, rise of the ray per distance from the axis.
///
/// Rays point down under overhangs and up above shelves. They do not cross within the figure: at any distance from the axis
/// up to the figure's, origin + rise × distance grows from row to row.
const FAN: [[f32; 3]; 15] = [
    [0.00, 0.12, -1.0],
    [0.02, 0.12, -0.12], // the plinth's lower edge
    [0.06, 0.12, 0.15],  // its upper edge
    [0.13, 0.12, 0.42],  // where the body stands on it
    [0.21, 0.45, 0.25],
    [0.31, 0.95, 0.25],
    [0.39, 1.35, 0.40], // shoulders
    [0.44, 1.58, 0.25],
    [0.51, 2.05, -0.22], // under the chin
    [0.60, 2.28, 0.08],  // on the lips
    [0.67, 2.48, -0.06], // under the nose
    [0.84, 3.04, -0.30], // under the brow
    [0.88, 3.10, -0.12], // under the hat
    [0.96, 3.42, 0.12],
    [1.00, 3.45, 1.0],
];

fn fan(height: f32) -> [f32; 3] {
    let above = FAN.iter().position(|row| height < row[0]).unwrap_or(FAN.len() - 1).clamp(1, FAN.len() - 1);
    let (low, high) = (FAN[above - 1], FAN[above]);
    let s = (height - low[0]) / (high[0] - low[0]);
    [height, low[1] + (high[1] - low[1]) * s, low[2] + (high[2] - low[2]) * s]
}

/// tan(x·π/4) to three digits: steps along a side of the square become nearly equal angles.
fn even_angle(x: f32) -> f32 {
    x * (0.785 + x * x * (0.162 + x * x * 0.053))
}

/// Signed distance to the smooth figure, in world units; negative inside.
///
/// Far from a part, a plane that bounds it stands in for it: half of the time of a statue is saved.
fn distance(p: Vec3) -> f32 {
    // The figure is symmetric.
    let q = Vec3::new(p.x.abs(), p.y, p.z);
    let body = if q.y < 2.15 { body(q) } else { q.y - 2.0 };
    let head = if q.y > 0.95 { head(q) } else { 1.1 - q.y };
    let plinth = rounded_box(q, [0.0, 0.14, 0.0], [1.0, 0.14, 0.72], 0.04);
    min(smooth_min(body, head, 0.08), plinth)
}

fn body(q: Vec3) -> f32 {
    let torso = ellipsoid(q, [0.0, 0.95, -0.03], [0.72, 1.0, 0.46]);
    let shoulders = capsule(q, [0.0, 1.58, -0.05], [0.52, 1.50, -0.05], 0.27, 0.25);
    let belly = ellipsoid(q, [0.0, 0.78, 0.22], [0.48, 0.52, 0.30]);
    let upper_arm = capsule(q, [0.73, 1.43, -0.03], [0.75, 0.72, 0.04], 0.19, 0.16);
    let forearm = capsule(q, [0.75, 0.70, 0.06], [0.34, 0.50, 0.48], 0.15, 0.11);
    let mut body = smooth_min(torso, shoulders, 0.18);
    body = smooth_min(body, belly, 0.15);
    body = smooth_min(body, upper_arm, 0.05);
    body = smooth_min(body, forearm, 0.04);
    if q.z > 0.2 {
        for finger in 0..4 {
            let y = 0.56 - 0.055 * finger as f32;
            body = smooth_min(body, capsule(q, [0.36, y, 0.50], [0.09, y - 0.03, 0.535], 0.034, 0.026), 0.02);
        }
    }
    body
}

fn head(q: Vec3) -> f32 {
    // The head narrows upwards, and its face leans back.
    let q = Vec3::new(q.x * (1.0 + 0.10 * (q.y - 2.4)), q.y, q.z + 0.10 * (q.y - 2.6));
    let skull = rounded_box(q, [0.0, 2.60, -0.02], [0.41, 0.66, 0.40], 0.17);
    let neck = capsule(q, [0.0, 1.5, 0.0], [0.0, 2.1, 0.04], 0.40, 0.35);
    let jaw = rounded_box(q, [0.0, 2.08, 0.20], [0.35, 0.14, 0.27], 0.12);
    let mut head = smooth_min(skull, neck, 0.12);
    head = smooth_min(head, jaw, 0.14);
    if q.z > 0.1 {
        head = face(q, head);
    }
    let ear = rounded_box(q, [0.43, 2.58, -0.06], [0.085, 0.40, 0.13], 0.08);
    let ear_hollow = ellipsoid(q, [0.54, 2.66, -0.05], [0.09, 0.26, 0.06]);
    head = smooth_min(head, smooth_max(ear, -ear_hollow, 0.05), 0.04);
    // The hat is round, and turned on a lathe.
    let from_axis = Vec3::new((q.x * q.x + (q.z + 0.04) * (q.z + 0.04)).sqrt(), q.y, 0.0);
    let hat = rounded_box(from_axis, [0.0, 3.35, 0.0], [0.40, 0.17, 1.0], 0.07);
    let knob = rounded_box(from_axis, [0.0, 3.56, 0.0], [0.17, 0.09, 1.0], 0.05);
    smooth_min(head, smooth_min(hat, knob, 0.05), 0.015)
}

/// The head with its face, in front of z = 0.1.
fn face(q: Vec3, mut head: f32) -> f32 {
    let chin = ellipsoid(q, [0.0, 2.04, 0.43], [0.17, 0.10, 0.09]);
    let hollow_cheek = ellipsoid(q, [0.34, 2.42, 0.46], [0.14, 0.24, 0.13]);
    head = smooth_max(smooth_min(head, chin, 0.08), -hollow_cheek, 0.14);
    let brow = ellipsoid(q, [0.0, 2.97, 0.35], [0.40, 0.080, 0.150]);
    let socket = ellipsoid(q, [0.205, 2.80, 0.46], [0.160, 0.120, 0.20]);
    let eye = ellipsoid(q, [0.205, 2.775, 0.245], [0.130, 0.060, 0.095]);
    head = smooth_max(smooth_min(head, brow, 0.10), -socket, 0.06);
    head = smooth_min(head, eye, 0.02);
    let nose = capsule(q, [0.0, 2.95, 0.42], [0.0, 2.50, 0.58], 0.065, 0.105);
    let wing = ellipsoid(q, [0.11, 2.47, 0.49], [0.085, 0.075, 0.115]);
    let nostril = ellipsoid(q, [0.07, 2.39, 0.575], [0.035, 0.05, 0.045]);
    head = smooth_min(head, smooth_max(smooth_min(nose, wing, 0.06), -nostril, 0.03), 0.05);
    // The corners of the mouth hang down.
    let q = q + Vec3::Y * (1.1 * q.x * q.x);
    let upper_lip = ellipsoid(q, [0.0, 2.285, 0.42], [0.21, 0.040, 0.085]);
    let lower_lip = ellipsoid(q, [0.0, 2.215, 0.42], [0.18, 0.044, 0.085]);
    smooth_min(head, smooth_min(upper_lip, lower_lip, 0.02), 0.05)
}

/// The stone's relief at a point of the smooth figure: its height along the ray.
fn relief(p: Vec3) -> f32 {
    let scaled = |s: f32| (p * s).to_array();
    // Weathering, from dents as wide as a hand down to grains.
    let mut height = 0.0;
    let (mut amplitude, mut frequency) = (0.019, 2.4);
    for octave in 0..8 {
        height += amplitude * gradient(scaled(frequency), octave);
        amplitude *= 0.55;
        frequency *= 2.03;
    }
    // Pores of volcanic stone, in patches.
    let patch = gradient(scaled(1.9), 20) + 0.3;
    let pore = gradient(scaled(26.0), 21) - 0.28;
    if patch > 0.0 && pore > 0.0 {
        height -= 0.06 * min(patch, 0.5) * pore;
    }
    // Layers of ash, and a crack in the forehead.
    height += 0.004 * gradient([p.x * 1.5, p.y * 16.0, p.z * 1.5], 22);
    let aside =
        p.x - 0.19 - 0.16 * gradient([p.y * 2.6, p.y * 0.7, 0.5], 23) - 0.03 * gradient([p.y * 11.0, 0.3, 0.5], 24);
    let crack = 1.0 - aside.abs() * 45.0;
    let reach = min((p.y - 2.72) * 3.0, (3.45 - p.y) * 6.0);
    if p.z > 0.0 && crack > 0.0 && reach > 0.0 {
        height -= 0.05 * min(reach, 1.0) * crack;
    }
    height
}

fn ellipsoid(p: Vec3, centre: [f32; 3], radii: [f32; 3]) -> f32 {
    let (q, radii) = (p - Vec3::from(centre), Vec3::from(radii));
    let (k0, k1) = ((q / radii).length(), (q / (radii * radii)).length());
    if k1 > 1e-6 { k0 * (k0 - 1.0) / k1 } else { -min(radii.x, min(radii.y, radii.z)) }
}

/// A capsule whose radius changes linearly from one end to the other.
fn capsule(p: Vec3, a: [f32; 3], b: [f32; 3], radius_a: f32, radius_b: f32) -> f32 {
    let (pa, ba) = (p - Vec3::from(a), Vec3::from(b) - Vec3::from(a));
    let s = (pa.dot(ba) / ba.dot(ba)).clamp(0.0, 1.0);
    (pa - ba * s).length() - (radius_a + (radius_b - radius_a) * s)
}

fn rounded_box(p: Vec3, centre: [f32; 3], half: [f32; 3], radius: f32) -> f32 {
    let d = (p - Vec3::from(centre)).abs() - Vec3::from(half) + radius;
    let inside = min(max(d.x, max(d.y, d.z)), 0.0);
    Vec3::from(d.to_array().map(|x| max(x, 0.0))).length() + inside - radius
}

/// The lesser of two distances, blended where they differ by less than `k`.
fn smooth_min(a: f32, b: f32, k: f32) -> f32 {
    let h = max(k - (a - b).abs(), 0.0);
    min(a, b) - h * h / (4.0 * k)
}

fn smooth_max(a: f32, b: f32, k: f32) -> f32 {
    -smooth_min(-a, -b, k)
}

// `f32::min` and `f32::max` do not specify which zero they return of 0 and −0.
fn min(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

fn max(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_do_not_cross_within_the_figure() {
        for pair in FAN.windows(2) {
            let ([_, low, low_rise], [_, high, high_rise]) = (pair[0], pair[1]);
            // The plinth is the widest part, the head the narrowest.
            let reach = if high < 0.2 { 1.25 } else { 0.95 - 0.12 * low };
            for distance in [0.05, reach] {
                assert!(low + low_rise * distance < high + high_rise * distance, "{pair:?} at {distance}");
            }
        }
    }

    #[test]
    fn neighbouring_rays_end_near_each_other() {
        // Behind the wings of the nose, the lips and the arms no vertex falls back to a surface far behind.
        let side = |i: usize, height: f32| surface(BoxPoint::Side([i as f32 / 200.0 - 1.0, 1.0], height)).into();
        for row in 0..=500 {
            let height = row as f32 / 500.0;
            let points: [Vec3; 401] = std::array::from_fn(|i| side(i, height));
            let farthest = points.windows(2).map(|pair| (pair[1] - pair[0]).length()).fold(0.0, f32::max);
            assert!(farthest < 0.045, "{height}: {farthest}");
        }
    }

    #[test]
    fn parts_far_away_do_not_shape_the_surface() {
        // Where a plane stands in for a part, the part itself is farther than its blend reaches.
        for k in 0..20_000u32 {
            let at = |shift: u32| (k.wrapping_mul(0x9e37_79b9) >> shift & 0x3ff) as f32 / 1023.0;
            let q = Vec3::new(at(0) * 1.2, at(10) * 4.0, at(20) * 2.4 - 1.2);
            assert!(q.y < 2.15 || body(q) > 0.08, "{q}");
            assert!(q.y > 0.95 || head(q) > 0.08, "{q}");
        }
    }

    #[test]
    fn every_ray_ends_on_the_figure() {
        for k in 0..1000 {
            let along = [(k % 25) as f32 / 12.0 - 1.0, 1.0];
            let (origin_y, direction) = ray(BoxPoint::Side(along, k as f32 / 999.0));
            let [inside, outside] = [NEAREST, FARTHEST].map(|t| Vec3::Y * origin_y + direction * t);
            assert!(distance(inside) < 0.0 && distance(outside) > 0.0, "{along:?} {k}");
        }
    }
}
