//! Measures the alignment of a wall of 4×3 projectors with a camera, in the virtual projection room: accuracy of places and
//! of light, photographs, time and memory of the real program.
//!
//!     cargo build --release && cargo run --release -p lab --example calibration
//!
//! `-- FOLDER` keeps the photographs. Drawing them takes some minutes.

#[path = "../../src/room/camera.rs"]
#[allow(dead_code, reason = "shared with the tests")]
mod camera;
#[path = "../../src/room/geometry.rs"]
mod geometry;
#[path = "../../src/room/light.rs"]
#[allow(dead_code, reason = "shared with the tests")]
mod light;
#[path = "../../src/room/projector.rs"]
#[allow(dead_code, reason = "shared with the tests")]
mod projector;
#[path = "../../src/room/rig.rs"]
#[allow(dead_code, reason = "shared with the tests")]
mod rig;
#[path = "../../src/room/surface.rs"]
#[allow(dead_code, reason = "shared with the tests")]
mod surface;

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    thread,
    time::Duration,
};

use anyhow::{Context, ensure};
use camera::{Camera, Random};
use compositor::{
    calibration::Plan,
    gpu::{Gpu, Offscreen, Present},
    wall::Wall,
};
use glam::{DVec2, DVec3};
use light::{Evenness, LEVELS, evenness};
use rig::{Agreement, Rig};
use shared::division::FrameSize;

fn main() -> anyhow::Result<()> {
    let kept = std::env::args().nth(1).map(PathBuf::from);
    let temporary = std::env::temp_dir().join(format!("calibration-{}", std::process::id()));
    let folder = kept.as_deref().unwrap_or(&temporary);
    let mut rig = Rig::new([4, 3], [1024, 768], 0.02, "").with_lights(3);
    let plan = Plan::of_wall(&rig.wall).map_err(anyhow::Error::msg)?;
    let before = rig.agreement(&rig.wall);
    println!(
        "{:<34}{:>8}{:>8}{:>8}{:>8}{:>8}{:>8}{:>8}{:>8}",
        "pixels of a projector; CPU s; MB", "photos", "median", "p99", "bent", "CPU", "memory", "seam %", "uneven %"
    );
    print(&"as the file has it", 0, before, ["", ""], light_of(&rig, &rig.wall)?);
    let tripod = rig.camera([6000, 4000], DVec3::new(2.2, 1.3, 4.6), DVec2::new(2.0, 1.125), 1.0);
    let tripod = Camera { noise: 0.01, exposure: 0.75, colours: Some(COLOURS), ..tripod };
    measure(&mut rig, &plan, &folder.join("tripod"), "24 megapixels on a tripod", &mut |_| tripod.clone(), 1)?;
    let mut random = Random::new(5);
    let places = [DVec3::new(0.8, 1.4, 3.6), DVec3::new(2.1, 1.7, 3.8), DVec3::new(3.3, 1.3, 3.5)];
    let view = rig.clone();
    let mut phone = |place: usize| {
        // Each place has the wall in another part of the picture.
        let mut shake = |most: f64| DVec3::new(random.around(most), random.around(most), random.around(most));
        let aims = [[1.85, 1.05], [2.0, 1.2], [2.15, 1.1]].map(DVec2::from);
        let (at, target) = (places[place] + shake(0.02), aims[place] + shake(0.03).truncate());
        let camera = view.camera([4000, 3000], at, target, 0.72);
        Camera { jpeg: Some(90), noise: 0.02, blur_px: 0.9, exposure: 0.75, colours: Some(COLOURS), ..camera }
    };
    let title = "12 megapixels, JPEG, by hand ×3";
    measure(&mut rig, &plan, &folder.join("phone"), title, &mut phone, places.len())?;
    bump(&rig, &folder.join("tripod"), "24 megapixels, after a bump", &tripod)?;
    bump(&rig, &folder.join("phone"), "12 megapixels, after a bump", &phone(1))?;
    if kept.is_none() {
        fs::remove_dir_all(&temporary)?;
    }
    Ok(())
}

/// Photographs all patterns from all places, has the program align the wall, and prints what it reached.
fn measure(
    rig: &mut Rig,
    plan: &Plan,
    folder: &Path,
    title: &str,
    camera_at: &mut dyn FnMut(usize) -> Camera,
    n_places: usize,
) -> anyhow::Result<()> {
    let photos = folder.join("photos");
    fs::create_dir_all(&photos)?;
    let file = folder.join("wall.toml");
    fs::write(&file, rig.wall.to_toml())?;
    let mut n_photos = 0;
    for (place, pattern) in
        (0..n_places).flat_map(|place| (0..plan.n_with_light()).map(move |pattern| (place, pattern)))
    {
        rig.show(plan, pattern, &[]);
        let camera = camera_at(place);
        let ending = if camera.jpeg.is_some() { "jpg" } else { "png" };
        n_photos += 1;
        let photograph = camera.photograph(&rig.projectors, None, n_photos);
        fs::write(photos.join(format!("{place}-{pattern}.{ending}")), photograph)?;
    }
    let Cost { most_kb, cpu_s } = align(&file, &photos, "--light")?;
    let wall = Wall::load(&file)?;
    let cost = [format!("{cpu_s:.1}"), format!("{:.0}", most_kb / 1e3)];
    print(&title, n_photos, rig.agreement(&wall), [&cost[0], &cost[1]], light_of(rig, &wall)?);
    Ok(())
}

