//! Walls that are not flat, with meshes: what projectors that truly stand in the room make of the GPU's picture.

use std::f64::consts::{FRAC_PI_6, PI};

use compositor::{
    gpu::{Offscreen, Present},
    wall::{Projector, Wall},
};
use glam::DVec2;

use super::{Room, check_room, projector::TrueProjector, rig::Rig, surface::Surface};
use crate::pictures::{Frame, check_twin, draw, gpu};

/// One projector hangs upside down, and one projects from behind; light of their own.
const OPTICS: &str = "[optics]\ngamma = 2.2\nblack_level = 0.004\n";
const TURNED: &str = "[[projector]]\nname = \"row 1 column 2\"\nrotation = 180\ngain = [0.9, 1.0, 0.8]\n\
                      [[projector]]\nname = \"row 1 column 3\"\nflip = \"horizontal\"\n";

/// One projector hangs upside down.
pub(crate) const UPSIDE_DOWN: &str = "[[projector]]\nname = \"row 1 column 2\"\nrotation = 180\n";

/// A quarter of a cylinder, three projectors.
pub(crate) fn cylinder(pixels: [u32; 2], keys: [&str; 2]) -> Rig {
    let radius = 2.0;
    let width_m = radius * PI / 2.0;
    let surface = Surface::Cylinder { middle: width_m / 2.0, radius };
    Rig::on(surface, [width_m, 0.75], 3, pixels, 0.01, keys)
}

/// A wall that is called flat but bends by 56 mm over three metres, three projectors.
pub(crate) fn nearly_flat(pixels: [u32; 2]) -> Rig {
    Rig::on(Surface::Cylinder { middle: 1.5, radius: 20.0 }, [3.0, 0.75], 3, pixels, 0.01, ["", ""])
}

/// Two planes at 120°, three projectors; the middle one lights both.
pub(crate) fn fold(pixels: [u32; 2], keys: [&str; 2]) -> Rig {
    Rig::on(Surface::Fold { middle: 1.5, turned: FRAC_PI_6 }, [3.0, 0.75], 3, pixels, 0.01, keys)
}

/// A part of a sphere, three projectors; unrolled around its middle or by longitude and latitude.
pub(crate) fn dome(by_longitude: bool, pixels: [u32; 2], keys: [&str; 2]) -> Rig {
    let canvas_m = [3.0, 0.75];
    let surface = Surface::Dome { middle: DVec2::from(canvas_m) / 2.0, radius: 2.2, by_longitude };
    Rig::on(surface, canvas_m, 3, pixels, 0.01, keys)
}

#[test]
fn a_cylinder_a_fold_and_a_dome_show_no_seam_and_no_displacement() {
    let gpu = gpu();
    for (name, rig, n_points) in [
        ("cylinder", cylinder([256, 192], [OPTICS, TURNED]), [33, 25]),
        ("fold", fold([256, 192], [OPTICS, TURNED]), [257, 49]),
        ("dome", dome(false, [256, 192], [OPTICS, TURNED]), [33, 25]),
    ] {
        let wall = rig.true_wall(n_points);
        assert!(wall.black() > 0.007 && wall.black() < 0.013, "{}", wall.black());
        check_room(&gpu, name, &Room::with(&wall, &rig.projectors), 6000);
    }
}

#[test]
fn walls_with_meshes_equal_their_cpu_twin() {
    let gpu = gpu();
    let mut present = Present::new(&gpu);
    let rig = cylinder([128, 96], [OPTICS, TURNED]);
    let wall = rig.true_wall([9, 7]);
    // Corners are moved on top of the first mesh, and the second stands beside a projector without one.
    let corners = wall.with_warps(&[(0, [[6.0, 3.0], [-4.5, -7.0], [-8.0, -2.0], [3.0, -5.0]])]).unwrap();
    let mut mixed: Vec<Projector> = corners.projectors().to_vec();
    mixed[2].mesh = None;
    let mixed = Wall::new(wall.canvas_m(), wall.frame_size(), mixed).unwrap();
    for wall in [&wall, &corners, &mixed] {
        for (what, frame) in Frame::all([64, 36]) {
            present.upload(&gpu, frame.size, &frame.rgba).unwrap();
            for (size, has_srgb_view) in [(wall.output_size(), true), ([300, 90], false), ([700, 260], true)] {
                let offscreen = Offscreen::with_srgb_view(&gpu, size, has_srgb_view).unwrap();
                check_twin(&gpu, &draw(&gpu, &mut present, wall, &offscreen), what, &frame, wall);
            }
        }
    }
}

/// The truth again: a projector that is bumped is mended by its corners, on top of its mesh.
#[test]
fn corners_correct_a_projector_with_a_mesh_after_a_bump() {
    let rig = cylinder([256, 192], ["", ""]);
    let wall = rig.true_wall([33, 25]);
    let mut bumped = rig.projectors.clone();
    bumped[1].pinhole = bumped[1].pinhole.bumped([0.012, -0.008]);
    // Pixels of a projector that turns about its centre move by a homography, whatever it lights.
    let size = DVec2::new(256.0, 192.0);
    let moved = |corner: [f64; 2]| {
        let px = DVec2::from(corner) * size;
        (bumped[1].px(rig.projectors[1].point(px)) - px).to_array()
    };
    let warp_px = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(moved);
    let mended = wall.with_warps(&[(1, warp_px)]).unwrap();
    let apart = |wall: &Wall, stands: &[TrueProjector]| {
        let away = |n: u32| {
            let px = DVec2::new(f64::from(n % 16) + 0.5, f64::from(n / 16) + 0.5) / 16.0 * size;
            let output = wall.projectors()[1].output.origin() + px;
            let shown = wall.canvas_at(output) * DVec2::from(wall.canvas_m());
            stands[1].px(shown).distance(px)
        };
        (0..256).map(away).fold(0.0, f64::max)
    };
    assert!(apart(&wall, &rig.projectors) < 0.02, "{}", apart(&wall, &rig.projectors));
    assert!(apart(&wall, &bumped) > 2.0);
    assert!(apart(&mended, &bumped) < 0.05, "{}", apart(&mended, &bumped));
}
