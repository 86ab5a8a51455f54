//! The reader against files written by hand.

use glam::{DVec3, Vec3};
use proptest::prelude::*;

use super::*;
use crate::model::mesh::Mesh;

fn parse(bytes: &[u8]) -> Result<Mesh, Problem> {
    read_from(bytes, bytes.len() as u64).map(|draft| draft.mesh)
}

/// Parses a valid file; panics with the reader's error.
fn mesh(bytes: impl AsRef<[u8]>) -> Mesh {
    parse(bytes.as_ref()).unwrap_or_else(|problem| panic!("{problem}"))
}

fn error_text(bytes: impl AsRef<[u8]>) -> String {
    let text = parse(bytes.as_ref()).map(|mesh| panic!("read {mesh:?}")).unwrap_err().to_string();
    assert!(!text.contains('\n'), "{text}");
    text
}

const TRIANGLE: &str = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
    element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";

const CORNERS: [[f32; 3]; 3] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];

/// A number in each of PLY's scalar types, as bytes of one endianness.
fn scalar(name: &str, value: i8, big: bool) -> Vec<u8> {
    let mut bytes = match name {
        "char" | "int8" | "uchar" | "uint8" => vec![value as u8],
        "short" | "int16" | "ushort" | "uint16" => i16::from(value).to_le_bytes().to_vec(),
        "int" | "int32" | "uint" | "uint32" => i32::from(value).to_le_bytes().to_vec(),
        "float" | "float32" => f32::from(value).to_le_bytes().to_vec(),
        "double" | "float64" => f64::from(value).to_le_bytes().to_vec(),
        _ => unreachable!("{name}"),
    };
    if big {
        bytes.reverse();
    }
    bytes
}

const SCALARS: [&str; 16] = [
    "char", "int8", "uchar", "uint8", "short", "int16", "ushort", "uint16", "int", "int32", "uint", "uint32", "float",
    "float32", "double", "float64",
];

#[test]
fn ascii_triangle() {
    let mesh = mesh(TRIANGLE);
    assert_eq!((mesh.vertices, mesh.triangles, mesh.n_rejected), (CORNERS.to_vec(), vec![[0, 1, 2]], 0));
    assert!(mesh.colors.is_empty());
}

#[test]
fn every_scalar_type_is_read_in_every_encoding() {
    for scalar_name in SCALARS {
        for (format, big) in [("ascii", None), ("binary_little_endian", Some(false)), ("binary_big_endian", Some(true))]
        {
            let count_name =
                if scalar_name.contains("float") || scalar_name == "double" { "uchar" } else { scalar_name };
            let mut bytes = format!(
                "ply\nformat {format} 1.0\nelement vertex 3\nproperty {scalar_name} x\nproperty {scalar_name} y\n\
                 property {scalar_name} z\nelement face 1\nproperty list {count_name} {scalar_name} vertex_index\n\
                 end_header\n"
            )
            .into_bytes();
            for (name, values) in
                [(scalar_name, &[0, 0, 0, 1, 0, 0, 0, 1, 0][..]), (count_name, &[3]), (scalar_name, &[2, 0, 1])]
            {
                for &value in values {
                    match big {
                        Some(big) => bytes.extend(scalar(name, value, big)),
                        None => bytes.extend(format!("{value}\n").bytes()),
                    }
                }
            }
            let mesh = mesh(&bytes);
            assert_eq!(mesh.vertices, CORNERS, "{format} {scalar_name}");
            assert_eq!(mesh.triangles, [[2, 0, 1]], "{format} {scalar_name}");
        }
    }
}

#[test]
fn colors_of_every_type_become_srgb_bytes() {
    for (scalar, names, values, expected) in [
        ("uchar", ["red", "green", "blue"], "7 128 255", [7, 128, 255]),
        ("uchar", ["diffuse_red", "diffuse_green", "diffuse_blue"], "7 128 255", [7, 128, 255]),
        ("ushort", ["red", "green", "blue"], "257 32896 65535", [1, 128, 255]),
        ("int", ["red", "green", "blue"], "-3 128 300", [0, 128, 255]),
        ("float", ["red", "green", "blue"], "0.0 0.5 1.0", [0, 128, 255]),
        ("double", ["red", "green", "blue"], "nan 0.2 7", [0, 51, 255]),
    ] {
        let [red, green, blue] = names;
        let text = format!(
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
             property {scalar} {red}\nproperty {scalar} {green}\nproperty {scalar} {blue}\nend_header\n0 0 0 {values}\n"
        );
        assert_eq!(mesh(text).colors, [expected], "{scalar}");
    }
}

