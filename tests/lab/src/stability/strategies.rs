//! Random meshes and rays for property tests.

use glam::Vec3;
use proptest::prelude::*;
use renderer::{intersect::ray::Ray, model::mesh::Mesh};

/// Numbers that often coincide, and some that do not.
fn coordinate() -> impl Strategy<Value = f32> {
    prop_oneof![
        (-8i32..=8).prop_map(|n| n as f32),
        (-32i32..=32).prop_map(|n| n as f32 / 4.0),
        -8.0f32..8.0,
        Just(-0.0),
        Just(1e-6),
        Just(1e4),
    ]
}

pub(super) fn point() -> impl Strategy<Value = [f32; 3]> {
    [coordinate(), coordinate(), coordinate()]
}

prop_compose! {
    /// Triangles over common vertices, moved and scaled.
    pub(super) fn mesh()(
        vertices in proptest::collection::vec(point(), 3..40),
        corners in proptest::collection::vec([(); 3].map(|()| any::<prop::sample::Index>()), 1..60),
        scale in prop_oneof![Just(1.0f32), Just(1e-8), Just(1e8), Just(0.37)],
        offset in prop_oneof![Just(0.0f32), Just(1e3), Just(1e5)],
    ) -> Mesh {
        let triangles = corners.iter().map(|three| three.map(|index| index.index(vertices.len()) as u32)).collect();
        let moved = |vertex: &[f32; 3]| vertex.map(|x| (x + offset) * scale);
        Mesh { vertices: vertices.iter().map(moved).collect(), triangles, ..Mesh::default() }
    }
}

/// A ray from a vertex of a mesh, from within a triangle or from elsewhere, towards any of these, whole or cut short.
pub(super) fn ray(mesh: &Mesh) -> impl Strategy<Value = Ray> + use<> {
    let vertices: Vec<_> = mesh.vertices.iter().copied().map(Vec3::from_array).collect();
    let corners: Vec<_> = mesh.triangles.iter().map(|three| three.map(|number| vertices[number as usize])).collect();
    let size = vertices.iter().fold(0.0, |size: f32, vertex| size.max((*vertex - vertices[0]).length()));
    let within = (prop::sample::select(corners), 0.0..1.0f32, 0.0..1.0f32)
        .prop_map(|([a, b, c], u, v)| a + (b - a) * u + (c - a) * (v * (1.0 - u)));
    let elsewhere = (prop::sample::select(vertices.clone()), point())
        .prop_map(move |(vertex, offset)| vertex + Vec3::from_array(offset) * (0.1 * size));
    let place = prop_oneof![prop::sample::select(vertices), within, elsewhere];
    let t_max = prop_oneof![2 => Just(f32::MAX), 1 => Just(f32::INFINITY), 2 => 0.0..2.0f32, 1 => Just(1.0f32)];
    let far = prop_oneof![Just(1.0f32), Just(1e-3), Just(1e4)];
    (place.clone(), place, t_max, far).prop_map(|(origin, target, t_max, far)| Ray {
        t_max,
        ..Ray::new(target + (origin - target) * far, target - origin)
    })
}
