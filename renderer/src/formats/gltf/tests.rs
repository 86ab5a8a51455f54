//! The reader against files written by hand.

use glam::Vec3;
use proptest::prelude::*;

use super::*;
use crate::formats::{
    images::{Channels, Glossy, ImageSource, Role},
    specular::Factors,
};
use crate::model::material::{TextureUse, Wrap};

/// A square of 0, 1, 2 and 3 in positions, then indices 0 1 2 2 1 3 as bytes, then texture coordinates in sixteen bits.
pub(super) fn square() -> Vec<u8> {
    let positions = [[0.0_f32, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]];
    let mut bytes: Vec<u8> = positions.as_flattened().iter().flat_map(|x| x.to_le_bytes()).collect();
    bytes.extend([0, 1, 2, 2, 1, 3, 0, 0]);
    bytes.extend([0_u16, 0, 65535, 0, 0, 65535, 65535, 65535].iter().flat_map(|x| x.to_le_bytes()));
    bytes
}

pub(super) const ACCESSORS: &str = r#""accessors":[
    {"bufferView":0,"componentType":5126,"count":4,"type":"VEC3"},
    {"bufferView":0,"byteOffset":48,"componentType":5121,"count":6,"type":"SCALAR"},
    {"bufferView":0,"byteOffset":56,"componentType":5123,"normalized":true,"count":4,"type":"VEC2"}],
    "bufferViews":[{"buffer":0,"byteLength":72}],"buffers":[{"byteLength":72}]"#;

