//! Aligning a wall again after a bump, in the virtual room, by the program, and on the wall.

use std::{f64::consts::PI, fs};

use compositor::{
    calibration::{Codebook, Plan, Reading, Verdict, check_again, judge, judge_again},
    wall::Wall,
};
use glam::{DVec2, DVec3};

use crate::{
    process::Program,
    room::{bent, camera::Camera, rig::Rig, surface::Surface},
};

/// A wall of 3×3 projectors whose file has their corners, and a camera that sees all of it.
struct Aligned {
    rig: Rig,
    plan: Plan,
    camera: Camera,
}

impl Aligned {
    fn new() -> Self {
        let mut rig = Rig::new([3, 3], [384, 288], 0.02, "");
        let plan = Plan::of_wall(&rig.wall).unwrap();
        let camera = rig.camera([1500, 1200], DVec3::new(1.7, 1.2, 3.4), DVec2::new(1.5, 1.125), 0.95);
        assert!(check_again(&rig.wall).is_err_and(|fault| fault.contains("no corners yet")));
        let all: Vec<Reading> = (0..plan.n_patterns()).map(|pattern| read(&mut rig, &plan, &camera, pattern)).collect();
        let Verdict { wall, faults, .. } = judge(&rig.wall, &plan, &all, None);
        assert!(faults.is_empty(), "{faults:?}");
        rig.wall = wall.unwrap();
        check_again(&rig.wall).unwrap();
        let plan = Plan::of_wall(&rig.wall).unwrap();
        // The second time, another camera, from elsewhere.
        let camera = rig.camera([1600, 1230], DVec3::new(1.3, 1.0, 3.3), DVec2::new(1.5, 1.1), 0.92);
        Self { rig, plan, camera }
    }

    fn bump(&mut self, index: usize, by: [f64; 2]) {
        self.rig.projectors[index].pinhole = self.rig.projectors[index].pinhole.bumped(by);
    }

    /// The verdict from a photograph of each of these patterns.
    fn again(&mut self, patterns: &[u32]) -> Verdict {
        let Self { rig, plan, camera } = self;
        let readings: Vec<Reading> = patterns.iter().map(|pattern| read(rig, plan, camera, *pattern)).collect();
        judge_again(&rig.wall, plan, &readings)
    }

    /// Projectors whose corners differ from the file's.
    fn changed(&self, wall: &Wall) -> Vec<usize> {
        let both = self.rig.wall.projectors().iter().zip(wall.projectors());
        both.enumerate().filter(|(_, (old, new))| old.warp_px != new.warp_px).map(|(index, _)| index).collect()
    }
}

fn read(rig: &mut Rig, plan: &Plan, camera: &Camera, pattern: u32) -> Reading {
    rig.show(plan, pattern, &[]);
    rig.read(camera, &Codebook::new(plan), &format!("{pattern}.png"), None, u64::from(pattern) + 31)
}

#[test]
fn after_a_bump_one_photograph_aligns_the_projector_that_moved_and_no_other() {
    let mut it = Aligned::new();
    it.bump(4, [0.012, -0.008]);
    let before = it.rig.agreement(&it.rig.wall);
    assert!(before.apart_px[1] > 2.0, "{before:?}");
    let pattern = it.plan.whole_in(4);
    let Verdict { wall, found, faults, projectors } = it.again(&[pattern]);
    assert!(faults.is_empty(), "{faults:?}\n{found:#?}");
    let wall = wall.unwrap();
    let after = it.rig.agreement(&wall);
    println!("one photograph of nine projectors: {after:?}");
    assert!(after.apart_px[0] < 0.1 && after.apart_px[1] < 0.3 && after.bent_px < 0.3, "{after:?}");
    assert_eq!(it.changed(&wall), [4]);
    let moved: Vec<bool> = projectors.iter().map(|finding| finding.moved_px.unwrap() > 0.0).collect();
    assert_eq!(moved.iter().filter(|moved| **moved).count(), 1);
    assert!(moved[4] && found.iter().filter(|line| line.contains("it has not moved")).count() == 8, "{found:?}");
    // Another pattern shows too little of it, and the cure names the one that shows all.
    let other = (pattern + 1) % it.plan.n_patterns();
    let Verdict { faults, .. } = it.again(&[other]);
    let cure = format!("take a photograph of pattern {}", pattern + 1);
    assert!(faults.len() == 1 && faults[0].contains("row 2 column 2") && faults[0].contains(&cure), "{faults:?}");
}

