//! Scenes in files give the same pictures, and nothing that a file holds does harm.

use std::{
    fs,
    path::{Path, PathBuf},
    sync::{Arc, Barrier},
    thread,
    time::{Duration, SystemTime},
};

use glam::Vec3;
use shared::{
    camera::{Camera, CanvasPart},
    detail::Detail,
    division::FrameSize,
    protocol::{FrameSpec, LightingMode, SampleRange, ShadingMode},
    scene::{Crease, SceneId, Treatment},
};

use super::{
    cache::Cache,
    fault::Fault,
    file::{self, SceneFile},
    store::{Stage, StoredScene, build_file},
    *,
};
use crate::{
    formats::ply,
    grid::{GridOptions, MemoryBudget, Storage},
    intersect::ray::Ray,
    model::{
        material::{Image, Material, Materials, TextureUse, Wrap},
        mesh::Mesh,
        scene::{LoadedMesh, ModelInfo, SceneSource},
        statue,
    },
    render::scene::Scene,
};

/// A statue with smooth normals and colours, half of it with a texture and a mask, and with metal.
fn looks() -> Mesh {
    let mesh = statue::generate(20_000, &|_| ()).smooth(Crease::default());
    let texture =
        |image| Some(TextureUse { image, wrap: [Wrap::Mirror, Wrap::Clamp], transform: [[0.3, 0.1, 0.0]; 2] });
    let images = [(64, 32), (7, 5)].map(|(width, height)| {
        let texel = |at: u32| [at as u8, (at >> 3) as u8, (at * 7) as u8, (at * 5) as u8];
        Image { width, height, texels: (0..width * height).map(texel).collect() }
    });
    let masked =
        Material { base_color_texture: texture(0), alpha_cutoff: Some(0.3), roughness: 0.4, ..Material::default() };
    let metal = Material { metallic: 0.9, metallic_roughness_texture: texture(1), ..Material::default() };
    let materials = Materials {
        materials: vec![masked, metal],
        images: images.into(),
        of_triangles: (0..mesh.triangles.len()).map(|triangle| (triangle / 64 % 2) as u16).collect(),
    };
    Mesh {
        colors: mesh.vertices.iter().map(|vertex| vertex.map(|x| x.to_bits().to_be_bytes()[2])).collect(),
        texture_coordinates: mesh.vertices.iter().map(|[x, y, _]| [*x, *y]).collect(),
        materials,
        ..mesh
    }
}

/// A scene of a mesh, which never was in a file.
fn scene_of(mesh: Mesh, options: &GridOptions) -> (ModelInfo, Scene) {
    let id = SceneId::Statue { triangles: 20_000, treatment: Treatment::default() };
    let info = LoadedMesh { id, mesh: mesh.clone(), left_out: vec!["a line".into()], sources: None }.info(true);
    (info, Scene::build(mesh, options, &|_| ()))
}

fn picture(scene: &Scene, info: &ModelInfo) -> Vec<u8> {
    let spec = FrameSpec {
        scene: info.id,
        camera: Camera::view_all(&info.shape, info.shape.up, 2.0, CanvasPart::WHOLE),
        size: FrameSize::new(128, 64).unwrap(),
        view: ShadingMode::Shaded,
        rays: LightingMode::AmbientOcclusion,
        samples: SampleRange::CENTRE,
        detail: Detail::FULL,
        appearance: Default::default(),
    };
    scene.render_frame(&spec).0
}

