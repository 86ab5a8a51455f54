//! Tiles of textures (UDIM): images whose names differ by a number, each for one unit square of texture coordinates.
//!
//! Tile 1001 + i + 10 j shows u from i to i + 1 and v, counted from the lower edge, from j to j + 1, as Mari and Blender
//! number them. Each tile that a material's triangles use becomes a material of its own.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    ops::Range,
};

use rayon::prelude::*;

use crate::{
    formats::{
        companions::Companions,
        file::Draft,
        images::{Channels, ImageSource},
    },
    model::{
        material::{Material, TextureUse, Wrap},
        mesh::Mesh,
    },
};

/// The number of a tile, from [`FIRST`].
type Tile = u16;

const FIRST: Tile = 1001;
const TILES_PER_ROW: u16 = 10;
/// As many as Blender reads: up to tile 2000.
const MOST_ROWS: u16 = 100;
/// Stands for the number in the names of programs that know tiles, in any case of letters.
const MARK: &str = "<udim>";
/// The number itself, in the names of others.
const FIRST_NUMBER: &str = "1001";
/// Tiles of a name with [`FIRST_NUMBER`] that are looked for, to tell whether it is one of several.
const MOST_TRIED: usize = 16;
/// Materials that triangles can name.
const MOST_MATERIALS: usize = 1 << 16;

/// Gives each tile that a mesh uses a material of its own. A texture has tiles if its name has the mark `<UDIM>`, or ends in
/// 1001 while the file of another tile that the mesh uses is there.
///
/// Triangles outside all tiles keep their material without these textures.
pub(super) fn divide(mut draft: Draft, companions: &Companions) -> Draft {
    if !draft.images.iter().any(|source| place_of_number(&source.name).is_some()) {
        return draft;
    }
    let tiles: Vec<_> = (0..draft.mesh.triangles.len()).into_par_iter().map(|it| tile_of(&draft.mesh, it)).collect();
    let look = &mut draft.mesh.materials;
    let material_of = |triangle: usize| look.of_triangles.get(triangle).copied().unwrap_or(0);

    // Find the tiles of each material and texture.
    let mut used: BTreeSet<(u16, Option<Tile>)> = BTreeSet::new();
    let mut last = None;
    for (triangle, &tile) in tiles.iter().enumerate() {
        let key = (material_of(triangle), tile);
        if last.replace(key) != Some(key) {
            used.insert(key);
        }
    }
    let mut of_images = vec![BTreeSet::new(); draft.images.len()];
    for &(material, tile) in &used {
        for texture in look.materials.get(usize::from(material)).into_iter().flat_map(textures) {
            of_images[texture.image as usize].extend(tile);
        }
    }
    let has_tiles: Vec<_> =
        draft.images.iter().zip(&of_images).map(|(source, used)| has_tiles(source, used, companions)).collect();
    if !has_tiles.contains(&true) {
        return draft;
    }
    let is_divided = |material: &Material| textures(material).any(|texture| has_tiles[texture.image as usize]);
    let is_divided: Vec<_> = look.materials.iter().map(is_divided).collect();
    used.retain(|&(material, _)| is_divided.get(usize::from(material)).is_some_and(|&it| it));

    // The first tile of a material takes its place, others follow.
    let fits = used.len() + look.materials.len() <= MOST_MATERIALS;
    let mut images = Images { sources: &draft.images, has_tiles: &has_tiles, kept: Vec::new(), places: HashMap::new() };
    let mut materials: Vec<_> = look.materials.iter().map(|material| images.material_of_tile(material, None)).collect();
    let mut numbers = BTreeMap::new();
    let mut before = None;
    for &(number, tile) in used.iter().filter(|_| fits) {
        let material = images.material_of_tile(&look.materials[usize::from(number)], tile);
        if before.replace(number) == Some(number) {
            numbers.insert((number, tile), materials.len() as u16);
            materials.push(material);
        } else {
            numbers.insert((number, tile), number);
            materials[usize::from(number)] = material;
        }
    }
    let number_of = |triangle: usize| {
        let number = material_of(triangle);
        numbers.get(&(number, tiles[triangle])).copied().unwrap_or(number)
    };
    let of_triangles = (materials.len() > 1).then(|| (0..tiles.len()).into_par_iter().map(number_of).collect());
    let is_outside = |&triangle: &usize| tiles[triangle].is_none() && is_divided[usize::from(material_of(triangle))];
    let n_outside = (0..tiles.len()).filter(is_outside).count();
    if !fits {
        let remark = format!("tiles of textures are left out: with its materials they are more than {MOST_MATERIALS}");
        draft.remarks.push(remark);
    } else if n_outside > 0 {
        let told = format!("triangles outside the tiles of their textures are plain: {n_outside} of {}", tiles.len());
        draft.remarks.push(told);
    }
    draft.images = images.kept;
    (look.materials, look.of_triangles) = (materials, of_triangles.unwrap_or_default());
    draft
}