#[test]
fn two_of_three_colors_are_no_color() {
    let text = TRIANGLE.replace("property float z\n", "property float z\nproperty uchar red\nproperty uchar green\n");
    assert!(mesh(text.replace("0 0\n", "0 0 9 9\n").replace("1 0\n", "1 0 9 9\n")).colors.is_empty());
}

#[test]
fn polygons_are_fanned_in_order() {
    let text = TRIANGLE.replace("vertex 3", "vertex 5").replace("face 1", "face 4");
    let text = text.replace("3 0 1 2\n", "1 1 0\n0.5 1.5 0\n5 0 1 3 4 2\n2 0 1\n0\n4 0 1 3 2\n");
    assert_eq!(mesh(text).triangles, [[0, 1, 3], [0, 3, 4], [0, 4, 2], [0, 1, 3], [0, 3, 2]]);
}

#[test]
fn strips_are_unrolled_facing_one_way() {
    let text = TRIANGLE.replace("face 1", "tristrips 1").replace("vertex 3", "vertex 4");
    let text = text.replace("3 0 1 2\n", "1 1 0\n9 0 1 2 3 -1 3 2 1 0\n");
    let mesh = mesh(text);
    assert_eq!(mesh.triangles, [[0, 1, 2], [2, 1, 3], [3, 2, 1], [1, 2, 0]]);
    assert_eq!(mesh.n_rejected, 0);
}

#[test]
fn looks_of_faces_after_strips_are_theirs() {
    let draft = read(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
        element tristrips 1\nproperty list int int vertex_indices\n\
        element face 2\nproperty list uchar int vertex_indices\nproperty uchar red\nproperty uchar green\n\
        property uchar blue\nend_header\n0 0 0\n1 0 0\n0 1 0\n1 1 0\n4 0 1 2 3\n3 0 1 2 255 0 0\n3 1 2 3 0 0 255\n",
    );
    let colors = draft.mesh.triangles.iter().map(|&[corner, ..]| draft.mesh.colors[corner as usize]);
    assert_eq!(colors.collect::<Vec<_>>(), [[255; 3], [255; 3], [255, 0, 0], [0, 0, 255]]);
}

#[test]
fn corners_of_concave_faces_keep_their_texture_coordinates() {
    let draft = read(
        "ply\nformat ascii 1.0\ncomment TextureFile a.png\nelement vertex 4\nproperty float x\nproperty float y\n\
        property float z\nelement face 1\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\n\
        property int texnumber\nend_header\n0 0 0\n4 0 0\n4 4 0\n3 1 0\n4 1 2 3 0 8 4 0 4 4 3 1 0 0 -1\n",
    );
    assert_eq!(draft.mesh.triangles.len(), 2);
    for corner in draft.mesh.triangles.into_iter().flatten() {
        let ([x, y, _], [u, v]) =
            (draft.mesh.vertices[corner as usize], draft.mesh.texture_coordinates[corner as usize]);
        assert_eq!([u, 1.0 - v], [x, y]);
    }
    let materials = &draft.mesh.materials;
    let of_triangles = materials.of_triangles.iter().map(|&number| &materials.materials[usize::from(number)]);
    assert!(of_triangles.into_iter().all(|material| material.base_color_texture.is_none()), "-1 is no texture");
}

#[test]
fn faces_may_come_first() {
    let text = "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int vertex_indices\nelement vertex 3\n\
        property float x\nproperty float y\nproperty float z\nend_header\n3 0 1 2\n0 0 0\n1 0 0\n0 1 0\n";
    assert_eq!(mesh(text), mesh(TRIANGLE));
}