#[test]
fn a_second_projector_that_moved_is_found_too_and_too_many_are_refused() {
    let mut it = Aligned::new();
    it.bump(4, [0.012, -0.008]);
    // Half a pixel's worth is enough to be noticed.
    it.bump(2, [0.002, 0.001]);
    let all: Vec<u32> = (0..it.plan.n_patterns()).collect();
    for patterns in [&all[..], &[it.plan.whole_in(4)]] {
        let Verdict { wall, found, projectors, .. } = it.again(patterns);
        let moved: Vec<usize> =
            (0..projectors.len()).filter(|index| projectors[*index].moved_px != Some(0.0)).collect();
        assert_eq!(moved, [2, 4], "{found:#?}");
        if patterns.len() > 1 {
            let after = it.rig.agreement(&wall.unwrap());
            assert!(after.apart_px[0] < 0.1 && after.apart_px[1] < 0.3, "{after:?}");
        }
    }
    for index in [0, 3, 7] {
        it.bump(index, [0.004 + 0.001 * index as f64, -0.005]);
    }
    let Verdict { faults, .. } = it.again(&all);
    assert!(faults.iter().any(|fault| fault.contains("fewer than half may have moved")), "{faults:?}");
}

#[test]
fn photographs_of_another_wall_among_the_right_ones_are_named() {
    let mut it = Aligned::new();
    it.bump(4, [0.012, -0.008]);
    let right: Vec<Reading> =
        [it.plan.whole_in(4), 0].map(|pattern| read(&mut it.rig, &it.plan, &it.camera, pattern)).into();
    let mut other = Rig::new([3, 3], [384, 288], 0.04, "");
    let mut strange = read(&mut other, &it.plan, &it.camera, 1);
    strange.name = "strange.png".to_owned();
    let all = [&right[..], &[strange]].concat();
    let Verdict { wall, faults, .. } = judge_again(&it.rig.wall, &it.plan, &all);
    assert!(faults.len() == 1 && faults[0].contains("take them out of the folder: strange.png"), "{faults:?}");
    // All else is as if it were not there.
    assert_eq!(it.changed(&wall.unwrap()), [4]);
    // With no right one, none is named.
    let Verdict { faults, .. } = judge_again(&it.rig.wall, &it.plan, &all[2..]);
    assert!(faults[0].contains("do not lie where the file has them") && !faults[0].contains("strange"), "{faults:?}");
}

#[test]
fn on_a_wall_that_is_not_flat_a_turned_photograph_is_named() {
    let cylinder = "[surface.cylinder]\nradius_m = 2.0\nat_m = 1.5707963267948966\n";
    let mut it = Bent::new(bent::cylinder([384, 288], [cylinder, HUNG]), [33, 25]);
    let all: Vec<u32> = (0..it.plan.n_patterns()).collect();
    let mut readings: Vec<Reading> =
        all.iter().map(|pattern| read(&mut it.rig, &it.plan, &it.camera, *pattern)).collect();
    let shot = &mut readings.last_mut().unwrap().shot;
    let rows = shot.size[1] as f64;
    shot.size.reverse();
    for [_, at] in shot.sightings.iter_mut().flat_map(|it| &mut it.points) {
        *at = DVec2::new(rows - at.y, at.x);
    }
    let name = readings.last().unwrap().name.clone();
    let line = format!("{name} has 1200×1700 pixels where others have 1700×1200, and does not count");
    for verdict in [judge_again(&it.rig.wall, &it.plan, &readings), judge(&it.rig.wall, &it.plan, &readings, None)] {
        assert!(verdict.found.iter().any(|it| it.contains(&line)), "{:?}", verdict.found);
    }
}

#[test]
fn projectors_that_no_photograph_shows_are_not_taken_for_unmoved() {
    let mut it = Aligned::new();
    it.bump(4, [0.012, -0.008]);
    // A close-up without the right column.
    it.camera = it.rig.camera([1500, 1500], DVec3::new(0.9, 1.1, 2.3), DVec2::new(0.85, 1.1), 0.95);
    let Verdict { faults, .. } = it.again(&[it.plan.whole_in(4)]);
    let names = |fault: &String| fault.contains("row 2 column 3") && fault.contains("photograph the whole wall");
    assert!(faults.iter().any(names), "{faults:?}");
    // No photograph at all.
    let Verdict { wall, faults, .. } = judge_again(&it.rig.wall, &it.plan, &[]);
    assert!(wall.is_none() && faults[0].contains("photograph the whole wall"), "{faults:?}");
}

