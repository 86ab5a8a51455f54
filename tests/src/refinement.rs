//! The resolution follows the motion: a real window, real render servers, and a camera that moves and rests.

use std::{fs, thread, time::Duration};

use serde_json::Value;
use shared::camera::Views;

use crate::{
    farm::{Files, RunningWall},
    process::Program,
    x_session::XSession,
};

/// The wall is much larger than the screen, so that it takes longer to render than to show, and resolution is worth lowering.
const WALL: [u32; 2] = [960, 540];
const SCREEN: [usize; 2] = [320, 180];
const SAMPLES: &str = "4";
const RAYS: &str = "ambient";
/// What the wall says, with its log turned up, when there is nothing left to refine.
const DONE: &str = "as fine as it gets";

/// CPU time of all of a process's threads, in hundredths of a second.
fn ticks(program: &Program) -> u64 {
    let stat = fs::read_to_string(format!("/proc/{}/stat", program.id())).expect("the program runs");
    // After the name in parentheses, utime and stime are the 12th and 13th.
    let (_, fields) = stat.rsplit_once(')').expect("a name in parentheses");
    fields.split_whitespace().skip(11).take(2).map(|ticks| ticks.parse::<u64>().expect("a number")).sum()
}

#[test]
fn a_moving_camera_is_followed_and_a_resting_one_refined_whoever_dies() {
    let files = Files::new();
    let wall = "canvas_m = [1.6, 0.9]\n[grid]\ncolumns = 2\nrows = 1\npixels = [480, 540]\n";
    fs::write(files.path("wall.toml"), wall).unwrap();
    let session = XSession::start(SCREEN);
    let mut command = Program::command("compositor");
    // No farm renders a thousand frames a second of this size.
    command
        .args(["--listen", "127.0.0.1:0", "--local", "0", "--triangles", "20000"])
        .args(["--target-rate", "1000", "--samples", SAMPLES, "--rays", RAYS, "--fullscreen", "--wall"])
        .arg(files.path("wall.toml"))
        .arg("--stats")
        .arg(files.path("stats.json"))
        .current_dir(files.path(""))
        .env("DISPLAY", session.display())
        .env_remove("WAYLAND_DISPLAY")
        .env("RUST_LOG", "info,compositor=debug");
    let mut wall = Program::start(command);
    wall.wait_for("listening on ");
    let address = wall.said().split("listening on ").nth(1).unwrap().split_whitespace().next().unwrap().to_owned();
    let [staying, dying] = ["staying", "dying"].map(|name| RunningWall::join_at(&address, name, &[]));
    wall.wait_for_count(" is ready", 2);
    wall.wait_for("is on screen");
    session.wait_for_window("Raywall");

    session.xdotool(&["keydown", "Right", "sleep", "2", "keyup", "Right"]);
    let n_done = wall.count(DONE);
    wall.wait_for_count(DONE, n_done + 1);
    // Until the frame rate has given way to "at rest".
    thread::sleep(Duration::from_millis(1500));
    let at_rest = || (wall.count("is on screen"), [&wall, &staying, &dying].map(ticks));
    let (n_shown, before) = at_rest();
    thread::sleep(Duration::from_secs(1));
    let (n_shown_later, after) = at_rest();
    assert_eq!(n_shown_later, n_shown, "a resting wall renders");
    let spent = [0, 1, 2].map(|program| after[program] - before[program]);
    assert!(spent.iter().all(|&ticks| ticks <= 4), "{spent:?} of 100 ticks of CPU time at rest");

    session.key("ctrl+1");
    wall.wait_for("View 1 is kept");
    // Divided otherwise, it is rendered anew; the last time without one of two render servers.
    let (n_done, n_refined) = (wall.count(DONE), wall.count("refining to"));
    session.key("h");
    wall.wait_for_count(DONE, n_done + 1);
    let n_refined_each = wall.count("refining to") - n_refined;
    session.key("h");
    wall.wait_for_count("refining to", n_refined + n_refined_each + 1);
    dying.signal("KILL");
    assert_eq!(wall.count(DONE), n_done + 1, "it died after the refinement");
    wall.wait_for_count(DONE, n_done + 2);
    session.key("ctrl+q");
    let (status, said) = wall.wait();
    assert!(status.success(), "{said}");

    let frames = files.frames();
    let size = |frame: &Value| frame["size"].as_str().unwrap().to_owned();
    let native = format!("{}x{}", WALL[0], WALL[1]);
    assert!(frames.iter().any(|frame| size(frame) != native), "coarser in motion");
    let views = Views::from_toml(&fs::read_to_string(files.path("statue.views.toml")).unwrap()).unwrap();
    fs::write(files.path("camera.toml"), views.get(1).unwrap().to_toml()).unwrap();
    let mut alone = files.wall(&native);
    alone.args(["--local", "1", "--frames", "1", "--samples", SAMPLES, "--rays", RAYS]);
    let (status, said) = Program::start(alone).wait();
    assert!(status.success(), "{said}");
    // By one render server, in one frame of a size that was set.
    let expected = files.frames()[0]["samples_blake3"].as_str().unwrap().to_owned();
    let refined: Vec<_> = frames.iter().filter(|frame| frame["samples_blake3"] == *expected).collect();
    let divisions: Vec<_> = refined.iter().map(|frame| frame["division"].as_str().unwrap()).collect();
    assert_eq!(divisions, ["tiled", "dynamic", "interleaved"], "the same bits however it is divided");
    let last = frames.last().unwrap();
    assert_eq!((&last["samples_blake3"], &last["n_lost"]), (&(*expected).into(), &1.into()), "and whoever died");
    assert_eq!((size(last), &last["samples"]), (native, &4.into()));
}

#[test]
fn a_wall_without_a_window_writes_the_refined_picture() {
    let files = Files::new();
    let fixed = |size: &str, samples: &str, args: &[&str]| {
        let picture = files.path(&format!("{size}-{samples}.png"));
        let mut command = files.wall(size);
        command.args(["--local", "1", "--frames", "2", "--samples", samples, "--screenshot"]).arg(&picture).args(args);
        let (status, said) = Program::start(command).wait();
        assert!(status.success(), "{said}");
        (compositor::gpu::RgbImage::read_png(&picture).unwrap(), said)
    };
    // The wall of these files has 128×72 pixels.
    let (refined, said) = fixed("64x36", "9", &["--target-rate", "30"]);
    assert_eq!(files.frames().len(), 2, "what is refined is not measured");
    assert!(said.contains("refining to 128x72, samples a pixel: 9"), "{said}");
    assert!(refined == fixed("128x72", "9", &[]).0, "it is the picture of as many samples");
}