#[test]
fn unknown_elements_and_properties_are_skipped() {
    let text = "ply\nformat ascii 1.0\nelement camera 2\nproperty double f\nproperty list int float k\n\
        element nothing 7\nelement vertex 3\nproperty list uchar uchar tags\nproperty float x\nproperty float odd[<1]\n\
        property float y\nproperty float y\nproperty float z\nelement face 1\nproperty list uchar float texcoord\n\
        property list uchar int vertex_indices\nproperty uchar red\nend_header\n0.5 0\n1e3 2 nan 8\n\
        0 0 9 0 9 0\n1 7 1 9 0 9 0\n2 8 8 0 9 1 9 0\n0 3 0 1 2 200\n";
    assert_eq!(mesh(text), mesh(TRIANGLE));
}

#[test]
fn header_may_have_any_line_ends_indents_and_comments() {
    let expected = mesh(TRIANGLE);
    let commented = TRIANGLE.replace("element", "comment gr\u{fc}n 'end_header'\n\n obj_info x\n \telement ");
    for text in [TRIANGLE.replace('\n', "\r\n"), TRIANGLE.replace('\n', "\r"), commented] {
        assert_eq!(mesh(text), expected);
    }
    let mut latin1 = b"ply\ncomment \xfc\xff\n".to_vec();
    latin1.extend(&TRIANGLE.as_bytes()[4..]);
    assert_eq!(mesh(latin1), expected);
}

#[test]
fn binary_data_follows_the_header_with_any_line_ends() {
    let text = "ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty char x\nproperty char y\n\
        property char z\nend_header\n";
    for line_end in ["\n", "\r\n", "\r"] {
        let mut bytes = text.replace('\n', line_end).into_bytes();
        bytes.extend(b"\n\r\n\r\n\r");
        assert_eq!(mesh(bytes).vertices, [[10.0, 13.0, 10.0], [13.0, 10.0, 13.0]]);
    }
}

#[test]
fn ascii_rows_may_wrap_and_lines_may_hold_more() {
    let text = TRIANGLE.replace("1 0 0\n", "\n  1\n0\t0 99 99\r\n").replace("3 0 1 2\n", "3\n0 1 2");
    assert_eq!(mesh(text), mesh(TRIANGLE));
}

#[test]
fn numbers_are_read_as_other_programs_write_them() {
    let text = TRIANGLE.replace("0 0 0\n", ".0 0. -0e5\n").replace("1 0 0\n", "+1.E0 0 -.0\n");
    assert_eq!(mesh(text.replace("3 0 1 2", "3.0 0.0 1.0 2")), mesh(TRIANGLE));
}

#[test]
fn triangles_that_cannot_be_traced_keep_their_place() {
    for bad in ["nan", "-nan", "inf", "-Infinity", "1e39", "-1.9e18", "1.#QNAN", "-1.#IND", "nan(ind)"] {
        let text = TRIANGLE.replace("vertex 3", "vertex 4").replace("3 0 1 2\n", &format!("7 {bad} 7\n4 0 1 2 3\n"));
        let mesh = mesh(text);
        assert_eq!(mesh.triangles, [[0, 1, 2], Mesh::REJECTED], "{bad}");
        assert_eq!(mesh.n_rejected, 1, "{bad}");
    }
    for bad in ["3", "-1", "4294967295", "4294967296", "1e30", "0.5", "nan"] {
        let text =
            TRIANGLE.replace("face 1", "face 3").replace("3 0 1 2\n", &format!("3 0 1 2\n3 0 {bad} 1\n3 2 1 0\n"));
        let mesh = mesh(text);
        assert_eq!(mesh.triangles, [[0, 1, 2], Mesh::REJECTED, [2, 1, 0]], "{bad}");
        assert_eq!(mesh.n_rejected, 1, "{bad}");
    }
}

/// A PLY of doubles: a patch of ground a hundred metres wide and its corners, far from the map's zero.
fn survey() -> (Vec<[f64; 3]>, Vec<u8>) {
    let point = |k: u32| [0.1, 0.037, 0.009].map(|step| f64::from((k * k + 7) % 1000) * step);
    let far = |[x, y, z]: [f64; 3]| [x + 512_345.0, y + 5_412_345.0, z - 71.0];
    // Exporters write zeros where a scanner saw nothing.
    let points: Vec<_> = [[0.0; 3]].into_iter().chain((0..500).map(point).map(far)).collect();
    let header = "ply\nformat binary_little_endian 1.0\nelement vertex 501\nproperty double x\nproperty double y\n\
        property double z\nelement face 1\nproperty list int int vertex_indices\nend_header\n";
    let numbers = points.as_flattened().iter().flat_map(|x| x.to_le_bytes());
    let polygon = [500].into_iter().chain(1..=500i32).flat_map(i32::to_le_bytes);
    (points.clone(), header.bytes().chain(numbers).chain(polygon).collect())
}

