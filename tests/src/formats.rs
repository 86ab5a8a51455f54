//! One mesh in every format: the same triangles, and the same hits, byte for byte.

use std::{fmt::Write, fs, path::Path};

use glam::DVec3;
use renderer::{
    formats::{file, ply},
    grid::GridOptions,
    intersect::ray::Hit,
    model::{mesh::Mesh, statue},
    render::{image::write_png, scene::Scene},
};
use shared::{camera::Camera, division::FrameSize};

use crate::{
    accuracy::hits,
    farm::{Files, RunningWall, nodes_of, samples_of_png},
    process::Program,
};

/// Each triangle with corners of its own.
fn corners(mesh: &Mesh) -> Vec<[[f32; 3]; 3]> {
    (0..mesh.triangles.len()).filter_map(|triangle| mesh.corners(triangle)).collect()
}

fn write_obj(path: &Path, mesh: &Mesh) {
    let mut text = String::from("# a mesh\n");
    for [x, y, z] in &mesh.vertices {
        writeln!(text, "v {x} {y} {z}").unwrap();
    }
    // Each corner has a look of its own, so vertices are split.
    for triangle in 0..mesh.triangles.len() {
        let [a, b, c] = mesh.triangles[triangle].map(|index| index + 1);
        writeln!(text, "vt 0.{triangle} 0.5\nf {a}/-1 {b}/-1 {c}").unwrap();
    }
    fs::write(path, text).unwrap();
}

fn write_stl(path: &Path, mesh: &Mesh) {
    let mut bytes = vec![b' '; 80];
    bytes.extend((mesh.triangles.len() as u32).to_le_bytes());
    for corners in corners(mesh) {
        bytes.extend([0; 12]);
        bytes.extend(corners.as_flattened().iter().flat_map(|x| x.to_le_bytes()));
        bytes.extend([0; 2]);
    }
    fs::write(path, bytes).unwrap();
}

fn write_text_stl(path: &Path, mesh: &Mesh) {
    let mut text = String::from("solid mesh\n");
    for corners in corners(mesh) {
        text += "facet normal 0 0 0\nouter loop\n";
        for [x, y, z] in corners {
            writeln!(text, "vertex {x:e} {y:e} {z:e}").unwrap();
        }
        text += "endloop\nendfacet\n";
    }
    fs::write(path, text + "endsolid mesh\n").unwrap();
}

/// The JSON of a mesh and its bytes. Its two halves are meshes of two nodes, which turn and move them there and back.
fn gltf(mesh: &Mesh, uri: &str) -> (String, Vec<u8>) {
    let numbers = mesh.vertices.as_flattened().iter().flat_map(|x| x.to_le_bytes());
    let indices = mesh.triangles.as_flattened().iter().flat_map(|index| index.to_le_bytes());
    let bytes: Vec<u8> = numbers.chain(indices).collect();
    let (n_vertices, n_bytes, n_corners) = (mesh.vertices.len(), bytes.len(), 3 * mesh.triangles.len());
    let (middle, start) = (3 * (mesh.triangles.len() / 2), 12 * n_vertices);
    let accessor = |first: usize, end: usize| {
        format!(
            "{{\"bufferView\":1,\"byteOffset\":{},\"componentType\":5125,\"count\":{},\"type\":\"SCALAR\"}}",
            4 * first,
            end - first
        )
    };
    let mesh =
        |indices: u32| format!("{{\"primitives\":[{{\"attributes\":{{\"POSITION\":0}},\"indices\":{indices}}}]}}");
    let json = format!(
        "{{\"asset\":{{\"version\":\"2.0\"}},\"scene\":0,\"scenes\":[{{\"nodes\":[0]}}],\"nodes\":[\
         {{\"rotation\":[0,1,0,0],\"translation\":[0,0,4],\"children\":[1,2]}},\
         {{\"mesh\":0,\"rotation\":[0,-1,0,0],\"translation\":[0,0,4]}},\
         {{\"mesh\":1,\"matrix\":[-1,0,0,0, 0,1,0,0, 0,0,-1,0, 0,0,4,1]}}],\
         \"meshes\":[{},{}],\"buffers\":[{{{uri}\"byteLength\":{n_bytes}}}],\"bufferViews\":[\
         {{\"buffer\":0,\"byteLength\":{start}}},\
         {{\"buffer\":0,\"byteOffset\":{start},\"byteLength\":{}}}],\"accessors\":[\
         {{\"bufferView\":0,\"componentType\":5126,\"count\":{n_vertices},\"type\":\"VEC3\"}},{},{}]}}",
        mesh(1),
        mesh(2),
        4 * n_corners,
        accessor(0, middle),
        accessor(middle, n_corners),
    );
    (json, bytes)
}

