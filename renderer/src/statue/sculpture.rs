//! The figure: a smooth union of simple solids, as a signed distance, and the stone's relief on it.
//!
//! Distances and smooth unions after Quilez, "Distance functions" and "Smooth minimum" (iquilezles.org).

use super::Place;
use super::noise::gradient;

type Vector = [f32; 3];

/// Where the ray that belongs to a place on the box leaves the figure, in world space.
pub(super) fn surface(place: Place) -> Vector {
    let (origin_y, direction) = ray(place);
    let point = |t: f32| [direction[0] * t, origin_y + direction[1] * t, direction[2] * t];

    // From outside inwards, so that the outermost surface is found.
    let mut t = FARTHEST;
    for _ in 0..64 {
        let d = distance(point(t));
        t -= d * 0.8; // smooth unions and ellipsoids overestimate distances a little
        if d < 1e-4 || t < NEAREST {
            break;
        }
    }
    let t = max(t, NEAREST);
    point(t + relief(point(t)))
}

/// Every solid lies within this distance of the axis, along any ray.
const FARTHEST: f32 = 2.2;
/// Rays end here at the latest, so that the surface stays closed.
const NEAREST: f32 = 0.05;

/// The ray of a place: its origin's height on the y axis, and its direction of length 1.
fn ray(place: Place) -> (f32, Vector) {
    let (along, height, rise) = match place {
        Place::Side(along, height) => {
            let t = 2.0 * height - 1.0;
            (along, LOWEST_ORIGIN + (HIGHEST_ORIGIN - LOWEST_ORIGIN) * height, t * t * t)
        }
        Place::Top(along) => (along, HIGHEST_ORIGIN, 1.0),
        Place::Bottom(along) => (along, LOWEST_ORIGIN, -1.0),
    };
    // On top and bottom, how far from the middle; 1 on the sides.
    let spread = max(along[0].abs(), along[1].abs());
    let around = if spread > 0.0 { along.map(|x| even_angle(x / spread)) } else { [0.0; 2] };
    let outwards = if spread > 0.0 { spread / (around[0] * around[0] + around[1] * around[1]).sqrt() } else { 0.0 };
    (height, normalize([around[0] * outwards, rise, around[1] * outwards]))
}

const LOWEST_ORIGIN: f32 = 0.35;
const HIGHEST_ORIGIN: f32 = 3.15;

/// tan(x·π/4) to three digits: steps along a side of the square become nearly equal angles.
fn even_angle(x: f32) -> f32 {
    x * (0.785 + x * x * (0.162 + x * x * 0.053))
}

/// Signed distance to the smooth figure, in world units; negative inside.
fn distance(p: Vector) -> f32 {
    // The figure is the same left and right.
    let q = [p[0].abs(), p[1], p[2]];

    let torso = ellipsoid(q, [0.0, 0.95, -0.03], [0.72, 1.0, 0.46]);
    let shoulders = capsule(q, [0.0, 1.58, -0.05], [0.52, 1.50, -0.05], 0.27, 0.25);
    let belly = ellipsoid(q, [0.0, 0.78, 0.22], [0.48, 0.52, 0.30]);
    let upper_arm = capsule(q, [0.74, 1.45, -0.03], [0.78, 0.72, 0.02], 0.17, 0.14);
    let forearm = capsule(q, [0.78, 0.70, 0.04], [0.34, 0.50, 0.50], 0.13, 0.10);
    let mut body = smooth_min(torso, shoulders, 0.18);
    body = smooth_min(body, belly, 0.15);
    body = smooth_min(body, upper_arm, 0.05);
    body = smooth_min(body, forearm, 0.04);
    for finger in 0..4 {
        let y = 0.56 - 0.055 * finger as f32;
        body = smooth_min(body, capsule(q, [0.36, y, 0.50], [0.09, y - 0.03, 0.535], 0.034, 0.026), 0.02);
    }

    let skull = rounded_box(q, [0.0, 2.66, 0.0], [0.42, 0.72, 0.40], 0.17);
    let neck = capsule(q, [0.0, 1.5, 0.0], [0.0, 2.1, 0.04], 0.40, 0.36);
    let jaw = rounded_box(q, [0.0, 2.10, 0.20], [0.37, 0.15, 0.27], 0.12);
    let mut head = smooth_min(skull, neck, 0.12);
    head = smooth_min(head, jaw, 0.12);
    let brow = capsule(q, [0.0, 3.00, 0.44], [0.36, 2.97, 0.36], 0.085, 0.075);
    head = smooth_min(head, brow, 0.08);
    let socket = ellipsoid(q, [0.215, 2.84, 0.47], [0.165, 0.115, 0.16]);
    head = smooth_max(head, -socket, 0.06);
    let nose = capsule(q, [0.0, 2.96, 0.43], [0.0, 2.50, 0.56], 0.065, 0.115);
    let nostril = ellipsoid(q, [0.115, 2.47, 0.50], [0.075, 0.065, 0.10]);
    head = smooth_min(head, smooth_min(nose, nostril, 0.05), 0.05);
    let upper_lip = capsule(q, [0.0, 2.285, 0.475], [0.20, 2.265, 0.42], 0.050, 0.035);
    let lower_lip = capsule(q, [0.0, 2.185, 0.475], [0.18, 2.190, 0.42], 0.052, 0.035);
    head = smooth_min(head, upper_lip, 0.03);
    head = smooth_min(head, lower_lip, 0.03);
    let ear = rounded_box(q, [0.45, 2.66, -0.06], [0.055, 0.40, 0.11], 0.05);
    let ear_hollow = ellipsoid(q, [0.52, 2.72, -0.03], [0.04, 0.22, 0.05]);
    head = smooth_min(head, smooth_max(ear, -ear_hollow, 0.03), 0.03);

    let plinth = rounded_box(q, [0.0, 0.14, 0.0], [1.0, 0.14, 0.72], 0.04);
    min(smooth_min(body, head, 0.08), plinth)
}