#[test]
fn coordinates_beyond_single_precision_are_kept_relative_to_an_origin() {
    let (points, bytes) = survey();
    let mesh = mesh(bytes);
    assert_eq!(mesh.origin.to_array(), points[1], "the first that f32 cannot hold");
    let rounding = |(vertex, point): (&[f32; 3], &[f64; 3])| {
        (Vec3::from_array(*vertex).as_dvec3() + mesh.origin - DVec3::from_array(*point)).abs().max_element()
    };
    let largest = mesh.vertices.iter().zip(&points).skip(1).map(rounding).fold(0.0, f64::max);
    let [min, max] = mesh.extent();
    let extent = (max - min).max_element();
    assert!(extent > 98.0 && largest > 0.0 && largest < extent * 2f64.powi(-24), "{largest} of {extent}");
    // Adding the origin rounds to a billionth of a metre.
    assert!((largest - 1e-9..=extent * 2f64.powi(-24)).contains(&mesh.largest_rounding()));
}

#[test]
fn text_keeps_all_digits_whatever_its_header_declares() {
    let rows = "512345.12 5412345.1 70.25\n512346.1 5412345.2 70.5\n512345.98 5412346.67 71\n3 0 1 2\n";
    let text = |scalar: &str| TRIANGLE.replace("float", scalar).replace("0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", rows);
    let double = mesh(text("double"));
    assert_eq!(double.origin, DVec3::new(512_345.12, 5_412_345.1, 70.25));
    assert!(double.largest_rounding() < 1e-7, "{}", double.largest_rounding());
    assert_eq!(mesh(text("float")), double);
}

#[test]
fn models_that_fit_single_precision_have_no_origin() {
    // Printed with fewer digits than f32 has, with more, and with all.
    for row in ["0.1 -0.0378297 1e-7\n", "0.100000001 0.12 3.00000000\n", "0.10000000149011612 5412345.5 1e30\n"] {
        let mesh = mesh(TRIANGLE.replace("1 0 0\n", row));
        assert_eq!((mesh.origin, mesh.largest_rounding()), (DVec3::ZERO, 0.0), "{row}");
        let as_f32: Vec<f32> = row.split_whitespace().map(|number| number.parse().unwrap()).collect();
        assert_eq!(mesh.vertices[1].to_vec(), as_f32);
    }
    // A vertex that cannot be traced is no reason to move the rest.
    for row in ["nan 0.1 0\n", "1e39 0 0\n", "inf 0 0\n"] {
        let mesh = mesh(TRIANGLE.replace("float", "double").replace("1 0 0\n", row));
        assert_eq!((mesh.origin, mesh.n_rejected), (DVec3::ZERO, 1), "{row}");
    }
    let exact = TRIANGLE.replace("float", "double").replace("1 0 0\n", "8388609.5 0.1015625 -3e6\n");
    assert_eq!(mesh(exact.replace("8388609.5", "8388609")).origin, DVec3::ZERO);
    assert_ne!(mesh(exact).origin, DVec3::ZERO);
}

#[test]
fn files_without_faces_or_vertices_have_no_triangles() {
    for text in [
        "ply\nformat ascii 1.0\nend_header\n",
        "ply\nformat ascii 1.0\nelement vertex 0\nelement face 0\nend_header",
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty int x\nproperty int y\nproperty int z\nend_header\n1 2 3",
    ] {
        assert!(mesh(text).triangles.is_empty());
    }
}

