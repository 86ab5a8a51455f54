//! The reader against files written by hand.

use std::fs;

use glam::{DVec3, Vec3};
use proptest::prelude::*;

use super::*;
use crate::formats::images::{Channels, ImageSource};
use crate::model::{
    material::{TextureUse, Wrap},
    mesh::Mesh,
};

fn parse(text: impl AsRef<[u8]>) -> Result<Draft, TextProblem> {
    let text = text.as_ref();
    read_from(text, text.len() as u64, &Companions::default())
}

/// Parses a valid file; panics with the reader's error.
fn mesh(text: impl AsRef<[u8]>) -> Mesh {
    parse(text).unwrap_or_else(|problem| panic!("{problem}")).mesh
}

const CORNERS: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n";

/// A mesh of an OBJ beside a file of materials.
fn with_library(obj: &str, library: &[u8]) -> Draft {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("a b.mtl"), library).unwrap();
    let companions = Companions::beside(&folder.path().join("model.obj"));
    read_from(obj.as_bytes(), obj.len() as u64, &companions).unwrap()
}

#[test]
fn faces_are_fanned_in_order() {
    let text = "f 1 2 3\nf 4/1 3//1 2/1/1 1\r\nf 1 2\nf\nfo -4 -3 -2 # a remark\n";
    assert_eq!(mesh(format!("{CORNERS}{text}")).triangles, [[0, 1, 2], [3, 2, 1], [3, 1, 0], [0, 1, 2]]);
}

#[test]
fn concave_faces_are_divided_within_them() {
    let Draft { mesh, .. } = parse("v 0 0 0\nv 4 0 0\nv 4 4 0\nv 3 1 0\nvt 0 1\nf 2/1 3/1 4/1 1/1\n").unwrap();
    let mut triangles: Vec<_> = mesh
        .triangles
        .iter()
        .map(|&corners| {
            let mut sorted = corners;
            sorted.sort();
            sorted
        })
        .collect();
    triangles.sort();
    assert_eq!(triangles, [[0, 1, 3], [1, 2, 3]]);
    assert_eq!(mesh.texture_coordinates, [[0.0; 2]; 4], "coordinates that are all zero are coordinates");
}

#[test]
fn a_remark_does_not_go_on() {
    let text = format!("# C:\\models\\\n{CORNERS}  # of d:\\\r\nf 1 2 3\n");
    assert_eq!(mesh(text).triangles, [[0, 1, 2]]);
}

#[test]
fn lines_may_go_on_and_end_anyhow() {
    let expected = mesh(format!("{CORNERS}f 1 2 3\n"));
    for text in [
        format!("\u{feff}# Müller\n{CORNERS}g a\\\n b\ns off\nf 1 2 \\\r\n  3"),
        format!("\n{CORNERS}f 1 2 3 # last\n").replace('\n', "\r\n"),
        format!("o thing\n  {CORNERS}\tf  1\t2 3"),
        format!("f 1 2 3\nusemtl none\n{CORNERS}"),
        format!("# an old Mac's\n{CORNERS}f 1 2 \\\n3\n").replace('\n', "\r"),
    ] {
        assert_eq!(mesh(&text), expected, "{text}");
    }
}

#[test]
fn vertices_are_split_where_their_look_differs() {
    let text = "vt 0.25 1\nvt 1 0.25\nvt 0.25 1.0\nvn 0 0 2\nvn 0 0 1\n\
        f 1/1/1 2/1/1 3/1/1\nf 1/3/2 2/2/1 3/1/1\nf 1 2 4\n";
    let mesh = mesh(format!("{CORNERS}{text}"));
    // Equal values are one look, whatever their rows.
    assert_eq!(mesh.triangles, [[0, 1, 2], [0, 4, 2], [5, 6, 3]]);
    assert_eq!(mesh.texture_coordinates[..3], [[0.25, 0.0]; 3]);
    assert_eq!(mesh.texture_coordinates[4], [1.0, 0.75]);
    assert_eq!(mesh.normals[0].vector(), Some(Vec3::Z));
    assert_eq!(mesh.normals[5], Normal::OF_TRIANGLE);
}

