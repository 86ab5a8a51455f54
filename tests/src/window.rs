//! A real window on a real X server, with real keys and a real mouse.

use std::{fs, path::Path, process::Command, time::Duration};

use shared::camera::{CameraPath, Views};

use crate::{
    process::{Program, generate_statue, wait_until},
    x_drop::drop_file,
    x_session::{SHOWN, Screenshot, XSession},
};

const SCREEN: [usize; 2] = [1280, 720];
/// Where a wall that fills this screen has the number of the light's angle.
const LIGHT: [&str; 2] = ["1089", "227"];

/// A wall of two local render servers in a window.
struct Wall {
    session: XSession,
    program: Program,
    window: String,
}

impl Wall {
    /// Starts it with a small statue in small frames, and waits until it is on screen.
    fn start(arguments: &[&str]) -> Self {
        Self::start_in(Path::new("."), arguments)
    }

    /// Like `start`, with a folder for sidecar files.
    fn start_in(folder: &Path, arguments: &[&str]) -> Self {
        Self::start_on(SCREEN, folder, arguments)
    }

    /// Like `start_in`, on a screen of `screen` pixels.
    fn start_on(screen: [usize; 2], folder: &Path, arguments: &[&str]) -> Self {
        let session = XSession::start(screen);
        let mut command = session.wall(&["--local", "2", "--size", "256x128"]);
        if !arguments.iter().any(|argument| argument.ends_with(".ply")) {
            command.args(["--triangles", "5000"]);
        }
        command.current_dir(folder).args(arguments);
        let mut program = Program::start(command);
        program.wait_for(SHOWN);
        let window = session.wait_for_window("Raywall");
        Self { session, program, window }
    }

    /// Hides the overlay, whose figures change with every frame; returns the screen without it.
    fn hide_overlay(&self) -> Screenshot {
        let before = self.session.steady_screenshot();
        self.session.key("o");
        wait_until("the overlay is gone", || before.difference(&self.session.screenshot(), 4) > 0.05);
        self.session.steady_screenshot()
    }

    /// Presses a key, and waits until another frame is on screen.
    fn key_and_frame(&mut self, key: &str) {
        let n_shown = self.program.count(SHOWN);
        self.session.key(key);
        self.program.wait_for_count(SHOWN, n_shown + 1);
    }

    /// Quits by key; returns the program's output.
    fn quit(self) -> String {
        self.session.key("ctrl+q");
        let (status, said) = self.program.wait();
        assert_eq!(status.code(), Some(0), "{said}");
        said
    }
}

#[test]
fn the_division_key_switches_the_division_while_the_wall_runs() {
    let folder = tempfile::tempdir().unwrap();
    let stats = folder.path().join("stats.json");
    let mut wall = Wall::start(&["--division", "tiled", "--stats", stats.to_str().unwrap()]);
    // The first frames may show the model before it makes room for panels.
    wall.session.steady_screenshot();
    wall.key_and_frame("h");
    wall.session.steady_screenshot();
    wall.quit();
    let stats: serde_json::Value = serde_json::from_str(&fs::read_to_string(stats).unwrap()).unwrap();
    let frames = stats["frames"].as_array().unwrap();
    let tiled = frames.iter().rfind(|frame| frame["division"] == "tiled").expect("the wall starts with tiles");
    let dynamic = frames.last().unwrap();
    assert_eq!(dynamic["division"], "dynamic");
    assert_eq!(tiled["samples_blake3"], dynamic["samples_blake3"], "the division changes the picture");
}

#[test]
fn sigterm_ends_a_wall_as_the_key_does() {
    let folder = tempfile::tempdir().unwrap();
    let stats = folder.path().join("stats.json");
    let wall = Wall::start(&["--stats", stats.to_str().unwrap()]);
    wall.program.signal("TERM");
    let (status, said) = wall.program.wait();
    assert_eq!(status.code(), Some(0), "{said}");
    assert!(stats.is_file(), "the statistics are not written");
}

#[test]
fn dragging_turns_the_model_and_dragging_back_turns_it_back() {
    let wall = Wall::start(&[]);
    let front = wall.hide_overlay();
    assert!(front.brighter_than(120) > 0.03, "no model is seen");
    let middle = [SCREEN[0] as i32 / 2, SCREEN[1] as i32 / 2];
    let difference = || front.difference(&wall.session.screenshot(), 16);
    wall.session.drag(middle, [160, 0]);
    wait_until("the model has turned", || difference() > 0.02);
    wall.session.drag([middle[0] + 160, middle[1]], [-160, 0]);
    wait_until("the model has turned back", || difference() < 0.002);
    wall.session.drag(middle, [60, 60]);
    wait_until("the model has turned again", || difference() > 0.02);
    wall.session.key("f");
    wait_until("all is seen as at the start", || wall.session.screenshot() == front);
    wall.quit();
}