#[test]
fn a_scene_from_a_file_gives_the_same_bits() {
    let few = GridOptions { memory_budget: "16M".parse().unwrap(), ..GridOptions::default() };
    for (mesh, options) in [
        (looks(), GridOptions::default()),
        (statue::generate(3000, &|_| ()), GridOptions { density: Some(0.5), ..GridOptions::default() }),
        (looks().snapped(14.try_into().unwrap()), GridOptions::default()),
        (looks(), GridOptions { storage: Storage::Compact, ..GridOptions::default() }),
        // Its hierarchy lies over leaves.
        (statue::generate(60_000, &|_| ()), few),
    ] {
        let (info, mut scene) = scene_of(mesh, &options);
        let bytes = file::to_bytes(&mut scene, &info).unwrap();
        let (info_again, again) = file::from_bytes(&bytes).unwrap();
        assert_eq!(info_again, info);
        assert_eq!((again.n_bytes(), again.grid.structure()), (scene.n_bytes(), scene.grid.structure()));
        assert_eq!(again.grid.is_limited(), scene.grid.is_limited());
        assert!(picture(&again, &info) == picture(&scene, &info), "the pictures differ");
    }
}

#[test]
fn stand_ins_come_back_from_a_file_and_wrong_ones_are_refused() {
    let mesh = statue::generate(20_000, &|_| ()).smooth(Crease::default());
    let (info, _) = scene_of(mesh.clone(), &GridOptions::default());
    let mut scene = Scene::build_with_stand_ins(mesh, 1, &GridOptions::default(), &|_| ());
    let bytes = file::to_bytes(&mut scene, &info).unwrap();
    let (_, again) = file::from_bytes(&bytes).unwrap();
    let sizes: Vec<_> = scene.stand_in_sizes().collect();
    assert!(sizes.len() > 2 && again.stand_in_sizes().eq(sizes.iter().copied()), "{sizes:?}");
    for (side, _) in sizes {
        let detail = Detail::try_from(side).unwrap();
        assert!(picture(again.at(detail), &info) == picture(scene.at(detail), &info), "{side}");
    }
    assert!(picture(&again, &info) == picture(&scene, &info));

    scene.stand_ins.reverse();
    let wrong = file::to_bytes(&mut scene, &info).unwrap();
    assert!(file::from_bytes(&wrong).is_err_and(|fault| fault.to_string().contains("stand-ins")));
}

#[test]
fn other_storages_have_no_files() {
    let options = GridOptions { storage: Storage::Plain, ..GridOptions::default() };
    let (info, mut scene) = scene_of(statue::generate(2000, &|_| ()), &options);
    assert!(
        file::to_bytes(&mut scene, &info).unwrap_err().to_string().ends_with("leave --storage out, or make it compact")
    );
}

/// Follows rays of every kind through a scene.
fn trace(scene: &Scene, info: &ModelInfo) {
    let _ = picture(scene, info);
    let rays: Vec<_> =
        (0..64).map(|n| Ray::new(Vec3::new(0.1, 1.5, 5.0), Vec3::new(n as f32 * 0.01, 0.0, -1.0))).collect();
    rays.iter().for_each(|ray| scene.grid.for_each_candidate(ray, |_| ()));
}

#[test]
fn changed_contents_with_right_hashes_are_refused_or_harmless() {
    let files = [looks(), looks().snapped(12.try_into().unwrap())].map(|mesh| {
        let (info, mut scene) = scene_of(mesh, &GridOptions::default());
        file::to_bytes(&mut scene, &info).unwrap()
    });
    let (mut n_refused, mut n_harmless) = (0, 0);
    let mut state = 1u64;
    for nth in 0..400 {
        let bytes = &files[nth % 2];
        let mut changed = bytes.clone();
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let at = (state >> 20) as usize % bytes.len();
        let value = [0, 0xff, 0x80, (state >> 8) as u8][(state >> 60) as usize % 4];
        let last = (at + 1 + (state >> 56) as usize % 4).min(bytes.len());
        changed[at..last].fill(value);
        let Some(changed) = file::with_hashes(changed) else { continue };
        match file::from_bytes(&changed) {
            Ok((info, scene)) => {
                trace(&scene, &info);
                n_harmless += 1;
            }
            Err(fault) => {
                assert!(!fault.to_string().contains('\n'));
                n_refused += 1;
            }
        }
    }
    assert!(n_refused > 30 && n_harmless > 30, "{n_refused} are refused, {n_harmless} traced");
}

