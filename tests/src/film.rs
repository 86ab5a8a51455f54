//! Films of a camera path, without a window.

use std::{fs, path::Path};

use glam::DVec3;
use shared::camera::{Camera, CameraPath, UpAxis};

use crate::{farm::Files, process::Program};

const SIZE: &str = "64x36";

/// Films a path of half a second, at the start of which the camera rests for 0.2 s; returns success and output.
fn film(files: &Files, folder: &Path, arguments: &[&str]) -> (bool, String) {
    let start = Camera::from_toml(&fs::read_to_string(files.path("camera.toml")).unwrap()).unwrap();
    let end = start.orbit(DVec3::Y, UpAxis::Y, 1.0, 0.2);
    let path = CameraPath::new(vec![(0.0, start), (0.2, start), (0.5, end)], UpAxis::Y).unwrap();
    fs::write(files.path("path.toml"), path.to_toml()).unwrap();
    let mut command = Program::command("compositor");
    command.args(["--headless", "--listen", "127.0.0.1:0", "--local", "1", "--triangles", "20000", "--size", SIZE]);
    command.args(["--fps", "10"]).arg("--wall").arg(files.path("wall.toml")).arg("--path").arg(files.path("path.toml"));
    command.arg("--pictures").arg(folder).arg("--stats").arg(files.path("stats.json")).args(arguments);
    let (status, said) = Program::start(command).wait();
    (status.success(), said)
}

#[test]
fn a_film_has_each_picture_once_from_its_camera() {
    let files = Files::new();
    let folder = files.path("film");
    let (is_done, said) = film(&files, &folder, &[]);
    assert!(is_done, "{said}");
    let mut names: Vec<_> =
        fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
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

    let (is_done, said) = film(&files, &folder, &[]);
    assert!(!is_done && said.lines().last().unwrap().contains("holds a film already"), "{said}");
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
