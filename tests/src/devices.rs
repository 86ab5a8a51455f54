//! Devices that steer a real wall: controllers of shows, and fingers.

use std::{fs, io::Write, net::UdpSocket, os::unix::net::UnixListener, thread, time::Duration};

use serde_json::json;

use crate::{
    process::{Program, generate_statue, wait_until},
    remote::RemoteWall,
    x_session::XSession,
    x_touch::{Finger, Fingers},
};

/// Where a wall that fills 1280×720 pixels has the number of the light's angle; its slider lies left of it.
const LIGHT: [f64; 2] = [1089.0, 227.0];

/// An OSC message of numbers, written by the specification: texts end with a zero, and all is padded to four bytes.
fn osc(address: &str, numbers: &[f32]) -> Vec<u8> {
    let padded = |text: &str| {
        let mut bytes = text.as_bytes().to_vec();
        bytes.resize(text.len() / 4 * 4 + 4, 0);
        bytes
    };
    let tags = padded(&format!(",{}", "f".repeat(numbers.len())));
    let values = numbers.iter().flat_map(|number| number.to_be_bytes()).collect();
    [padded(address), tags, values].concat()
}

#[test]
fn a_controller_of_shows_steers_the_wall() {
    let folder = tempfile::tempdir().expect("a folder");
    let show = "fade_seconds = 0\n[[scene]]\nends = \"order\"\ncaption = \"one\"\n[[scene]]\nends = \"order\"\ncaption = \"two\"\n";
    fs::write(folder.path().join("tour.toml"), show).expect("a file");
    let remote = ["--remote", "127.0.0.1:0", "--osc", "127.0.0.1:0", "--show", "tour.toml"];
    let mut wall = RemoteWall::start_in(folder, &remote);
    wall.program.wait_for("OSC at ");
    let said = wall.program.said();
    let at = said.split("OSC at ").nth(1).and_then(|rest| rest.lines().next()).expect("an address").to_owned();
    let desk = UdpSocket::bind("127.0.0.1:0").expect("a socket");
    let send = |packet: &[u8]| _ = desk.send_to(packet, &at).expect("sent");
    let caption = |text: &str| wall.state()["show"]["caption"] == text;
    wait_until("the show begins", || caption("one"));
    // A button is pressed and released.
    send(&osc("/raywall/next-scene", &[1.0]));
    send(&osc("/raywall/next-scene", &[0.0]));
    wait_until("the second scene is shown", || caption("two"));
    send(&osc("/raywall/previous-scene", &[]));
    wait_until("the first scene is shown again", || caption("one"));
    send(&osc("/raywall/pause-show", &[]));
    wait_until("the show is held", || wall.state()["show"]["is_show_playing"] == false);
    wall.session.key("o");
    let before = wall.session.steady_screenshot();
    send(&osc("/raywall/orbit", &[0.2, 0.0]));
    wait_until("the model has turned", || before.difference(&wall.session.screenshot(), 16) > 0.02);
    send(&osc("/raywall/light", &[-30.0, 60.0]));
    send(&osc("/raywall/rays/path", &[1.0]));
    wait_until("light and rays are set", || {
        let controls = wall.state()["controls"].take();
        controls["light_deg"] == json!([-30, 60]) && controls["rays"] == "path"
    });
    // Nonsense, floods and packets without end change nothing, and are told in few lines.
    let nonsense: [&[u8]; 5] = [b"", b"/", b"#bundle\0\0\0\0\0", &[0xff; 1400], &[b'/'; 20_000]];
    for _ in 0..200 {
        nonsense.iter().for_each(|packet| send(packet));
        send(&osc("/raywall/quit", &[1.0]));
        send(&osc("/raywall/go-to-view", &[f32::NAN]));
    }
    wall.program.wait_for("ignored OSC of 127.0.0.1: ");
    // Those that the flood has used up come back.
    wait_until("the wall hears sense again", || {
        send(&osc("/raywall/exposure", &[1.5]));
        wall.state()["controls"]["exposure_stops"] == 1.5
    });
    assert!(wall.program.count("ignored OSC of") <= 8 && !wall.program.said().contains("panicked"));
}

#[test]
fn the_network_steers_by_osc_only_with_leave() {
    let folder = tempfile::tempdir().expect("a folder");
    generate_statue(300, &folder.path().join("statue.ply"));
    let session = XSession::start([320, 180]);
    let mut command = session.wall(&["statue.ply", "--osc", "0.0.0.0:0"]);
    command.current_dir(folder.path());
    let (status, said) = Program::start(command).wait();
    assert!(!status.success() && said.contains("add --osc-open if you trust everybody there"), "{said}");
}