fn write_glb(path: &Path, mesh: &Mesh) {
    let (mut json, bytes) = gltf(mesh, "");
    while json.len() % 4 != 0 {
        json.push(' ');
    }
    let mut glb = b"glTF\x02\0\0\0".to_vec();
    glb.extend((28 + json.len() as u32 + bytes.len() as u32).to_le_bytes());
    for (kind, chunk) in [(b"JSON", json.as_bytes()), (b"BIN\0", &bytes)] {
        glb.extend((chunk.len() as u32).to_le_bytes());
        glb.extend(kind);
        glb.extend(chunk);
    }
    fs::write(path, glb).unwrap();
}

fn write_gltf(path: &Path, mesh: &Mesh) {
    let (json, bytes) = gltf(mesh, "\"uri\":\"the%20mesh.bin\",");
    fs::write(path, json).unwrap();
    fs::write(path.with_file_name("the mesh.bin"), bytes).unwrap();
}

/// All that a hit is, as bytes.
fn bytes_of(hits: &[Hit]) -> Vec<u8> {
    hits.iter().flat_map(|hit| [hit.triangle.to_le_bytes(), hit.t.to_le_bytes()].concat()).collect()
}

#[test]
fn every_format_gives_the_same_hits() {
    let folder = tempfile::tempdir().unwrap();
    // Coordinates that stay what they are when they are moved by four and back.
    let mut mesh = statue::generate(20_000, &|_| ());
    let round = |x: f32| (x * 65_536.0).round() / 65_536.0;
    mesh.vertices.as_flattened_mut().iter_mut().for_each(|x| *x = round(*x));
    let size = FrameSize::new(256, 192).unwrap();
    let camera = Camera::look_at(DVec3::new(1.5, 2.5, 5.0), DVec3::Y * 1.7, DVec3::Y, 0.8, 4.0 / 3.0).unwrap();
    let traced = |name: &str, write: &dyn Fn(&Path, &Mesh)| {
        let path = folder.path().join(name);
        write(&path, &mesh);
        let read = file::read(&path, &|_| ()).unwrap();
        assert_eq!((corners(&read.mesh) == corners(&mesh), read.remarks), (true, vec![]), "{name}");
        assert_eq!(read.mesh.facing(), mesh.facing(), "{name}");
        let scene = Scene::build(read.mesh, &GridOptions::default(), &|_| ());
        bytes_of(&hits(&scene, &camera.rays(size), size))
    };
    let expected = traced("a", &|path, mesh| ply::write(path, mesh).unwrap());
    assert!(hits_of(&expected) > 5000, "the statue is seen");
    for (name, write) in [
        ("b.wrong", &write_obj as &dyn Fn(&Path, &Mesh)),
        ("c", &write_stl),
        ("d", &write_text_stl),
        ("e", &write_glb),
        ("f", &write_gltf),
    ] {
        assert!(traced(name, write) == expected, "{name} is hit otherwise");
    }
}

fn hits_of(bytes: &[u8]) -> usize {
    bytes.chunks_exact(8).filter(|hit| hit[..4] != [0xff; 4]).count()
}

