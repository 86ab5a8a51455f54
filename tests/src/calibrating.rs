//! Aligning a wall with a camera, in the virtual room and by the program.

use std::{f64::consts::PI, fs, sync::OnceLock};

use compositor::{
    calibration::{Codebook, Placement, Plan, Reading, Verdict, judge},
    wall::{Surface, Unrolling, Wall},
};
use glam::{DVec2, DVec3};

use crate::room::{
    bent,
    camera::{Camera, Random},
    rig::Rig,
};

/// Six projectors; one hangs upside down, and one projects from behind.
const TURNED: &str = "[[projector]]\nname = \"row 1 column 2\"\nrotation = 180\n[[projector]]\nname = \"row 2 column 1\"\n\
                      flip = \"horizontal\"\n";

fn six() -> Rig {
    Rig::new([3, 2], [256, 192], 0.02, TURNED)
}

/// A camera that sees all of the six.
fn tripod(rig: &Rig) -> Camera {
    rig.camera([900, 640], DVec3::new(1.7, 0.9, 3.3), DVec2::new(1.5, 0.75), 0.95)
}

/// The six, their patterns, a camera that sees them all, and a photograph of every pattern.
fn photographed() -> (Rig, Plan, Camera, Vec<Reading>) {
    static PHOTOGRAPHED: OnceLock<(Rig, Plan, Camera, Vec<Reading>)> = OnceLock::new();
    let take = || {
        let mut rig = six();
        let plan = Plan::of_wall(&rig.wall).unwrap();
        let camera = tripod(&rig);
        let readings = readings(&mut rig, &plan, &camera, &[]);
        (rig, plan, camera, readings)
    };
    PHOTOGRAPHED.get_or_init(take).clone()
}

/// A photograph of every pattern.
fn readings(rig: &mut Rig, plan: &Plan, camera: &Camera, off: &[usize]) -> Vec<Reading> {
    let codebook = Codebook::new(plan);
    let read = |pattern: u32| {
        rig.show(plan, pattern, off);
        rig.read(camera, &codebook, &format!("{pattern}.png"), None, pattern.into())
    };
    (0..plan.n_patterns()).map(read).collect()
}

#[test]
fn a_camera_on_a_tripod_aligns_projectors_however_they_hang() {
    let (rig, plan, _, readings) = photographed();
    let before = rig.agreement(&rig.wall);
    let Verdict { wall, found, faults, .. } = judge(&rig.wall, &plan, &readings, None);
    assert!(faults.is_empty(), "{faults:?}\n{found:#?}");
    assert!(!found.iter().any(|line| is_off_throughout(line)), "{found:#?}");
    let after = rig.agreement(&wall.unwrap());
    assert!(before.apart_px[0] > 2.0, "{before:?}");
    assert!(after.apart_px[0] < 0.1 && after.apart_px[1] < 0.3 && after.bent_px < 0.3, "{after:?}");
    assert!(plan.n_patterns() <= 4);
}

#[test]
fn a_phone_in_two_hands_joins_what_each_photograph_sees_in_any_order() {
    let mut rig = six();
    let plan = Plan::of_wall(&rig.wall).unwrap();
    let codebook = Codebook::new(&plan);
    let mut readings = Vec::new();
    let mut random = Random::new(3);
    for (place, target) in [1.05, 1.95].into_iter().enumerate() {
        for pattern in 0..plan.n_patterns() {
            rig.show(&plan, pattern, &[]);
            let mut shake = || random.around(0.02);
            let at = DVec3::new(target + shake(), 0.8 + shake(), 2.4 + shake());
            let camera = rig.camera([800, 600], at, DVec2::new(target + shake(), 0.75 + shake()), 1.0);
            let camera = Camera { jpeg: Some(88), noise: 0.05, blur_px: 0.9, ..camera };
            readings.push(rig.read(&camera, &codebook, &format!("{place}-{pattern}.jpg"), None, pattern.into()));
        }
    }
    readings.reverse();
    // Nobody sees all of the wall.
    assert!(readings.iter().all(|reading| !reading.line(&rig.wall).contains("6 of 6")));
    let Verdict { wall, found, faults, .. } = judge(&rig.wall, &plan, &readings, None);
    assert!(faults.is_empty(), "{faults:?}\n{found:#?}");
    assert!(!found.iter().any(|line| is_off_throughout(line)), "{found:#?}");
    let after = rig.agreement(&wall.unwrap());
    assert!(after.apart_px[0] < 0.15 && after.apart_px[1] < 0.5 && after.bent_px < 0.5, "{after:?}");
}

