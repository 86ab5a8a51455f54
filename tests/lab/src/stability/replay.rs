//! Any mesh seen by any camera, and pairs of them that have failed once.

use std::path::Path;

use anyhow::{Result, bail};
use renderer::{
    cli::say,
    grid::{Grid, GridOptions, MeshLayout, Storage},
    intersect::InstructionSet,
    model::{
        mesh::Mesh,
        scene::{self, SceneSource},
    },
};
use shared::camera::Camera;

use super::{cameras, contenders::Tally, head, line};

/// Rays of a picture: few, for each is tested with each triangle.
const N_RAYS: u64 = 512;

/// Tries a mesh from a file again.
pub(super) fn run(mesh: &Path, camera: &Camera) -> Result<()> {
    let mesh = scene::load(&SceneSource::Ply(mesh.to_owned()), &|_| ())?.mesh;
    let tally = check(&mesh, camera);
    say(format_args!("{}\n{}", head(), line("replayed", &tally)))?;
    match tally.first_failure {
        None => Ok(()),
        Some(failure) => bail!("the default fails: {failure}"),
    }
}

/// A picture against the reference, for every way to keep the mesh and every instruction set.
pub(super) fn check(mesh: &Mesh, camera: &Camera) -> Tally {
    let mut sum = Tally::default();
    for (storage, layout) in
        Storage::ALL.into_iter().flat_map(|storage| [(storage, MeshLayout::Indexed), (storage, MeshLayout::Flat)])
    {
        let options = GridOptions { storage, mesh: layout, ..GridOptions::default() };
        let mut grid = Grid::build(mesh.clone(), &options, &|_| ());
        for set in InstructionSet::available() {
            grid = grid.with_instructions(set);
            let mut tally = cameras::rays_of(mesh, &grid, camera, N_RAYS);
            tally.first_failure = tally.first_failure.map(|what| format!("{storage}, {layout}, {set:?}: {what}"));
            sum += tally;
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use proptest::prelude::*;

    use super::{super::contenders::Contender, *};
    use renderer::model::ply;

    /// Numbers that meet each other often, and some that do not.
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

    fn point() -> impl Strategy<Value = [f32; 3]> {
        [coordinate(), coordinate(), coordinate()]
    }

    prop_compose! {
        /// Triangles over common vertices, moved and scaled.
        fn mesh()(
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

    prop_compose! {
        /// From near or far towards somewhere in a mesh, or any other way.
        fn camera(mesh: Mesh)(
            (eye, target) in (point(), any::<prop::sample::Index>()),
            (far, fov) in (prop_oneof![Just(1.0), Just(30.0), Just(1e4)], prop_oneof![Just(0.6), Just(1e-3), Just(2.8)]),
            up in point(),
        ) -> Option<(Mesh, Camera)> {
            let double = |p: [f32; 3]| DVec3::from_array(p.map(f64::from));
            let bounds = mesh.bounds();
            let size = (double(bounds.max) - double(bounds.min)).length();
            let target = double(mesh.vertices[target.index(mesh.vertices.len())]);
            let eye = target + double(eye) * (0.1 * size * far);
            let up = double(up);
            let camera = Camera::look_at(eye, target, if up == DVec3::ZERO { DVec3::Y } else { up }, fov, 2.0);
            camera.ok().map(|camera| (mesh.clone(), camera))
        }
    }

    /// Leaves what failed in files, each failure in place of the last: the smallest stays.
    fn keep(mesh: &Mesh, camera: &Camera) -> String {
        let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../target/stability-found"));
        let [mesh_path, camera_path] = ["mesh.ply", "camera.toml"].map(|name| folder.join(name));
        let kept = std::fs::create_dir_all(folder)
            .and_then(|()| ply::write(&mesh_path, mesh))
            .and_then(|()| std::fs::write(&camera_path, camera.to_toml()));
        match kept {
            Ok(()) => format!("lab stability --replay {} {}", mesh_path.display(), camera_path.display()),
            Err(error) => format!("(nothing could be kept: {error})"),
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]

        #[test]
        fn any_mesh_is_seen_right_by_any_camera(scene in mesh().prop_flat_map(camera)) {
            if let Some((mesh, camera)) = scene {
                let tally = check(&mesh, &camera);
                if let Some(failure) = tally.first_failure {
                    let command = keep(&mesh, &camera);
                    return Err(TestCaseError::fail(format!("{failure}\ntry it again: {command}")));
                }
            }
        }
    }

    #[test]
    fn what_is_kept_can_be_tried_again() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mesh.ply");
        let mesh = Mesh {
            vertices: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, -0.0]],
            triangles: vec![[0, 1, 2]],
            ..Mesh::default()
        };
        ply::write(&path, &mesh).unwrap();
        let camera = Camera::look_at(DVec3::Z, DVec3::ZERO, DVec3::Y, 0.6, 2.0).unwrap();
        let tally = check(&mesh, &camera);
        assert_eq!(tally.first_failure, None);
        assert!(Contender::ALL.iter().zip(tally.wrong).all(|(_, wrong)| wrong.is_some()));
        run(&path, &Camera::from_toml(&camera.to_toml()).unwrap()).unwrap();
    }
}
