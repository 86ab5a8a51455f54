//! The intersection methods that `lab chart` and `lab stability` compare: Raywall's own, and rivals from the literature.
//!
//! Rivals have no margins and no second test. All are inlined, so that none pays for a call.

use std::ops::{Add, Div, Mul, Sub};

use renderer::{
    grid::traced::TracedMesh,
    intersect::{InstructionSet, filter, ray::Ray, triangle},
};
use serde::Serialize;

use crate::vector::{add, cross, dot, sub};

/// A method that decides whether and where a ray hits a triangle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Method {
    /// Volumes of tetrahedra between the ray's origin and the edges' ends, in `f32`.
    OriginEdgesF32,
    /// Möller and Trumbore, "Fast, Minimum Storage Ray/Triangle Intersection" (1997), in `f32`.
    MollerTrumboreF32,
    /// Plücker coordinates of edges relative to the ray's origin, in `f32`, as in Embree's robust mode.
    PluckerF32,
    /// Raywall: candidates are filtered in `f32`, many at a time; [`triangle::intersect`] decides what is left.
    Raywall,
    MollerTrumboreF64,
}

/// The nearest hit of a ray: triangle index and t.
pub(crate) type Answer = Option<(u32, f64)>;

impl Method {
    pub(crate) const ALL: [Self; 5] =
        [Self::OriginEdgesF32, Self::MollerTrumboreF32, Self::PluckerF32, Self::Raywall, Self::MollerTrumboreF64];

    pub(crate) fn label(self) -> &'static str {
        match self {
            Self::OriginEdgesF32 => "origin edges f32",
            Self::MollerTrumboreF32 => "Möller–Trumbore f32",
            Self::PluckerF32 => "Plücker f32",
            Self::Raywall => "Raywall",
            Self::MollerTrumboreF64 => "Möller–Trumbore f64",
        }
    }

    /// The t of a ray's hit with a triangle; `None` without a hit.
    pub(crate) fn intersect(self, ray: &Ray, corners: &[[f32; 3]; 3]) -> Option<f64> {
        match self {
            Self::OriginEdgesF32 => origin_edges(ray, corners),
            Self::MollerTrumboreF32 => moller_trumbore_f32(ray, corners),
            Self::PluckerF32 => plucker(ray, corners),
            Self::Raywall => triangle::intersect(ray, corners),
            Self::MollerTrumboreF64 => moller_trumbore_f64(ray, corners),
        }
    }

    /// The nearest candidate of each ray, of several at the same t the first. `candidates` are triangle indices, and `ends`
    /// holds the end of each ray's candidates.
    pub(crate) fn run(
        self,
        mesh: &TracedMesh,
        rays: &[Ray],
        candidates: &[u32],
        ends: &[usize],
        out: &mut Vec<Answer>,
    ) {
        match self {
            Self::OriginEdgesF32 => one_by_one(mesh, rays, candidates, ends, out, origin_edges),
            Self::MollerTrumboreF32 => one_by_one(mesh, rays, candidates, ends, out, moller_trumbore_f32),
            Self::PluckerF32 => one_by_one(mesh, rays, candidates, ends, out, plucker),
            Self::Raywall => raywall(mesh, rays, candidates, ends, out),
            Self::MollerTrumboreF64 => one_by_one(mesh, rays, candidates, ends, out, moller_trumbore_f64),
        }
    }
}

fn one_by_one(
    mesh: &TracedMesh,
    rays: &[Ray],
    candidates: &[u32],
    ends: &[usize],
    out: &mut Vec<Answer>,
    intersect: impl Fn(&Ray, &[[f32; 3]; 3]) -> Option<f64>,
) {
    let mut first = 0;
    for (ray, &end) in rays.iter().zip(ends) {
        let mut nearest: Answer = None;
        for &triangle_idx in &candidates[first..end] {
            if let Some(t) = intersect(ray, &mesh.corners(triangle_idx))
                && nearest.is_none_or(|(_, nearest_t)| t < nearest_t)
            {
                nearest = Some((triangle_idx, t));
            }
        }
        out.push(nearest);
        first = end;
    }
}

/// As single rays test the candidates of a cell, with t rounded to `f32` as in a hit.
fn raywall(mesh: &TracedMesh, rays: &[Ray], candidates: &[u32], ends: &[usize], out: &mut Vec<Answer>) {
    let instructions = InstructionSet::best();
    let mut first = 0;
    for (ray, &end) in rays.iter().zip(ends) {
        let mut nearest: Answer = None;
        for batch in candidates[first..end].chunks(filter::BATCH) {
            // SAFETY: these are the best instructions that this machine has.
            let mut left = unsafe { filter::may_hit(instructions, mesh, ray, batch) };
            while left != 0 {
                let triangle_idx = batch[left.trailing_zeros() as usize];
                left &= left - 1;
                let Some(t) = triangle::intersect(ray, &mesh.corners(triangle_idx)) else { continue };
                if nearest.is_none_or(|(_, nearest_t)| t < nearest_t) {
                    nearest = Some((triangle_idx, t));
                }
            }
        }
        out.push(nearest.map(|(triangle_idx, t)| (triangle_idx, f64::from(t as f32))));
        first = end;
    }
}