/// A GLB of the square, with more properties in the JSON.
pub(super) fn glb(more: &str, binary: &[u8]) -> Vec<u8> {
    let json = format!(r#"{{"asset":{{"version":"2.0"}},{more}}}"#);
    let mut glb = b"glTF\x02\0\0\0\0\0\0\0".to_vec();
    for (kind, chunk) in [(JSON, json.as_bytes()), (BINARY, binary)] {
        glb.extend((chunk.len() as u32).to_le_bytes());
        glb.extend(kind);
        glb.extend(chunk);
    }
    glb
}

pub(super) fn parse(glb: &[u8]) -> Result<Draft, Problem> {
    read_binary(glb, glb.len() as u64, &Companions::default())
}

pub(super) fn draft(more: &str) -> Draft {
    parse(&glb(&format!("{more},{ACCESSORS}"), &square())).unwrap_or_else(|problem| panic!("{problem}"))
}

pub(super) const PRIMITIVE: &str = r#"{"attributes":{"POSITION":0,"TEXCOORD_0":2},"indices":1}"#;

fn with_primitive(primitive: &str) -> Draft {
    draft(&format!(r#""nodes":[{{"mesh":0}}],"meshes":[{{"primitives":[{primitive}]}}]"#))
}

#[test]
fn every_mode_of_triangles_is_read_and_others_are_left_out() {
    for (mode, triangles) in [
        (4, vec![[0, 1, 2], [2, 1, 3]]),
        (5, vec![[0, 1, 2], [1, 2, 2], [2, 2, 1], [2, 3, 1]]),
        (6, vec![[0, 1, 2], [0, 2, 2], [0, 2, 1], [0, 1, 3]]),
    ] {
        let draft = with_primitive(&format!(r#"{{"attributes":{{"POSITION":0}},"indices":1,"mode":{mode}}}"#));
        assert_eq!((draft.mesh.triangles, draft.mesh.up), (triangles, Some(UpAxis::Y)), "{mode}");
    }
    let draft = with_primitive(&format!(r#"{PRIMITIVE},{{"attributes":{{"POSITION":0}},"mode":1}}"#));
    assert_eq!(draft.mesh.texture_coordinates, [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]);
    assert_eq!(draft.remarks, ["points and lines are left out: a point cloud must be meshed first"]);
    assert_eq!(with_primitive(r#"{"attributes":{"POSITION":0}}"#).mesh.triangles, [[0, 1, 2]]);
}

#[test]
fn nodes_place_meshes_and_mirrors_turn_triangles_over() {
    let mesh = draft(&format!(
        r#""scene":1,"scenes":[{{}},{{"nodes":[1,0]}}],"nodes":[{{"mesh":0,"scale":[-2,1,1]}},
        {{"mesh":0,"translation":[0,0,5],"rotation":[0,0,2,0],"children":[2]}},{{"mesh":0}}],
        "meshes":[{{"primitives":[{PRIMITIVE}]}}]"#
    ))
    .mesh;
    let corner = |triangle: usize, corner: usize| mesh.corners(triangle).unwrap()[corner];
    assert_eq!(mesh.triangles.len(), 6);
    assert_eq!((corner(1, 2), corner(3, 2)), ([-1.0, -1.0, 5.0], [-1.0, -1.0, 5.0]));
    assert_eq!([corner(5, 0), corner(5, 1), corner(5, 2)], [[0.0, 1.0, 0.0], [-2.0, 1.0, 0.0], [-2.0, 0.0, 0.0]]);
    assert_eq!(mesh.origin, glam::DVec3::ZERO);
}

#[test]
fn models_far_from_zero_keep_their_digits() {
    let mesh = draft(&format!(
        r#""nodes":[{{"mesh":0,"translation":[512345.1,5412345.7,0],"scale":[0.001,0.001,0.001]}}],
        "meshes":[{{"primitives":[{PRIMITIVE}]}}]"#
    ))
    .mesh;
    assert_eq!(mesh.origin, glam::DVec3::new(512_345.1, 5_412_345.7, 0.0));
    assert!((mesh.vertices[3][0] - 0.001).abs() < 1e-9);
}

#[test]
fn hidden_nodes_hide_those_below_them_and_still_move_what_is_seen() {
    let more = |visible: &str| {
        format!(
            r#""extensionsRequired":["KHR_node_visibility"],"scenes":[{{"nodes":[0,1]}}],"nodes":[{{"mesh":0}},
            {{"mesh":0,"children":[2],"extensions":{{"KHR_node_visibility":{{{visible}}}}}}},
            {{"mesh":0,"extensions":{{"KHR_node_visibility":{{"visible":true}}}}}}],"meshes":[{{"primitives":[{PRIMITIVE}]}}]"#
        )
    };
    for (visible, n_triangles) in [(r#""visible":false"#, 2), (r#""visible":true"#, 6), ("", 6)] {
        let draft = draft(&more(visible));
        assert_eq!((draft.mesh.triangles.len(), draft.remarks.len()), (n_triangles, 0), "{visible}");
    }
    let all = more(r#""visible":false"#).replace("[0,1]", "[1]");
    let told = parse(&glb(&format!("{all},{ACCESSORS}"), &square())).unwrap_err().to_string();
    assert_eq!(told, "holds nothing that can be shown: its scene has no meshes, or hides them");
}

#[test]
fn nodes_that_come_again_are_left_out() {
    let draft = draft(&format!(
        r#""scenes":[{{"nodes":[0,0,9]}}],"nodes":[{{"mesh":0,"children":[0,1]}},{{"children":[0]}}],
        "meshes":[{{"primitives":[{PRIMITIVE}]}}]"#
    ));
    assert_eq!((draft.mesh.triangles.len(), draft.remarks.len()), (2, 1), "{:?}", draft.remarks);
}

#[test]
fn vertices_that_several_meshes_share_are_taken_where_they_are_used() {
    let draft = with_primitive(&format!(r#"{{"attributes":{{"POSITION":0}},"indices":3}},{PRIMITIVE}"#));
    // Accessor 3 does not exist: the other primitive is read.
    assert_eq!((draft.mesh.vertices.len(), draft.remarks.len()), (4, 1));
    let sparse = r#""nodes":[{"mesh":0}],"meshes":[{"primitives":[{"attributes":{"POSITION":0},"indices":1}]}],
        "accessors":[{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3","sparse":{"count":1,
        "indices":{"bufferView":0,"byteOffset":49,"componentType":5121},"values":{"bufferView":0,"byteOffset":36}}},
        {"bufferView":0,"byteOffset":50,"componentType":5121,"count":3,"type":"SCALAR"}],
        "bufferViews":[{"buffer":0,"byteLength":72}],"buffers":[{"byteLength":72}]"#;
    let mesh = parse(&glb(sparse, &square())).unwrap().mesh;
    assert_eq!((mesh.vertices, mesh.triangles), (vec![[1.0, 1.0, 0.0], [0.0, 1.0, 0.0]], vec![[1, 1, 0]]));
}

#[test]
fn materials_textures_and_their_transforms_are_read() {
    let draft = draft(
        r#""extensionsRequired":["KHR_texture_transform","X_unknown"],"nodes":[{"mesh":0}],"meshes":[{"primitives":[
        {"attributes":{"POSITION":0,"TEXCOORD_0":2},"indices":1,"material":1},
        {"attributes":{"POSITION":0,"TEXCOORD_0":2},"indices":1}]}],"materials":[{},{"name":"stone",
        "pbrMetallicRoughness":{"baseColorFactor":[1,0.5,0,2],"metallicFactor":0,"baseColorTexture":{"index":0,
        "extensions":{"KHR_texture_transform":{"offset":[0.25,0.5],"rotation":1.5707963,"scale":[2,3]}}},
        "metallicRoughnessTexture":{"index":0,"texCoord":1}},"emissiveFactor":[0,0,1],"emissiveTexture":{"index":1},
        "alphaMode":"BLEND","normalTexture":{"index":0}}],"textures":[{"source":0,"sampler":0},{"source":7}],"samplers":[{"wrapS":33071,"wrapT":33648}],
        "images":[{"uri":"a%20b.png"}]"#,
    );
    let materials = &draft.mesh.materials;
    assert_eq!((materials.of_triangles.as_slice(), materials.materials.len()), (&[1, 1, 0, 0][..], 2));
    let stone = &materials.materials[1];
    assert_eq!((stone.base_color, stone.metallic, stone.roughness), ([1.0, 0.5, 0.0, 1.0], 0.0, 1.0));
    // Without its texture a factor says little.
    assert_eq!((stone.emissive, stone.alpha_cutoff, stone.emissive_texture), ([0.0; 3], Some(0.5), None));
    let TextureUse { image, wrap, transform } = stone.base_color_texture.unwrap();
    assert_eq!((image, wrap, draft.images[0].name.as_str()), (0, [Wrap::Clamp, Wrap::Mirror], "a b.png"));
    let expected = [[0.0, 3.0, 0.25], [-2.0, 0.0, 0.5]];
    let difference =
        transform.as_flattened().iter().zip(expected.as_flattened()).map(|(a, b): (&f32, &f32)| (a - b).abs());
    assert!(difference.fold(0.0, f32::max) < 1e-6, "{transform:?}");
    assert_eq!(
        draft.remarks,
        [
            "needs X_unknown, which is not read: parts may be missing; export without it",
            "a texture with coordinates of its own is left out",
            "texture 1 is left out: there is no image 7",
            "textures of normals are left out: light falls by the normals of vertices",
            "material `stone` is see-through: it is shown where it is half there or more"
        ]
    );
}

#[test]
fn unlit_materials_keep_their_colours() {
    let draft = with_material(
        r#"{"extensions":{"KHR_materials_unlit":{}},"emissiveFactor":[1,1,1],
        "pbrMetallicRoughness":{"baseColorFactor":[0.5,0.25,0,1]}}"#,
    );
    let material = &draft.mesh.materials.materials[0];
    assert_eq!((material.is_unlit, material.base_color, material.emissive), (true, [0.5, 0.25, 0.0, 1.0], [0.0; 3]));
    assert_eq!(draft.remarks, ["its unlit materials keep their colours in any light"]);
    assert!(!with_material("{}").mesh.materials.materials[0].is_unlit);
}

#[test]
fn factors_of_specular_glossiness_make_the_metal_that_their_images_make() {
    let images = r#","textures":[{"source":0}],"images":[{"uri":"a.png"}]"#;
    let read = |glossy: &str| {
        let glossy = format!(r#"{{"extensions":{{"KHR_materials_pbrSpecularGlossiness":{{{glossy}}}}}}}"#);
        with_material_and(&glossy, images)
    };
    let gold = r#""specularFactor":[1,0.77,0.34],"glossinessFactor":0.75"#;
    let draft = read(&format!(r#""diffuseFactor":[0,0,0,0.5],{gold}"#));
    let material = &draft.mesh.materials.materials[0];
    let difference = material.base_color.iter().zip([1.0, 0.77, 0.34, 0.5]).map(|(a, b): (&f32, f32)| (a - b).abs());
    assert!(difference.fold(0.0, f32::max) < 1e-4, "{:?}", material.base_color);
    assert!((material.metallic - 1.0).abs() < 1e-4, "{}", material.metallic);
    assert_eq!((material.roughness, draft.images.len()), (0.25, 0));
    for (glossy, role, factors, roughness) in [
        (
            format!(r#""diffuseTexture":{{"index":0}},{gold}"#),
            Role::Diffuse,
            Factors::new([1.0; 3], [1.0, 0.77, 0.34], 0.0),
            0.25,
        ),
        (
            r#""diffuseFactor":[0,0.5,0,1],"glossinessFactor":0.75,"specularGlossinessTexture":{"index":0}"#.to_owned(),
            Role::Specular,
            Factors::new([0.0, 0.5, 0.0], [1.0; 3], 0.75),
            1.0,
        ),
    ] {
        let draft = read(&glossy);
        let material = &draft.mesh.materials.materials[0];
        assert_eq!((material.base_color, material.metallic, material.roughness), ([1.0; 4], 1.0, roughness));
        let glossy = || Box::new(Glossy { role: role.clone(), factors });
        let expected = [Channels::BaseColorOfGlossy(glossy()), Channels::MetalOfGlossy(glossy())]
            .map(|channels| ImageSource { channels, ..ImageSource::file("a.png") });
        assert_eq!(draft.images, expected);
        let textures = [material.base_color_texture, material.metallic_roughness_texture];
        assert_eq!(textures.map(|texture| texture.map(|texture| texture.image)), [Some(0), Some(1)]);
    }
}

#[test]
fn what_materials_are_shown_without_is_told() {
    let glass = |factor: f32| {
        let material = format!(
            r#"{{"name":"pane","extensions":{{"KHR_materials_transmission":{{"transmissionFactor":{factor}}}}}}}"#
        );
        with_material(&material).remarks
    };
    assert_eq!(glass(0.5), ["material `pane` lets light through: it is shown opaque"]);
    assert!(glass(0.0).is_empty());
    let accessor = r#""VEC2"},{"bufferView":0,"componentType":5121,"normalized":true,"count":4,"type":"VEC4"}"#;
    let colored = |mode: &str| {
        let more = format!(
            r#""nodes":[{{"mesh":0}}],"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"COLOR_0":3}},"material":0}}]}}],
            "materials":[{{"alphaMode":"{mode}"}}],{}"#,
            ACCESSORS.replace(r#""VEC2"}"#, accessor)
        );
        parse(&glb(&more, &square())).unwrap().remarks
    };
    assert_eq!(colored("MASK"), ["the coverage of vertices' colours is left out"]);
    assert!(colored("OPAQUE").is_empty());
}

#[test]
fn shapes_that_nodes_blend_are_told() {
    for (of_node, of_mesh, is_told) in [("[0,1]", "[]", true), ("[0,0]", "[1]", false), ("null", "[1]", true)] {
        let draft = draft(&format!(
            r#""nodes":[{{"mesh":0,"weights":{of_node}}}],"meshes":[{{"primitives":[{PRIMITIVE}],"weights":{of_mesh}}}]"#
        ));
        let expected = ["a shape that is blended with others is shown without them".to_owned()];
        assert_eq!(draft.remarks, expected[..usize::from(is_told)], "{of_node}");
    }
}

#[test]
fn attributes_that_cannot_be_used_are_left_out_with_a_line() {
    for (name, accessor, fault) in [
        ("TEXCOORD_0", 9, "there is no accessor 9"),
        ("COLOR_0", 2, "accessor 2: is of another type than its use needs"),
        ("NORMAL", 3, "it has 3 elements for 4 vertices"),
        ("NORMAL", 4, "accessor 4: is cut short: its view has no 9 elements"),
    ] {
        let more = format!(
            r#""nodes":[{{"mesh":0}}],"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"{name}":{accessor}}},"indices":1}}]}}],{}"#,
            ACCESSORS.replacen(
                r#""VEC2"}"#,
                r#""VEC2"},{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"},
                {"bufferView":0,"componentType":5126,"count":9,"type":"VEC3"}"#,
                1
            )
        );
        let draft = parse(&glb(&more, &square())).unwrap();
        assert_eq!(draft.remarks, [format!("{name} of a mesh is left out: {fault}")]);
        assert_eq!(draft.mesh.triangles.len(), 2);
    }
}

#[test]
fn textures_without_coordinates_are_told() {
    let more = |attributes: &str| {
        format!(
            r#""nodes":[{{"mesh":0}}],"meshes":[{{"primitives":[{{"attributes":{{{attributes}}},"indices":1,"material":0}}]}}],
            "materials":[{{"pbrMetallicRoughness":{{"baseColorTexture":{{"index":0}}}}}}],
            "textures":[{{"source":0}}],"images":[{{"uri":"a.png"}}]"#
        )
    };
    let bare = draft(&more(r#""POSITION":0"#));
    assert_eq!(bare.remarks, ["its textures are left out: it has no texture coordinates"]);
    assert_eq!((bare.images.len(), bare.mesh.materials.materials[0].base_color_texture), (0, None));
    let whole = draft(&more(r#""POSITION":0,"TEXCOORD_0":2"#));
    assert_eq!((whole.remarks.len(), whole.images.len()), (0, 1));
}

#[test]
fn json_of_careless_programs_is_read() {
    let plain = format!(r#""nodes":[{{"mesh":0}}],"meshes":[{{"primitives":[{PRIMITIVE}]}}],{ACCESSORS}"#);
    for (from, to) in [
        (r#""count":4"#, r#""count":4.0"#),
        (r#""byteOffset":48"#, r#""byteOffset":4.8e1"#),
        (r#""nodes":["#, r#""nodes":[],"nodes":["#),
    ] {
        let more = plain.replace(from, to);
        assert_ne!(more, plain);
        assert_eq!(parse(&glb(&more, &square())).unwrap().mesh.triangles.len(), 2, "{to}");
    }
    let fraction = plain.replace(r#""count":4"#, r#""count":4.5"#);
    assert!(parse(&glb(&fraction, &square())).unwrap_err().to_string().contains("invalid type: floating point `4.5`"));
}

#[test]
fn bytes_after_the_declared_ones_are_no_part_of_a_glb() {
    let more = format!(r#""nodes":[{{"mesh":0}}],"meshes":[{{"primitives":[{PRIMITIVE}]}}],{ACCESSORS}"#)
        .replace(r#""buffers":[{"#, &format!(r#""buffers":[{{"uri":"data:;base64,{}","#, "AAAA".repeat(24)));
    let whole = glb(&more, &[]);
    let mut json_alone = whole[..whole.len() - 8].to_vec();
    let n = (json_alone.len() as u32).to_le_bytes();
    json_alone[8..12].copy_from_slice(&n);
    json_alone.extend([0xff; 16]);
    assert_eq!(parse(&json_alone).unwrap().mesh.triangles.len(), parse(&whole).unwrap().mesh.triangles.len());
}

/// A square of one material.
fn with_material(material: &str) -> Draft {
    with_material_and(material, "")
}

pub(super) fn with_material_and(material: &str, more: &str) -> Draft {
    draft(&format!(
        r#""nodes":[{{"mesh":0}}],"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"TEXCOORD_0":2}},"indices":1,
        "material":0}}]}}],"materials":[{material}]{more}"#
    ))
}

#[test]
fn a_material_that_does_not_exist_is_told() {
    let draft = with_primitive(r#"{"attributes":{"POSITION":0},"indices":1,"material":3}"#);
    assert_eq!(draft.remarks, ["there is no material 3: a mesh is shown without one"]);
}

#[test]
fn buffers_of_the_same_address_are_one() {
    let more =
        r#""nodes":[{"mesh":0}],"meshes":[{"primitives":[{"attributes":{"POSITION":0},"indices":1}]}],"accessors":[
        {"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"},
        {"bufferView":1,"componentType":5121,"count":3,"type":"SCALAR"}],
        "bufferViews":[{"buffer":0,"byteLength":36},{"buffer":1,"byteOffset":2,"byteLength":3}],
        "buffers":[{"uri":"URI","byteLength":36},{"uri":"URI","byteLength":36}]"#
            .replace("URI", &format!("data:;base64,{}", "AAEC".repeat(12)));
    let draft = parse(&glb(&more, &[])).unwrap();
    assert_eq!((draft.mesh.triangles, draft.remarks.len()), (vec![[2, 0, 1]], 0));
}

#[test]
fn a_node_may_list_copies_of_its_mesh() {
    // Copies at the corners of the square, three times as large, below a node that is moved.
    let more = format!(
        r#""nodes":[{{"translation":[0,0,7],"mesh":0,"extensions":{{"EXT_mesh_gpu_instancing":{{"attributes":{{"TRANSLATION":0,"SCALE":3}}}}}}}}],
        "meshes":[{{"primitives":[{PRIMITIVE}]}}],{ACCESSORS}"#
    )
    .replace(r#""type":"VEC2"}]"#, r#""type":"VEC2"},{"bufferView":1,"componentType":5126,"count":3,"type":"VEC3"}]"#)
    .replace(r#""byteLength":72}],"#, r#""byteLength":72},{"buffer":0,"byteOffset":72,"byteLength":36}],"#);
    let scales = [3.0_f32; 9].map(f32::to_le_bytes).as_flattened().to_vec();
    let draft = parse(&glb(&more, &[square(), scales].concat())).unwrap();
    assert_eq!((draft.mesh.triangles.len(), draft.remarks.len()), (6, 0), "{:?}", draft.remarks);
    assert_eq!(draft.mesh.corners(5), Some([[0.0, 4.0, 7.0], [3.0, 1.0, 7.0], [3.0, 4.0, 7.0]]));
    let wrong = more.replace(r#""SCALE":3"#, r#""SCALE":1"#);
    assert!(
        parse(&glb(&wrong, &square())).unwrap_err().to_string().contains("copies of a mesh are left out: accessor 1")
    );
}

#[test]
fn skeletons_are_shown_at_rest() {
    // Every vertex follows joint 1, by the bytes 0 1 2 2 of the indices and 255 of the texture coordinates.
    let mut binary = square();
    binary[48..52].copy_from_slice(&[1, 0, 0, 0]);
    let more = r#""scenes":[{"nodes":[0,1,2]}],"nodes":[{"mesh":0,"skin":0,"translation":[9,9,9]},{},{"translation":[0,0,3]}],
        "skins":[{"joints":[1,2]}],"meshes":[{"primitives":[{"attributes":{"POSITION":0,"JOINTS_0":1,"WEIGHTS_0":2}}]}],
        "accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"},
        {"bufferView":1,"componentType":5121,"count":3,"type":"VEC4"},
        {"bufferView":1,"componentType":5121,"normalized":true,"count":3,"type":"VEC4"}],
        "bufferViews":[{"buffer":0,"byteLength":48},{"buffer":0,"byteOffset":48,"byteLength":4}],
        "buffers":[{"byteLength":72}]"#;
    let more = more.replace(r#""byteLength":4}"#, r#""byteLength":12}"#);
    binary.splice(52..60, [1, 0, 0, 0, 1, 0, 0, 0]);
    let draft = parse(&glb(&more, &binary)).unwrap();
    assert_eq!(draft.mesh.vertices, [[0.0, 0.0, 3.0], [1.0, 0.0, 3.0], [0.0, 1.0, 3.0]]);
    assert_eq!(draft.remarks, ["its skeletons are shown at rest"]);
    let hidden = more
        .replace(r#"{},{"translation""#, r#"{},{"extensions":{"KHR_node_visibility":{"visible":false}},"translation""#);
    assert_eq!(parse(&glb(&hidden, &binary)).unwrap().mesh.vertices, draft.mesh.vertices);
}

#[test]
fn normals_and_colors_follow_their_vertices() {
    let more = r#""nodes":[{"mesh":0,"scale":[1,1,-1]}],"meshes":[{"primitives":[{"attributes":{"POSITION":0}},
        {"attributes":{"POSITION":0,"NORMAL":0,"COLOR_0":1}}]}],"accessors":[
        {"bufferView":0,"componentType":5126,"count":3,"type":"VEC3"},
        {"bufferView":0,"componentType":5121,"normalized":true,"count":3,"type":"VEC3"}],
        "bufferViews":[{"buffer":0,"byteLength":72}],"buffers":[{"byteLength":72}]"#;
    let mesh = parse(&glb(more, &square())).unwrap().mesh;
    let normals: Vec<_> = mesh.normals.iter().map(|normal| normal.vector()).collect();
    assert_eq!(normals, [None, None, None, None, Some(Vec3::X), Some(Vec3::Y)]);
    assert_eq!((mesh.colors[2], mesh.colors[3]), ([255; 3], [0; 3]));
}

fn bytes_of(hex: &str) -> Vec<u8> {
    (0..hex.len() / 2).map(|k| u8::from_str_radix(&hex[2 * k..2 * k + 2], 16).unwrap()).collect()
}

/// Rows of six numbers of sixteen bits, as meshoptimizer 1.0 writes them in versions 0 and 1 of its format.
const ATTRIBUTES: [&str; 2] = [
    "a0052aaaaaaaaa000000000a06666666666666666666000000000000000000070002060a0e12161a45223d2a2e313629ff0000002542\
     1d19000700303030303030303030303030303030ff000000303030300a05777777777577777777000000000000000000000000000000\
     000000000000000000000000000000000007000000ffff0000",
    "a199baa7052aaaaaaaaa0000000206666666666666660f00060606060002060a0e12161a45223d2a2e31362925421d19003030303030\
     30303030303030303030303030300205777777777577770f00070707070000000000000000000000000007000000ffff0000000000",
];
const TRIANGLES: [&str; 2] =
    ["e0f010f06f6012007687566778a9866589689801690000", "e1f010f06f6012007687566778a9866589689801690000"];
const SEQUENCE: &str = "d00004040002080404040c1a02180e0600000000";

#[test]
fn compressed_views_are_those_of_meshoptimizer() {
    use meshopt::{Filter, Mode, decode};
    let row = |i: u16| [i, i * 3, 7, i * i % 50, 65535 - i * 1000, 0];
    let rows: Vec<u8> = (0..20).flat_map(row).flat_map(u16::to_le_bytes).collect();
    for encoded in ATTRIBUTES.map(bytes_of) {
        assert_eq!(decode(&encoded, Mode::Attributes, Filter::None, 20, 12).unwrap(), rows);
        assert!(decode(&encoded[..encoded.len() - 1], Mode::Attributes, Filter::None, 20, 12).is_none());
        assert!(decode(&encoded, Mode::Attributes, Filter::None, usize::MAX / 4, 12).is_none());
        assert!(decode(&encoded, Mode::Attributes, Filter::None, 20, 13).is_none());
    }
    let bytes = |indices: [u32; 15]| indices.map(u32::to_le_bytes).as_flattened().to_vec();
    for encoded in TRIANGLES.map(bytes_of) {
        let triangles = decode(&encoded, Mode::Triangles, Filter::None, 15, 4).unwrap();
        assert_eq!(triangles, bytes([0, 1, 2, 2, 1, 3, 4, 5, 6, 2, 1, 9, 3, 1, 7]));
        assert!(decode(&encoded, Mode::Triangles, Filter::None, usize::MAX / 3 * 3, 4).is_none());
    }
    let sequence = decode(&bytes_of(SEQUENCE), Mode::Indices, Filter::None, 15, 4).unwrap();
    assert_eq!(sequence, bytes([0, 1, 2, 2, 1, 3, 4, 5, 6, 9, 2, 1, 7, 3, 1]));
}

/// Rows that are stored as they are, in version 1 of the format: the control bytes say so.
fn stored(rows: &[u8], stride: usize) -> Vec<u8> {
    let words = stride / 4;
    let mut bytes = vec![0xa1];
    bytes.extend(vec![0xff; words]);
    for byte in 0..stride {
        let mut last = 0_u8;
        for row in rows.chunks(stride) {
            let delta = row[byte].wrapping_sub(last) as i8;
            bytes.push((delta << 1 ^ delta >> 7) as u8);
            last = row[byte];
        }
    }
    let tail = stride + words;
    bytes.extend(vec![0; tail.max(24)]);
    bytes
}

#[test]
fn filters_of_compressed_views_are_undone() {
    use meshopt::{Filter, Mode, decode};
    let halves = |row: [i32; 4]| row.map(|half| (half as u16).to_le_bytes()).as_flattened().to_vec();
    // All bits, then four bits, which leave three to the coverage.
    let colors = [[113, 75, 244, 255], [3, 1, 255, 10]].concat();
    assert_eq!(
        decode(&stored(&colors, 4), Mode::Attributes, Filter::Color, 2, 4).unwrap(),
        [200, 101, 50, 255, 85, 34, 51, 68]
    );
    let color = halves([30_000, 10_000, -5_000, 65_535]);
    assert_eq!(
        decode(&stored(&color, 8), Mode::Attributes, Filter::Color, 1, 8).unwrap(),
        halves([45_000, 25_000, 25_000, 65_535])
    );
    // No turn; a third of one about (1, 1, 1), whose x was taken for the largest; and one whose z is the largest.
    for (row, expected) in [
        ([0, 0, 0, 32_767], [0, 0, 0, 32_767]),
        ([23_170, 23_170, 23_170, 32_764], [16_384, 16_384, 16_384, 16_384]),
        ([0, 0, -16_384, 16_382], [0, -23_170, 23_170, 0]),
    ] {
        let turn = decode(&stored(&halves(row), 8), Mode::Attributes, Filter::Quaternion, 1, 8).unwrap();
        let found: Vec<i32> = turn.as_chunks().0.iter().map(|half| i16::from_le_bytes(*half).into()).collect();
        assert!(found.iter().zip(expected).all(|(a, b): (&i32, i32)| (a - b).abs() <= 2), "{found:?}");
    }
}

#[test]
fn compressed_views_that_share_bytes_are_left_out() {
    let rows = bytes_of(ATTRIBUTES[0]);
    let view = format!(
        r#"{{"buffer":0,"byteLength":240,"extensions":{{"EXT_meshopt_compression":
        {{"buffer":0,"byteLength":{},"byteStride":12,"count":20,"mode":"ATTRIBUTES"}}}}}}"#,
        rows.len()
    );
    let more = format!(
        r#""nodes":[{{"mesh":0}}],"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}}}},{{"attributes":{{"POSITION":1}}}}]}}],
        "accessors":[{{"bufferView":0,"componentType":5123,"count":20,"type":"VEC3"}},
        {{"bufferView":1,"componentType":5123,"count":20,"type":"VEC3"}}],
        "buffers":[{{"byteLength":{}}}],"bufferViews":[{view},{view}]"#,
        rows.len()
    );
    let draft = parse(&glb(&more, &rows)).unwrap();
    assert_eq!(draft.mesh.triangles.len(), 6);
    assert!(draft.remarks[0].contains("compressed views share their bytes"), "{:?}", draft.remarks);
}

#[test]
fn compressed_geometry_is_read() {
    let (rows, triangles) = (bytes_of(ATTRIBUTES[0]), bytes_of(TRIANGLES[0]));
    let more = format!(
        r#""extensionsRequired":["EXT_meshopt_compression","KHR_mesh_quantization"],"nodes":[{{"mesh":0,"scale":[2,2,2]}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1}}]}}],"accessors":[
        {{"bufferView":0,"componentType":5123,"count":20,"type":"VEC3"}},
        {{"bufferView":1,"componentType":5123,"count":15,"type":"SCALAR"}}],"buffers":[{{"byteLength":{}}},{{"byteLength":999}}],
        "bufferViews":[{{"buffer":1,"byteLength":240,"byteStride":12,"extensions":{{"EXT_meshopt_compression":
        {{"buffer":0,"byteLength":{},"byteStride":12,"count":20,"mode":"ATTRIBUTES"}}}}}},
        {{"buffer":1,"byteLength":30,"extensions":{{"EXT_meshopt_compression":
        {{"buffer":0,"byteOffset":{},"byteLength":{},"byteStride":2,"count":15,"mode":"TRIANGLES"}}}}}}]"#,
        rows.len() + triangles.len(),
        rows.len(),
        rows.len(),
        triangles.len()
    );
    let draft = parse(&glb(&more, &[rows, triangles].concat())).unwrap();
    assert_eq!((draft.mesh.vertices.len(), draft.remarks.len()), (9, 0), "{:?}", draft.remarks);
    assert_eq!(draft.mesh.corners(3), Some([[4.0, 12.0, 14.0], [2.0, 6.0, 14.0], [18.0, 54.0, 14.0]]));
}

/// Nine points in a square of side 2, and eight triangles, as draco-core 2.3 writes them.
const DRACO: &str = "445241434f0202010100000009080008010003efd31aff011101ff000001000903000002010101000c0355151f55155915044784dd92\
    ffff3f00feef7f0000a0ff00120000fc0f000000100000f03f00000000ff070000000000000000000000000000000000400b";

/// A GLB of compressed triangles.
fn draco_glb(binary: &[u8]) -> Vec<u8> {
    let n = binary.len();
    let more = format!(
        r#""nodes":[{{"mesh":0}},{{"mesh":0}}],"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1,"extensions":
        {{"KHR_draco_mesh_compression":{{"bufferView":0,"attributes":{{"POSITION":0}}}}}}}}]}}],"accessors":[
        {{"componentType":5126,"count":9,"type":"VEC3"}},{{"componentType":5123,"count":24,"type":"SCALAR"}}],
        "bufferViews":[{{"buffer":0,"byteLength":{n}}}],"buffers":[{{"byteLength":{n}}}]"#
    );
    glb(&more, binary)
}

#[test]
fn draco_is_read() {
    let mesh = parse(&draco_glb(&bytes_of(DRACO))).unwrap().mesh;
    assert_eq!((mesh.vertices.len(), mesh.triangles.len(), mesh.n_rejected), (18, 16, 0));
    let [min, max] = mesh.extent();
    assert!(min.abs_diff_eq(glam::DVec3::ZERO, 1e-6) && max.truncate().abs_diff_eq(glam::DVec2::splat(2.0), 1e-6));
    let damaged = parse(&draco_glb(&bytes_of(&DRACO[..80]))).unwrap_err().to_string();
    assert!(damaged.contains("its Draco data is damaged"), "{damaged}");
}

/// A triangle of which each point follows the second joint, as draco-core 2.3 writes it.
const DRACO_SKIN: &str = "445241434f02020100000001030100010201030009030000040204000104090400020001000000000000000000000000000000803f00\
    00000000000000000000000000803f0000000000010100020301400100010000000000010000000000803f00000000000000000000000000\
    00803f0000000000000000000000000000803f000000000000000000000000";

#[test]
fn compressed_skeletons_are_shown_at_rest() {
    let skin = bytes_of(DRACO_SKIN);
    let skinned = |joints: u32, weights: u32| {
        let n = skin.len();
        let more = format!(
            r#""scenes":[{{"nodes":[0,1,2]}}],"nodes":[{{"mesh":0,"skin":0}},{{}},{{"translation":[0,0,3]}}],"skins":[{{"joints":[1,2]}}],
            "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"JOINTS_0":1,"WEIGHTS_0":2}},"extensions":{{"KHR_draco_mesh_compression":
            {{"bufferView":0,"attributes":{{"POSITION":0,"JOINTS_0":{joints},"WEIGHTS_0":{weights}}}}}}}}}]}}],
            "accessors":[{{"componentType":5126,"count":3,"type":"VEC3"}},{{"componentType":5121,"count":3,"type":"VEC4"}},
            {{"componentType":5126,"count":3,"type":"VEC4"}}],"bufferViews":[{{"buffer":0,"byteLength":{n}}}],
            "buffers":[{{"byteLength":{n}}}]"#
        );
        parse(&glb(&more, &skin)).unwrap().mesh.vertices
    };
    assert_eq!(skinned(1, 2), [[0.0, 0.0, 3.0], [1.0, 0.0, 3.0], [0.0, 1.0, 3.0]]);
    // Three numbers a point are no joints and no weights.
    for (joints, weights) in [(0, 2), (1, 0), (0, 0)] {
        assert_eq!(skinned(joints, weights), [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]);
    }
}