fn textures(material: &Material) -> impl Iterator<Item = TextureUse> {
    let Material { base_color_texture, metallic_roughness_texture, emissive_texture, .. } = material;
    [*base_color_texture, *metallic_roughness_texture, *emissive_texture].into_iter().flatten()
}

/// The tile of a triangle's centre; on the edge between two, the lower one. `None` outside all tiles, and without texture
/// coordinates.
fn tile_of(mesh: &Mesh, triangle: usize) -> Option<Tile> {
    let corners = mesh.triangles[triangle].map(|vertex| mesh.texture_coordinates.get(vertex as usize));
    let [Some(a), Some(b), Some(c)] = corners else { return None };
    let centre = [0, 1].map(|axis| (f64::from(a[axis]) + f64::from(b[axis]) + f64::from(c[axis])) / 3.0);
    let [u, v_from_top] = centre;
    let [column, row] = [u, 1.0 - v_from_top].map(|x| if x == 0.0 { 0.0 } else { x.ceil() - 1.0 });
    let is_tile = (0.0..f64::from(TILES_PER_ROW)).contains(&column) && (0.0..f64::from(MOST_ROWS)).contains(&row);
    is_tile.then(|| FIRST + column as u16 + TILES_PER_ROW * row as u16)
}

/// Whether a texture has tiles, of which the mesh uses those of these numbers.
fn has_tiles(source: &ImageSource, used: &BTreeSet<Tile>, companions: &Companions) -> bool {
    let is_there = |&tile: &Tile| companions.find(&source.folder, &named(&source.name, tile)).is_ok();
    let mut others = used.iter().filter(|&&tile| tile != FIRST).take(MOST_TRIED);
    place_of_mark(&source.name).is_some() || place_of_number(&source.name).is_some() && others.any(is_there)
}

fn place_of_mark(name: &str) -> Option<Range<usize>> {
    // Only ASCII letters change, so all keep their places.
    let start = name.to_ascii_lowercase().find(MARK)?;
    Some(start..start + MARK.len())
}

/// The place of a tile's number in a name: the mark's, or that of the first tile's number before the extension.
fn place_of_number(name: &str) -> Option<Range<usize>> {
    place_of_mark(name).or_else(|| {
        let start = name.rfind(['/', '\\']).map_or(0, |slash| slash + 1);
        let end = name[start..].rfind('.').map_or(name.len(), |dot| start + dot);
        let before = name[start..end].strip_suffix(FIRST_NUMBER)?;
        let is_number = !before.ends_with(|letter: char| letter.is_ascii_digit());
        is_number.then_some(start + before.len()..end)
    })
}

/// The name of a tile's file.
fn named(name: &str, tile: Tile) -> String {
    match place_of_number(name) {
        Some(Range { start, end }) => format!("{}{tile}{}", &name[..start], &name[end..]),
        None => name.to_owned(),
    }
}

/// The images of tiles, each once.
struct Images<'a> {
    sources: &'a [ImageSource],
    has_tiles: &'a [bool],
    kept: Vec<ImageSource>,
    /// Those of images without tiles, and of tiles.
    places: HashMap<(u32, Option<Tile>), u32>,
}

impl Images<'_> {
    /// A material as a tile shows it; without one, it has no textures with tiles.
    fn material_of_tile(&mut self, material: &Material, tile: Option<Tile>) -> Material {
        let mut material = material.clone();
        material.keep_textures(|texture| self.texture_of_tile(texture, tile));
        material
    }

    fn texture_of_tile(&mut self, texture: TextureUse, tile: Option<Tile>) -> Option<TextureUse> {
        let (number, source) = (texture.image, self.sources.get(texture.image as usize)?);
        let tile = self.has_tiles[number as usize].then_some(tile);
        let kept = &mut self.kept;
        let mut place = |tile: Option<Tile>| {
            *self.places.entry((number, tile)).or_insert_with(|| {
                kept.push(tile.map_or_else(|| source.clone(), |tile| source_of_tile(source, tile)));
                kept.len() as u32 - 1
            })
        };
        let Some(tile) = tile else { return Some(TextureUse { image: place(None), ..texture }) };
        let tile = tile?;
        // The tile's square becomes 0 to 1, from where the neighbours' texels must not be repeated.
        let (column, row) = ((tile - FIRST) % TILES_PER_ROW, (tile - FIRST) / TILES_PER_ROW);
        let moved = |[u, v, one]: [f32; 3]| [u, v, one - u * f32::from(column) + v * f32::from(row)];
        let transform = texture.transform.map(moved);
        Some(TextureUse { image: place(Some(tile)), wrap: [Wrap::Clamp; 2], transform })
    }
}

