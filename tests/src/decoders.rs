//! Every decoder on arbitrary bytes: no panic, no endless loop, no unbounded memory, and what it accepts is valid.
//!
//! `make fuzz` calls these with libFuzzer's inputs, `make test` with the kept corpus and mutations of it.

use std::sync::LazyLock;

use channel::{key::Key, secure};
use renderer::{
    formats::{
        companions::Companions,
        file::{Draft, Reading},
        gltf, images, obj, ply,
        sky::SkyImage,
        stl,
    },
    grid::GridOptions,
    model::{
        material::{Image, Material, Materials, TextureUse},
        mesh::Mesh,
        scene::LoadedMesh,
        statue,
    },
    render::scene::Scene,
    scene_file::file as scene_file,
};
use serde::{Serialize, de::DeserializeOwned};
use shared::{
    appearance::Appearance,
    camera::{Camera, CameraPath, CanvasPart, Views},
    codec::{self, BodyKind, CONTROL_LIMIT, HANDSHAKE_LIMIT, HEADER_BYTES, Header},
    detail::Detail,
    division::{Division, FrameSize, Part, Selection, Task, TileRun},
    marks::Marks,
    printable::printable_line,
    protocol::{CHUNK_BYTES, Chunk, Encoding, FrameSpec, LightingMode, SampleRange, ShadingMode, ToServer, ToWall},
    scene::{SceneId, Treatment},
};
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, duplex, split};

use crate::{
    frame_buffer::BufferPool,
    message,
    mpcdi_file::{
        archive::Archive,
        canvas::{self, Rough},
        convert::{self, Source},
        document::{Mpcdi, Profile},
        points::{self, Shape},
        view,
    },
    osc as osc_packet,
    show_file::Show,
    wall::{Wall, mesh::pfm::Pfm},
};

/// A decoder under test.
pub type Decoder = fn(&[u8]);

/// All decoders, with the names of their folders in `tests/corpus` and of their targets in `tests/fuzz`.
pub const ALL: [(&str, Decoder); 16] = [
    ("camera", camera),
    ("gltf", gltf),
    ("marks", marks),
    ("mpcdi", mpcdi),
    ("obj", obj),
    ("osc", osc),
    ("placement", placement),
    ("ply", ply),
    ("protocol", protocol),
    ("records", records),
    ("remote", remote),
    ("scene", scene),
    ("show", show),
    ("sky", sky),
    ("stl", stl),
    ("wall", wall),
];

/// The protocol's codec: a header and the message after it, in both directions.
pub fn protocol(data: &[u8]) {
    let Some((&header, rest)) = data.split_first_chunk::<HEADER_BYTES>() else { return };
    for limit in [HANDSHAKE_LIMIT, CONTROL_LIMIT] {
        // The header may claim any length, but the wire reads no more than the limit.
        let _ = Header::parse(header, limit).map(|header| assert!(header.n_bytes <= CONTROL_LIMIT));
    }
    if let Some(ToServer::RenderFrame { spec, task, .. }) = round_trip::<ToServer>(rest) {
        let _ = task.share(spec.size).map(|share| {
            let last = share.count().checked_sub(1);
            last.map(|last| assert!(share.unit(last) < share.units().count()))
        });
    }
    if let Some(ToWall::TaskDone { costs, .. }) = round_trip::<ToWall>(rest)
        && costs.fits(1000)
    {
        assert!(costs.runs(1000).all(|(units, _)| units.end <= 1000));
    }
    if let Ok(chunk) = Chunk::decode(rest) {
        let mut bytes = Vec::new();
        chunk.encode(Encoding::Raw, &mut bytes);
        assert_eq!(&bytes[HEADER_BYTES..], rest);
        let mut room = Vec::new();
        let unpacked = chunk.unpack(Encoding::Lz4, &mut room).ok();
        unpacked.into_iter().for_each(|chunk| assert!(chunk.rgb.len() <= CHUNK_BYTES));
        if chunk.rgb.len() <= CHUNK_BYTES {
            travels_as_lz4(&chunk);
        }
    }
}

/// Samples arrive unchanged as LZ4.
fn travels_as_lz4(chunk: &Chunk<'_>) {
    let (mut bytes, mut room) = (Vec::new(), Vec::new());
    chunk.encode(Encoding::Lz4, &mut bytes);
    let (header, body) = bytes.split_first_chunk::<HEADER_BYTES>().expect("a header comes first");
    let header = Header::parse(*header, CONTROL_LIMIT).expect("a header as it is written");
    let BodyKind::Samples(encoding) = header.kind else { panic!("samples are {:?}", header.kind) };
    let arrived = Chunk::decode(body).expect("a chunk").unpack(encoding, &mut room).expect("it unpacks").rgb.to_vec();
    assert_eq!(arrived, chunk.rgb);
}