/// The bytes of a scene with another number at the beginning of a section.
fn with_number(bytes: &[u8], section: &str, number: u32) -> Vec<u8> {
    let head = head::Head::from_bytes(bytes, bytes.len() as u64).unwrap();
    let range = (0..head.n_sections()).find_map(|nth| head.section(nth, section)).expect("the section");
    let mut changed = bytes.to_vec();
    changed[range.start..range.start + 4].copy_from_slice(&number.to_le_bytes());
    file::with_hashes(changed).expect("the head is sound")
}

#[test]
fn no_index_leads_out_of_its_array_and_no_way_goes_round() {
    let budget = |text: &str| GridOptions { memory_budget: text.parse().unwrap(), ..GridOptions::default() };
    for options in [budget("1G"), budget("16M")] {
        let (info, mut scene) = scene_of(statue::generate(60_000, &|_| ()), &options);
        let bytes = file::to_bytes(&mut scene, &info).unwrap();
        let n_vertices = scene.mesh().n_vertices() as u32;
        let out = [u32::MAX - 1, u32::MAX >> 1, 1 << 30, scene.n_triangles() as u32 + 1];
        // The last vertex is there to be loaded, not to be used.
        let mut cases = vec![("windows", n_vertices), ("vertices", f32::NAN.to_bits()), ("leaves", 1)];
        for number in out {
            cases.extend([("windows", number), ("bricks", number), ("cubes", number)]);
        }
        for (section, number) in cases {
            let fault = file::from_bytes(&with_number(&bytes, section, number)).err();
            assert!(matches!(fault, Some(Fault::Damaged(_))), "{section}: {number}");
        }
        assert!(file::from_bytes(&bytes).is_ok());
    }
}

/// A model of enough triangles for the cache, and an empty cache.
fn model(folder: &Path, n_triangles: u32) -> (PathBuf, SceneStore) {
    let path = folder.join("a.ply");
    ply::write(&path, &statue::generate(n_triangles, &|_| ())).unwrap();
    thread::sleep(Duration::from_millis(50));
    let cache = Cache::at(folder.join("cache"), 200_000_000).unwrap();
    (path, SceneStore::new(Some(cache)))
}

fn load(store: &SceneStore, path: &Path, options: &GridOptions) -> (StoredScene, Vec<Stage>) {
    let stages = std::sync::Mutex::new(Vec::new());
    let report = |stage, done: f32| {
        assert!((0.0..=1.0).contains(&done), "{stage} {done}");
        stages.lock().unwrap().push(stage);
    };
    let scene = store.load(&SceneSource::File(path.to_owned()), Treatment::default(), options, &report).unwrap();
    let mut stages = stages.into_inner().unwrap();
    stages.dedup();
    (scene, stages)
}

#[test]
fn a_model_is_built_once_and_checked_never() {
    let folder = tempfile::tempdir().unwrap();
    let (path, store) = model(folder.path(), 200_000);
    let options = GridOptions::default();
    let source = SceneSource::File(path.clone());
    assert!(!store.has(&source, Treatment::default()));
    let (first, stages) = load(&store, &path, &options);
    assert!(first.is_mapped && stages.contains(&Stage::Building) && stages.contains(&Stage::Writing));
    let (info, bits) = (first.info.clone(), picture(&first.scene, &first.info));
    first.finish();
    let (second, stages) = load(&store, &path, &options);
    assert!(second.is_mapped && stages.is_empty(), "{stages:?}");
    assert!(second.info == info && picture(&second.scene, &info) == bits);
    assert!(store.has(&source, Treatment::default()));
    assert_eq!(store.describe(&source, Treatment::default(), &|_| panic!("it is read")).unwrap(), info);
    let owned = load(&SceneStore::default(), &path, &options).0;
    assert!(!owned.is_mapped && owned.info == info && picture(&owned.scene, &info) == bits);

    // Other options are another scene; another budget is not, as this one was enough.
    let treatment = Treatment { crease: Crease::try_from(10).unwrap(), ..Treatment::default() };
    assert!(!store.has(&source, treatment));
    let dense = GridOptions { density: Some(4.0), ..options };
    assert!(load(&store, &path, &dense).1.contains(&Stage::Building));
    let more = GridOptions { memory_budget: "9G".parse().unwrap(), ..options };
    assert!(load(&store, &path, &more).1.is_empty());

    // A model that has changed is another one, also with the time of the old.
    let time = fs::metadata(&path).unwrap().modified().unwrap();
    ply::write(&path, &statue::generate(160_000, &|_| ())).unwrap();
    fs::File::options().write(true).open(&path).unwrap().set_modified(time).unwrap();
    assert!(!store.has(&source, Treatment::default()));
    thread::sleep(Duration::from_millis(50));
    let (changed, stages) = load(&store, &path, &options);
    assert!(stages.contains(&Stage::Building) && changed.info.id != info.id);
}

