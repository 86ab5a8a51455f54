//! A wall that dies: what is seen of it, and that it comes back.

use std::{
    path::Path,
    process::Command,
    time::{Duration, Instant},
};

use x11rb::{
    connection::Connection,
    protocol::xproto::{ChangeWindowAttributesAux, ConnectionExt as _},
    wrapper::ConnectionExt as _,
};

use crate::{
    process::{GENEROUS, Program, wait_until},
    x_session::{Screenshot, XSession},
};

const SHOWN: &str = "is on screen";
const PROCESS: &str = "the wall is process ";

/// A desktop that is seen where nothing hides it: none of its pixels is black or of a wall.
fn pink_desktop() -> XSession {
    let session = XSession::start([640, 360]);
    let (connection, screen) = x11rb::connect(Some(session.display())).expect("the X server runs");
    let root = connection.setup().roots[screen].root;
    let pink = ChangeWindowAttributesAux::new().background_pixel(0x00ff_00ff);
    connection.change_window_attributes(root, &pink).expect("sent");
    connection.clear_area(false, root, 0, 0, 0, 0).expect("sent");
    connection.sync().expect("the X server runs");
    session
}

fn command(session: &XSession, arguments: &[&str]) -> Command {
    let mut command = Program::command("compositor");
    command.args(["--listen", "127.0.0.1:0", "--local", "1", "--triangles", "5000", "--size", "256x128", "--kiosk"]);
    command.args(arguments).env("DISPLAY", session.display()).env_remove("WAYLAND_DISPLAY");
    command.env("RUST_LOG", "info,compositor=debug");
    command
}

/// A wall that fills the screen, and what is on it.
fn start(session: &XSession, arguments: &[&str]) -> (Program, Screenshot) {
    let mut guard = Program::start(command(session, arguments));
    guard.wait_for(SHOWN);
    session.wait_for_window("Raywall");
    let statue = session.steady_screenshot();
    assert!(statue.brighter_than(120) > 0.03 && !shows_desktop(&statue), "no wall fills the screen");
    (guard, statue)
}

fn shows_desktop(screen: &Screenshot) -> bool {
    screen.rgb.as_chunks::<3>().0.contains(&[255, 0, 255])
}

fn is_black(screen: &Screenshot) -> bool {
    screen.rgb.iter().all(|&byte| byte == 0)
}

/// The number of the newest wall's process.
fn wall_of(guard: &Program) -> String {
    let said = guard.said();
    let (_, number) = said.rsplit_once(PROCESS).expect("a guard says so");
    number.split(';').next().expect("the first part").to_owned()
}

fn is_there(process: &str) -> bool {
    Path::new("/proc").join(process).is_dir()
}

/// What is seen from now on, until another wall has shown its frame for a second.
fn seen_until_back(session: &XSession, guard: &Program, n_shown: usize) -> Vec<Screenshot> {
    let (start, mut back_at, mut seen) = (Instant::now(), None, Vec::new());
    while back_at.is_none_or(|back_at: Instant| back_at.elapsed() < Duration::from_secs(1)) {
        seen.push(session.screenshot());
        if guard.count(SHOWN) > n_shown {
            back_at.get_or_insert_with(Instant::now);
        }
        assert!(start.elapsed() < GENEROUS, "the wall never comes back\n{}", guard.said());
    }
    seen
}

fn kill(signal: &str, process: &str) {
    assert!(Command::new("kill").args([signal, process]).status().is_ok_and(|status| status.success()));
}

#[test]
fn a_wall_that_is_killed_shows_its_last_frame_until_it_is_back() {
    let session = pink_desktop();
    let (guard, statue) = start(&session, &[]);
    // However it dies, and as often as it does.
    for (n_deaths, signal) in ["-KILL", "-ABRT"].into_iter().enumerate() {
        let (n_shown, dead) = (guard.count(SHOWN), wall_of(&guard));
        kill(signal, &dead);
        for (index, screen) in seen_until_back(&session, &guard, n_shown).iter().enumerate() {
            assert!(*screen == statue, "screenshot {index}: desktop {}", shows_desktop(screen));
        }
        assert!(guard.count("the wall has died") == n_deaths + 1 && !is_there(&dead));
    }
    // The wall that is seen again is alive.
    session.wait_for_window("Raywall");
    session.drag([300, 150], [80, 40]);
    wait_until("visitors turn the model", || statue.difference(&session.screenshot(), 16) > 0.02);
    // Nothing is left of any.
    let wall = wall_of(&guard);
    guard.signal("TERM");
    assert_eq!(guard.wait().0.code(), Some(0));
    assert!(!is_there(&wall));
    wait_until("the desktop is seen", || {
        session.screenshot().rgb.as_chunks::<3>().0.iter().all(|it| *it == [255, 0, 255])
    });
}

#[test]
fn a_wall_that_is_killed_can_be_black_until_it_is_back() {
    let session = pink_desktop();
    let (guard, statue) = start(&session, &["--on-loss", "black"]);
    let n_shown = guard.count(SHOWN);
    kill("-KILL", &wall_of(&guard));
    let seen = seen_until_back(&session, &guard, n_shown);
    assert!(seen.iter().all(|screen| is_black(screen) || *screen == statue));
    assert!(seen.iter().any(is_black) && *seen.last().unwrap() == statue);
    session.wait_for_window("Raywall");
    session.key("ctrl+l");
    session.key("ctrl+q");
    assert_eq!(guard.wait().0.code(), Some(0), "closed for good");
}

#[test]
fn a_wall_ends_with_its_guard_and_is_not_started_again_before_it_has_shown_anything() {
    let session = pink_desktop();
    let (guard, _) = start(&session, &[]);
    let wall = wall_of(&guard);
    guard.signal("KILL");
    wait_until("the wall has ended", || !is_there(&wall));
    let (status, said) = Program::start(command(&session, &["--key", "no/such.key"])).wait();
    assert!(status.code() == Some(1) && said.matches(PROCESS).count() == 1, "{status}\n{said}");
    assert!(said.lines().last().unwrap().contains("no/such.key"), "{said}");
}