/// A decoded message survives encoding and decoding.
fn round_trip<M: Serialize + DeserializeOwned>(body: &[u8]) -> Option<M> {
    let message: M = codec::decode(body).ok()?;
    let mut bytes = Vec::new();
    codec::encode(&message, &mut bytes).expect("a decoded message is short enough");
    let again: M = codec::decode(&bytes[HEADER_BYTES..]).expect("a message decodes");
    let mut bytes_again = Vec::new();
    codec::encode(&again, &mut bytes_again).expect("the same message");
    // Compare bytes, because a number may be NaN.
    assert_eq!(bytes, bytes_again);
    Some(message)
}

/// Images of the sky.
pub fn sky(data: &[u8]) {
    let Ok(image) = SkyImage::read_from(std::io::Cursor::new(data)) else { return };
    assert!(image.width == 2 * image.height && image.texels.len() == (image.width * image.height) as usize);
    assert!(image.texels.as_flattened().iter().all(|light| light.is_finite() && *light >= 0.0));
}

/// Placement of chunks' samples in a frame buffer.
pub fn placement(data: &[u8]) {
    let Some((&[kind, x, y, machine_idx, n_machines, part, n_parts, first, count, fill], rgb)) =
        data.split_first_chunk()
    else {
        return;
    };
    let Ok(size) = FrameSize::new(x.into(), y.into()) else { return };
    let (machine_idx, n_machines) = (u32::from(machine_idx), u32::from(n_machines));
    let strided = |division| Selection::Strided { division, machine_idx, n_machines };
    let selection = match kind % 4 {
        0 => strided(Division::Interleaved),
        1 => strided(Division::Tiled),
        2 => strided(Division::Dynamic),
        _ => Selection::CurveRun(TileRun { first: machine_idx, count: n_machines }),
    };
    let task = Task { selection, part: Part { index: part.into(), n_parts: n_parts.into() } };
    let Ok(share) = task.share(size) else { return };
    let spare = BufferPool::default();
    let buffer = std::sync::Arc::new(spare.take(size));
    // The byte's own number, or the largest possible one.
    let wide = |byte: u8| if byte == u8::MAX { u32::MAX } else { u32::from(byte) };
    let _ = buffer.place(&share, wide(first), wide(count), rgb);
    let whole: Vec<u8> = vec![fill; 3 * (0..share.count()).map(|k| share.samples(k).count() as usize).sum::<usize>()];
    buffer.place(&share, 0, share.count(), &whole).expect("all of a share fits");
    assert_eq!(buffer.size(), size);
    let samples = buffer.into_samples(spare);
    let n_filled = samples.iter().filter(|&&sample| sample == u32::from_ne_bytes([fill, fill, fill, 255])).count();
    assert!(n_filled >= whole.len() / 3, "{n_filled} samples of {} are placed", whole.len() / 3);
}

/// A camera file, a camera path, and a file of views.
pub fn camera(data: &[u8]) {
    let text = String::from_utf8_lossy(data);
    if let Ok(camera) = Camera::from_toml(&text) {
        assert_eq!(Camera::from_toml(&camera.to_toml()), Ok(camera));
    }
    match CameraPath::from_toml(&text) {
        Ok(path) => {
            let again = CameraPath::from_toml(&path.to_toml()).expect("a path that was written is read");
            assert_eq!((again.up(), again.keys()), (path.up(), path.keys()));
            let middle = path.at(path.duration_seconds() / 2.0);
            assert!(Camera::new(middle.eye(), middle.ll(), middle.u(), middle.v()).is_ok());
        }
        Err(error) => assert!(!error.to_string().contains('\n'), "{error}"),
    }
    match Views::from_toml(&text) {
        Ok(views) => assert_eq!(Views::from_toml(&views.to_toml()), Ok(views)),
        Err(error) => assert!(!error.to_string().contains('\n'), "{error}"),
    }
}

/// A file of marks, and the table of its measurements.
pub fn marks(data: &[u8]) {
    match Marks::from_toml(&String::from_utf8_lossy(data)) {
        Ok(marks) => {
            let printed = marks.to_toml();
            assert_eq!(Marks::from_toml(&printed).as_ref(), Ok(&marks), "{printed}");
            let texts = marks.annotations.iter().flat_map(|annotation| [annotation.label(), annotation.text()]);
            assert!(texts.into_iter().all(|text| !text.contains(char::is_control)));
            assert_eq!(marks.to_csv(None).lines().count(), 1 + marks.measurements.len());
        }
        Err(error) => assert!(!error.to_string().contains('\n'), "{error}"),
    }
}