#[test]
fn a_kept_view_is_there_for_this_wall_and_the_next() {
    let folder = tempfile::tempdir().unwrap();
    let middle = [SCREEN[0] as i32 / 2, SCREEN[1] as i32 / 2];
    let wall = Wall::start_in(folder.path(), &[]);
    let front = wall.hide_overlay();
    wall.session.drag(middle, [120, 60]);
    wait_until("the model has turned", || front.difference(&wall.session.screenshot(), 16) > 0.02);
    let turned = wall.session.steady_screenshot();
    wall.session.key("ctrl+3");
    wall.session.key("f");
    wait_until("all is seen, and the note is gone", || wall.session.screenshot() == front);
    wall.session.key("3");
    wait_until("the view is there again", || wall.session.screenshot() == turned);
    wall.quit();
    let views = Views::from_toml(&fs::read_to_string(folder.path().join("statue.views.toml")).unwrap()).unwrap();
    assert_eq!(views.numbers().collect::<Vec<_>>(), [3]);
    let wall = Wall::start_in(folder.path(), &[]);
    assert!(wall.hide_overlay() == front);
    wall.session.key("3");
    wait_until("the next wall has the view", || wall.session.screenshot() == turned);
    wall.quit();
}

#[test]
fn a_recorded_path_is_played() {
    let folder = tempfile::tempdir().unwrap();
    let wall = Wall::start_in(folder.path(), &[]);
    let front = wall.hide_overlay();
    wall.session.key("c");
    // Two movements with a rest between them are four keys at least, however fast the mouse is.
    for _ in 0..2 {
        let before = wall.session.steady_screenshot();
        wall.session.drag([SCREEN[0] as i32 / 2, SCREEN[1] as i32 / 2], [100, 0]);
        wait_until("the model has turned", || before.difference(&wall.session.screenshot(), 16) > 0.02);
    }
    wall.session.key("c");
    let file = folder.path().join("statue.path.toml");
    wait_until("the path is kept", || file.is_file());
    wait_until("the note is gone", || wall.session.steady_screenshot() != front);
    wall.session.key("f");
    wait_until("all is seen again", || wall.session.screenshot() == front);
    let path = CameraPath::from_toml(&fs::read_to_string(&file).unwrap()).unwrap();
    assert!(path.duration_seconds() > 0.05 && path.keys().len() > 2, "{path:?}");
    wall.session.key("space");
    wait_until("the camera has followed the path", || front.difference(&wall.session.screenshot(), 16) > 0.02);
    let end = wall.session.steady_screenshot();
    wall.session.key("f");
    wait_until("all is seen once more", || wall.session.screenshot() == front);
    wall.session.key("space");
    wait_until("the path ends where it ended", || wall.session.screenshot() == end);
    wall.quit();
}

#[test]
fn a_click_says_which_triangle_is_there_and_a_double_click_goes_to_it() {
    let mut wall = Wall::start(&[]);
    let front = wall.hide_overlay();
    let middle = [SCREEN[0] / 2, SCREEN[1] / 2].map(|side| side.to_string());
    wall.session.xdotool(&["mousemove", &middle[0], &middle[1], "click", "1"]);
    wall.program.wait_for("Triangle ");
    // Later than the second click of a double click.
    std::thread::sleep(Duration::from_millis(600));
    wall.session.xdotool(&["click", "--repeat", "2", "--delay", "60", "1"]);
    wait_until("the statue is nearer", || front.difference(&wall.session.screenshot(), 16) > 0.1);
    wall.quit();
}

#[test]
fn visitors_of_a_locked_wall_can_only_steer() {
    let mut wall = Wall::start(&["--kiosk"]);
    let screen = [0, 0, SCREEN[0] as i32, SCREEN[1] as i32];
    wait_until("the window fills the screen", || wall.session.geometry(&wall.window) == screen);
    let front = wall.session.steady_screenshot();
    for key in ["o", "F1", "v", "h", "Escape", "ctrl+q", "p"] {
        wall.session.key(key);
    }
    wall.session.drag([600, 300], [100, 50]);
    wait_until("visitors turn the model", || front.difference(&wall.session.screenshot(), 16) > 0.02);
    wall.session.key("f");
    wait_until("nothing else has changed", || wall.session.screenshot() == front);
    wall.session.key("ctrl+l");
    wall.program.wait_for("Unlocked");
    wall.quit();
}

