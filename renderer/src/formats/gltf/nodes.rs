//! Nodes and their transforms.

use std::collections::BTreeMap;

use glam::{DMat4, DQuat, DVec3, DVec4};

use crate::formats::gltf::{
    accessor::Elements,
    buffers::Buffers,
    document::{Document, Kind, Node},
};

/// The most copies of meshes that nodes place.
const MOST_COPIES: usize = 1 << 20;

/// A mesh in the scene.
pub(super) struct Instance {
    /// Index of the mesh.
    pub(super) mesh: usize,
    /// From the mesh's space to the world's.
    pub(super) transform: DMat4,
    /// For a mesh that bends with a skeleton, the transform of each joint: vertices weigh these instead.
    pub(super) joints: Vec<DMat4>,
    /// Whether it is blended with other shapes.
    pub(super) is_blended: bool,
}

/// The meshes of the scene in the order of its nodes, each node once, but those that are hidden.
pub(super) fn instances(document: &Document<'_>, buffers: &Buffers<'_>, remarks: &mut Vec<String>) -> Vec<Instance> {
    let (order, transforms, is_tree) = place(document);
    if !is_tree {
        remarks.push("its nodes are no tree: those that come again, or do not exist, are left out".to_owned());
    }
    let mut instances = Vec::new();
    let mut has_skins = false;
    let mut n_left = MOST_COPIES;
    for node in order {
        let Node { mesh: Some(mesh), skin, ref weights, ref extensions, .. } = document.nodes[node] else { continue };
        let of_mesh = || document.meshes.get(mesh).map(|mesh| &*mesh.weights);
        let weights = weights.as_deref().or_else(of_mesh).unwrap_or_default();
        let is_blended = weights.iter().any(|&weight| weight != 0.0);
        if let Some(described) = &extensions.copies {
            match copies(document, buffers, &described.attributes, &mut n_left) {
                Ok(copies) => instances.extend(copies.into_iter().map(|copy| {
                    let transform = transforms[node] * copy;
                    Instance { mesh, transform, joints: Vec::new(), is_blended }
                })),
                Err(fault) => remarks.push(format!("copies of a mesh are left out: {fault}")),
            }
            continue;
        }
        let joints = skin.map(|skin| joints(document, buffers, &transforms, skin)).unwrap_or_default();
        has_skins |= skin.is_some();
        instances.push(Instance { mesh, transform: transforms[node], joints, is_blended });
    }
    if has_skins {
        remarks.push("its skeletons are shown at rest".to_owned());
    }
    instances
}

/// Visible nodes of the scene from the root on, the transform of every node, and whether the nodes form a tree.
fn place(document: &Document<'_>) -> (Vec<usize>, Vec<DMat4>, bool) {
    let nodes = &document.nodes;
    let mut transforms = vec![DMat4::IDENTITY; nodes.len()];
    let mut is_seen = vec![false; nodes.len()];
    let mut order = Vec::new();
    let mut is_tree = true;
    let scene = document.scenes.get(document.scene.unwrap_or(0));
    let roots = scene.map_or_else(|| roots(document), |scene| scene.nodes.clone());
    let mut waiting: Vec<_> = roots.into_iter().rev().map(|node| (node, DMat4::IDENTITY, true)).collect();
    while let Some((index, parent, is_visible)) = waiting.pop() {
        if is_seen.get(index) != Some(&false) {
            is_tree = false;
            continue;
        }
        is_seen[index] = true;
        let node = &nodes[index];
        transforms[index] = parent * local(node);
        // A hidden node hides those below it, but joints among them move what is seen.
        let is_visible = is_visible && node.extensions.visibility.as_ref().and_then(|it| it.visible) != Some(false);
        order.extend(is_visible.then_some(index));
        waiting.extend(node.children.iter().rev().map(|&child| (child, transforms[index], is_visible)));
    }
    (order, transforms, is_tree)
}