/// A wall file.
pub fn wall(data: &[u8]) {
    let text = String::from_utf8_lossy(data);
    match Wall::from_toml("wall.toml", &text) {
        Ok(wall) => {
            assert!(wall.output_size().iter().all(|side| (1..=Wall::LARGEST_SIDE).contains(side)));
            let printed = wall.to_toml();
            let again = Wall::from_toml("printed.toml", &printed).expect("a printed wall is a wall file");
            assert_eq!(again.to_toml(), printed);
        }
        Err(error) => assert!(!error.to_string().contains('\n'), "{error}"),
    }
}

/// An MPCDI file, and the same as its document alone and as a warp.
pub fn mpcdi(data: &[u8]) {
    if let Ok(warp) = Pfm::read(data) {
        assert_eq!(warp.values.len(), warp.size[0] * warp.size[1]);
    }
    let is_line = |problem: &str| assert!(!printable_line(problem).contains('\n'));
    Mpcdi::read(&String::from_utf8_lossy(data)).err().iter().for_each(|problem| is_line(problem));
    let Ok(mut archive) = Archive::open(std::io::Cursor::new(data)) else { return };
    let Ok(document) = archive.document() else { return };
    let regions = &document.regions[..document.regions.len().min(4)];
    let mut warps = Vec::new();
    for region in regions {
        let Ok(warp) = archive.warp(&region.warp) else { return };
        let canvas_from = convert::in_picture(region);
        match convert::projector(Source { region, warp: &warp, canvas_from: &canvas_from }, [0, 0], "a.pfm") {
            Ok(projector) => drop(Wall::new([4.0, 2.0], FrameSize::PAPER, vec![projector])),
            Err(problem) => is_line(&problem),
        }
        warps.push(canvas::thin(region, &warp));
    }
    let maps: Vec<_> =
        regions.iter().map(|it| it.alpha.as_ref().and_then(|(path, gamma)| archive.light(path, *gamma).ok())).collect();
    let rough = Rough { regions, warps: &warps, maps: &maps };
    let places = match document.profile {
        Profile::Picture => return,
        Profile::View => view::places(None, &rough).map(|(places, _)| vec![places]),
        Profile::Space => {
            let shapes = [Shape::Flat, Shape::Cylinder, Shape::Fold, Shape::Dome];
            Ok(shapes.iter().filter_map(|shape| Some(points::places(*shape, &rough).ok()?.0)).collect())
        }
    };
    match places {
        Ok(places) => {
            let is_area = |[least, greatest]: [glam::DVec2; 2]| greatest.cmpgt(least).all();
            assert!(places.iter().filter_map(|places| rough.lit(places)).all(is_area));
        }
        Err(problem) => is_line(&problem),
    }
}

/// A show.
pub fn show(data: &[u8]) {
    let path = std::path::Path::new("show.toml");
    match Show::from_toml(&String::from_utf8_lossy(data), path) {
        Ok(show) => {
            let printed: String = show.scenes.iter().map(|scene| scene.to_toml(path)).collect();
            let again = Show::from_toml(&printed, path).expect("a printed scene is one of a show");
            assert_eq!(again.scenes, show.scenes);
        }
        Err(problem) => assert!(!problem.contains('\n'), "{problem}"),
    }
}

/// A packet of a controller of shows.
pub fn osc(data: &[u8]) {
    let mut n_messages = 0;
    osc_packet::decode(data, &mut |outcome| {
        n_messages += 1;
        check_action(outcome);
    });
    assert!(n_messages <= data.len() / 8 + 1, "{n_messages} messages");
}

/// A remote's message.
pub fn remote(data: &[u8]) {
    check_action(message::decode(data).map(|message| message.action));
}

/// An action is within its limits, and a fault is one line.
fn check_action(outcome: Result<message::Action, String>) {
    match outcome {
        Ok(action) => {
            use message::Action::*;
            let numbers = match action {
                Orbit { x, y } | Pan { x, y } | GoTo { x, y } => [x, y, 0.0],
                Dolly { factor, x, y } => [x, y, factor],
                Roll { degrees } => [degrees, 0.0, 0.0],
                _ => [0.0; 3],
            };
            assert!(numbers.iter().all(|number| number.abs() <= 360.0), "{numbers:?}");
            if let Open { model } = action {
                assert_eq!(std::path::Path::new(&model).components().count(), 1, "{model} is in another folder");
            }
        }
        Err(problem) => assert!(!problem.contains('\n'), "{problem}"),
    }
}

