//! A wall of two monitors: a window on each, one picture on both, and a monitor that disappears and returns.

use std::{fs, path::Path};

use compositor::{gpu::RgbImage, wall::Wall};
use shared::camera::UpAxis;

use crate::{
    farm::RunningWall,
    pictures::statue_frame_of,
    present_cpu,
    process::{Program, wait_until},
    references,
    x_monitors::{self, Desk, Monitor},
    x_session::{SHOWN, Screenshot, XSession},
};

/// Half as large as the shipped wall's monitors.
const MONITORS: [Monitor; 2] = [
    Monitor { name: "DUMMY0", at: [0, 0], size: [1280, 720] },
    Monitor { name: "DUMMY1", at: [1280, 0], size: [960, 540] },
];
const N_TRIANGLES: u32 = 5000;

/// The shipped wall file, for these monitors.
fn wall_text() -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../wall-config/two-monitors.toml");
    fs::read_to_string(path)
        .expect("a shipped wall file")
        .replace("\"HDMI-1\"", "\"DUMMY0\"")
        .replace("\"DP-1\"", "\"DUMMY1\"")
}

fn start(session: &XSession, file: &Path, arguments: &[&str]) -> Program {
    let mut command = session.wall(&["--local", "1", "--triangles", &N_TRIANGLES.to_string()]);
    command.arg("--wall").arg(file).args(arguments);
    Program::start(command)
}

/// The part of the screen on a monitor.
fn on(monitor: Monitor, screen: &Screenshot) -> Screenshot {
    screen.part(monitor.at.map(usize::from), monitor.size.map(usize::from))
}

#[test]
fn each_monitor_shows_its_part_and_is_used_again_when_it_returns() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("two.toml");
    fs::write(&file, wall_text()).unwrap();
    let session = x_monitors::start(&MONITORS);
    // The statue lies on its side, so both monitors show some of it.
    let mut program = start(&session, &file, &["--up", "x", "--target-rate", "0"]);
    program.wait_for(SHOWN);
    for monitor in MONITORS {
        session.wait_for_window(&format!("Raywall on {}", monitor.name));
    }
    let wait_for_both = |program: &mut Program| {
        wait_until("a frame is on both", || {
            let n_shown = program.count(SHOWN);
            session.key("h");
            program.wait_for_count(SHOWN, n_shown + 1);
            let said = program.said();
            said.lines().rfind(|line| line.contains(SHOWN)).is_some_and(|line| line.ends_with("on DUMMY0 and DUMMY1"))
        });
    };
    wait_for_both(&mut program);
    let with_overlay = session.steady_screenshot();
    session.key("o");
    wait_until("the overlay is gone", || with_overlay.difference(&session.screenshot(), 4) > 0.02);
    let whole = session.steady_screenshot();

    let [left, right] = MONITORS;
    // The truth: the same frame, traced here and drawn for each monitor by the CPU.
    let wall = Wall::from_toml("two.toml", &wall_text()).unwrap();
    let frame = statue_frame_of(N_TRIANGLES, &wall, UpAxis::X);
    for (monitor, (name, part)) in MONITORS.into_iter().zip(wall.monitors()) {
        assert_eq!(monitor.name, name);
        let expected = present_cpu::present(frame.size, &frame.rgba, &wall, part, monitor.size.map(u32::from));
        let Screenshot { size, rgb } = on(monitor, &whole);
        let shown = RgbImage { size: size.map(|side| side as u32), rgb };
        references::check_same(&format!("monitor-{name}"), &expected, &shown);
    }

    // Steering in one window turns the model in all.
    let middle = [right.at[0] + right.size[0] / 2, right.at[1] + right.size[1] / 2].map(i32::from);
    session.drag(middle, [120, 60]);
    for monitor in MONITORS {
        wait_until("both have turned", || {
            on(monitor, &whole).difference(&on(monitor, &session.screenshot()), 16) > 0.01
        });
    }
    session.key("f");
    wait_until("all is seen as before", || session.screenshot() == whole);
    // The statue's pedestal, in the picture that is turned.
    session.xdotool(&["mousemove", "1760", "345", "key", "i"]);
    program.wait_for("Triangle ");
    wait_until("it is marked there", || on(right, &whole) != on(right, &session.screenshot()));
    // And the sky beside it.
    session.xdotool(&["mousemove", "1760", "60", "key", "i"]);
    wait_until("note and mark are gone", || session.screenshot() == whole);

    let desk = Desk::connect(session.display());
    desk.unplug(right.name);
    program.wait_for("the monitor DUMMY1 is gone");
    let n_shown = program.count(SHOWN);
    session.xdotool(&["mousemove", "100", "100"]);
    session.wait_for_window("Raywall on DUMMY0");
    session.key("v");
    program.wait_for_count(SHOWN, n_shown + 1);
    wait_until("normals are seen", || on(left, &whole).difference(&on(left, &session.screenshot()), 16) > 0.05);
    assert!(program.said().lines().rfind(|line| line.contains(SHOWN)).unwrap().ends_with("on DUMMY0"));
    session.key("v");
    session.key("v");
    desk.plug(right);
    wait_until("the monitor is used again", || session.screenshot() == whole);
    wait_for_both(&mut program);
    session.key("ctrl+q");
    let (status, said) = program.wait();
    assert_eq!(status.code(), Some(0), "{said}");
}

#[test]
fn a_wall_waits_for_missing_monitors_and_can_span_one_window_instead() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("two.toml");
    fs::write(&file, wall_text().replace("\"DUMMY0\"", "\"DUMMY2\"")).unwrap();
    let [left, right] = MONITORS;
    let session = x_monitors::start(&[left]);
    let mut program = start(&session, &file, &["--size", "256x128"]);
    program.wait_for("there is no monitor DUMMY1 now, only: DUMMY0");
    program.wait_for("is ready");
    assert_eq!(program.count(SHOWN), 0);
    // The monitors may overlap.
    Desk::connect(session.display()).plug(Monitor { at: [320, 180], ..right });
    program.wait_for("after the camera, on DUMMY1");
    program.signal("TERM");
    assert_eq!(program.wait().0.code(), Some(0));
    let mut program = start(&session, &file, &["--size", "256x128", "--spanning"]);
    program.wait_for(SHOWN);
    session.wait_for_window("Raywall");
    session.key("ctrl+q");
    assert_eq!(program.wait().0.code(), Some(0));
}

#[test]
fn a_wall_turns_black_without_render_servers_if_told_to_and_comes_back() {
    let session = XSession::start([640, 360]);
    let mut command = session.wall(&["--local", "0", "--triangles", "5000", "--size", "256x128"]);
    command.args(["--fullscreen", "--on-loss", "black"]);
    let mut wall = Program::start(command);
    let address = wall.wait_for_address();
    let renderer = RunningWall::join_at(&address, "first", &[]);
    wall.wait_for(SHOWN);
    session.wait_for_window("Raywall");
    let with_overlay = session.steady_screenshot();
    session.key("o");
    wait_until("the overlay is gone", || with_overlay.difference(&session.screenshot(), 4) > 0.05);
    let statue = session.steady_screenshot();
    assert!(statue.brighter_than(120) > 0.03, "no model is seen");
    renderer.signal("KILL");
    wait_until("the wall is black", || session.screenshot().rgb.iter().all(|&byte| byte == 0));
    let _renderer = RunningWall::join_at(&address, "second", &[]);
    wait_until("the frame is back", || session.screenshot() == statue);
    session.key("ctrl+q");
    assert_eq!(wall.wait().0.code(), Some(0));
}