/// Nodes that are no other's child.
fn roots(document: &Document<'_>) -> Vec<usize> {
    let mut is_child = vec![false; document.nodes.len()];
    for &child in document.nodes.iter().flat_map(|node| &node.children) {
        if let Some(is_child) = is_child.get_mut(child) {
            *is_child = true;
        }
    }
    (0..is_child.len()).filter(|&node| !is_child[node]).collect()
}

fn local(node: &Node) -> DMat4 {
    if let Some(matrix) = &node.matrix {
        return DMat4::from_cols_array(matrix);
    }
    let vector = |values: &Option<Box<[f64; 3]>>, default| values.as_deref().copied().unwrap_or(default);
    let rotation = node.rotation.as_deref().copied().unwrap_or(NO_TURN);
    placed(vector(&node.translation, [0.0; 3]), rotation, vector(&node.scale, [1.0; 3]))
}

/// The quaternion of no rotation.
const NO_TURN: [f64; 4] = [0.0, 0.0, 0.0, 1.0];

/// Scaled, then turned by a quaternion, then moved.
fn placed(translation: [f64; 3], rotation: [f64; 4], scale: [f64; 3]) -> DMat4 {
    let length = DVec4::from(rotation).length();
    let rotation = rotation.map(|part| part / length);
    let rotation = if length > 0.0 { DQuat::from_array(rotation) } else { DQuat::IDENTITY };
    let (scale, translation) = (DVec3::from(scale), DVec3::from(translation));
    let [x, y, z] = [rotation * DVec3::X, rotation * DVec3::Y, rotation * DVec3::Z];
    DMat4::from_cols(
        (x * scale.x).extend(0.0),
        (y * scale.y).extend(0.0),
        (z * scale.z).extend(0.0),
        translation.extend(1.0),
    )
}

/// The transforms of a node's copies of its mesh, as `EXT_mesh_gpu_instancing` lists them; at most `n_left`.
fn copies(
    document: &Document<'_>,
    buffers: &Buffers<'_>,
    attributes: &BTreeMap<String, usize>,
    n_left: &mut usize,
) -> Result<Vec<DMat4>, String> {
    let read = |name: &str, kind| {
        attributes.get(name).map(|&index| Elements::new(document, buffers, index, &[kind])).transpose()
    };
    let (translations, rotations) = (read("TRANSLATION", Kind::Vec3)?, read("ROTATION", Kind::Vec4)?);
    let scales = read("SCALE", Kind::Vec3)?;
    let all = [&translations, &rotations, &scales];
    let count = all.into_iter().flatten().map(|elements| elements.count).min().unwrap_or(0);
    *n_left = n_left.checked_sub(count).ok_or_else(|| format!("there are more than {MOST_COPIES}"))?;
    let vector = |elements: &Option<Elements<'_>>, k, default| {
        elements.as_ref().map_or(default, |elements| elements.get::<3>(k).map(f64::from))
    };
    let copy = |k: usize| {
        let rotation = rotations.as_ref().map_or(NO_TURN, |elements| elements.get::<4>(k).map(f64::from));
        placed(vector(&translations, k, [0.0; 3]), rotation, vector(&scales, k, [1.0; 3]))
    };
    Ok((0..count).map(copy).collect())
}

/// The transforms of a skeleton's joints; empty if it is damaged.
fn joints(document: &Document<'_>, buffers: &Buffers<'_>, transforms: &[DMat4], skin: usize) -> Vec<DMat4> {
    let Some(skin) = document.skins.get(skin) else { return Vec::new() };
    let inverse = skin.inverse_bind_matrices.map(|index| Elements::new(document, buffers, index, &[Kind::Mat4]));
    let joint = |(index, &node): (usize, &usize)| {
        let inverse = match &inverse {
            None => DMat4::IDENTITY,
            Some(Ok(matrices)) if index < matrices.count => {
                DMat4::from_cols_array(&matrices.get::<16>(index).map(f64::from))
            }
            Some(_) => return None,
        };
        Some(*transforms.get(node)? * inverse)
    };
    skin.joints.iter().enumerate().map(joint).collect::<Option<_>>().unwrap_or_default()
}