#[inline(always)]
fn moller_trumbore_f32(ray: &Ray, corners: &[[f32; 3]; 3]) -> Option<f64> {
    moller_trumbore(ray.origin.to_array(), ray.direction.to_array(), *corners).map(f64::from)
}

#[inline(always)]
fn moller_trumbore_f64(ray: &Ray, corners: &[[f32; 3]; 3]) -> Option<f64> {
    let double = |vector: [f32; 3]| vector.map(f64::from);
    moller_trumbore(double(ray.origin.to_array()), double(ray.direction.to_array()), corners.map(double))
}

#[inline(always)]
fn moller_trumbore<R>(origin: [R; 3], direction: [R; 3], [a, b, c]: [[R; 3]; 3]) -> Option<R>
where
    R: Copy + From<u8> + PartialOrd + Add<Output = R> + Sub<Output = R> + Mul<Output = R> + Div<Output = R>,
{
    let (zero, one) = (R::from(0), R::from(1));
    let (edge_ab, edge_ac) = (sub(b, a), sub(c, a));
    let p = cross(direction, edge_ac);
    let determinant = dot(edge_ab, p);
    if determinant == zero {
        return None;
    }
    let inverse = one / determinant;
    let to_origin = sub(origin, a);
    let u = dot(to_origin, p) * inverse;
    let q = cross(to_origin, edge_ab);
    let v = dot(direction, q) * inverse;
    let t = dot(edge_ac, q) * inverse;
    (u >= zero && v >= zero && u + v <= one && t >= zero).then_some(t)
}

#[inline(always)]
fn plucker(ray: &Ray, corners: &[[f32; 3]; 3]) -> Option<f64> {
    let direction = ray.direction.to_array();
    let [v0, v1, v2] = corners.map(|corner| sub(corner, ray.origin.to_array()));
    let edges = [(v2, v0), (v0, v1), (v1, v2)];
    let sides = edges.map(|(from, to)| dot(direction, cross(sub(from, to), add(from, to))));
    is_one_side(sides)?;
    let normal = cross(sub(v2, v0), sub(v1, v0));
    distance(dot(normal, v0), dot(normal, direction))
}

#[inline(always)]
fn origin_edges(ray: &Ray, corners: &[[f32; 3]; 3]) -> Option<f64> {
    let direction = ray.direction.to_array();
    let [v0, v1, v2] = corners.map(|corner| sub(corner, ray.origin.to_array()));
    let normals = [(v0, v1), (v1, v2), (v2, v0)].map(|(from, to)| cross(from, to));
    let sides = normals.map(|normal| dot(direction, normal));
    is_one_side(sides)?;
    // The triangle's normal is the sum of the normals of the planes through origin and edges.
    let normal = add(add(normals[0], normals[1]), normals[2]);
    distance(dot(normal, v0), sides[0] + sides[1] + sides[2])
}

#[inline(always)]
fn is_one_side(sides: [f32; 3]) -> Option<()> {
    (sides.iter().all(|&side| side >= 0.0) || sides.iter().all(|&side| side <= 0.0)).then_some(())
}

#[inline(always)]
fn distance(numerator: f32, determinant: f32) -> Option<f64> {
    let t = numerator / determinant;
    (determinant != 0.0 && t >= 0.0).then_some(f64::from(t))
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use renderer::model::mesh::Mesh;

    #[test]
    fn all_methods_agree_where_nothing_is_hard() {
        let mesh = Mesh {
            vertices: vec![[-1.0, -1.0, 5.0], [3.0, -1.0, 5.0], [-1.0, 3.0, 5.0], [-1.0, -1.0, 7.0], [3.0, 3.0, 7.0]],
            triangles: vec![[1, 4, 3], [0, 1, 2], [2, 1, 0]],
            ..Mesh::default()
        };
        let mesh = TracedMesh::new(mesh, vec![0, 1, 2]);
        let rays = [[0.1, 0.1, 1.0], [0.2, 0.1, 1.0], [0.3, 0.2, 1.0], [-0.5, 0.0, 1.0], [0.1, 0.1, -1.0]]
            .map(|direction| Ray::new(Vec3::ZERO, Vec3::from_array(direction)));
        for method in Method::ALL {
            let mut answers = Vec::new();
            method.run(&mesh, &rays, &[0, 1, 2, 0, 2, 1, 0, 1, 0, 1, 2], &[3, 6, 8, 9, 11], &mut answers);
            let near = |answer: Answer| answer.map(|(triangle_idx, t)| (triangle_idx, (t * 1e4).round() / 1e4));
            let answers: Vec<_> = answers.into_iter().map(near).collect();
            assert_eq!(answers[..2], [Some((1, 5.0)), Some((2, 5.0))], "{method:?}: the first of equals");
            assert_eq!(answers[3..], [None, None], "{method:?}");
            assert!(
                answers[2].is_some_and(|(triangle_idx, t)| triangle_idx == 0 && (5.0..7.0).contains(&t)),
                "{method:?} {answers:?}"
            );
        }
    }
}