#[test]
fn an_idle_kiosk_returns_to_the_whole_model() {
    let wall = Wall::start(&["--kiosk=3"]);
    let front = wall.session.steady_screenshot();
    wall.session.drag([600, 300], [100, 50]);
    let difference = || front.difference(&wall.session.screenshot(), 16);
    wait_until("a visitor has turned the model", || difference() > 0.02);
    std::thread::sleep(Duration::from_secs(2));
    assert!(difference() > 0.02, "too early");
    wait_until("the whole model is seen again", || wall.session.screenshot() == front);
    wall.session.key("ctrl+l");
    wall.quit();
}

#[cfg(unix)]
#[test]
fn a_folder_that_takes_long_to_read_is_listed_without_another_key() {
    let folder = tempfile::tempdir().unwrap();
    // Reading them takes longer than drawing after the key's release.
    for index in 0..200_000 {
        std::os::unix::fs::symlink("missing", folder.path().join(index.to_string())).unwrap();
    }
    // Only its listed names make the panel as high as the screen.
    for index in 0..40 {
        fs::write(folder.path().join(format!("scan {index}.ply")), "ply\n").unwrap();
    }
    let wall = Wall::start_in(folder.path(), &[]);
    let statue = wall.hide_overlay();
    wall.session.key("ctrl+o");
    wait_until("the files are listed", || statue.difference(&wall.session.screenshot(), 4) > 0.2);
    wall.session.key("Escape");
    wait_until("the list is gone", || wall.session.screenshot() == statue);
    wall.quit();
}

#[test]
fn a_session_from_opening_a_model_to_leaving() {
    let folder = tempfile::tempdir().unwrap();
    let (model, stats) = (folder.path().join("a model.ply"), folder.path().join("stats.json"));
    generate_statue(300, &model);
    let mut wall = Wall::start_in(folder.path(), &["--division", "tiled", "--stats", stats.to_str().unwrap()]);
    let statue = wall.hide_overlay();
    wall.session.key("ctrl+o");
    wait_until("the files are listed", || statue.difference(&wall.session.screenshot(), 4) > 0.02);
    let listed = wall.session.steady_screenshot();
    // Without the list, these keys would switch the division, keep a view and quit.
    for key in ["h", "q", "ctrl+3", "ctrl+q", "BackSpace", "BackSpace"] {
        wall.session.key(key);
    }
    wait_until("the letters are typed and taken away", || wall.session.steady_screenshot() == listed);
    wall.session.key("m");
    wall.session.key("Return");
    wall.session.wait_for_window("a model.ply");
    wait_until("the model is seen", || statue.difference(&wall.session.screenshot(), 16) > 0.005);
    let opened = wall.session.steady_screenshot();
    wall.session.drag([SCREEN[0] as i32 / 2, SCREEN[1] as i32 / 2], [-150, 40]);
    wait_until("it is orbited", || opened.difference(&wall.session.screenshot(), 16) > 0.02);
    wall.key_and_frame("h");
    let shaded = wall.session.steady_screenshot();
    // Later frames come from the rebuilt grids.
    let n_ready = wall.program.count("is ready");
    wall.session.key("k");
    wall.program.wait_for("Grids become masks, 32 cells a triangle");
    wall.program.wait_for_count("is ready", n_ready + 2);
    wall.key_and_frame("v");
    wait_until("normals are seen", || shaded.difference(&wall.session.screenshot(), 16) > 0.05);
    let normals = wall.session.steady_screenshot();
    wall.session.key("t");
    wait_until("tiles have their render servers' colours", || normals.difference(&wall.session.screenshot(), 16) > 0.5);
    wall.session.key("p");
    wait_until("the screenshot is written", || folder.path().join("wall-0001.png").is_file());
    let said = wall.quit();
    assert_eq!(said.matches("dividing frames").count(), 1, "a letter for the list is a command\n{said}");
    assert!(!said.contains("View 3 is kept"), "{said}");
    let picture = crate::references::read_png(&folder.path().join("wall-0001.png")).unwrap();
    assert_eq!(picture.size, [4096, 2304]);
    let stats: serde_json::Value = serde_json::from_str(&fs::read_to_string(stats).unwrap()).unwrap();
    let last = stats["frames"].as_array().unwrap().last().unwrap();
    assert_eq!((&last["division"], last["nodes"].as_array().unwrap().len()), (&"dynamic".into(), 2));
}