/// Bumps a projector of the wall in a folder, and has the program align it again from a photograph of the pattern that shows
/// all of it.
fn bump(rig: &Rig, folder: &Path, title: &str, camera: &Camera) -> anyhow::Result<()> {
    const BUMPED: usize = 5;
    let file = folder.join("wall.toml");
    let mut rig = Rig { wall: Wall::load(&file)?, ..rig.clone() };
    rig.projectors[BUMPED].pinhole = rig.projectors[BUMPED].pinhole.bumped([0.012, -0.008]);
    print(&"a projector was bumped", 0, rig.agreement(&rig.wall), ["", ""], light_of(&rig, &rig.wall)?);
    let plan = Plan::of_wall(&rig.wall).map_err(anyhow::Error::msg)?;
    let photos = folder.join("again");
    fs::create_dir_all(&photos)?;
    rig.show(&plan, plan.whole_in(BUMPED), &[]);
    fs::write(photos.join("again.jpg"), camera.photograph(&rig.projectors, None, 77))?;
    let Cost { most_kb, cpu_s } = align(&file, &photos, "--again")?;
    let wall = Wall::load(&file)?;
    let cost = [format!("{cpu_s:.1}"), format!("{:.0}", most_kb / 1e3)];
    print(&title, 1, rig.agreement(&wall), [&cost[0], &cost[1]], light_of(&rig, &wall)?);
    Ok(())
}

fn print(
    title: &dyn std::fmt::Display,
    n_photos: u64,
    agreement: Agreement,
    [time, memory]: [&str; 2],
    light: Evenness,
) {
    let Agreement { apart_px: [median, p99], bent_px } = agreement;
    let [seam, uneven] = [light.seam, light.uneven].map(|part| 100.0 * part);
    println!(
        "{title:<34}{n_photos:>8}{median:>8.3}{p99:>8.3}{bent_px:>8.3}{time:>8}{memory:>8}{seam:>8.2}{uneven:>8.2}"
    );
}

/// What the camera's red, green and blue see of projectors' red, green and blue.
const COLOURS: [[f64; 3]; 3] = [[0.7, 0.25, 0.05], [0.2, 0.7, 0.1], [0.02, 0.18, 0.8]];

/// How even the GPU's picture of grey fields is in the room.
fn light_of(rig: &Rig, wall: &Wall) -> anyhow::Result<Evenness> {
    let gpu = Gpu::headless()?;
    let mut present = Present::new(&gpu);
    let offscreen = Offscreen::new(&gpu, wall.output_size())?;
    let mut pictures = Vec::new();
    for [red, green, blue] in LEVELS {
        present.upload(&gpu, FrameSize::new(1, 1)?, &[red, green, blue, 255])?;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        present.draw(&gpu, &mut encoder, wall, &[(offscreen.target(), wall.whole_output())]);
        gpu.queue.submit([encoder.finish()]);
        pictures.push(offscreen.read(&gpu)?);
    }
    let shown = |level: usize, projector: usize, [x, y]: [usize; 2]| {
        let output = wall.projectors()[projector].output;
        pictures[level].pixel(output.x + x as u32, output.y + y as u32)
    };
    Ok(evenness(rig, wall, &shown, 1000))
}

/// The most memory that the program took, and its CPU time on all threads.
#[derive(Default)]
struct Cost {
    most_kb: f64,
    cpu_s: f64,
}

/// Runs the program with an option.
fn align(file: &Path, photos: &Path, kind: &str) -> anyhow::Result<Cost> {
    let own = std::env::current_exe()?;
    let program = own.ancestors().nth(2).context("target/release/examples")?.join("compositor");
    let mut command = Command::new(&program);
    command.arg("calibrate").arg(file).arg(kind).arg("--photos").arg(photos).stdout(Stdio::null());
    let mut child =
        command.spawn().with_context(|| format!("{} does not start: cargo build --release", program.display()))?;
    let mut cost = Cost::default();
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        // The peak and the time so far, while the program runs.
        let read = |name: &str| fs::read_to_string(format!("/proc/{}/{name}", child.id())).unwrap_or_default();
        let (status, stat) = (read("status"), read("stat"));
        let peak =
            status.lines().find_map(|line| line.strip_prefix("VmHWM:")?.trim().strip_suffix("kB")?.trim().parse().ok());
        // Fields 14 and 15, in hundredths; the program's name, in brackets, is the second.
        let ticks = stat.rsplit(')').next().unwrap_or_default().split_whitespace().skip(11).take(2);
        cost.cpu_s = cost.cpu_s.max(ticks.filter_map(|ticks| ticks.parse::<f64>().ok()).sum::<f64>() / 100.0);
        cost.most_kb = cost.most_kb.max(peak.unwrap_or(0.0));
        thread::sleep(Duration::from_millis(20));
    };
    ensure!(status.success(), "the program did not align the wall");
    Ok(cost)
}