#[test]
fn errors_say_what_and_where() {
    let with = |from: &str, to: &str| error_text(TRIANGLE.replace(from, to));
    let not_ply = "is not a PLY file, which begins with a line `ply`";
    for (text, expected) in [
        (error_text(""), not_ply),
        (error_text("plywood\n"), not_ply),
        (error_text("ply\nformat ascii 1.0\n"), "ends inside its header: no line `end_header`"),
        (error_text("ply\nend_header\n"), "its header is not understood: No format line found."),
        (with("property float y", "property bool y"), "header line 5 is not understood: `property bool y`"),
        (with("property float y", "remark y"), "header line 5 is not understood: `remark y`"),
        (with("vertex 3", "vertex -3"), "header line 3 is not understood: `element vertex -3`"),
        (
            with("vertex 3", "vertex 18446744073709551617"),
            "header line 3 is not understood: `element vertex 18446744073709551617`",
        ),
        (with("element face 1", "element vertex 1"), "declares element `vertex` twice"),
        (with("property float y\n", ""), "its element `vertex` has no coordinate y"),
        (with("vertex_indices", "vertices"), "its element `face` has no list vertex_indices"),
        (with("list uchar int", "int"), "its element `face` has no list vertex_indices"),
        (
            with("vertex 3", "vertex 9999999"),
            "is cut short, or its header is wrong: 9999999 rows of `vertex` need at least 59999994 bytes, 26 are left",
        ),
        (with("1 0 0", "1 O 0"), "row 1 of element `vertex`: `O` is not a number"),
        (with("3 0 1 2", "3 0 1"), "row 0 of element `face`: the file ends here"),
        (with("3 0 1 2", "-3 0 1 2"), "row 0 of element `face`: `-3` is not the length of a list"),
    ] {
        assert_eq!(text, expected);
    }
}

#[test]
fn headers_without_end_are_given_up() {
    let mut endless = b"ply\ncomment ".to_vec();
    endless.resize(3 << 20, b'x');
    assert_eq!(error_text(endless), "has no line `end_header` in its first 1024 KB");
    // As much as a header may have, before the first line ends.
    let blank = format!("ply{}\r\nformat ascii 1.0\nend_header\n", " ".repeat((1 << 20) - 4));
    assert_eq!(error_text(blank.as_bytes()), "has no line `end_header` in its first 1024 KB");
}

#[test]
fn headers_of_many_lines_take_no_time() {
    let header = |lines: String| error_text(format!("ply\nformat ascii 1.0\n{lines}"));
    let started_at = std::time::Instant::now();
    let elements: String = (0..65_000).map(|i| format!("element {i} 0\n")).collect();
    assert_eq!(header(elements), "declares more than 1000 elements");
    let properties =
        format!("element vertex 0\n{}{}", "property char q\n".repeat(30_000), "property char y\n".repeat(30_000));
    assert_eq!(header(properties), "declares more than 10000 properties");
    let most: String = (0..1000).map(|i| format!("element {i} 0\n")).collect();
    let most = format!("ply\nformat ascii 1.0\n{most}{}end_header\n", "property char q\n".repeat(10_000));
    assert!(mesh(most).triangles.is_empty());
    // Without limits, seconds for each of the first two.
    assert!(started_at.elapsed().as_secs_f64() < 1.0);
}

#[test]
fn huge_claims_are_refused_at_once() {
    let header = |count: &str, n: &str| {
        format!(
            "ply\nformat binary_big_endian 1.0\nelement empty {n}\nelement face 1\nproperty list {count} int vertex_indices\n\
             end_header\n"
        )
    };
    let mut bytes = header("int", "18446744073709551615").into_bytes();
    bytes.extend((-1i32).to_be_bytes());
    assert_eq!(error_text(&bytes), "row 0 of element `face`: List length cannot be negative (i32)");
    let mut bytes = header("uint", "1").into_bytes();
    bytes.extend(u32::MAX.to_be_bytes());
    assert_eq!(error_text(&bytes), "row 0 of element `face`: the file ends here");
}

#[test]
fn a_written_mesh_reads_back_the_same() {
    let colored = Mesh {
        vertices: CORNERS.to_vec(),
        triangles: vec![[2, 1, 0], Mesh::REJECTED, [0, 1, 2]],
        colors: vec![[1, 2, 3], [4, 5, 6], [7, 8, 9]],
        n_rejected: 1,
        ..Mesh::default()
    };
    for mesh in [Mesh { colors: Vec::new(), ..colored.clone() }, colored, Mesh::default()] {
        let mut bytes = Vec::new();
        write_to(&mut bytes, &mesh).unwrap();
        assert_eq!(parse(&bytes).unwrap(), mesh);
    }
}