#[test]
fn bad_photographs_are_named_and_count_for_nothing() {
    let (mut rig, plan, camera, mut all) = photographed();
    let codebook = Codebook::new(&plan);
    let good = judge(&rig.wall, &plan, &all, None).wall.unwrap();
    rig.show(&plan, 0, &[]);
    // Patterns are lost first where the light is brightest.
    let bright = Camera { exposure: 2.0 * camera.exposure, ..camera.clone() };
    let line = rig.read(&bright, &codebook, "bright in part", None, 9).line(&rig.wall);
    assert!(line.contains("shows pattern 1 on") && line.contains("it is over-exposed"), "{line}");
    let mut add = |rig: &Rig, camera: Camera, obstacle, name: &str| {
        all.push(rig.read(&camera, &codebook, name, obstacle, 9));
        all.last().unwrap().line(&rig.wall)
    };
    let dark = Camera { exposure: 0.004, ..camera.clone() };
    assert!(add(&rig, dark, None, "dark").contains("too dark"));
    let bright = Camera { exposure: 60.0, ..camera.clone() };
    assert!(add(&rig, bright, None, "bright").contains("over-exposed"));
    let blurred = Camera { blur_px: 14.0, ..camera.clone() };
    assert!(add(&rig, blurred, None, "blurred").contains("sharp"));
    // A person in front of two projectors.
    let person = Some([DVec2::new(0.3, 0.2), DVec2::new(0.5, 1.0)]);
    let line = add(&rig, camera.clone(), person, "person");
    assert!(line.contains("shows pattern 1 on"), "{line}");
    // The same projectors under another name.
    let mut other = Rig { wall: renamed(&rig.wall), ..rig.clone() };
    let plan_of_other = Plan::of_wall(&other.wall).unwrap();
    other.show(&plan_of_other, 0, &[]);
    let line = add(&other, camera.clone(), None, "other");
    assert!(line.contains("not those of this wall file"), "{line}");
    let Verdict { wall, faults, .. } = judge(&rig.wall, &plan, &all, None);
    assert!(faults.is_empty(), "{faults:?}");
    for (a, b) in wall.unwrap().projectors().iter().zip(good.projectors()) {
        let apart = a.warp_px.as_flattened().iter().zip(b.warp_px.as_flattened()).map(|(a, b)| (a - b).abs());
        assert!(apart.fold(0.0, f64::max) < 0.3, "{:?} {:?}", a.warp_px, b.warp_px);
    }
}

fn renamed(wall: &Wall) -> Wall {
    Wall::from_toml("other", &wall.to_toml().replace("row 1", "line 1")).unwrap()
}

#[test]
fn a_projector_that_is_off_or_stands_alone_is_named_with_the_cure() {
    let mut rig = six();
    let plan = Plan::of_wall(&rig.wall).unwrap();
    let camera = tripod(&rig);
    let all = readings(&mut rig, &plan, &camera, &[4]);
    let Verdict { wall, faults, .. } = judge(&rig.wall, &plan, &all, None);
    assert_eq!(faults.len(), 1, "{faults:?}");
    assert!(faults[0].contains("\"row 2 column 2\" is in no photograph: is it on"), "{faults:?}");
    assert_eq!(wall.unwrap().projectors()[4].warp_px, [[0.0; 2]; 4]);
    // Close-ups that share no projector.
    let codebook = Codebook::new(&plan);
    rig.show(&plan, 0, &[]);
    let close_up = |x: f64| rig.camera([700, 500], DVec3::new(x, 1.1, 1.3), DVec2::new(x, 1.12), 1.1);
    let apart: Vec<Reading> =
        [0.45, 2.55].map(|x| rig.read(&close_up(x), &codebook, "close", None, 1)).into_iter().collect();
    let Verdict { faults, .. } = judge(&rig.wall, &plan, &apart, Some(&Placement::Keep));
    assert!(faults.iter().any(|fault| fault.contains("take one that shows it with its neighbours")), "{faults:?}");
}