#[test]
fn a_wall_that_did_not_move_stays_as_it_is() {
    let mut it = Aligned::new();
    let Verdict { wall, found, faults, .. } = it.again(&[0]);
    assert!(wall.is_none() && faults.is_empty(), "{faults:?}");
    assert!(found.iter().any(|line| line.contains("no projector has moved")), "{found:?}");
}

#[test]
fn the_program_aligns_again_draws_a_report_and_says_when_it_cannot() {
    let mut it = Aligned::new();
    let folder = tempfile::tempdir().unwrap();
    let (file, photos, report) =
        (folder.path().join("ours.toml"), folder.path().join("photos"), folder.path().join("report.png"));
    fs::create_dir(&photos).unwrap();
    fs::write(&file, it.rig.wall.to_toml()).unwrap();
    it.bump(4, [0.012, -0.008]);
    let pattern = it.plan.whole_in(4);
    it.rig.show(&it.plan, pattern, &[]);
    fs::write(photos.join("one.png"), it.camera.photograph(&it.rig.projectors, None, 7)).unwrap();
    let run = |arguments: &[&str]| {
        let mut command = Program::command("compositor");
        command.arg("calibrate").arg(&file).arg("--photos").arg(&photos).args(arguments);
        let (status, said) = Program::start(command).wait();
        (status.code(), said)
    };
    let (code, said) = run(&["--again", "--report", report.to_str().unwrap()]);
    assert!(code == Some(0) && said.contains("wrote the corners into"), "{said}");
    let wall = Wall::load(&file).unwrap();
    assert_eq!(it.changed(&wall), [4]);
    let after = it.rig.agreement(&wall);
    assert!(after.apart_px[0] < 0.1 && after.apart_px[1] < 0.3, "{after:?}");
    let drawn = image::open(&report).unwrap().into_rgb8();
    assert_eq!(drawn.width(), 1920);
    // Fields are green where projectors fit.
    let green = drawn.pixels().filter(|px| px.0[1] > px.0[0] + 30).count();
    assert!(green * 2 > drawn.pixels().count(), "{green}");
    // A second time nothing has moved, and the file stays.
    let before = fs::read_to_string(&file).unwrap();
    let (code, said) = run(&["--again"]);
    assert!(code == Some(0) && said.contains("no projector has moved"), "{said}");
    assert_eq!(fs::read_to_string(&file).unwrap(), before);
    // A close-up without the right column: projectors were found, but none can be written.
    let close_up = it.rig.camera([1500, 1500], DVec3::new(0.9, 1.1, 2.3), DVec2::new(0.85, 1.1), 0.95);
    fs::write(photos.join("one.png"), close_up.photograph(&it.rig.projectors, None, 7)).unwrap();
    let (code, said) = run(&["--again"]);
    assert!(code == Some(1) && said.contains("too little is seen of"), "{said}");
    assert!(said.contains("nothing of this can be written") && !said.contains("nothing was found"), "{said}");
    fs::write(&file, "canvas_m = [2.0, 0.75]\n[grid]\ncolumns = 2\nrows = 1\npixels = [256, 192]\n").unwrap();
    let (code, said) = run(&["--again"]);
    assert!(code == Some(1) && said.contains("the file has no corners yet"), "{said}");
}

/// One hangs upside down, and one projects from behind.
const HUNG: &str = "[[projector]]\nname = \"row 1 column 2\"\nrotation = 180\n\
                    [[projector]]\nname = \"row 1 column 3\"\nflip = \"horizontal\"\n";

/// A wall that is not flat, with the meshes of its file, which are true in the room, and a camera that sees all of it.
struct Bent {
    rig: Rig,
    plan: Plan,
    camera: Camera,
}

impl Bent {
    fn new(mut rig: Rig, n_points: [usize; 2]) -> Self {
        let surface = rig.wall.surface();
        assert!(
            check_again(&rig.wall).is_err_and(|fault| fault.contains("not all projectors in the file have meshes"))
        );
        rig.wall = rig.true_wall(n_points).with_surface(surface);
        check_again(&rig.wall).unwrap();
        let plan = Plan::of_wall(&rig.wall).unwrap();
        let middle = rig.wall.canvas_m()[0] / 2.0;
        let camera = rig.camera([1700, 1200], DVec3::new(middle - 0.2, 0.45, 2.5), DVec2::new(middle, 0.37), 0.7);
        Self { rig, plan, camera }
    }