proptest! {
    #[test]
    fn damaged_files_never_panic(at in 0..TRIANGLE.len(), byte: u8, cut in 0..TRIANGLE.len()) {
        let mut bytes = TRIANGLE.as_bytes().to_vec();
        bytes[at] = byte;
        let _ = parse(&bytes);
        bytes.truncate(cut);
        let _ = parse(&bytes);
    }
}

/// Two triangles with all that a look can have.
const TEXTURED: &str = "ply\nformat ascii 1.0\ncomment TextureFile a b.png\ncomment TextureFile c.jpg\nelement vertex 4\n\
    property float x\nproperty float y\nproperty float z\nproperty float nx\nproperty double ny\nproperty float nz\n\
    element face 2\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\nproperty int texnumber\n\
    property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n\
    0 0 0 0 0 2\n1 0 0 0 1 0\n0 1 0 0 0 0\n1 1 0 nan 0 1\n\
    4 0 1 3 2 8 0 0 1 0 1 1 0 1 0 9 9 9\n3 1 0 2 6 1 0 0.5 0 0 1 1 9 9 9\n";

#[test]
fn looks_of_vertices_faces_and_corners_are_read() {
    let draft = read_from(TEXTURED.as_bytes(), TEXTURED.len() as u64).unwrap();
    let mesh = &draft.mesh;
    // One corner has other texture coordinates than the rest of its vertex.
    assert_eq!(mesh.triangles, [[0, 1, 3], [0, 3, 2], [1, 4, 2]]);
    assert_eq!(mesh.texture_coordinates, [[0.0, 1.0], [1.0, 1.0], [0.0, 0.0], [1.0, 0.0], [0.5, 1.0]]);
    let normals: Vec<_> = mesh.normals.iter().map(|normal| normal.vector()).collect();
    assert_eq!(normals, [Some(Vec3::Z), Some(Vec3::Y), None, None, Some(Vec3::Z)]);
    assert_eq!(mesh.colors, [[9; 3]; 5]);
    assert_eq!((mesh.materials.of_triangles.as_slice(), mesh.materials.materials.len()), (&[0, 0, 1][..], 3));
    let names: Vec<_> = draft.images.iter().map(|image| image.name.as_str()).collect();
    assert_eq!(names, ["a b.png", "c.jpg"]);
}

#[test]
fn faces_of_other_colors_split_vertices() {
    let mesh = mesh(TEXTURED.replace("0 1 1 9 9 9", "0 1 1 8 9 9").replace("0.5 0", "0 0"));
    assert_eq!(mesh.triangles, [[0, 1, 3], [0, 3, 2], [4, 5, 6]]);
    assert_eq!((mesh.colors[3], mesh.colors[4]), ([9; 3], [8, 9, 9]));
}

#[test]
fn textures_are_named_in_comments_and_elsewhere() {
    for line in ["comment TextureFile\ta b.png", "obj_info TextureFile a b.png ", "obj_info texture a b.png"] {
        let draft = read(&TEXTURED.replace("comment TextureFile a b.png", line));
        assert_eq!((draft.images.len(), &*draft.images[0].name), (2, "a b.png"), "{line}");
    }
    let bare = "ply\nformat ascii 1.0\ncomment TextureFile a.png\nelement vertex 0\nproperty float x\nproperty float y\n\
        property float z\nend_header\n";
    assert_eq!(read(bare).remarks, ["its textures are left out: it has no texture coordinates"]);
}

fn read(text: &str) -> Draft {
    read_from(text.as_bytes(), text.len() as u64).unwrap_or_else(|problem| panic!("{problem}"))
}

#[test]
fn texture_coordinates_of_vertices_have_many_names() {
    for [s, t] in [["s", "t"], ["u", "v"], ["texture_u", "texture_v"]] {
        let text = TRIANGLE.replace("float z\n", &format!("float z\nproperty float {s}\nproperty float {t}\n"));
        let text = text.replace("0 0 0\n", "0 0 0 .5 .25\n").replace("1 0 0\n", "1 0 0 2 3\n");
        let draft = read_from(text.replace("0 1 0\n", "0 1 0 nan 7\n").as_bytes(), 1000).unwrap();
        assert_eq!(draft.mesh.texture_coordinates[..2], [[0.5, 0.75], [2.0, -2.0]]);
        assert!(draft.mesh.materials.materials.is_empty());
    }
}
