//! Aligning a wall: test patterns, and corners that are dragged and saved.

use std::fs;

use crate::{
    process::{Program, wait_until},
    x_session::{SHOWN, XSession},
};

/// Two overlapping projectors side by side; each of their pixels is one of the screen.
const WALL: &str =
    "# Ours.\ncanvas_m = [1.6, 0.9]\n[grid]\ncolumns = 2\nrows = 1\npixels = [640, 720]\noverlap = [0.1, 0.0]\n";

#[test]
fn a_corner_dragged_on_the_wall_is_saved_in_its_file() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("ours.toml");
    fs::write(&file, WALL).unwrap();
    let session = XSession::start([1280, 720]);
    let mut command = session.wall(&["--local", "2", "--triangles", "5000", "--size", "256x128", "--fullscreen"]);
    command.arg("--wall").arg(&file);
    let mut program = Program::start(command);
    program.wait_for(SHOWN);
    session.wait_for_window("Raywall");
    session.key("o");
    let statue = session.steady_screenshot();

    session.key("n");
    wait_until("the alignment grid is seen", || session.screenshot().brighter_than(200) > 0.005);
    let straight = session.steady_screenshot();
    // The right projector's upper-left corner.
    session.drag([643, 3], [20, 15]);
    wait_until("the corner has moved", || straight.difference(&session.screenshot(), 30) > 0.001);
    session.key("Right");
    session.key("shift+Down");
    for key in ["Left", "ctrl+z", "ctrl+z", "ctrl+shift+z"] {
        session.key(key);
    }
    session.key("ctrl+s");
    program.wait_for("saved the corners in");
    let saved = fs::read_to_string(&file).unwrap();
    assert!(saved.starts_with(WALL.trim_end()), "{saved}");
    assert!(saved.contains("name = \"row 1 column 2\"\nwarp_px = [[21.0, 15.1], [0.0, 0.0]"), "{saved}");

    let mut before = session.steady_screenshot();
    for pattern in ["names", "pixels", "overlap", "gamma", "focus"] {
        session.key("n");
        wait_until(pattern, || before.difference(&session.screenshot(), 30) > 0.02);
        before = session.steady_screenshot();
    }
    session.key("Escape");
    wait_until("the statue is back", || statue.difference(&session.screenshot(), 30) < 0.05);
    for key in ["n", "Tab", "Right", "Escape"] {
        session.key(key);
    }
    program.wait_for("INFO The corners have moved and are not saved: Ctrl+S saves them in");
    session.key("ctrl+q");
    let (status, said) = program.wait();
    assert_eq!(status.code(), Some(0), "{said}");
    assert!(said.contains("ours.corners-1.toml shows them"), "{said}");
    assert!(fs::read_to_string(folder.path().join("ours.corners-1.toml")).unwrap().contains("[[21.0, 15.1]"));
    assert_eq!(fs::read_to_string(&file).unwrap(), saved);
}

#[test]
fn without_a_wall_file_the_note_says_how_to_save_corners() {
    let session = XSession::start([640, 480]);
    let folder = tempfile::tempdir().unwrap();
    let mut command = session.wall(&["--local", "1", "--triangles", "1000", "--size", "64x32"]);
    command.current_dir(folder.path());
    let mut program = Program::start(command);
    program.wait_for(SHOWN);
    session.wait_for_window("Raywall");
    session.key("o");
    session.key("ctrl+s");
    program.wait_for("INFO No corner has moved: there is nothing to save");
    for key in ["n", "Tab", "Right"] {
        session.key(key);
    }
    // Notes leave the screen after eight seconds.
    std::thread::sleep(std::time::Duration::from_secs(9));
    let pattern = session.steady_screenshot();
    session.key("ctrl+s");
    program.wait_for("start with --wall FILE");
    wait_until("the message is seen without the overlay", || pattern != session.screenshot());
    session.key("ctrl+q");
    let (_, said) = program.wait();
    assert!(said.contains("they are in wall.corners-1.toml: --wall wall.corners-1.toml shows them"), "{said}");
    assert!(folder.path().join("wall.corners-1.toml").is_file());
}