/// The stone's relief at a point of the smooth figure: how far it stands out along the ray.
fn relief(p: Vector) -> f32 {
    let scaled = |s: f32| [p[0] * s, p[1] * s, p[2] * s];
    // Weathering, from dents of a hand's width down to grains.
    let mut height = 0.0;
    let (mut amplitude, mut frequency) = (0.016, 2.7);
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
    // Layers of ash, and a few cracks.
    height += 0.004 * gradient([p[0] * 1.5, p[1] * 16.0, p[2] * 1.5], 22);
    let crack = 1.0 - gradient([p[0] * 1.3, p[1] * 0.9, p[2] * 1.3], 23).abs() * 60.0;
    if crack > 0.0 {
        height -= 0.02 * crack;
    }
    height
}

fn ellipsoid(p: Vector, center: Vector, radii: Vector) -> f32 {
    let q = sub(p, center);
    let k0 = length([q[0] / radii[0], q[1] / radii[1], q[2] / radii[2]]);
    let k1 = length([q[0] / (radii[0] * radii[0]), q[1] / (radii[1] * radii[1]), q[2] / (radii[2] * radii[2])]);
    if k1 > 1e-6 { k0 * (k0 - 1.0) / k1 } else { -min(radii[0], min(radii[1], radii[2])) }
}

/// A capsule whose radius changes evenly from one end to the other.
fn capsule(p: Vector, a: Vector, b: Vector, radius_a: f32, radius_b: f32) -> f32 {
    let (pa, ba) = (sub(p, a), sub(b, a));
    let s = (dot(pa, ba) / dot(ba, ba)).clamp(0.0, 1.0);
    length([pa[0] - ba[0] * s, pa[1] - ba[1] * s, pa[2] - ba[2] * s]) - (radius_a + (radius_b - radius_a) * s)
}

fn rounded_box(p: Vector, center: Vector, half: Vector, radius: f32) -> f32 {
    let q = sub(p, center);
    let d = [q[0].abs() - half[0] + radius, q[1].abs() - half[1] + radius, q[2].abs() - half[2] + radius];
    let inside = min(max(d[0], max(d[1], d[2])), 0.0);
    length(d.map(|x| max(x, 0.0))) + inside - radius
}

/// The lesser of two distances, blended where they differ by less than `k`.
fn smooth_min(a: f32, b: f32, k: f32) -> f32 {
    let h = max(k - (a - b).abs(), 0.0);
    min(a, b) - h * h / (4.0 * k)
}

fn smooth_max(a: f32, b: f32, k: f32) -> f32 {
    -smooth_min(-a, -b, k)
}

// Not `f32::min` and `f32::max`: which zero they return of 0 and −0 is not specified.
fn min(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

fn max(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

fn sub(a: Vector, b: Vector) -> Vector {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn dot(a: Vector, b: Vector) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn length(a: Vector) -> f32 {
    dot(a, a).sqrt()
}

fn normalize(a: Vector) -> Vector {
    let scale = 1.0 / length(a);
    a.map(|x| x * scale)
}