#[test]
fn a_scene_that_is_cut_changed_or_of_another_version_is_built_again() {
    let folder = tempfile::tempdir().unwrap();
    let (path, store) = model(folder.path(), 200_000);
    let options = GridOptions::default();
    let (scene, _) = load(&store, &path, &options);
    let (info, bits) = (scene.info.clone(), picture(&scene.scene, &scene.info));
    scene.finish();
    let cached = fs::read_dir(folder.path().join("cache")).unwrap().flatten().map(|entry| entry.path());
    let cached = cached.into_iter().find(|path| path.extension().is_some_and(|it| it == cache::ENDING)).unwrap();
    let whole = fs::read(&cached).unwrap();
    let middle = whole.len() / 2;
    let changes: [fn(&mut Vec<u8>, usize); 6] = [
        |bytes, middle| bytes.truncate(middle),
        |bytes, _| bytes.clear(),
        |bytes, middle| bytes[middle] ^= 1,
        |bytes, _| bytes[12] += 1,
        |bytes, _| bytes[8..12].reverse(),
        |bytes, _| bytes.push(0),
    ];
    for (number, change) in changes.into_iter().enumerate() {
        let mut changed = whole.clone();
        change(&mut changed, middle);
        fs::write(&cached, &changed).unwrap();
        let (again, stages) = load(&store, &path, &options);
        assert!(stages.contains(&Stage::Building), "change {number}: {stages:?}");
        assert!(again.info == info && picture(&again.scene, &info) == bits, "change {number}");
    }
    // Bytes that are as they were, in a file that is not: they are checked, and sealed again.
    let whole = fs::read(&cached).unwrap();
    fs::write(&cached, &whole).unwrap();
    let (again, stages) = load(&store, &path, &options);
    assert_eq!(stages, [Stage::Checking]);
    again.finish();
    assert!(load(&store, &path, &options).1.is_empty());
}

#[test]
fn a_scene_with_too_little_memory_is_built_again_where_there_is_more() {
    // A cache in memory has no room for temporary files.
    let folder = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).unwrap();
    let (path, store) = model(folder.path(), 500_000);
    let with = |text: &str| GridOptions { memory_budget: text.parse().unwrap(), ..GridOptions::default() };
    let (coarse, _) = load(&store, &path, &with("16M"));
    let shortage = coarse.scene.grid.shortage().map(|it| it.to_string());
    assert!(
        shortage.is_some_and(|told| told.starts_with("the grid is made coarser, to stay within --memory-budget 16M"))
    );
    for (budget, is_built) in [("16M", false), ("17M", false), ("1G", true), ("16M", false), ("2G", false)] {
        let (scene, stages) = load(&store, &path, &with(budget));
        assert_eq!(stages.contains(&Stage::Building), is_built, "{budget}");
        drop(scene);
    }
}

