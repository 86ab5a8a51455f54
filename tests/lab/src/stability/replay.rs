//! Random meshes and cameras, and the replay of a pair that failed.

use std::path::Path;

use anyhow::{Result, bail};
use renderer::{
    cli::say,
    grid::{Grid, GridOptions, Storage},
    intersect::InstructionSet,
    model::{
        mesh::Mesh,
        scene::{self, SceneSource},
    },
};
use shared::{camera::Camera, scene::Treatment};
use strum::VariantArray;

use super::{cameras, contenders::Tally, head, line};

/// Rays of a picture: few, because each is tested against each triangle.
const N_RAYS: u64 = 512;

pub(super) fn run(mesh: &Path, camera: &Camera) -> Result<()> {
    let mesh = scene::load(&SceneSource::File(mesh.to_owned()), Treatment::FLAT, &|_| ())?.mesh;
    let tally = check(&mesh, &camera.relative_to(mesh.origin));
    say(format_args!("{}\n{}", head(), line("replayed", &tally)))?;
    match tally.first_failure {
        None => Ok(()),
        Some(failure) => bail!("the default fails: {failure}"),
    }
}

/// Compares a picture with the reference, for every storage and instruction set.
pub(super) fn check(mesh: &Mesh, camera: &Camera) -> Tally {
    let mut sum = Tally::default();
    for &storage in Storage::VARIANTS {
        let options = GridOptions { storage, ..GridOptions::default() };
        let mut grid = Grid::build(mesh.clone(), &options, &|_| ());
        for set in InstructionSet::available() {
            grid = grid.with_instructions(set);
            let mut tally = cameras::rays_of(mesh, &grid, camera, N_RAYS);
            tally.first_failure = tally.first_failure.map(|failure| format!("{storage}, {set:?}: {failure}"));
            sum += tally;
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use proptest::prelude::*;

    use super::{
        super::{
            contenders::Contender,
            strategies::{mesh, point},
        },
        *,
    };
    use renderer::formats::ply;

    prop_compose! {
        /// A camera near or far that looks at a vertex.
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

    /// Writes a failure to files; the last and smallest one stays.
    fn keep(mesh: &Mesh, camera: &Camera) -> String {
        let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../target/stability-found"));
        let [mesh_path, camera_path] = ["mesh.ply", "camera.toml"].map(|name| folder.join(name));
        let kept = std::fs::create_dir_all(folder)
            .and_then(|()| ply::write(&mesh_path, mesh))
            .and_then(|()| channel::files::write(&camera_path, |out| out.write_all(camera.to_toml().as_bytes())));
        match kept {
            Ok(()) => format!("lab stability --replay {} {}", mesh_path.display(), camera_path.display()),
            Err(error) => format!("(cannot write the failure: {error})"),
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]

        #[test]
        fn any_camera_sees_any_mesh_right(scene in mesh().prop_flat_map(camera)) {
            if let Some((mesh, camera)) = scene {
                let tally = check(&mesh, &camera);
                if let Some(failure) = tally.first_failure {
                    let command = keep(&mesh, &camera);
                    return Err(TestCaseError::fail(format!("{failure}\nreplay it: {command}")));
                }
            }
        }
    }

    #[test]
    fn a_written_failure_can_be_replayed() {
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
