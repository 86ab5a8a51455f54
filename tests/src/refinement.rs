//! Refinement: a real window, real render servers, and a camera that moves and rests.

use std::{fs, thread, time::Duration};

use serde_json::Value;
use shared::camera::Views;

use crate::{
    farm::{Files, RunningWall},
    process::Program,
    x_session::{SHOWN, XSession},
};

/// Much larger than the screen, so rendering takes longer than showing, and a lower resolution pays.
const WALL: [u32; 2] = [960, 540];
const SCREEN: [usize; 2] = [320, 180];
const SAMPLES: &str = "4";
const RAYS: &str = "ambient";
/// Logged when nothing is left to refine.
const DONE: &str = "fully refined";

#[test]
fn a_moving_camera_lowers_the_resolution_and_a_resting_one_refines_whoever_dies() {
    let files = Files::new();
    let wall = "canvas_m = [1.6, 0.9]\n[grid]\ncolumns = 2\nrows = 1\npixels = [480, 540]\n";
    fs::write(files.path("wall.toml"), wall).unwrap();
    let session = XSession::start(SCREEN);
    let mut command = session.wall(&["--local", "0", "--triangles", "20000"]);
    // No farm renders a thousand frames a second of this size.
    command
        .args(["--target-rate", "1000", "--samples", SAMPLES, "--rays", RAYS, "--fullscreen", "--wall"])
        .arg(files.path("wall.toml"))
        .arg("--stats")
        .arg(files.path("stats.json"))
        .current_dir(files.path(""));
    let mut wall = Program::start(command);
    let address = wall.wait_for_address();
    let [staying, dying] = ["staying", "dying"].map(|name| RunningWall::join_at(&address, name, &[]));
    wall.wait_for_count(" is ready", 2);
    wall.wait_for(SHOWN);
    session.wait_for_window("Raywall");

    session.xdotool(&["keydown", "Right", "sleep", "2", "keyup", "Right"]);
    let n_done = wall.count(DONE);
    wall.wait_for_count(DONE, n_done + 1);
    // Until the overlay says "at rest" in place of the frame rate.
    thread::sleep(Duration::from_millis(1500));
    let at_rest = || (wall.count(SHOWN), [&wall, &staying, &dying].map(Program::ticks));
    let (n_shown, before) = at_rest();
    thread::sleep(Duration::from_secs(1));
    let (n_shown_later, after) = at_rest();
    assert_eq!(n_shown_later, n_shown, "a resting wall renders no frame");
    let spent = [0, 1, 2].map(|program| after[program] - before[program]);
    assert!(spent.iter().all(|&ticks| ticks <= 4), "{spent:?} of 100 ticks of CPU time at rest");

    session.key("ctrl+1");
    wall.wait_for("View 1 is kept");
    // Another division renders it anew; the last time one of two render servers dies.
    let (n_done, n_refined) = (wall.count(DONE), wall.count("refining to"));
    session.key("h");
    wall.wait_for_count(DONE, n_done + 1);
    let n_refined_each = wall.count("refining to") - n_refined;
    session.key("h");
    wall.wait_for_count("refining to", n_refined + n_refined_each + 1);
    dying.signal("KILL");
    assert_eq!(wall.count(DONE), n_done + 1, "the server died after the refinement");
    wall.wait_for_count(DONE, n_done + 2);
    session.key("ctrl+q");
    let (status, said) = wall.wait();
    assert!(status.success(), "{said}");

    let frames = files.frames();
    let size = |frame: &Value| frame["size"].as_str().unwrap().to_owned();
    let native = format!("{}x{}", WALL[0], WALL[1]);
    assert!(frames.iter().any(|frame| size(frame) != native), "no frame was coarser in motion");
    let views = Views::from_toml(&fs::read_to_string(files.path("statue.views.toml")).unwrap()).unwrap();
    fs::write(files.path("camera.toml"), views.get(1).unwrap().camera.to_toml()).unwrap();
    let mut alone = files.wall(&native);
    alone.args(["--local", "1", "--frames", "1", "--samples", SAMPLES, "--rays", RAYS]);
    Program::succeed(alone);
    // One render server, one frame of a fixed size.
    let expected = files.frames()[0]["samples_blake3"].as_str().unwrap().to_owned();
    let refined: Vec<_> = frames.iter().filter(|frame| frame["samples_blake3"] == *expected).collect();
    let divisions: Vec<_> = refined.iter().map(|frame| frame["division"].as_str().unwrap()).collect();
    assert_eq!(divisions, ["tiled", "dynamic", "interleaved"], "each division gives the same bits");
    let last = frames.last().unwrap();
    assert_eq!((&last["samples_blake3"], &last["n_lost"]), (&(*expected).into(), &1.into()), "and so does a death");
    assert_eq!((size(last), &last["samples"]), (native, &4.into()));
}

#[test]
fn a_wall_without_a_window_writes_the_refined_picture() {
    let files = Files::new();
    let fixed = |size: &str, samples: &str, args: &[&str]| {
        let picture = files.path(&format!("{size}-{samples}.png"));
        let mut command = files.wall(size);
        command.args(["--frames", "2", "--samples", samples, "--screenshot"]).arg(&picture).args(args);
        if !args.contains(&"--local") {
            command.args(["--local", "1"]);
        }
        let said = Program::succeed(command);
        (crate::references::read_png(&picture).unwrap(), said)
    };
    // The wall file has 128×72 pixels.
    let (refined, said) = fixed("64x36", "9", &["--target-rate", "30"]);
    assert_eq!(files.frames().len(), 2, "the refinement is not among the measured frames");
    assert!(said.contains("refining to 128x72, samples a pixel: 9"), "{said}");
    assert!(refined == fixed("128x72", "9", &["--rays", "path"]).0, "it differs from a frame of that many samples");
    let (plain, _) = fixed("64x36", "9", &["--target-rate", "30", "--rays", "primary"]);
    assert!(plain == fixed("128x72", "9", &[]).0, "chosen rays are kept");
    // Pixels stop at a noise, in one division of several render servers as in another of one.
    let noisy = ["--noise", "4", "--rays", "path"];
    let (refined, said) = fixed("64x36", "99", &[&noisy[..], &["--target-rate", "30", "--local", "2"]].concat());
    assert!(said.contains("samples a pixel: 16") && said.contains("samples a pixel: 99"), "{said}");
    for division in ["interleaved", "dynamic"] {
        let (fixed, _) = fixed("128x72", "99", &[&noisy[..], &["--division", division]].concat());
        assert!(refined == fixed, "{division}");
    }
}