#[test]
fn faults_are_told_in_one_line() {
    let error = |bytes: &[u8]| parse(bytes).unwrap_err().to_string();
    let text =
        |json: &str| read_text(json.as_bytes(), json.len() as u64, &Companions::default()).unwrap_err().to_string();
    let whole =
        glb(&format!(r#""nodes":[{{"mesh":0}}],"meshes":[{{"primitives":[{PRIMITIVE}]}}],{ACCESSORS}"#), &square());
    for (told, expected) in [
        (error(b"glTF"), "is cut short: 12 bytes are needed, it has 4"),
        (error(b"glTF\x01\0\0\0\0\0\0\0"), "has version 1 of glTF: convert it to 2.0, for example with Blender"),
        (error(&whole[..whole.len() - 1]), "is cut short: "),
        (text(r#"{"asset":{"version":"1.0"},"nodes":{}}"#), "has version 1.0 of glTF"),
        (text(r#"{"asset":{"version":1},"nodes":{}}"#), "has version 1 of glTF"),
        (
            text(r#"{"asset":{"version":"2.0"}}"#),
            "holds nothing that can be shown: its scene has no meshes, or hides them",
        ),
        (
            text(r#"{"asset":{"version":"2.0"},"nodes":[{}],"animations":[{}]}"#),
            "holds nothing that can be shown: its scene has no meshes, or hides them",
        ),
        (text(r#"{"scenes":[]}"#), "is no glTF 2.0: missing field `asset`"),
        (
            text("{\"asset\":{\"version\":\"2.0\"},\n\"nodes\":[{\"na"),
            "is cut short: its JSON breaks off in line 2, column 13",
        ),
        (
            error(&glb(r#""nodes":[{"mesh":0}],"meshes":[{"primitives":[{"attributes":{},"mode":0}]}]"#, &[])),
            "holds no triangles: points and lines are left out: a point cloud must be meshed first",
        ),
        (text(r#"{"asset":{"version":"2.0"},"nodes":3}"#), "is no glTF 2.0: invalid type"),
        (
            text(
                r#"{"asset":{"version":"2.0"},"nodes":[{"mesh":0}],"meshes":[{"primitives":[{"attributes":{"POSITION":0}}]}],
                "accessors":[{"componentType":5126,"count":18446744073709551615,"type":"VEC3"}]}"#,
            ),
            "holds nothing that can be shown: a mesh is left out: accessor 0: counts 18446744073709551615 elements, and has no",
        ),
    ] {
        assert!(told.starts_with(expected) && !told.contains('\n'), "{told}");
    }
    let missing = format!(r#""nodes":[{{"mesh":0}}],"meshes":[{{"primitives":[{PRIMITIVE}]}}],{ACCESSORS}"#)
        .replace(r#""buffers":[{"#, r#""buffers":[{"uri":"data.bin","#);
    let told = error(&glb(&missing, &[]));
    assert!(told.contains("data.bin is missing: put it beside the model"), "{told}");
}

#[test]
fn copies_without_end_are_refused() {
    // 200 million primitives of two triangles in a few hundred KB.
    let node = r#"{"mesh":0},"#.repeat(100_000);
    let primitives = vec![PRIMITIVE; 2000].join(",");
    let more = format!(r#""nodes":[{node}{{}}],"meshes":[{{"primitives":[{primitives}]}}],{ACCESSORS}"#);
    assert!(matches!(parse(&glb(&more, &square())), Err(Problem::TooManyCopies(_))));
    let lines = vec![r#"{"attributes":{},"mode":1}"#; 2000].join(",");
    let more = format!(r#""nodes":[{node}{{}}],"meshes":[{{"primitives":[{lines}]}}],{ACCESSORS}"#);
    assert!(matches!(parse(&glb(&more, &square())), Err(Problem::TooManyCopies(_))));
    // A million primitives with nine thousand positions to copy, before their indices turn out to be missing.
    let positions = r#"{"bufferView":0,"componentType":5126,"count":9000,"type":"VEC3","sparse":{"count":1,
        "indices":{"bufferView":0,"componentType":5121},"values":{"bufferView":0}}}"#;
    let node = r#"{"mesh":0},"#.repeat(1000);
    let primitives = vec![r#"{"attributes":{"POSITION":0},"indices":9}"#; 1000].join(",");
    let more = format!(
        r#""nodes":[{node}{{}}],"meshes":[{{"primitives":[{primitives}]}}],"accessors":[{positions}],
        "bufferViews":[{{"buffer":0,"byteLength":108000}}],"buffers":[{{"byteLength":108000}}]"#
    );
    let told = parse(&glb(&more, &[0; 108_000])).unwrap_err().to_string();
    assert_eq!(told, "holds too many damaged meshes: there is no accessor 9");
}

proptest! {
    #[test]
    fn damaged_files_never_panic(at in 0..2000_usize, byte: u8, cut in 0..2000_usize, is_draco: bool) {
        let mut bytes = if is_draco {
            draco_glb(&bytes_of(DRACO))
        } else {
            glb(&format!(r#""nodes":[{{"mesh":0}}],"meshes":[{{"primitives":[{PRIMITIVE}]}}],{ACCESSORS}"#), &square())
        };
        let n = bytes.len();
        bytes[at % n] = byte;
        let _ = parse(&bytes);
        bytes.truncate(cut % n);
        let _ = parse(&bytes);
    }
}
