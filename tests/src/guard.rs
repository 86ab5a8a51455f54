//! The supervisor: what the screen shows while a crashed wall restarts.

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
    x_session::{SHOWN, Screenshot, XSession},
};

const PROCESS: &str = "the wall is process ";

/// A session with a pink desktop: a colour that no wall shows.
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
    let mut command = session.wall(&["--local", "1", "--triangles", "5000", "--size", "256x128", "--kiosk"]);
    command.args(arguments);
    command
}

/// The supervisor of a wall that fills the screen, and the screen's content.
fn start(session: &XSession, arguments: &[&str]) -> (Program, Screenshot) {
    let mut supervisor = Program::start(command(session, arguments));
    supervisor.wait_for(SHOWN);
    session.wait_for_window("Raywall");
    let statue = session.steady_screenshot();
    assert!(statue.brighter_than(120) > 0.03 && !shows_desktop(&statue), "no wall fills the screen");
    (supervisor, statue)
}

fn shows_desktop(screen: &Screenshot) -> bool {
    screen.rgb.as_chunks::<3>().0.contains(&[255, 0, 255])
}

fn is_black(screen: &Screenshot) -> bool {
    screen.rgb.iter().all(|&byte| byte == 0)
}

/// The process identifier of the newest wall.
fn wall_of(supervisor: &Program) -> String {
    let said = supervisor.said();
    let (_, number) = said.rsplit_once(PROCESS).expect("the supervisor logs it");
    number.split(';').next().expect("the first part").to_owned()
}

fn is_running(process: &str) -> bool {
    Path::new("/proc").join(process).is_dir()
}

/// Screenshots from now on, until another wall has shown its frame for a second.
fn seen_until_back(session: &XSession, supervisor: &Program, n_shown: usize) -> Vec<Screenshot> {
    let (start, mut back_at, mut seen) = (Instant::now(), None, Vec::new());
    while back_at.is_none_or(|back_at: Instant| back_at.elapsed() < Duration::from_secs(1)) {
        seen.push(session.screenshot());
        if supervisor.count(SHOWN) > n_shown {
            back_at.get_or_insert_with(Instant::now);
        }
        assert!(start.elapsed() < GENEROUS, "the wall does not come back\n{}", supervisor.said());
    }
    seen
}

fn kill(signal: &str, process: &str) {
    assert!(Command::new("kill").args([signal, process]).status().is_ok_and(|status| status.success()));
}

#[test]
fn a_killed_wall_shows_its_last_frame_until_it_is_back() {
    let session = pink_desktop();
    let (supervisor, statue) = start(&session, &[]);
    // Each crash, by either signal.
    for (n_deaths, signal) in ["-KILL", "-ABRT"].into_iter().enumerate() {
        let (n_shown, dead) = (supervisor.count(SHOWN), wall_of(&supervisor));
        kill(signal, &dead);
        for (index, screen) in seen_until_back(&session, &supervisor, n_shown).iter().enumerate() {
            assert!(*screen == statue, "screenshot {index}: desktop {}", shows_desktop(screen));
        }
        assert!(supervisor.count("the wall has died") == n_deaths + 1 && !is_running(&dead));
    }
    // The new wall reacts.
    session.wait_for_window("Raywall");
    session.drag([300, 150], [80, 40]);
    wait_until("visitors turn the model", || statue.difference(&session.screenshot(), 16) > 0.02);
    // No process or window remains.
    let wall = wall_of(&supervisor);
    supervisor.signal("TERM");
    assert_eq!(supervisor.wait().0.code(), Some(0));
    assert!(!is_running(&wall));
    wait_until("the desktop is seen", || {
        session.screenshot().rgb.as_chunks::<3>().0.iter().all(|it| *it == [255, 0, 255])
    });
}

#[test]
fn a_killed_wall_can_be_black_until_it_is_back() {
    let session = pink_desktop();
    let (supervisor, statue) = start(&session, &["--on-loss", "black"]);
    let n_shown = supervisor.count(SHOWN);
    kill("-KILL", &wall_of(&supervisor));
    let seen = seen_until_back(&session, &supervisor, n_shown);
    assert!(seen.iter().all(|screen| is_black(screen) || *screen == statue));
    assert!(seen.iter().any(is_black) && *seen.last().unwrap() == statue);
    session.wait_for_window("Raywall");
    session.key("ctrl+l");
    session.key("ctrl+q");
    assert_eq!(supervisor.wait().0.code(), Some(0), "closed for good");
}

#[test]
fn a_wall_ends_with_its_supervisor_and_does_not_restart_before_its_first_frame() {
    let session = pink_desktop();
    let (supervisor, _) = start(&session, &[]);
    let wall = wall_of(&supervisor);
    supervisor.signal("KILL");
    wait_until("the wall has ended", || !is_running(&wall));
    let (status, said) = Program::start(command(&session, &["--key", "no/such.key"])).wait();
    assert!(status.code() == Some(1) && said.matches(PROCESS).count() == 1, "{status}\n{said}");
    assert!(said.lines().last().unwrap().contains("no/such.key"), "{said}");
}