#[test]
fn a_bumped_projector_moves_back_and_the_others_stay() {
    let (mut rig, plan, camera, all) = photographed();
    let aligned = judge(&rig.wall, &plan, &all, None).wall.unwrap();
    rig.wall = aligned.clone();
    rig.projectors[1].pinhole = rig.projectors[1].pinhole.bumped([0.012, -0.008]);
    assert!(rig.agreement(&aligned).apart_px[1] > 2.0);
    let plan = Plan::of_wall(&rig.wall).unwrap();
    let all = readings(&mut rig, &plan, &camera, &[]);
    let Verdict { wall, faults, .. } = judge(&rig.wall, &plan, &all, None);
    assert!(faults.is_empty(), "{faults:?}");
    let wall = wall.unwrap();
    let after = rig.agreement(&wall);
    assert!(after.apart_px[0] < 0.1 && after.apart_px[1] < 0.3, "{after:?}");
    let moved = |index: usize| {
        let (new, old) = (wall.projectors()[index].warp_px, aligned.projectors()[index].warp_px);
        new.as_flattened().iter().zip(old.as_flattened()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    };
    assert!(moved(1) > 2.0, "{}", moved(1));
    assert!([0, 2, 3, 4, 5].into_iter().all(|index| moved(index) < 0.3), "{:?}", [0, 1, 2, 3, 4, 5].map(moved));
}

#[test]
fn marks_in_a_photograph_set_the_frame() {
    let (rig, plan, camera, all) = photographed();
    // Crosses on the wall: upper left, upper right, lower right, lower left.
    let marks_m = [[0.12, 1.41], [2.86, 1.38], [2.88, 0.14], [0.1, 0.11]].map(DVec2::from);
    let placement = Placement::Marks { shot: 1, at: marks_m.map(|point| camera.px(point)) };
    let Verdict { wall, faults, .. } = judge(&rig.wall, &plan, &all, Some(&placement));
    assert!(faults.is_empty(), "{faults:?}");
    let corners = rig.canvas_corners(&wall.unwrap());
    for (corner, mark) in corners.into_iter().zip(marks_m) {
        // A millimetre is a quarter of a pixel here.
        assert!(corner.distance(mark) < 0.001, "{corner} {mark}");
    }
}

#[test]
fn a_layout_that_swaps_two_projectors_is_not_believed() {
    let (rig, plan, _, all) = photographed();
    // The second hangs upside down.
    for swapped in [[0, 1, 2, 3, 5, 4], [1, 0, 2, 3, 4, 5]] {
        let mut all = all.clone();
        for sighting in all.iter_mut().flat_map(|reading| &mut reading.shot.sightings) {
            sighting.projector_idx = swapped[sighting.projector_idx];
        }
        let Verdict { wall, found, faults, .. } = judge(&rig.wall, &plan, &all, None);
        let is_told = faults.iter().any(|fault| fault.contains("do columns, rows, overlap and at_m"));
        assert!(is_told, "{swapped:?}: {faults:?} {found:#?} {:?}", wall.map(|wall| wall.projectors()[0].warp_px));
    }
}

/// Photographs of a wall that is not flat by a phone, held in three places.
fn by_phone(rig: &mut Rig, plan: &Plan) -> Vec<Reading> {
    let codebook = Codebook::new(plan);
    let mut random = Random::new(5);
    let middle = rig.wall.canvas_m()[0] / 2.0;
    let mut readings = Vec::new();
    for (place, aside) in [-0.6, 0.0, 0.7].into_iter().enumerate() {
        for pattern in 0..plan.n_patterns() {
            rig.show(plan, pattern, &[]);
            let mut shake = || random.around(0.02);
            let at = DVec3::new(middle + aside + shake(), 0.5 + shake(), 2.6 + shake());
            let camera = rig.camera([1600, 1200], at, DVec2::new(middle + shake(), 0.375 + shake()), 0.72);
            let camera = Camera { jpeg: Some(85), noise: 0.05, blur_px: 0.9, ..camera };
            readings.push(rig.read(&camera, &codebook, &format!("{place}-{pattern}.jpg"), None, pattern.into()));
        }
    }
    readings
}

const CYLINDER: &str = "[surface.cylinder]\nradius_m = 2.0\nat_m = 1.5707963\n";
const FOLD: &str = "[surface.fold]\nat_m = 1.5\nangle = 120.0\n";
const DOME: &str = "[surface.dome]\nradius_m = 2.2\nat_m = [1.5, 0.375]\n";
const GLOBE: &str = "[surface.dome]\nradius_m = 2.2\nat_m = [1.5, 0.375]\nunrolled = \"longitude\"\n";
/// One hangs upside down, and one projects from behind.
const HUNG: &str = "[[projector]]\nname = \"row 1 column 2\"\nrotation = 180\n\
                    [[projector]]\nname = \"row 1 column 3\"\nflip = \"horizontal\"\n";

#[test]
fn a_cylinder_a_fold_and_domes_are_aligned_from_a_phone_s_photographs() {
    for (name, mut rig) in [
        ("cylinder", bent::cylinder([512, 384], [CYLINDER, HUNG])),
        ("fold", bent::fold([512, 384], [FOLD, HUNG])),
        ("dome", bent::dome(false, [512, 384], [DOME, HUNG])),
        ("dome by longitude", bent::dome(true, [512, 384], [GLOBE, HUNG])),
    ] {
        let plan = Plan::of_wall(&rig.wall).unwrap();
        let readings = by_phone(&mut rig, &plan);
        let Verdict { wall, found, faults, .. } = judge(&rig.wall, &plan, &readings, None);
        assert!(faults.is_empty(), "{name}: {faults:?}\n{found:#?}");
        assert!(!found.iter().any(|line| is_off_throughout(line)), "{name}: {found:#?}");
        let wall = wall.unwrap();
        let ([median, p99], stretched) = rig.agreement_of_meshes(&wall);
        println!("{name}: {median:.3} pixels apart, p99 {p99:.3}; distances change from {stretched:.4?}");
        // Everywhere by the same factor: what is even on the canvas is even on the wall.
        assert!(stretched[1] - stretched[0] < 0.01, "{name}: {stretched:?}");
        assert!(median < 0.1 && p99 < 0.2, "{name}: {median} {p99}");
        // All of the canvas is lit.
        assert!(!found.iter().any(|line| line.contains("of the canvas is lit")), "{found:#?}");
        // A second run keeps the canvas where it is.
        let again = judge(&wall, &plan, &readings, None).wall.unwrap();
        for (a, b) in wall.projectors().iter().zip(again.projectors()) {
            let (a, b) = (a.mesh.as_ref().unwrap(), b.mesh.as_ref().unwrap());
            let moved = a.points().zip(b.points()).map(|(a, b)| a.distance(b)).fold(0.0, f64::max);
            assert!(moved < 1e-3, "{name}: {moved}");
        }
    }
}

#[test]
fn a_wrong_radius_angle_or_edge_is_refused_with_the_value_that_fits() {
    let surface = |name: &str, value: f64| match name {
        "cylinder" => Surface::Cylinder { radius_m: value, at_m: PI / 2.0 },
        "dome" => Surface::Dome { radius_m: value, at_m: [1.5, 0.375], unrolled: Unrolling::Azimuthal },
        _ => Surface::Fold { at_m: 1.5, angle: value },
    };
    // The number after a word of a line.
    let number = |line: &str, word: &str| -> Option<f64> {
        line.split_once(word)?.1.split([' ', ':', ';', ',']).next()?.parse().ok()
    };
    for (name, mut rig, right, wrong) in [
        ("cylinder", bent::cylinder([512, 384], [CYLINDER, HUNG]), 2.0, &[1.6, 2.4, 4.0][..]),
        ("dome", bent::dome(false, [512, 384], [DOME, HUNG]), 2.2, &[1.76, 2.64, 5.0]),
        ("fold", bent::fold([512, 384], [FOLD, HUNG]), 120.0, &[100.0, 112.0, 130.0, 150.0]),
    ] {
        let word = if name == "fold" { "set angle = " } else { "about " };
        let plan = Plan::of_wall(&rig.wall).unwrap();
        let readings = by_phone(&mut rig, &plan);
        let judged = |surface: Surface| judge(&rig.wall.clone().with_surface(Some(surface)), &plan, &readings, None);
        let Verdict { found, faults, .. } = judged(surface(name, right));
        assert!(faults.is_empty() && !found.iter().any(|line| line.contains("do not tell")), "{name}: {faults:?}");
        // A radius is never believed without a word.
        assert_eq!(found.iter().any(|line| line.contains("photographs tell no sizes")), name != "fold", "{found:#?}");
        for value in wrong {
            let faults = judged(surface(name, *value)).faults;
            let told = faults.iter().find_map(|fault| number(fault, word));
            println!("{name}: {right} is told as {told:?} where the file says {value}");
            // A radius follows from the layout, roughly.
            let most = if name == "fold" { 1.5 } else { 0.12 * right };
            assert!(told.is_some_and(|told| (told - right).abs() < most), "{name} {value}: {faults:?}");
        }
        if name == "fold" {
            let faults = judged(Surface::Fold { at_m: 1.1, angle: 120.0 }).faults;
            assert!(faults.iter().any(|fault| fault.contains("at_m = 1.1 does not fit")), "{faults:?}");
        }
        // From one place, other shapes fit as well.
        let one: Vec<Reading> = readings[..plan.n_patterns() as usize].to_vec();
        let faults = judge(&rig.wall, &plan, &one, None).faults;
        assert!(faults.iter().any(|fault| fault.contains("from one place")), "{name}: {faults:?}");
    }
}

#[test]
fn a_wall_of_another_shape_than_its_file_says_is_not_believed() {
    let cylinder = "[surface.cylinder]\nradius_m = 2.0\nat_m = 1.5\n";
    let mut rig = bent::fold([512, 384], [cylinder, ""]);
    let plan = Plan::of_wall(&rig.wall).unwrap();
    let readings = by_phone(&mut rig, &plan);
    let Verdict { faults, .. } = judge(&rig.wall, &plan, &readings, None);
    assert!(faults.iter().any(|fault| fault.contains("the shape that [surface] says")), "{faults:?}");
    let Verdict { wall, faults, .. } = judge(&rig.wall, &plan, &[], None);
    assert!(wall.is_none() && faults[0].contains("no photograph shows enough"), "{faults:?}");
}

#[test]
fn a_wall_that_is_not_quite_flat_is_told() {
    let mut rig = bent::nearly_flat([512, 384]);
    let plan = Plan::of_wall(&rig.wall).unwrap();
    let readings = by_phone(&mut rig, &plan);
    // From one place, the bend looks like the lens's.
    let Verdict { found, .. } = judge(&rig.wall, &plan, &readings[..plan.n_patterns() as usize], None);
    assert!(found.iter().any(|line| is_off_throughout(line) && line.contains("not quite flat")), "{found:#?}");
}

fn is_off_throughout(line: &str) -> bool {
    line.contains("pixels throughout")
}

#[test]
fn the_program_reads_a_folder_and_keeps_the_old_file() {
    let mut rig = Rig::new([2, 1], [256, 192], 0.02, "# A comment stays.\n");
    let folder = tempfile::tempdir().unwrap();
    let (file, photos) = (folder.path().join("ours.toml"), folder.path().join("photos"));
    fs::create_dir(&photos).unwrap();
    let text = "# Ours.\ncanvas_m = [2.0, 0.75] # wide\n[grid]\ncolumns = 2\nrows = 1\npixels = [256, 192]\noverlap = [0.1, 0.1]\n";
    fs::write(&file, text).unwrap();
    let plan = Plan::of_wall(&rig.wall).unwrap();
    let camera = rig.camera([640, 320], DVec3::new(1.1, 0.4, 2.6), DVec2::new(1.0, 0.375), 1.05);
    let take = |rig: &mut Rig, off: &[usize]| {
        for pattern in 0..plan.n_patterns() {
            rig.show(&plan, pattern, off);
            let photograph = camera.photograph(&rig.projectors, None, pattern.into());
            fs::write(photos.join(format!("{pattern}.png")), photograph).unwrap();
        }
        fs::write(photos.join("broken.jpg"), b"no photograph").unwrap();
        let mut cut = Vec::new();
        let grey = image::DynamicImage::ImageRgb8(image::RgbImage::from_pixel(64, 48, image::Rgb([90; 3])));
        grey.write_to(&mut std::io::Cursor::new(&mut cut), image::ImageFormat::Jpeg).unwrap();
        fs::write(photos.join("cut.jpg"), &cut[..cut.len() - 2]).unwrap();
        fs::write(photos.join("empty.jpg"), b"").unwrap();
        fs::write(photos.join("notes.txt"), b"no photograph").unwrap();
    };
    let run = |arguments: &[&str]| {
        let mut command = crate::process::Program::command("compositor");
        command.arg("calibrate").arg(&file).arg("--photos").arg(&photos).args(arguments);
        let (status, said) = crate::process::Program::start(command).wait();
        (status.code(), said)
    };
    take(&mut rig, &[1]);
    #[cfg(unix)]
    {
        let link = folder.path().join("link.png");
        std::os::unix::fs::symlink(photos.join("0.png"), &link).unwrap();
        let (code, said) = run(&["--report", link.to_str().unwrap()]);
        assert!(code == Some(1) && said.contains("not among the photographs"), "{said}");
    }
    let (code, said) = run(&[]);
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("broken.jpg cannot be read") && said.contains("--force"), "{said}");
    assert!(said.contains("cut.jpg is cut off") && said.contains("empty.jpg is empty"), "{said}");
    assert!(said.contains("fault: \"row 1 column 2\" is in no photograph"), "{said}");
    assert_eq!(fs::read_to_string(&file).unwrap(), text);
    take(&mut rig, &[]);
    let (code, said) = run(&[]);
    assert_eq!(code, Some(0), "{said}");
    assert!(fs::read_to_string(&file).unwrap().starts_with(text.trim_end()), "comments stay");
    assert_eq!(fs::read_to_string(folder.path().join("ours.old-1.toml")).unwrap(), text);
    let after = rig.agreement(&Wall::load(&file).unwrap());
    assert!(after.apart_px[0] < 0.1 && after.apart_px[1] < 0.3, "{after:?}");
}