#[test]
fn fingers_steer_as_the_mouse_does_and_panels_keep_theirs() {
    let Some((session, mut fingers)) = Fingers::start([1280, 720]) else { return };
    let remote = ["--remote", "127.0.0.1:0"];
    let mut wall = RemoteWall::start_on(session, tempfile::tempdir().expect("a folder"), &remote);
    wall.session.key("o");
    let front = wall.session.steady_screenshot();
    let is_whole = |wall: &RemoteWall| wall.session.screenshot() == front;
    // One finger turns the model as the mouse does.
    wall.session.drag([600, 400], [200, 0]);
    wait_until("the model has turned", || front.difference(&wall.session.screenshot(), 16) > 0.02);
    let by_mouse = wall.session.steady_screenshot();
    wall.session.key("f");
    wait_until("all is seen after the mouse", || is_whole(&wall));
    fingers.drag([[600.0, 400.0]], [[800.0, 400.0]]);
    wait_until("it has turned as by the mouse", || by_mouse.difference(&wall.session.screenshot(), 16) < 0.005);
    wall.session.key("f");
    wait_until("all is seen after a finger", || is_whole(&wall));
    // Two fingers that part come nearer: the model covers more of the screen.
    let lit = front.brighter_than(60);
    fingers.drag([[600.0, 360.0], [680.0, 360.0]], [[560.0, 360.0], [720.0, 360.0]]);
    wait_until("the model is nearer", || wall.session.screenshot().brighter_than(60) > 1.5 * lit);
    wall.session.key("f");
    wait_until("all is seen after two fingers", || is_whole(&wall));
    // A finger that comes down on a panel has the panel, wherever it goes: the slider of the light.
    wall.session.key("o");
    let light = |wall: &RemoteWall| wall.state()["controls"]["light_deg"].take();
    let (before, panel) = (light(&wall), wall.session.steady_screenshot());
    assert!(panel != front, "the panel is there");
    fingers.touch(0, Finger::Begin, [LIGHT[0] - 40.0, LIGHT[1]]);
    wait_until("the light has turned", || light(&wall) != before);
    let begun = light(&wall);
    fingers.touch(0, Finger::Update, [LIGHT[0] - 80.0, LIGHT[1] + 5.0]);
    wait_until("the light turns on", || light(&wall) != begun);
    fingers.touch(0, Finger::Update, [900.0, 400.0]);
    fingers.touch(0, Finger::End, [900.0, 400.0]);
    // The panel has its last say.
    thread::sleep(Duration::from_millis(500));
    wall.act(&json!({ "do": "light", "azimuth_deg": before[0], "elevation_deg": before[1] }));
    wait_until("the light is as before", || light(&wall) == before);
    wall.session.key("o");
    wait_until("nothing has moved", || is_whole(&wall));
    // A tap says what is there, and marks it; two go there.
    fingers.tap([640.0, 360.0]);
    wall.program.wait_for("Triangle ");
    // Later than the second tap of a double tap.
    thread::sleep(Duration::from_millis(700));
    fingers.tap([640.0, 360.0]);
    fingers.tap([644.0, 362.0]);
    wait_until("the model is nearer", || wall.session.screenshot().brighter_than(60) > 1.5 * lit);
}

/// An event of spacenavd: its kind, x, y, z, rotations about them, and a time.
fn spacenav(numbers: [i32; 8]) -> Vec<u8> {
    numbers.map(i32::to_ne_bytes).concat()
}

#[test]
fn a_spacemouse_turns_the_model_until_it_is_let_go_or_pulled_out() {
    let folder = tempfile::tempdir().expect("a folder");
    let socket = folder.path().join("spnav.sock");
    let daemon = UnixListener::bind(&socket).expect("a socket");
    let session = XSession::start([640, 360]);
    let environment = [("SPNAV_SOCKET", socket.to_str().expect("a path"))];
    let mut wall = RemoteWall::start_with(
        session,
        tempfile::tempdir().expect("a folder"),
        &environment,
        &["--remote", "127.0.0.1:0"],
    );
    wall.program.wait_for("a SpaceMouse may steer");
    let (mut stream, _) = daemon.accept().expect("the wall has connected");
    let mut say = |numbers| stream.write_all(&spacenav(numbers)).expect("the wall listens");
    wall.session.key("o");
    let front = wall.session.steady_screenshot();
    // Turned for a while, then let go.
    say([0, 0, 0, 0, 0, 250, 0, 16]);
    wait_until("the model turns", || front.difference(&wall.session.screenshot(), 16) > 0.02);
    say([0, 0, 0, 0, 0, 0, 0, 16]);
    let turned = wall.session.steady_screenshot();
    assert!(front.difference(&turned, 16) > 0.01);
    // Its first button shows all.
    say([1, 0, 0, 0, 0, 0, 0, 0]);
    say([2, 0, 0, 0, 0, 0, 0, 0]);
    wait_until("all is seen", || wall.session.screenshot() == front);
    // Nonsense is nothing.
    say([77, 1, 2, 3, 4, 5, 6, 7]);
    say([1, -1, 0, 0, 0, 0, 0, 0]);
    // Pulled out while it is held out: the wall comes to rest.
    say([0, 0, 0, 0, 0, -250, 0, 16]);
    wait_until("the model turns", || front.difference(&wall.session.screenshot(), 16) > 0.02);
    drop(stream);
    wall.program.wait_for("has ended");
    wall.session.steady_screenshot();
    // It is found again when it is back.
    let (mut stream, _) = daemon.accept().expect("the wall has connected again");
    wall.session.key("f");
    wait_until("all is seen", || wall.session.screenshot() == front);
    // One that says nothing more, as when its cable breaks, is at rest soon.
    stream.write_all(&spacenav([0, 0, 0, 0, 0, 250, 0, 16])).expect("the wall listens");
    wait_until("the model turns", || front.difference(&wall.session.screenshot(), 16) > 0.02);
    thread::sleep(Duration::from_secs(3));
    wall.session.steady_screenshot();
    assert!(!wall.program.said().contains("panicked"));
}