#[test]
fn colors_follow_positions() {
    let text = "v 0 0 0\nv 1 0 0 1.0 0.5 0\nv 0 1 0 1 0 0 1\nv 0 0 1 1 # none\nf 1 2 3\n";
    assert_eq!(mesh(text).colors, [[255; 3], [255, 128, 0], [0, 0, 255], [255; 3]]);
}

#[test]
fn corners_that_do_not_exist_reject_their_triangle_alone() {
    for bad in ["0", "5", "-5", "99999999999999999999", "-99999999999999999999", "/1", "//"] {
        let mesh = mesh(format!("{CORNERS}f 1 2 3\nf 1 {bad} 2\nf 3 2 1\n"));
        assert_eq!(mesh.triangles, [[0, 1, 2], Mesh::REJECTED, [2, 1, 0]], "{bad}");
    }
    let mesh = mesh(format!("{CORNERS}vt 0.5 0.5\nf 1/7/9 2/-3/0 3/1\n"));
    assert_eq!((mesh.n_rejected, mesh.texture_coordinates[2]), (0, [0.5; 2]));
    assert!(mesh.normals.is_empty());
}

#[test]
fn errors_name_the_line() {
    for (text, expected) in [
        ("v 1 2\n", "line 5: a number is missing"),
        ("\n\nv 1 2 O\n", "line 7: `O` is not a number"),
        ("g a\\\nb\nf 1 2 x\n", "line 7: `x` is not a corner"),
        ("f 1 2 3.5\n", "line 5: `3.5` is not a corner"),
    ] {
        assert_eq!(parse(format!("{CORNERS}{text}")).unwrap_err().to_string(), expected);
    }
}

#[test]
fn coordinates_beyond_single_precision_are_kept_as_in_ply() {
    let rows = ["512345.12 5412345.1 70.25", "512346.1 5412345.2 70.5", "512345.98 5412346.67 71"];
    let obj = mesh(format!("v {}\nv {}\nv {}\nf 1 2 3\n", rows[0], rows[1], rows[2]));
    let ply = format!(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
         element face 1\nproperty list uchar int vertex_indices\nend_header\n{}\n3 0 1 2\n",
        rows.join("\n")
    );
    assert_eq!(obj.origin, DVec3::new(512_345.12, 5_412_345.1, 70.25));
    assert_eq!(obj, crate::formats::ply::read_from(ply.as_bytes(), ply.len() as u64).unwrap().mesh);
}

#[test]
fn the_mesh_does_not_depend_on_where_the_text_is_cut() {
    // Several pieces and batches; each face counts back over some thousand lines.
    let n = 150_000;
    let rows = |i: usize| match i % 3 {
        0 => format!("v {i} 0.5 -{i}e-3\n"),
        1 if i > 30_000 => "f -10000 -9999 \\\n -1\n".to_owned(),
        _ => format!("usemtl m{}\n", i / 20_000),
    };
    let text: String = (0..n).map(rows).collect();
    assert!(text.len() > 3 * PIECE_BYTES);
    let pool = |n_threads| rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().unwrap();
    let [one, four] = [1, 4].map(|n_threads| pool(n_threads).install(|| mesh(&text)));
    assert_eq!(one, four);
    let number = |i: usize| (i / 3) as u32;
    let expected: Vec<_> = (0..n)
        .filter(|i| i % 3 == 1 && *i > 30_000)
        .map(|i| [number(i) + 1 - 10_000, number(i) + 1 - 9_999, number(i)])
        .collect();
    assert_eq!(one.triangles, expected);
}

#[test]
fn a_byte_order_mark_is_no_part_of_the_first_line() {
    let draft = with_library(
        &format!("\u{feff}mtllib a b.mtl\n{CORNERS}usemtl a\nf 1 2 3\n"),
        b"\xef\xbb\xbf newmtl a\n\tKd 1 0 0\n",
    );
    assert_eq!(draft.mesh.materials.materials[0].base_color, [1.0, 0.0, 0.0, 1.0]);
}