/// A PLY file.
pub fn ply(data: &[u8]) {
    ply::read_from(data, data.len() as u64).into_iter().for_each(check_model);
}

/// An OBJ file, and the same as a file of materials.
pub fn obj(data: &[u8]) {
    obj::read_from(data, data.len() as u64, &Companions::default()).into_iter().for_each(check_model);
    let mut library = obj::Library::default();
    library.read(data, "");
    let textures = library
        .materials
        .iter()
        .flat_map(|it| [it.base_color_texture, it.metallic_roughness_texture, it.emissive_texture])
        .flatten();
    textures.for_each(|texture| assert!((texture.image as usize) < library.images.len()));
}

/// An STL file, as text and as binary.
pub fn stl(data: &[u8]) {
    stl::read_text(data).into_iter().for_each(check_model);
    stl::read_binary(data, data.len() as u64).into_iter().for_each(check_model);
}

/// A glTF or a GLB, with the images in it.
pub fn gltf(data: &[u8]) {
    let n_bytes = data.len() as u64;
    gltf::read_text(data, n_bytes, &Companions::default()).into_iter().for_each(check_model);
    gltf::read_binary(data, n_bytes, &Companions::default()).into_iter().for_each(check_model);
}

/// A scene file: these bytes themselves, or a small scene's file after changes, with hashes that fit. What is accepted is
/// traced.
pub fn scene(data: &[u8]) {
    static WHOLE: LazyLock<Vec<u8>> = LazyLock::new(small_scene);
    let Some((&kind, changes)) = data.split_first() else { return };
    let file = if kind % 4 == 0 {
        changes.to_vec()
    } else {
        let mut file = WHOLE.clone();
        for &[what, high, middle, low] in changes.as_chunks::<4>().0.iter().take(16) {
            let at = u32::from_be_bytes([0, high, middle, low]) as usize % file.len();
            let last = (at + 1 + usize::from(what >> 6)).min(file.len());
            match what % 5 {
                0 => file[at] ^= 1 << (what >> 5),
                1 => file[at..last].fill(0),
                2 => file[at..last].fill(0xff),
                3 => file[at] = file[at].wrapping_add(1),
                _ => file.copy_within(last.., at),
            }
        }
        file
    };
    let repaired = scene_file::with_hashes(file.clone());
    for file in repaired.into_iter().chain([file]) {
        let Ok((info, scene)) = scene_file::from_bytes(&file) else { continue };
        let spec = FrameSpec {
            scene: info.id,
            camera: Camera::view_all(&info.shape, info.shape.up, 2.0, CanvasPart::WHOLE),
            size: FrameSize::new(16, 8).expect("a small frame"),
            view: ShadingMode::Shaded,
            rays: LightingMode::AmbientOcclusion,
            samples: SampleRange::CENTRE,
            detail: Detail::FULL,
            appearance: Appearance::default(),
        };
        assert_eq!(scene.render_frame(&spec).0.len(), 16 * 8 * 3);
    }
}

/// The file of a statue of several leaves, with normals and a texture.
fn small_scene() -> Vec<u8> {
    let mesh = statue::generate(1200, &|_| ());
    let texture = TextureUse { image: 0, wrap: Default::default(), transform: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]] };
    let material = Material { base_color_texture: Some(texture), alpha_cutoff: Some(0.5), ..Material::default() };
    let image = Image { width: 4, height: 2, texels: (0..8).map(|texel| [texel * 30; 4]).collect() };
    let materials = Materials { materials: vec![material], images: vec![image], of_triangles: Vec::new() };
    let texture_coordinates = mesh.vertices.iter().map(|&[x, y, _]| [x, y]).collect();
    let mesh = Mesh { texture_coordinates, materials, ..mesh };
    let id = SceneId::Statue { triangles: 1200, treatment: Treatment::default() };
    let loaded = LoadedMesh { id, mesh, left_out: Vec::new(), sources: None }.treated();
    let info = loaded.info(true);
    let mut scene = Scene::build(loaded.mesh, &GridOptions::default(), &|_| ());
    scene_file::to_bytes(&mut scene, &info).expect("it has the default storage")
}