#[test]
fn the_program_writes_meshes_beside_the_file() {
    let mut rig = bent::cylinder([256, 192], [CYLINDER, ""]);
    let folder = tempfile::tempdir().unwrap();
    let (file, photos) = (folder.path().join("ours.toml"), folder.path().join("photos"));
    fs::create_dir(&photos).unwrap();
    let text = format!(
        "# Ours.\ncanvas_m = {:?} # unrolled\n{CYLINDER}[grid]\ncolumns = 3\nrows = 1\npixels = [256, 192]\n\
         overlap = [0.1, 0.0]\n",
        rig.wall.canvas_m()
    );
    fs::write(&file, &text).unwrap();
    let plan = Plan::of_wall(&rig.wall).unwrap();
    let middle = rig.wall.canvas_m()[0] / 2.0;
    // From two places: from one, photographs tell little of the wall's size.
    for (place, aside) in [0.5, -0.5].into_iter().enumerate() {
        let camera = rig.camera([1400, 900], DVec3::new(middle + aside, 0.5, 2.6), DVec2::new(middle, 0.375), 0.72);
        for pattern in 0..plan.n_patterns() {
            rig.show(&plan, pattern, &[]);
            let photograph = camera.photograph(&rig.projectors, None, pattern.into());
            fs::write(photos.join(format!("{place}-{pattern}.png")), photograph).unwrap();
        }
    }
    for run in 1..=2 {
        let mut command = crate::process::Program::command("compositor");
        command.arg("calibrate").arg(&file).arg("--photos").arg(&photos);
        let (status, said) = crate::process::Program::start(command).wait();
        assert!(status.code() == Some(0) && said.contains("wrote the meshes into"), "{said}");
        // Comments stay, and each run has its own files: the old wall file goes on working.
        let written = fs::read_to_string(&file).unwrap();
        assert!(written.starts_with(text.trim_end()), "{written}");
        assert!(written.contains(&format!("mesh = \"ours.mesh-{run}-3.pfm\"")), "{written}");
        Wall::load(&folder.path().join(format!("ours.old-{run}.toml"))).unwrap();
        let ([median, p99], _) = rig.agreement_of_meshes(&Wall::load(&file).unwrap());
        assert!(median < 0.5 && p99 < 1.2, "{median} {p99}");
    }
}