#[test]
fn materials_follow_faces() {
    let obj = format!(
        "mtllib a b.mtl\n{CORNERS}f 1 2 3\nusemtl red\nf 1 2 4\nusemtl picture one\nvt 0 0\nf 1/1 2/1 3/1 4/1\nusemtl lost\nf 1 2 3\nl 1 2\n"
    );
    let library =
        b"# M\xfcller\nKd 9 9 9\nnewmtl red\r\nKd 1 0.5 0\nKe 0.25\nPr 0.5\nd 0.5\nnewmtl unused\nmap_Kd no.png\n\
        newmtl picture one\nKd 0 0 0\nmap_Kd -s 2 4 1 -o 0.5 -clamp on C:\\scans\\W\xe4nde 1.png\nmap_d -s 2 4 -o .5 mask.png\n";
    let draft = with_library(&obj, library);
    let materials = &draft.mesh.materials;
    assert_eq!(materials.of_triangles, [0, 1, 2, 2, 3]);
    let names: Vec<_> = materials.materials.iter().map(|material| &*material.name).collect();
    assert_eq!(names, ["", "red", "picture one", "lost"]);
    let red = &materials.materials[1];
    assert_eq!((red.base_color, red.emissive, red.roughness), ([1.0, 0.5, 0.0, 1.0], [0.25; 3], 0.5));
    let picture = &materials.materials[2];
    assert_eq!((picture.base_color, picture.alpha_cutoff), ([1.0; 4], Some(0.5)));
    let transform = [[2.0, 0.0, 0.5], [0.0, 4.0, -3.0]];
    assert_eq!(picture.base_color_texture, Some(TextureUse { image: 1, wrap: [Wrap::Clamp; 2], transform }));
    assert_eq!(draft.images[1].name, "C:\\scans\\W\u{e4}nde 1.png");
    assert_eq!(draft.images[1].channels, Channels::Coverage("mask.png".to_owned()));
    assert_eq!(
        draft.remarks,
        [
            "points, lines and curved surfaces are left out: 1",
            "see-through materials are shown opaque",
            "materials that none of its files of materials has: 1 of 3"
        ]
    );
}

#[test]
fn coverage_lies_as_its_colour_does_and_transparency_is_told() {
    let read = |library: &str| {
        let mut read = Library::default();
        read.read(format!("newmtl a\n{library}").as_bytes(), "");
        (read.materials[0].alpha_cutoff, read.images, read.remarks)
    };
    let with_mask = ImageSource { channels: Channels::Coverage("m.png".to_owned()), ..ImageSource::file("c.png") };
    for (color, coverage) in [
        ("", "-imfchan m"),
        ("", "-s 1 1 1 -o 0 0"),
        ("-clamp on", ""),
        ("-s 2 2 -o .5", "-o 0.5 0 -s 2 2 2 -clamp on"),
    ] {
        let library = format!("map_d {coverage} m.png\nmap_Tr m.png\nmap_Kd {color} c.png\n");
        assert_eq!(read(&library), (Some(0.5), vec![with_mask.clone()], vec![]), "{library}");
    }
    let plain = vec![ImageSource::file("c.png")];
    for (color, coverage) in [("", "-s 4 4"), ("-o 0.5", ""), ("-s 2 2", "-s 2 1")] {
        let material = format!("map_Kd {color} c.png\nmap_d {coverage} m.png\n");
        let told = "a texture of coverage (map_d) with other -s or -o than that of colour (map_Kd) is left out";
        // Once, however many materials there are.
        assert_eq!(read(&format!("{material}newmtl b\n{material}")), (None, plain.clone(), vec![told.to_owned()]));
    }
    let others = "textures of map_Tr are left out: of a material, map_Kd, map_Ke, map_Pr, map_Pm and map_d are read";
    assert_eq!(read("map_Kd c.png\nmap_Tr m.png\n"), (None, plain, vec![others.to_owned()]));
    let opaque = "see-through materials are shown opaque".to_owned();
    for (library, is_told) in [
        ("Tr 0.9", true),
        ("d 1\nTr 1", false),
        ("Tr 0\nd .5", true),
        ("d -halo 0.5", true),
        ("Tr 0", false),
        ("d 1", false),
    ] {
        assert_eq!(read(library), (None, vec![], Vec::from_iter(is_told.then(|| opaque.clone()))), "{library}");
    }
}