fn source_of_tile(source: &ImageSource, tile: Tile) -> ImageSource {
    let channels = match &source.channels {
        Channels::Coverage(other) => Channels::Coverage(named(other, tile)),
        Channels::RoughnessAndMetallic(other) => Channels::RoughnessAndMetallic(named(other, tile)),
        channels => channels.clone(),
    };
    ImageSource { name: named(&source.name, tile), channels, ..source.clone() }
}

#[cfg(test)]
mod tests {
    use std::{collections::BTreeMap, fs, path::Path};

    use image::{Rgb, RgbImage};

    use super::*;
    use crate::formats::file::{self, Reading};

    /// Writes an image of one colour.
    fn write(folder: &Path, name: &str, grey: u8) {
        RgbImage::from_pixel(2, 2, Rgb([grey; 3])).save(folder.join(name)).unwrap();
    }

    /// Reads an OBJ of one triangle around each point of a texture.
    fn read(folder: &Path, library: &str, points: &[[f32; 2]]) -> Reading {
        let rows = points.iter().zip(0..).map(|([u, v], i)| {
            let at = 3 * i + 1;
            let corners = format!("v {i} 0 0\nv {i} 1 0\nv {i} 0 1\n");
            let on_texture = format!("vt {} {}\nvt {} {}\nvt {} {}\n", u - 0.1, v - 0.1, u + 0.1, v - 0.1, u, v + 0.2);
            format!("{corners}{on_texture}f {at}/{at} {0}/{0} {1}/{1}\n", at + 1, at + 2)
        });
        fs::write(folder.join("a.mtl"), library).unwrap();
        fs::write(folder.join("a.obj"), format!("mtllib a.mtl\nusemtl a\n{}", rows.collect::<String>())).unwrap();
        file::read(&folder.join("a.obj"), &|_| ()).unwrap()
    }

    /// The material of each triangle.
    fn materials(reading: &Reading) -> Vec<&Material> {
        let look = &reading.mesh.materials;
        let number = |triangle: usize| look.of_triangles.get(triangle).copied().unwrap_or(0);
        (0..reading.mesh.triangles.len()).map(|triangle| &look.materials[usize::from(number(triangle))]).collect()
    }

    /// The grey of the image that each triangle shows, if it shows one, and the point at its centre.
    fn shown(reading: &Reading) -> Vec<Option<(u8, [f32; 2], Wrap)>> {
        let mesh = &reading.mesh;
        let shown = |(triangle, material): (usize, &&Material)| {
            let TextureUse { image, wrap, transform } = material.base_color_texture?;
            let corners = mesh.triangles[triangle].map(|vertex| mesh.texture_coordinates[vertex as usize]);
            let [u, v] = [0, 1].map(|axis| corners.iter().map(|corner| corner[axis]).sum::<f32>() / 3.0);
            let at = transform.map(|[by_u, by_v, one]| ((by_u * u + by_v * v + one) * 1000.0).round() / 1000.0);
            Some((mesh.materials.images[image as usize].texels[0][0], at, wrap[0]))
        };
        materials(reading).iter().enumerate().map(shown).collect()
    }

    #[test]
    fn each_tile_shows_its_image() {
        let folder = tempfile::tempdir().unwrap();
        for (name, grey) in [("a.1001.png", 1), ("a.1002.png", 2), ("a.1011.png", 11), ("a.2000.png", 200)] {
            write(folder.path(), name, grey);
        }
        let points = [[0.5, 0.25], [1.5, 0.5], [0.25, 1.75], [9.5, 99.5], [2.5, 0.5], [-0.5, 0.5], [1.25, 0.5]];
        let reading = read(folder.path(), "newmtl a\nKd 0.5 0.5 0.5\nmap_Kd a.<udim>.png\n", &points);
        let clamped = |grey, u: f32, v| Some((grey, [u, v], Wrap::Clamp));
        let [first, right, above, last] =
            [clamped(1, 0.5, 0.75), clamped(2, 0.5, 0.5), clamped(11, 0.25, 0.25), clamped(200, 0.5, 0.5)];
        assert_eq!(shown(&reading), [first, right, above, last, None, None, clamped(2, 0.25, 0.5)]);
        assert!(materials(&reading).iter().all(|material| material.base_color == [0.5, 0.5, 0.5, 1.0]));
        assert_eq!(
            reading.remarks,
            [
                "triangles outside the tiles of their textures are plain: 1 of 7",
                "an image is left out: a.1003.png is missing: put it beside the model"
            ]
        );
        let images = &reading.mesh.materials.images;
        assert_eq!((images.len(), reading.mesh.materials.materials.len()), (4, 6), "each once");
    }

