//! Models on a map grid: files, cameras and pictures of a wall at coordinates that single precision cannot hold.

use std::fs;

use glam::{DVec3, dvec3};
use shared::camera::Camera;

use crate::{
    farm::{Files, hash_of_png},
    process::Program,
};

const SIZE: &str = "96x54";

/// Rounds to steps that `f64` holds exactly here and on the map grid, and that `f32` does not hold.
fn exact(point: DVec3) -> DVec3 {
    (point * 2f64.powi(28)).round() * 2f64.powi(-28)
}

/// A barrel of doubles around a point.
fn barrel(at: DVec3) -> String {
    const SIDES: usize = 24;
    let angle = |side: usize| (side as f64 + 0.3) * std::f64::consts::TAU / SIDES as f64;
    let rim = |z: f64| (0..SIDES).map(move |side| dvec3(angle(side).cos(), angle(side).sin(), z));
    let vertices = rim(0.0).chain(rim(1.7)).map(|point| exact(point) + at);
    let rows: String = vertices.map(|DVec3 { x, y, z }| format!("{x:?} {y:?} {z:?}\n")).collect();
    let next = |side: usize| (side + 1) % SIDES;
    let side = |side: usize| format!("4 {side} {} {} {}\n", next(side), next(side) + SIDES, side + SIDES);
    let sides: String = (0..SIDES).map(side).collect();
    format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\n\
         element face {SIDES}\nproperty list uchar int vertex_indices\nend_header\n{rows}{sides}",
        2 * SIDES
    )
}

#[test]
fn a_barrel_on_a_map_grid_is_seen_as_it_is_at_zero() {
    let files = Files::new();
    let grid = exact(dvec3(512_345.123, 5_412_345.678, 71.25));
    let camera = Camera::look_at(dvec3(2.0, -4.0, 2.5), dvec3(0.0, 0.0, 0.8), DVec3::Z, 0.7, 16.0 / 9.0).unwrap();
    let [eye, ll] = [camera.eye(), camera.ll()].map(exact);
    for (name, at) in [("zero", DVec3::ZERO), ("grid", grid)] {
        fs::write(files.path(&format!("{name}.ply")), barrel(at)).unwrap();
        let camera = Camera::new(eye + at, ll + at, camera.u(), camera.v()).unwrap();
        fs::write(files.path(&format!("{name}.toml")), camera.to_toml()).unwrap();
    }

    let mut trace = Program::command("renderer");
    trace.args(["trace", "--size", SIZE, "--rays", "shadows", "--model"]).arg(files.path("zero.ply"));
    trace.arg("--camera").arg(files.path("zero.toml")).arg("--image").arg(files.path("zero.png"));
    Program::succeed(trace);
    let at_zero = hash_of_png(&files.path("zero.png"));

    let mut wall = Program::command("compositor");
    wall.args(["--headless", "--listen", "127.0.0.1:0", "--local", "2", "--frames", "2", "--size", SIZE]);
    wall.args(["--rays", "shadows", "--model"]).arg(files.path("grid.ply"));
    wall.arg("--camera").arg(files.path("grid.toml")).arg("--stats").arg(files.path("stats.json"));
    wall.arg("--wall").arg(files.path("wall.toml"));
    let said = Program::succeed(wall);
    assert!(said.contains("grid.ply: traced relative to (512346."), "{said}");
    assert!(files.frames().iter().all(|frame| frame["samples_blake3"] == at_zero.as_str()), "other pictures");
}