#[test]
fn textures_without_coordinates_are_told() {
    let obj = format!("mtllib a b.mtl\n{CORNERS}usemtl a\nf 1 2 3\n");
    let library = b"newmtl a\nKd 0.5 0.5 0.5\nmap_Kd a.png\nnewmtl b\nmap_Kd b.png\n";
    let draft = with_library(&obj, library);
    assert_eq!(draft.remarks, ["its textures are left out: it has no texture coordinates"]);
    let material = &draft.mesh.materials.materials[0];
    assert_eq!((material.base_color_texture, material.base_color[0], draft.images.len()), (None, 0.5, 0));
    let other = with_library(&obj.replace("usemtl a", "usemtl c"), library);
    assert_eq!(other.remarks, ["materials that none of its files of materials has: 1 of 1"]);
    let whole = with_library(&obj.replace("usemtl a\nf 1 2 3", "vt 0 0\nusemtl a\nf 1/1 2/1 3/1"), library);
    assert_eq!((whole.remarks.len(), whole.images.len()), (0, 2));
}

#[test]
fn one_material_needs_no_list() {
    let faces = format!("mtllib a b.mtl\n{CORNERS}f 1 2 3\nf 1 2 4\n");
    let expected = Material { name: "m".to_owned(), base_color: [0.5, 0.5, 0.5, 1.0], ..Material::default() };
    for obj in [faces.clone(), faces.replace("f 1 2 3", "usemtl m\nf 1 2 3")] {
        let materials = with_library(&obj, b"newmtl m\nKd .5 .5 .5").mesh.materials;
        assert_eq!((materials.materials, materials.of_triangles), (vec![expected.clone()], vec![]));
    }
}

#[test]
fn missing_materials_are_a_remark() {
    let draft = parse(format!("mtllib c.mtl\nmtllib c.mtl\n{CORNERS}usemtl m\nf 1 2 3\n")).unwrap();
    assert_eq!(draft.remarks, ["its materials are left out: c.mtl is missing: put it beside the model"]);
    assert!(draft.mesh.materials.materials.is_empty() && draft.mesh.materials.of_triangles.is_empty());
    let mut library = Library::default();
    library.read(b"newmtl a\nnewmtl b\nmap_d -bm\nnewmtl c\nmap_d x.png\nmtllib a b.mtl\n", "");
    assert_eq!(library.materials.len(), 3);
    assert!(library.images.is_empty() && library.remarks.len() == 1, "{library:?}");
    let mut library = Library::default();
    library.read(b"newmtl a\nKd red\nKe 1 0 0\n", "");
    assert_eq!(library.remarks, ["Kd red of a material is left out: its three values are numbers"]);
}

#[test]
fn files_of_materials_are_found_by_any_name() {
    let obj = |row: &str| format!("mtllib {row}\n{CORNERS}usemtl m\nf 1 2 3\n");
    for row in
        ["a b.mtl", "\"a b.mtl\"", "a\\ b.mtl", "none.mtl a b.mtl", "a b.mtl none.mtl", "\"none.mtl\" \"a b.mtl\""]
    {
        let draft = with_library(&obj(row), b"newmtl m\nKd 1 0 0\n");
        assert_eq!(draft.mesh.materials.materials[0].base_color[0], 1.0, "{row}");
        assert_eq!(draft.remarks.len(), usize::from(row.contains("none")), "{row}: {:?}", draft.remarks);
    }
    let draft = with_library(&obj("my own looks.mtl"), b"");
    assert_eq!(draft.remarks, ["its materials are left out: my own looks.mtl is missing: put it beside the model"]);
}

#[test]
fn materials_without_a_line_are_those_of_the_model_s_name() {
    let obj = "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl red\nf 1 2 3\n";
    let folder = tempfile::tempdir().unwrap();
    let companions = Companions::beside(&folder.path().join("scan.obj"));
    let draft = || read_from(obj.as_bytes(), obj.len() as u64, &companions).unwrap();
    assert_eq!(draft().remarks, ["its materials are left out: no line `mtllib` names their file"]);
    fs::write(folder.path().join("scan.mtl"), "newmtl red\nKd 1 0 0\n").unwrap();
    let renamed = format!("mtllib old name.mtl\n{obj}");
    for Draft { mesh, remarks, .. } in
        [draft(), read_from(renamed.as_bytes(), renamed.len() as u64, &companions).unwrap()]
    {
        assert_eq!((mesh.materials.materials[0].base_color, remarks.len()), ([1.0, 0.0, 0.0, 1.0], 0));
    }
}