/// Writes a model of four squares beside each other, in front of the default camera, with a picture on each of three.
/// `corner` gives the texture coordinates of a square's lower left corner, and its material.
fn write_squares(path: &Path, corner: impl Fn(usize) -> ([u32; 2], &'static str)) {
    let mut text = String::from("mtllib squares.mtl\n");
    for square in 0..4 {
        let ([u, v], material) = corner(square);
        writeln!(text, "usemtl {material}").unwrap();
        for [x, y] in [[0, 0], [1, 0], [1, 1], [0, 1]] {
            writeln!(text, "v {} {y} 0\nvt {} {}", square + x, u as usize + x, v as usize + y).unwrap();
        }
        text += "f -4/-4 -3/-3 -2/-2 -1/-1\n";
    }
    fs::write(path, text).unwrap();
}

#[test]
fn tiles_of_a_texture_look_like_a_material_for_each_and_are_part_of_the_scene() {
    const TILES: [(&str, [u32; 2], u8); 3] = [("1001", [0, 0], 40), ("1002", [1, 0], 120), ("1011", [0, 1], 200)];
    let files = Files::new();
    for folder in ["tiled", "plain", "other"] {
        fs::create_dir(files.path(folder)).unwrap();
        for (tile, _, red) in TILES {
            let rgb: Vec<u8> = (0..64).flat_map(|texel| [red, texel % 8 * 30, texel / 8 * 30]).collect();
            let size = FrameSize::new(8, 8).unwrap();
            write_png(&files.path(&format!("{folder}/t.{tile}.png")), size, &rgb).unwrap();
        }
        write_squares(&files.path(&format!("{folder}/squares.obj")), |square| match (folder, TILES.get(square)) {
            ("plain", Some((tile, ..))) => ([0, 0], tile),
            ("plain", None) => ([0, 0], "none"),
            (_, Some(&(_, tile, _))) => (tile, "all"),
            // Of a tile that no file has.
            (_, None) => ([5, 0], "all"),
        });
    }
    let look = "Kd 0.5 0.25 0.125\n";
    for folder in ["tiled", "other"] {
        let library = format!("newmtl all\n{look}map_Kd t.<UDIM>.png\n");
        fs::write(files.path(&format!("{folder}/squares.mtl")), library).unwrap();
    }
    let material = |tile| format!("newmtl {tile}\n{look}map_Kd -clamp on t.{tile}.png\n");
    let plain = TILES.map(|(tile, ..)| material(tile)).concat() + &format!("newmtl none\n{look}");
    fs::write(files.path("plain/squares.mtl"), plain).unwrap();
    fs::remove_file(files.path("other/t.1011.png")).unwrap();

    let traced = |folder: &str| {
        let picture = files.path(&format!("{folder}.png"));
        let mut command = Program::command("renderer");
        command.args(["trace", "--size", "96x54", "--model"]).arg(files.path(&format!("{folder}/squares.obj")));
        command.arg("--image").arg(&picture);
        (Program::succeed(command), samples_of_png(&picture))
    };
    let ((told, tiled), (_, plain)) = (traced("tiled"), traced("plain"));
    assert!(told.contains("t.1006.png is missing: put it beside the model"), "{told}");
    // Coordinates farther from zero are rounded otherwise.
    assert!(tiled.iter().zip(&plain).all(|(tiled, plain)| tiled.abs_diff(*plain) <= 1), "looks otherwise");
    assert!(plain.iter().any(|&part| part != plain[0]), "the squares are seen");

    let mut command = Program::command("compositor");
    command.args(["--headless", "--listen", "127.0.0.1:0", "--local", "0", "--frames", "1", "--size", "96x54"]);
    command.arg("--model").arg(files.path("tiled/squares.obj")).arg("--stats").arg(files.path("stats.json"));
    command.arg("--wall").arg(files.path("wall.toml"));
    let mut wall = Program::start(command);
    let address = wall.wait_for_address();
    let join = |folder: &str| {
        let model = files.path(&format!("{folder}/squares.obj"));
        RunningWall::join_at(&address, folder, &["--model", model.to_str().unwrap()])
    };
    let _other = join("other");
    wall.wait_for("give it the wall's own file, and all that it names: an image is left out: ");
    wall.wait_for("t.1011.png is missing: put it beside the model");
    let _right = join("tiled");
    let (status, said) = wall.wait();
    assert!(status.success(), "{said}");
    assert_eq!(nodes_of(&files.frames()[0]), ["tiled"]);
}