    fn again(&mut self, patterns: &[u32]) -> Verdict {
        let Self { rig, plan, camera } = self;
        let readings: Vec<Reading> = patterns.iter().map(|pattern| read(rig, plan, camera, *pattern)).collect();
        judge_again(&rig.wall, plan, &readings)
    }
}

#[test]
fn after_a_bump_curved_and_folded_walls_and_domes_are_aligned_again() {
    let cylinder = "[surface.cylinder]\nradius_m = 2.0\nat_m = 1.5707963267948966\n";
    let fold = "[surface.fold]\nat_m = 1.5\nangle = 120.0\n";
    let dome = "[surface.dome]\nradius_m = 2.2\nat_m = [1.5, 0.375]\n";
    for (name, rig, n_points) in [
        ("cylinder", bent::cylinder([384, 288], [cylinder, HUNG]), [33, 25]),
        ("fold", bent::fold([384, 288], [fold, HUNG]), [385, 73]),
        ("dome", bent::dome(false, [384, 288], [dome, HUNG]), [33, 25]),
    ] {
        let mut it = Bent::new(rig, n_points);
        for bumped in [1, 0] {
            let before = it.rig.projectors[bumped].pinhole;
            it.rig.projectors[bumped].pinhole = before.bumped([0.012, -0.008]);
            let [_, apart] = it.rig.agreement_of_meshes(&it.rig.wall).0;
            assert!(apart > 2.0, "{name}: {apart}");
            // One photograph of the pattern that shows all of it does, if it shows enough of the others.
            let all: Vec<u32> = (0..it.plan.n_patterns()).collect();
            let one = [it.plan.whole_in(bumped)];
            for patterns in [&one[..], &all] {
                let Verdict { wall, found, faults, projectors } = it.again(patterns);
                if patterns.len() == 1 && faults.iter().any(|fault| fault.contains("too little is seen of")) {
                    assert!((name, bumped) == ("fold", 0), "{name} {bumped}: {faults:?}");
                    continue;
                }
                assert!(faults.is_empty(), "{name} {bumped}: {faults:?}\n{found:#?}");
                let moved: Vec<bool> = projectors.iter().map(|finding| finding.moved_px.unwrap() > 0.0).collect();
                assert_eq!(moved, [0, 1, 2].map(|index| index == bumped), "{name}: {found:?}");
                let wall = wall.unwrap();
                // The others keep their files.
                for (index, (old, new)) in it.rig.wall.projectors().iter().zip(wall.projectors()).enumerate() {
                    assert_eq!(old.mesh.as_ref().unwrap().file() == new.mesh.as_ref().unwrap().file(), index != bumped);
                }
                let ([median, p99], _) = it.rig.agreement_of_meshes(&wall);
                println!(
                    "{name}, {} photographs, \"{bumped}\": {median:.3} pixels apart, p99 {p99:.3}",
                    patterns.len()
                );
                assert!(median < 0.1 && p99 < 0.2, "{name}: {median} {p99}");
            }
            it.rig.projectors[bumped].pinhole = before;
        }
        let Verdict { wall, found, faults, .. } = it.again(&(0..it.plan.n_patterns()).collect::<Vec<_>>());
        assert!(wall.is_none() && faults.is_empty(), "{name}: {faults:?}");
        assert!(found.iter().any(|line| line.contains("no projector has moved")), "{found:?}");
    }
}

/// How far the worst projector is off throughout: half of the parts of its picture are nearer to where they should be.
fn off_px(verdict: &Verdict) -> f64 {
    let of_projector = |misses: &[[DVec2; 2]]| {
        let mut all: Vec<f64> = misses.iter().map(|[_, by]| by.length()).collect();
        all.sort_by(f64::total_cmp);
        all.get(all.len() / 2).copied().unwrap_or_default()
    };
    verdict.projectors.iter().map(|finding| of_projector(&finding.misses)).fold(0.0, f64::max)
}