#[test]
fn two_that_start_at_once_build_one_scene() {
    let folder = tempfile::tempdir().unwrap();
    let (path, store) = model(folder.path(), 200_000);
    let start = Arc::new(Barrier::new(2));
    let both: Vec<_> = (0..2)
        .map(|_| {
            let (path, store, start) = (path.clone(), store.clone(), Arc::clone(&start));
            thread::spawn(move || {
                start.wait();
                let (scene, stages) = load(&store, &path, &GridOptions::default());
                (scene.is_mapped, picture(&scene.scene, &scene.info), stages.contains(&Stage::Building))
            })
        })
        .collect();
    let both: Vec<_> = both.into_iter().map(|thread| thread.join().unwrap()).collect();
    assert!(both[0].1 == both[1].1 && both[0].0 && both[1].0);
    assert_eq!(both.iter().filter(|(_, _, has_built)| *has_built).count(), 1);
}

#[test]
fn the_cache_has_a_limit_and_keeps_what_was_used_last() {
    let folder = tempfile::tempdir().unwrap();
    let (first, store) = model(folder.path(), 200_000);
    let [second, third] = ["b.ply", "c.ply"].map(|name| folder.path().join(name));
    [&second, &third].iter().for_each(|path| assert!(fs::copy(&first, path).is_ok()));
    thread::sleep(Duration::from_millis(50));
    let n_bytes = load(&SceneStore::default(), &first, &GridOptions::default()).0.scene.n_bytes() as u64;
    let cache = Cache::at(folder.path().join("small"), 2 * n_bytes + n_bytes / 2).unwrap();
    let small = SceneStore::new(Some(cache.clone()));
    let use_at = |path: &Path, seconds| {
        load(&small, path, &GridOptions::default()).0.finish();
        let lock = Cache::lock_of(&cache.path(path, Treatment::default(), &GridOptions::default()));
        let time = SystemTime::UNIX_EPOCH + Duration::from_secs(seconds);
        fs::File::options().write(true).open(lock).unwrap().set_modified(time).unwrap();
    };
    use_at(&first, 1);
    use_at(&second, 2);
    use_at(&first, 3);
    use_at(&third, 4);
    let of = |cache: &Cache| {
        let models = cache.scenes().into_iter().map(|scene| scene.model.unwrap());
        models.map(|model| model.rsplit('/').next().unwrap().to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(of(&cache), ["c.ply", "a.ply"]);
    assert!(cache.clear() > 2 * n_bytes && of(&cache).is_empty());
    // A scene that is larger than the cache is not kept, and replaces nothing.
    let tiny = SceneStore::new(Some(Cache::at(folder.path().join("tiny"), n_bytes / 2).unwrap()));
    let (scene, _) = load(&tiny, &first, &GridOptions::default());
    assert!(!scene.is_mapped && !tiny.has(&SceneSource::File(first.clone()), Treatment::default()));
    drop(store);
}

#[test]
fn a_scene_file_takes_the_place_of_its_model() {
    let folder = tempfile::tempdir().unwrap();
    let (path, store) = model(folder.path(), 20_000);
    // Its name says nothing.
    let file = folder.path().join("scene.bin");
    let source = SceneSource::File(file.clone());
    let options = GridOptions::default();
    let treatment = Treatment { crease: 25.try_into().unwrap(), precision: 14.try_into().unwrap() };
    let (info, n_bytes) = build_file(&SceneSource::File(path.clone()), treatment, &options, &file, &|_, _| ()).unwrap();
    assert_eq!(fs::metadata(&file).unwrap().len(), n_bytes);
    assert!(SceneFile::open(&file).unwrap().record.sources.is_none(), "it says where it was built");
    fs::remove_file(&path).unwrap();
    for (store, is_mapped) in [(&store, true), (&SceneStore::default(), false)] {
        assert!(store.has(&source, treatment));
        assert_eq!(store.describe(&source, Treatment::default(), &|_| ()).unwrap(), info);
        let (scene, stages) = load(store, &file, &options);
        assert!(scene.is_mapped == is_mapped && scene.info == info && stages == [Stage::Checking]);
        scene.finish();
    }
    assert!(load(&store, &file, &options).1.is_empty(), "its seal is in the cache");
    let told = |path: &Path, treatment| {
        let error = store.load(&SceneSource::File(path.to_owned()), treatment, &options, &|_, _| ()).err().unwrap();
        assert!(
            store
                .describe(&SceneSource::File(path.to_owned()), treatment, &|_| ())
                .is_err_and(|it| it.to_string() == error.to_string())
        );
        error.to_string()
    };
    assert!(told(&file, Treatment::FLAT).ends_with(
        "scene.bin: was built with --crease 25 --geometry 14, not --crease 0 --geometry exact: leave --crease and --geometry out, \
         or build it again with `renderer build`"
    ));
    let cut = folder.path().join("cut.raywall");
    fs::write(&cut, &fs::read(&file).unwrap()[..9000]).unwrap();
    assert!(told(&cut, treatment).contains("cut.raywall: it has 9000 bytes in place of"), "{}", told(&cut, treatment));
    assert!(told(&cut, treatment).ends_with(": copy the scene file again, or build it again with `renderer build`"));
    // In the cache, that is not the user's to do.
    assert!(!SceneFile::open(&cut).err().unwrap().to_string().contains("again"));
}

#[test]
fn a_long_file_without_contents_is_refused_before_anything_is_allocated() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("sparse.raywall");
    // Numbers of bytes in the record and in the body, and of sections, and the length that they give.
    for sizes in [[0, 0, 1 << 36], [0, 1 << 56, 0], [1 << 40, 0, 0]] {
        let [n_record_bytes, n_body_bytes, n_sections] = sizes;
        let n_chunks = n_body_bytes / head::CHUNK as u64;
        let n_head_bytes = head::PREFIX_BYTES as u64 + 40 * n_sections + 32 * n_chunks + n_record_bytes;
        let start = [&head::MAGIC[..], &0x0403_0201_u32.to_le_bytes(), &head::VERSION.to_le_bytes()].concat();
        let sizes = sizes.map(u64::to_le_bytes);
        fs::write(&path, [&start, sizes.as_flattened(), &[0; 32]].concat()).unwrap();
        let n_bytes = n_head_bytes.next_multiple_of(bytes::PAGE as u64) + n_body_bytes;
        // Not all file systems have files so long; the sizes are looked at before the length.
        let _ = fs::File::options().write(true).open(&path).unwrap().set_len(n_bytes);
        let fault = SceneFile::open(&path).err().unwrap();
        assert!(matches!(fault, Fault::Damaged(fault::Damage::Head)), "{fault}");
    }
}

#[test]
fn what_a_killed_builder_leaves_is_removed_once_nobody_builds() {
    let folder = tempfile::tempdir().unwrap();
    let cache = Cache::at(folder.path().to_owned(), 1000).unwrap();
    let [part, scene] = [".raywall-x.part", "b.raywall"].map(|name| folder.path().join(name));
    let begin = || fs::write(&part, [0; 100]).unwrap();
    begin();
    let lock = lock::Lock::take(&Cache::lock_of(&scene), &|_| ()).unwrap();
    assert!(cache.clear() == 0 && part.exists(), "it is being written");
    assert!(cache.make_room(1, &folder.path().join("c.raywall")) && part.exists());
    assert!(cache.make_room(1, &scene) && !part.exists(), "the one that builds has begun none yet");
    begin();
    drop(lock);
    assert!(cache.clear() == 100 && !part.exists());
}

#[test]
fn a_part_of_a_scene_file_tells_of_the_whole_and_is_removed_once_nobody_fetches_it() {
    let folder = tempfile::tempdir().unwrap();
    let cache = Cache::at(folder.path().to_owned(), 1000).unwrap();
    let (info, mut scene) = scene_of(statue::generate(3000, &|_| ()), &GridOptions::default());
    let whole = file::to_bytes(&mut scene, &info).unwrap();
    let part = folder.path().join("fetched-x.fetch");
    let lock = lock::Lock::take(&Cache::lock_of(&part), &|_| ()).unwrap();
    // Before its head, then with it, then with all but the last byte.
    let head = whole.len() - scene.n_bytes() / 2;
    for (n_bytes, is_known) in [(0, false), (100, false), (head, true), (whole.len() - 1, true)] {
        fs::write(&part, &whole[..n_bytes]).unwrap();
        let parts = cache.parts();
        let expected = is_known.then_some((whole.len() as u64, info.n_triangles));
        assert_eq!((parts.len(), parts[0].whole, parts[0].n_bytes), (1, expected, n_bytes as u64));
        assert!(parts[0].is_arriving && cache.clear() == 0 && cache.scenes().is_empty());
    }
    drop(lock);
    assert!(!cache.parts()[0].is_arriving);
    assert!(cache.clear() == whole.len() as u64 - 1 && !part.exists() && cache.parts().is_empty());
}

#[cfg(target_os = "linux")]
#[test]
fn a_scene_file_on_another_disk_than_the_cache_is_read_and_never_sealed() {
    use std::os::unix::fs::MetadataExt;
    let (folder, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir_in("/dev/shm").unwrap());
    let disk = |folder: &tempfile::TempDir| fs::metadata(folder.path()).unwrap().dev();
    assert_ne!(disk(&folder), disk(&other), "the test needs two disks");
    let (path, store) = model(folder.path(), 20_000);
    let file = other.path().join("scene.raywall");
    let options = GridOptions::default();
    build_file(&SceneSource::File(path), Treatment::default(), &options, &file, &|_, _| ()).unwrap();
    for _ in 0..2 {
        let (scene, stages) = load(&store, &file, &options);
        assert!(!scene.is_mapped && stages == [Stage::Checking], "it is checked at each start");
        scene.finish();
    }
    assert_eq!(fs::read_dir(folder.path().join("cache/seals")).unwrap().count(), 0);
    let copy = folder.path().join("scene.raywall");
    fs::copy(&file, &copy).unwrap();
    assert!(load(&store, &copy, &options).0.is_mapped);
}

#[cfg(unix)]
#[test]
fn what_others_may_write_is_read_and_where_they_may_write_is_no_cache() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let (path, store) = model(folder.path(), 20_000);
    let file = folder.path().join("scene.raywall");
    build_file(&SceneSource::File(path), Treatment::default(), &GridOptions::default(), &file, &|_, _| ()).unwrap();
    let set_mode = |path: &Path, mode| fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
    assert!(load(&store, &file, &GridOptions::default()).0.is_mapped);
    set_mode(&file, 0o664);
    for _ in 0..2 {
        let (scene, stages) = load(&store, &file, &GridOptions::default());
        assert!(!scene.is_mapped && stages == [Stage::Checking], "it is checked at each start");
    }
    let cache = folder.path().join("cache");
    set_mode(&cache, 0o777);
    assert!(Cache::at(cache, 1 << 30).unwrap_err().contains("others may write in the cache (chmod 700)"));
    assert!(Cache::at("/proc/no/cache".into(), 1 << 30).unwrap_err().contains("the cache cannot be made"));
}

#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_costs_the_file_and_nothing_else() {
    let (info, mut scene) = scene_of(statue::generate(20_000, &|_| ()), &GridOptions::default());
    let bits = picture(&scene, &info);
    let full = fs::File::options().write(true).open("/dev/full").unwrap();
    let budget = MemoryBudget::default();
    let error = file::write(&full, &mut scene, &info, (None, budget), &|_| ()).unwrap_err();
    assert_eq!(error.kind(), std::io::ErrorKind::StorageFull);
    assert!(picture(&scene, &info) == bits);
}