#[test]
fn keys_belong_to_the_field_that_has_the_focus() {
    let mut wall = Wall::start(&["--fullscreen"]);
    let before = wall.session.steady_screenshot();
    let open_field = |before: &Screenshot| {
        // The number beside the slider that turns the light.
        wall.session.xdotool(&["mousemove", LIGHT[0], LIGHT[1], "click", "--repeat", "2", "--delay", "60", "1"]);
        wait_until("the field is open", || *before != wall.session.screenshot());
        wall.session.steady_screenshot()
    };
    let field = open_field(&before);
    // A press outside the overlay takes the focus away.
    wall.session.xdotool(&["mousemove", "600", "20", "click", "1"]);
    wait_until("the field is closed", || field != wall.session.screenshot());
    wall.session.key("8");
    wall.program.wait_for("There is no view 8");
    open_field(&wall.session.steady_screenshot());
    let n_shown = wall.program.count(SHOWN);
    for key in ["h", "BackSpace", "ctrl+3", "9", "0", "Return"] {
        wall.session.key(key);
    }
    wall.program.wait_for_count(SHOWN, n_shown + 1);
    wait_until("the light has turned", || before.difference(&wall.session.steady_screenshot(), 16) > 0.005);
    wall.session.key("9");
    wall.program.wait_for("There is no view 9");
    let said = wall.quit();
    assert!(!said.contains("dividing frames") && !said.contains("View 3 is kept"), "{said}");
    assert_eq!(said.matches("There is no view 9").count(), 1, "{said}");
}

#[test]
fn a_window_can_be_minimised_and_made_small_and_large() {
    let mut wall = Wall::start(&[]);
    let before = wall.hide_overlay();
    wall.session.xdotool(&["windowminimize", "--sync", &wall.window]);
    std::thread::sleep(Duration::from_millis(500));
    wall.session.xdotool(&["windowmap", &wall.window]);
    wall.session.xdotool(&["windowactivate", "--sync", &wall.window]);
    wait_until("the wall is there again", || wall.session.screenshot() == before);
    for size in [["1", "1"], ["333", "777"], ["1200", "190"], ["1024", "576"]] {
        wall.session.xdotool(&["windowsize", &wall.window, size[0], size[1]]);
        wall.key_and_frame("h");
        wall.session.key("o");
        wall.session.key("o");
    }
    wall.quit();
}

#[test]
fn a_wall_of_a_single_pixel_shows_it() {
    let mut wall = Wall::start_on([1, 1], Path::new("."), &["--fullscreen"]);
    for key in ["v", "v", "h"] {
        wall.key_and_frame(key);
    }
    wall.session.key("t");
    wall.session.key("F1");
    wait_until("the pixel is drawn", || wall.session.screenshot().rgb != [0; 3]);
    wall.quit();
}

#[test]
fn f11_fills_the_screen_and_escape_gives_it_back() {
    let wall = Wall::start(&[]);
    let windowed = wall.session.geometry(&wall.window);
    let screen = [0, 0, SCREEN[0] as i32, SCREEN[1] as i32];
    assert_ne!(windowed, screen);
    wall.session.key("F11");
    wait_until("the window fills the screen", || wall.session.geometry(&wall.window) == screen);
    wall.session.key("o");
    // Every corner shows sky, not desktop: the wall has the screen's shape.
    wait_until("the wall fills the screen", || {
        corners(&wall.session.screenshot()).iter().all(|&pixel| pixel != [0; 3])
    });
    wall.session.key("Escape");
    wait_until("the window is as it was", || wall.session.geometry(&wall.window)[2..] == windowed[2..]);
    wall.quit();
}

#[test]
fn a_fullscreen_wall_holds_the_screensaver_off_until_it_ends() {
    let wall = Wall::start(&["--fullscreen"]);
    wall.session.make_screensaver_impatient();
    for _ in 0..6 {
        std::thread::sleep(Duration::from_millis(500));
        assert!(!wall.session.screensaver_is_on(), "the screensaver started");
    }
    wall.session.key("ctrl+q");
    let Wall { session, program, .. } = wall;
    program.wait();
    wait_until("the screensaver starts after the wall has ended", || session.screensaver_is_on());
}

#[test]
fn a_screenshot_is_the_whole_wall_without_overlay() {
    let folder = tempfile::tempdir().unwrap();
    let last = folder.path().join("last.png");
    let wall = Wall::start(&["--fullscreen", "--screenshot", last.to_str().unwrap()]);
    wall.quit();
    let decoder = png::Decoder::new(std::io::BufReader::new(fs::File::open(last).unwrap()));
    let reader = decoder.read_info().unwrap();
    assert_eq!((reader.info().width, reader.info().height), (4096, 2304));
}