    #[test]
    fn a_number_in_a_name_is_a_tile_s_if_others_are_there() {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), "a_1001.png", 1);
        let library = "newmtl unused\nmap_Kd b.<UDIM>.png\nnewmtl a\nmap_Kd C:\\scans\\a_1001.png\n";
        let points = [[0.5, 0.5], [1.5, 0.5]];
        let repeated = Some((1, [0.5, 0.5], Wrap::Repeat));
        let reading = read(folder.path(), library, &points);
        assert_eq!((shown(&reading)[0], reading.remarks.len()), (repeated, 0));
        write(folder.path(), "a_1002.png", 2);
        let tile = |grey| Some((grey, [0.5, 0.5], Wrap::Clamp));
        assert_eq!(shown(&read(folder.path(), library, &points)), [tile(1), tile(2)]);
        // It repeats nothing, so it may be another object's.
        assert_eq!(shown(&read(folder.path(), library, &points[..1])), [repeated]);
        for (name, is_one) in [("1001", true), ("b/c 1001.tif", true), ("21001.png", false), ("1001.b.png", false)] {
            assert_eq!(place_of_number(name).is_some(), is_one, "{name}");
        }
    }

    #[test]
    fn every_kind_of_texture_may_have_tiles() {
        let folder = tempfile::tempdir().unwrap();
        for (name, grey) in [("c.1002.png", 9), ("r.1002.png", 8), ("m.1002.png", 7), ("d.1002.png", 6), ("e.png", 5)] {
            write(folder.path(), name, grey);
        }
        let library = "newmtl a\nKd 0 0 0\nmap_Kd c.<UDIM>.png\nmap_Pr r.<UDIM>.png\nmap_Pm m.<UDIM>.png\n\
            map_d d.<UDIM>.png\nmap_Ke e.png\n";
        let Reading { mesh, remarks } = read(folder.path(), library, &[[1.5, 0.5], [1.5, 1.5]]);
        let texels = |texture: Option<TextureUse>| {
            let texture = texture?;
            Some((mesh.materials.images[texture.image as usize].texels[0], texture.wrap[0]))
        };
        let found: BTreeMap<_, _> = (mesh.materials.materials.iter().enumerate())
            .map(|(number, it)| (number, [it.base_color_texture, it.metallic_roughness_texture, it.emissive_texture]))
            .collect();
        let glow = Some(([5, 5, 5, 255], Wrap::Repeat));
        let whole = [Some(([9, 9, 9, 6], Wrap::Clamp)), Some(([0, 8, 7, 255], Wrap::Clamp)), glow];
        assert_eq!((found[&0].map(texels), found[&1].map(texels)), (whole, [None, None, glow]));
        assert_eq!(mesh.materials.materials[1].base_color, [1.0; 4], "no black surface");
        assert!(remarks.iter().all(|remark| remark.contains(".1012.png is missing")), "{remarks:?}");
    }

    #[test]
    fn centres_on_edges_belong_to_the_lower_tile() {
        let mesh = |[u, v]: [f32; 2]| Mesh {
            triangles: vec![[0; 3]],
            texture_coordinates: vec![[u, 1.0 - v]],
            ..Mesh::default()
        };
        for (at, tile) in [
            ([0.0, 0.0], Some(1001)),
            ([0.0, 1.0], Some(1001)),
            ([1.0, 1.0], Some(1001)),
            ([1.25, 2.0], Some(1012)),
            ([10.0, 0.5], Some(1010)),
            ([10.25, 0.5], None),
            ([0.5, 100.5], None),
            ([-0.25, 0.5], None),
            ([f32::NAN, 0.5], None),
            ([0.5, f32::INFINITY], None),
        ] {
            assert_eq!(tile_of(&mesh(at), 0), tile, "{at:?}");
        }
        let rejected = Mesh { triangles: vec![Mesh::REJECTED], ..mesh([0.5; 2]) };
        assert_eq!(tile_of(&rejected, 0), None);
    }
}