#[test]
fn images_are_beside_their_file_of_materials() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("looks")).unwrap();
    fs::write(folder.path().join("looks/a.mtl"), "newmtl m\nmap_Kd -colorspace sRGB deep/x.png\n").unwrap();
    let obj = format!("mtllib looks\\a.mtl\n{CORNERS}vt 0 0\nf 1/1 2/1 3/1\n");
    let companions = Companions::beside(&folder.path().join("model.obj"));
    let draft = read_from(obj.as_bytes(), obj.len() as u64, &companions).unwrap();
    assert_eq!((&*draft.images[0].folder, &*draft.images[0].name), ("looks", "deep/x.png"));
}

#[test]
fn a_face_that_is_cut_is_told() {
    let remarks = |face: &str| parse(format!("{CORNERS}vn 0 0 1\nf 1//1 2//1 3//1\n{face}")).unwrap().remarks;
    let short = "faces with fewer than three corners are left out: 1";
    let cut = "ends in the middle of a face: it may have been cut short";
    for (face, expected) in [
        ("f 1//1 2//1 4//1", vec![]),
        ("f 1//1 2//1", vec![short, cut]),
        ("f", vec![short, cut]),
        ("f 1//1 2//1 3//", vec![cut]),
        ("f 1//1 2//1 3\n", vec![]),
        ("f 1//1 2//1\n", vec![short]),
    ] {
        assert_eq!(remarks(face), expected, "{face}");
    }
    let told = parse(format!("{CORNERS}v 1 2")).unwrap_err().to_string();
    assert_eq!(told, "line 5: a number is missing, where the file ends: it may have been cut short");
}

#[test]
fn images_of_roughness_and_metal_become_one() {
    let mut library = Library::default();
    library.read(
        b"newmtl a\nmap_Pr r.png\nmap_Pm m.png\nnewmtl b\nPr 0.5\nPm 0\nmap_Pm m.png\nnewmtl c\nPm 0.25\nmap_Pr r.png\n\
        newmtl d\nmap_Pr x.png\nmap_Pm x.png\nmap_Ka x.png\nmap_bump x.png\nnewmtl e\nPm 1\n\
        map_Kd y.png\nmap_Ka y.png\n",
        "",
    );
    let looks: Vec<_> = (library.materials.iter())
        .map(|it| (it.roughness, it.metallic, it.metallic_roughness_texture.map(|texture| texture.image)))
        .collect();
    assert_eq!(
        looks,
        [(1.0, 1.0, Some(0)), (0.5, 1.0, Some(1)), (1.0, 0.25, Some(2)), (1.0, 1.0, Some(3)), (1.0, 1.0, None)]
    );
    let channels: Vec<_> = library.images.into_iter().take(4).map(|image| image.channels).collect();
    let both = Channels::RoughnessAndMetallic("m.png".to_owned());
    assert_eq!(channels, [both, Channels::Metallic, Channels::Roughness, Channels::Whole]);
    assert_eq!(
        library.remarks,
        ["textures of map_Bump, map_Ka are left out: of a material, map_Kd, map_Ke, map_Pr, map_Pm and map_d are read"]
    );
}

proptest! {
    #[test]
    fn damaged_files_never_panic(at in 0..200_usize, byte: u8, cut in 0..200_usize) {
        let text = format!("mtllib m.mtl\n{CORNERS}vt 0 1\nvn 0 0 1\nusemtl m\nf 1/1/1 2/-1/-1 \\\n3//1 -1\nl 1 2\n");
        let mut bytes = text.into_bytes();
        let n = bytes.len();
        bytes[at % n] = byte;
        let _ = parse(&bytes);
        bytes.truncate(cut % n);
        let _ = parse(&bytes);
    }
}