#[test]
fn a_dropped_model_is_shown_and_a_broken_one_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let (good, broken) = (folder.path().join("a good model.ply"), folder.path().join("broken.ply"));
    generate_statue(200, &good);
    fs::write(&broken, "ply\nformat ascii 1.0\nelement vertex 3\n").unwrap();
    let mut wall = Wall::start(&[]);
    let statue = wall.hide_overlay();
    drop_file(wall.session.display(), &wall.window, &good);
    wall.session.wait_for_window("a good model.ply");
    wait_until("the dropped model is seen", || statue.difference(&wall.session.screenshot(), 16) > 0.005);
    let dropped = wall.session.steady_screenshot();
    drop_file(wall.session.display(), &wall.window, &broken);
    wall.program.wait_for("broken.ply");
    wait_until("the message is seen", || dropped != wall.session.screenshot());
    wait_until("the model is still there", || dropped == wall.session.screenshot());
    wall.session.key("o");
    wait_until("the overlay is back", || dropped.difference(&wall.session.screenshot(), 16) > 0.05);
    wall.quit();
}

#[test]
fn another_model_opens_whole_and_uncut() {
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("another.ply");
    generate_statue(300, &model);
    let fresh = Wall::start(&[model.to_str().unwrap()]);
    let whole = fresh.hide_overlay();
    fresh.quit();
    let wall = Wall::start(&["--clip", "y:60", "--up", "x"]);
    let cut = wall.hide_overlay();
    drop_file(wall.session.display(), &wall.window, &model);
    wall.session.wait_for_window("another.ply");
    wait_until("the other model is seen", || cut.difference(&wall.session.screenshot(), 16) > 0.005);
    wait_until("it is seen as a wall of its own shows it", || wall.session.screenshot() == whole);
    wall.quit();
}

#[test]
fn a_resting_wall_costs_the_main_thread_no_time() {
    let wall = Wall::start(&[]);
    wall.session.steady_screenshot();
    // Until the overlay says "at rest" in place of the frame rate.
    std::thread::sleep(Duration::from_millis(1500));
    let before = wall.program.main_thread_ticks();
    std::thread::sleep(Duration::from_secs(2));
    let ticks = wall.program.main_thread_ticks() - before;
    assert!(ticks <= 4, "{ticks} of 200 ticks of CPU time at rest");
    wall.quit();
}

#[test]
fn a_missing_requirement_of_the_window_is_reported_in_one_line() {
    let session = XSession::start([64, 64]);
    let folder = tempfile::tempdir().unwrap();
    // Found before the real library, and unusable.
    for name in ["libxkbcommon-x11.so.0", "libxkbcommon-x11.so"] {
        fs::write(folder.path().join(name), "").unwrap();
    }
    let check = |expected: &str, prepare: &dyn Fn(&mut Command)| {
        let mut command = Program::command("compositor");
        command.args(["--listen", "127.0.0.1:0"]).env_remove("WAYLAND_DISPLAY");
        command.env("DISPLAY", session.display());
        prepare(&mut command);
        let (status, said) = Program::start(command).wait();
        let last = said.lines().last().unwrap_or_default();
        assert!(last.contains(expected), "expected \"{expected}\"\n{said}");
        assert!(status.code().is_some_and(|code| code != 0 && code != 101), "{status}\n{said}");
        assert!(!said.contains("panicked"), "{said}");
    };
    check("neither WAYLAND_DISPLAY nor DISPLAY is set", &|command| {
        command.env_remove("DISPLAY");
    });
    check("no window can be opened (DISPLAY=:9999", &|command| {
        command.env("DISPLAY", ":9999");
    });
    check("apt install libxkbcommon-x11-0 (Debian", &|command| {
        command.env("LD_LIBRARY_PATH", folder.path());
    });
    check("install mesa-vulkan-drivers", &|command| {
        let no_driver = Path::new("/no/driver.json");
        command.env("VK_DRIVER_FILES", no_driver).env("VK_ICD_FILENAMES", no_driver);
    });
    check("no/such.ply", &|command| {
        command.args(["--model", "no/such.ply"]);
    });
}

fn corners(screenshot: &Screenshot) -> [[u8; 3]; 4] {
    let [width, height] = screenshot.size;
    [(2, 2), (width - 3, 2), (2, height - 3), (width - 3, height - 3)]
        .map(|(x, y)| screenshot.rgb.as_chunks::<3>().0[y * width + x])
}