/// A camera that photographs the X server's screen: pixels are seen as they are.
#[test]
#[cfg(target_os = "linux")]
fn patterns_on_the_wall_follow_the_photographs_and_the_wall_shows_what_was_found() {
    use crate::{
        process::{Program, wait_until},
        x_session::{Screenshot, XSession},
    };
    let folder = tempfile::tempdir().unwrap();
    let (file, photos) = (folder.path().join("ours.toml"), folder.path().join("photos"));
    fs::create_dir(&photos).unwrap();
    let text = "canvas_m = [2.0, 0.75]\n[grid]\ncolumns = 2\nrows = 1\npixels = [400, 300]\n";
    fs::write(&file, text).unwrap();
    let session = XSession::start([800, 300]);
    let start = |arguments: &[&str]| {
        let mut command = Program::command("compositor");
        command.env("DISPLAY", session.display()).env_remove("WAYLAND_DISPLAY");
        command.arg("calibrate").arg(&file).args(arguments);
        let program = Program::start(command);
        session.wait_for_window("Patterns");
        program
    };
    let folder_of_photos = photos.to_str().unwrap();
    let image_of = |shown: &Screenshot| image::RgbImage::from_raw(800, 300, shown.rgb.clone()).unwrap();
    // For those who want to see it.
    let keep = |name: &str, shown: &Screenshot| {
        if let Some(kept) = std::env::var_os("RAYWALL_KEEP") {
            image_of(shown).save(std::path::Path::new(&kept).join(name)).unwrap();
        }
    };
    let take_all = |program: &mut Program, run: u32| {
        for pattern in 1..=2 {
            wait_until("a pattern is seen", || session.screenshot().brighter_than(200) > 0.1);
            let shown = session.steady_screenshot();
            // Without a blur it would be a drawing.
            image::imageops::blur(&image_of(&shown), 1.0).save(photos.join(format!("{run}-{pattern}.png"))).unwrap();
            program.wait_for(&format!("{run}-{pattern}.png shows pattern {pattern} on 2 of 2 projectors"));
            if pattern == 1 {
                wait_until("the next pattern is seen", || session.screenshot().difference(&shown, 30) > 0.05);
            }
        }
    };
    let is_green = |shown: &Screenshot| {
        shown.rgb.chunks_exact(3).filter(|px| px[1] > px[0].saturating_add(20)).count() * 3 > 800 * 300 * 2
    };
    let check = |said: &str| {
        let wall = Wall::load(&file).unwrap();
        let farthest = wall.projectors().iter().flat_map(|it| it.warp_px.as_flattened().to_vec()).map(f64::abs);
        assert!(farthest.fold(0.0, f64::max) <= 0.05, "{said}");
    };

    // Somebody looks at the progress and at what was found, and discards it.
    let mut program = start(&["--watch", folder_of_photos]);
    take_all(&mut program, 1);
    wait_until("what was found is seen", || is_green(&session.screenshot()));
    keep("found.png", &session.steady_screenshot());
    program.wait_for("Enter writes this into");
    let found = session.steady_screenshot();
    session.key("Tab");
    wait_until("the progress is seen", || session.screenshot().difference(&found, 30) > 0.01);
    keep("progress.png", &session.steady_screenshot());
    session.key("Tab");
    wait_until("a pattern is seen again", || session.screenshot().brighter_than(200) > 0.1);
    session.key("Escape");
    let (status, said) = program.wait();
    assert!(status.code() == Some(0) && said.contains("nothing was written"), "{said}");
    assert_eq!(fs::read_to_string(&file).unwrap(), text);

    // The photographs as a folder; what was found is shown, and accepted.
    let mut program = start(&["--photos", folder_of_photos, "--show"]);
    program.wait_for("Enter writes this into");
    wait_until("what was found is seen", || is_green(&session.screenshot()));
    session.key("Return");
    let (status, said) = program.wait();
    assert!(status.code() == Some(0) && said.contains("wrote the corners into"), "{said}");
    assert_eq!(fs::read_to_string(folder.path().join("ours.old-1.toml")).unwrap(), text);
    check(&said);

    // Nobody is asked.
    fs::write(&file, text).unwrap();
    let mut program = start(&["--watch", folder_of_photos, "--yes"]);
    take_all(&mut program, 3);
    let (status, said) = program.wait();
    assert_eq!(status.code(), Some(0), "{said}");
    check(&said);
}