/// A reader accepts only sound meshes, also with their images.
fn check_model(draft: Draft) {
    let Reading { mesh, remarks } = images::decode(draft, &Companions::default());
    let is_sound = |triangle: &[u32; 3]| triangle.iter().all(|&index| (index as usize) < mesh.vertices.len());
    let n_rejected = mesh.triangles.iter().filter(|&&triangle| triangle == Mesh::REJECTED).count();
    assert_eq!(n_rejected, mesh.n_rejected);
    assert!(mesh.triangles.iter().all(|triangle| *triangle == Mesh::REJECTED || is_sound(triangle)));
    assert!(mesh.origin.is_finite());
    let is_whole = |n_items: usize| n_items == 0 || n_items == mesh.vertices.len();
    assert!([mesh.colors.len(), mesh.normals.len(), mesh.texture_coordinates.len()].into_iter().all(is_whole));
    let Materials { materials, images, of_triangles } = &mesh.materials;
    assert!(of_triangles.is_empty() || of_triangles.len() == mesh.triangles.len());
    assert!(of_triangles.iter().all(|&material| usize::from(material) < materials.len()));
    for material in materials {
        let textures = [material.base_color_texture, material.metallic_roughness_texture, material.emissive_texture];
        assert!(textures.into_iter().flatten().all(|texture| (texture.image as usize) < images.len()));
    }
    assert!(images.iter().all(|image| image.texels.len() as u64 == u64::from(image.width) * u64::from(image.height)));
    assert!(remarks.iter().all(|remark| remark.len() < 1 << 20));
}

/// The encrypted channel: a stranger's handshake, or a friend's records that are changed on the way.
pub fn records(data: &[u8]) {
    let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime of one thread");
    let Some((&kind, data)) = data.split_first() else { return };
    runtime.block_on(async {
        if kind % 4 == 0 {
            let (mut stranger, wall) = duplex(1 << 16);
            let (input, output) = split(wall);
            let said = &data[..data.len().min(1 << 15)];
            stranger.write_all(said).await.expect("there is room");
            stranger.shutdown().await.expect("a pipe ends");
            let key = Key::random().expect("random numbers");
            assert!(secure::accept(input, output, &key).await.is_err(), "a stranger gets in");
        } else {
            tampered(data).await;
        }
    });
}

/// Records that are changed on the way: the receiver gets a prefix of what was sent.
async fn tampered(tampering: &[u8]) {
    let key = Key::random().expect("random numbers");
    let (server_end, mut server_wire) = duplex(1 << 18);
    let (wall_end, mut wall_wire) = duplex(1 << 18);
    let (server_in, server_out) = split(server_end);
    let (wall_in, wall_out) = split(wall_end);
    let between = async {
        forward(&mut server_wire, &mut wall_wire, 56).await;
        forward(&mut wall_wire, &mut server_wire, 56).await;
        forward(&mut server_wire, &mut wall_wire, 16).await;
    };
    let (server, wall, ()) =
        tokio::join!(secure::connect(server_in, server_out, &key), secure::accept(wall_in, wall_out, &key), between);
    let ((_, mut speaker), (mut listener, _wall_out)) = (server.expect("a friend"), wall.expect("a friend"));
    let said: Vec<u8> = (0..40_000_u32).map(|index| (index * 7) as u8).collect();
    for part in said.chunks(20_000) {
        speaker.write_all(part).await.expect("there is room");
        speaker.flush().await.expect("there is room");
    }
    speaker.shutdown().await.expect("a pipe ends");
    let mut sealed = Vec::new();
    server_wire.read_to_end(&mut sealed).await.expect("all of it is there");
    for &[what, high, low] in tampering.as_chunks::<3>().0.iter().take(16) {
        if sealed.is_empty() {
            break;
        }
        let at = (usize::from(high) << 8 | usize::from(low)) % sealed.len();
        match what % 5 {
            0 => sealed[at] ^= 1 << (what >> 5),
            1 => sealed.truncate(at),
            2 => sealed.extend_from_within(..at),
            3 => sealed.rotate_left(at),
            _ => sealed[at..].fill(what),
        }
    }
    sealed.truncate(1 << 17);
    wall_wire.write_all(&sealed).await.expect("there is room");
    wall_wire.shutdown().await.expect("a pipe ends");
    let mut heard = Vec::new();
    let ended = listener.read_to_end(&mut heard).await;
    assert!(said.starts_with(&heard), "bytes arrive that were never sent");
    assert!(!tampering.is_empty() || ended.is_ok() && heard == said, "unchanged records do not arrive whole");
}

async fn forward(from: &mut DuplexStream, to: &mut DuplexStream, n_bytes: usize) {
    let mut bytes = vec![0; n_bytes];
    from.read_exact(&mut bytes).await.expect("a handshake");
    to.write_all(&bytes).await.expect("there is room");
}