#[test]
fn photographs_of_another_wall_are_refused_and_those_of_a_phone_are_not() {
    let cylinder = "[surface.cylinder]\nradius_m = 2.0\nat_m = 1.5707963267948966\n";
    let dome = "[surface.dome]\nradius_m = 2.2\nat_m = [1.5, 0.375]\n";
    let middle = DVec2::new(1.5, 0.375);
    let round = |radius: f64| Surface::Dome { middle, radius, by_longitude: false };
    let on = |surface: Surface, askew: f64| Rig::on(surface, [3.0, 0.75], 3, [384, 288], askew, ["", HUNG]);
    let mut others = [
        ("flat", on(Surface::Flat, 0.01)),
        ("cylinder", bent::cylinder([384, 288], ["", HUNG])),
        ("wider cylinder", on(Surface::Cylinder { middle: 1.5, radius: 2.6 }, 0.01)),
        ("fold", bent::fold([384, 288], ["", HUNG])),
        ("dome", on(round(2.2), 0.01)),
        ("other projectors", on(round(2.2), 0.02)),
    ];
    for (name, rig) in [
        ("cylinder", bent::cylinder([384, 288], [cylinder, HUNG])),
        ("dome", bent::dome(false, [384, 288], [dome, HUNG])),
    ] {
        let mut it = Bent::new(rig, [33, 25]);
        let all: Vec<u32> = (0..it.plan.n_patterns()).collect();
        it.camera = Camera { jpeg: Some(85), noise: 0.06, blur_px: 0.9, ..it.camera.clone() };
        let right = it.again(&all);
        println!("{name} by a phone: {:.3} pixels off throughout", off_px(&right));
        assert!(right.faults.is_empty() && off_px(&right) < 0.05, "{name}: {:?}", right.faults);
        for (other, rig) in &mut others {
            if *other == name {
                continue;
            }
            let target = rig.wall.canvas_m()[0] / 2.0;
            let camera = rig.camera([1400, 1000], DVec3::new(target - 0.2, 0.45, 2.5), DVec2::new(target, 0.37), 0.7);
            let readings: Vec<Reading> = all.iter().map(|pattern| read(rig, &it.plan, &camera, *pattern)).collect();
            let verdict = judge_again(&it.rig.wall, &it.plan, &readings);
            println!("{name} by photographs of {other}: {:.3} pixels off throughout", off_px(&verdict));
            assert!(!verdict.faults.is_empty(), "{name} by {other}: {:?}", verdict.found);
        }
    }
}

#[test]
fn on_a_cylinder_a_second_projector_that_moved_is_found_too_and_too_many_are_refused() {
    let width_m = PI;
    let surface = Surface::Cylinder { middle: width_m / 2.0, radius: 2.0 };
    let keys = format!("[surface.cylinder]\nradius_m = 2.0\nat_m = {}\n", width_m / 2.0);
    let mut it = Bent::new(Rig::on(surface, [width_m, 0.45], 5, [288, 216], 0.01, [&keys, ""]), [25, 19]);
    let bump = |it: &mut Bent, index: usize, by: [f64; 2]| {
        it.rig.projectors[index].pinhole = it.rig.projectors[index].pinhole.bumped(by);
    };
    bump(&mut it, 2, [0.012, -0.008]);
    bump(&mut it, 3, [-0.004, 0.005]);
    let all: Vec<u32> = (0..it.plan.n_patterns()).collect();
    let Verdict { wall, found, faults, projectors } = it.again(&all);
    assert!(faults.is_empty(), "{faults:?}\n{found:#?}");
    let moved: Vec<usize> = (0..5).filter(|index| projectors[*index].moved_px != Some(0.0)).collect();
    assert_eq!(moved, [2, 3], "{found:#?}");
    let ([median, p99], _) = it.rig.agreement_of_meshes(&wall.unwrap());
    println!("two of five: {median:.3} pixels apart, p99 {p99:.3}");
    assert!(median < 0.1 && p99 < 0.2, "{median} {p99}");
    bump(&mut it, 0, [0.006, 0.007]);
    let Verdict { faults, .. } = it.again(&all);
    assert!(faults.iter().any(|fault| fault.contains("fewer than half may have moved")), "{faults:?}");
    // No photograph at all.
    let Verdict { wall, faults, .. } = judge_again(&it.rig.wall, &it.plan, &[]);
    assert!(wall.is_none() && faults[0].contains("photograph the whole wall"), "{faults:?}");
}
