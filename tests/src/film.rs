//! Films of a camera path, without a window.

use std::{
    fs,
    path::Path,
    process::{Command, Stdio},
};

use glam::DVec3;
use shared::camera::{Camera, CameraPath, UpAxis};

use crate::{farm::Files, process::Program};

const SIZE: &str = "64x36";

/// Films a path of half a second, at the start of which the camera rests for 0.2 s; returns success and output.
fn film(files: &Files, folder: &Path, arguments: &[&str]) -> (bool, String) {
    let mut command = command(files);
    command.args(["--size", SIZE, "--samples", "1", "--pictures"]).arg(folder).args(arguments);
    let (status, said) = Program::start(command).wait();
    (status.success(), said)
}

/// The command that films this path, without the film's name, size and samples.
fn command(files: &Files) -> Command {
    let start = Camera::from_toml(&fs::read_to_string(files.path("camera.toml")).unwrap()).unwrap();
    let end = start.orbit(DVec3::Y, UpAxis::Y, 1.0, 0.2);
    let path = CameraPath::new(vec![(0.0, start), (0.2, start), (0.5, end)], UpAxis::Y).unwrap();
    fs::write(files.path("path.toml"), path.to_toml()).unwrap();
    let mut command = Program::command("compositor");
    command.args(["--headless", "--listen", "127.0.0.1:0", "--local", "1", "--triangles", "20000", "--fps", "10"]);
    command.arg("--wall").arg(files.path("wall.toml")).arg("--path").arg(files.path("path.toml"));
    command.arg("--stats").arg(files.path("stats.json"));
    command
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<_> =
        fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn a_film_has_each_picture_once_from_its_camera() {
    let files = Files::new();
    let folder = files.path("film");
    let (is_done, said) = film(&files, &folder, &[]);
    assert!(is_done, "{said}");
    assert!(said.contains("picture 1 of 6"), "no progress\n{said}");
    let names = names(&folder);
    assert_eq!(names, (1..=6).map(|number| format!("picture-{number:06}.png")).collect::<Vec<_>>());
    let pictures: Vec<_> = names
        .iter()
        .map(|name| crate::references::read_png(&folder.join(name)).unwrap())
        .inspect(|picture| assert_eq!(picture.size, [128, 72], "not the whole wall in full resolution"))
        .collect();
    assert!(pictures[0] == pictures[1] && pictures[1] == pictures[2], "the camera moves before 0.2 s");
    assert!((2..5).all(|index| pictures[index] != pictures[index + 1]), "the camera rests after 0.2 s");
    let hashes: Vec<_> =
        files.frames().iter().map(|frame| frame["samples_blake3"].as_str().unwrap().to_owned()).collect();
    assert_eq!(hashes[0], files.traced_hash(SIZE), "the film does not begin with the first camera");
    fs::write(files.path("camera.toml"), {
        let start = Camera::from_toml(&fs::read_to_string(files.path("camera.toml")).unwrap()).unwrap();
        start.orbit(DVec3::Y, UpAxis::Y, 1.0, 0.2).to_toml()
    })
    .unwrap();
    assert_eq!(hashes[5], files.traced_hash(SIZE), "the film does not end with the last camera");
}

#[test]
fn a_film_goes_on_where_it_ended_and_never_holds_another() {
    let files = Files::new();
    let folder = files.path("film");
    let bytes =
        |folder: &Path| names(folder).iter().map(|name| fs::read(folder.join(name)).unwrap()).collect::<Vec<_>>();
    let (is_done, said) = film(&files, &folder, &["--frames", "4"]);
    assert!(is_done && said.contains("the first 4 of 6 pictures are in"), "{said}");
    let (is_done, said) = film(&files, &folder, &[]);
    assert!(!is_done && said.lines().last().unwrap().contains("--resume goes on"), "{said}");
    let (is_done, said) = film(&files, &folder, &["--resume", "--background", "102030"]);
    assert!(!is_done && said.lines().last().unwrap().contains("picture-000004.png is of another film"), "{said}");
    assert_eq!(names(&folder).len(), 4);
    let (is_done, said) = film(&files, &folder, &["--resume"]);
    assert!(is_done && said.contains("going on after") && said.contains("the film's 6 pictures are in"), "{said}");
    assert_eq!(files.frames().len(), 3, "one to compare, and two that were missing");
    assert!(film(&files, &files.path("whole"), &["--resume"]).0, "an empty folder begins the film");
    let whole = bytes(&folder);
    assert!(whole == bytes(&files.path("whole")), "a film that goes on differs from one made at once");

    // An empty one, one without its end, and the last with another byte in its middle.
    let picture = |number: u32| folder.join(format!("picture-{number:06}.png"));
    fs::write(picture(2), "").unwrap();
    fs::write(picture(4), &whole[3][..whole[3].len() - 1]).unwrap();
    let mut last = whole[5].clone();
    let middle = last.len() / 2;
    last[middle] ^= 0xff;
    fs::write(picture(6), last).unwrap();
    let (is_done, said) = film(&files, &folder, &["--resume"]);
    assert!(is_done && !said.contains("another film"), "{said}");
    for number in [2, 4, 6] {
        assert!(said.contains(&format!("picture-00000{number}.png is damaged, and is made again")), "{said}");
    }
    assert_eq!(files.frames().len(), 4, "one to compare, and three that were damaged");
    assert!(bytes(&folder) == whole, "a film that was mended differs from one made at once");
}

#[test]
fn a_film_that_ends_at_rest_does_not_go_on_with_a_slower_path() {
    let files = Files::new();
    let start = Camera::from_toml(&fs::read_to_string(files.path("camera.toml")).unwrap()).unwrap();
    let end = start.orbit(DVec3::Y, UpAxis::Y, 1.0, 0.2);
    let film = |seconds_in_motion: f64, arguments: &[&str]| {
        let mut command = command(&files);
        let keys = vec![(0.0, start), (seconds_in_motion, end), (1.0, end)];
        fs::write(files.path("path.toml"), CameraPath::new(keys, UpAxis::Y).unwrap().to_toml()).unwrap();
        command.args(["--size", SIZE, "--samples", "1", "--pictures"]).arg(files.path("film")).args(arguments);
        let (status, said) = Program::start(command).wait();
        (status.success(), said)
    };
    let (is_done, said) = film(0.3, &["--frames", "8"]);
    assert!(is_done, "{said}");
    let (is_done, said) = film(0.6, &["--resume"]);
    assert!(!is_done && said.lines().last().unwrap().contains("picture-000006.png is of another film"), "{said}");
    let (is_done, said) = film(0.3, &["--resume"]);
    assert!(is_done && said.contains("the film's 11 pictures are in"), "{said}");
    assert_eq!(files.frames().len(), 5, "two to compare, and three that were missing");
}

#[test]
fn a_film_has_the_walls_resolution_and_sixteen_samples() {
    let files = Files::new();
    let mut command = command(&files);
    command.args(["--frames", "1", "--pictures"]).arg(files.path("film"));
    Program::succeed(command);
    let by_default = files.frames()[0]["samples_blake3"].clone();
    assert!(film(&files, &files.path("asked"), &["--frames", "1", "--size", "128x72", "--samples", "16"]).0);
    assert_eq!(by_default, files.frames()[0]["samples_blake3"]);
}

#[test]
fn a_film_without_ffmpeg_is_told_the_cure() {
    let files = Files::new();
    let mut command = command(&files);
    command.arg("--film").arg(files.path("film.mp4")).env("PATH", files.path("no"));
    let (status, said) = Program::start(command).wait();
    let line = said.lines().last().unwrap();
    assert!(!status.success() && line.contains("install it") && line.contains("--pictures FOLDER"), "{said}");
    assert!(!names(files.path("").as_path()).iter().any(|name| name.contains("film") || name.ends_with(".part")));
}

#[test]
fn ffmpeg_makes_a_film_with_the_colours_of_the_pictures() {
    if Command::new("ffmpeg").arg("-version").stdout(Stdio::null()).status().is_err() {
        return println!("skipped: ffmpeg is not installed");
    }
    let files = Files::new();
    let path = files.path("film.mp4");
    let filmed = |size: &str| {
        let mut command = command(&files);
        command.args(["--size", size, "--film"]).arg(&path);
        Program::start(command).wait()
    };
    let (status, said) = filmed(SIZE);
    assert!(status.success() && said.contains("wrote "), "{said}");
    assert!(!names(files.path("").as_path()).iter().any(|name| name.ends_with(".part")));
    let decoded = Command::new("ffmpeg")
        .args(["-loglevel", "error", "-i"])
        .arg(&path)
        .args(["-vf", "scale=in_color_matrix=bt709", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"])
        .output()
        .unwrap();
    let (frames, _) = decoded.stdout.as_chunks::<{ 128 * 72 * 3 }>();
    assert_eq!(frames.len(), 6, "{decoded:?}");
    let mut command = command(&files);
    command.args(["--size", SIZE, "--pictures"]).arg(files.path("film"));
    Program::succeed(command);
    let picture = crate::references::read_png(&files.path("film/picture-000006.png")).unwrap();
    let mean = |channel: usize, bytes: &[u8]| {
        bytes.iter().skip(channel).step_by(3).map(|&byte| f64::from(byte)).sum::<f64>() / (128.0 * 72.0)
    };
    for channel in 0..3 {
        let [film, picture] = [&frames[5][..], &picture.rgb].map(|bytes| mean(channel, bytes));
        assert!((film - picture).abs() < 2.0, "channel {channel}: {film} in the film, {picture} in the picture");
    }
}

#[test]
fn a_film_can_be_shortened_and_supersampled() {
    let files = Files::new();
    let (is_done, said) = film(&files, &files.path("film"), &["--frames", "1", "--samples", "4"]);
    assert!(is_done, "{said}");
    assert_eq!(fs::read_dir(files.path("film")).unwrap().count(), 1);
    assert_ne!(
        files.frames()[0]["samples_blake3"],
        files.traced_hash(SIZE),
        "four rays a sample give the same samples as one"
    );
}
