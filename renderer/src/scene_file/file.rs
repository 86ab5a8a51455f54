//! Writes and opens scene files.

use std::{
    fs::{File, Metadata},
    io::{self, BufWriter, Read, Seek, SeekFrom, Write},
    path::Path,
    sync::Arc,
};

use channel::files::{self, NewFile, ReadError};
use glam::DVec3;
use serde::{Deserialize, Serialize};
use shared::{codec, printable::printable_line};

use crate::{
    formats::sources::{Sources, Stamp},
    grid::{Grid, MemoryBudget},
    model::scene::ModelInfo,
    render::scene::{Scene, StandIn},
    scene_file::{
        bytes::FileBytes,
        fault::{Damage, Fault},
        head::{Extent, Hash, Head, LONGEST_RECORD, MAGIC, PREFIX_BYTES},
        sections::{Collector, Filler, Writer, expect},
    },
};

/// The code that has read a model and built its grid; another may do either otherwise.
const BUILDER: &str = env!("RAYWALL_BUILDER");

/// All of a scene but its arrays.
#[derive(Serialize, Deserialize)]
pub(crate) struct Record<G> {
    builder: String,
    /// Of the model.
    pub(crate) info: ModelInfo,
    /// The files of the model; none in a scene file that an operator has named, which may travel.
    pub(crate) sources: Option<Sources>,
    /// The memory that building could take.
    budget: MemoryBudget,
    pub(crate) grid: G,
    /// With the sides of their cells.
    stand_ins: Vec<(f32, G)>,
}

/// A scene file that is open, with its head.
pub(crate) struct SceneFile {
    file: File,
    metadata: Metadata,
    pub(crate) head: Head,
    pub(crate) record: Record<Grid>,
}

/// Most stand-ins: each has at most half of the triangles of the one before.
const MOST_STAND_INS: usize = 32;

/// Most lines that are told of a model; models have fewer.
const MOST_LINES: usize = 100;

/// Most points of a model's outline; models have fewer.
const MOST_OUTLINE_POINTS: usize = 1000;

/// Whether the file of a path begins as scene files do.
pub fn is_scene_file(path: &Path) -> bool {
    let mut start = [0; MAGIC.len()];
    files::open(path).is_ok_and(|mut file| file.read_exact(&mut start).is_ok() && start == MAGIC)
}

/// Writes a scene, with the sources of its model and the budget of its grid; returns the hash of all of it. `progress`
/// receives the fraction done, 0 to 1. A scene whose [grid](Grid::is_storable) no file can hold is an error.
///
/// # Errors
/// The file cannot be written.
pub(crate) fn write(
    out: impl Write,
    scene: &mut Scene,
    info: &ModelInfo,
    origin: (Option<&Sources>, MemoryBudget),
    progress: &(dyn Fn(f32) + Sync),
) -> io::Result<Hash> {
    write_arrays(out, scene, true, info, origin, progress)
}

/// Does the same with a scene that has no further use: each of its arrays goes when it is written, so that file and scene
/// together take little more than one of them.
///
/// # Errors
/// The file cannot be written.
pub(crate) fn write_last(
    out: impl Write,
    mut scene: Scene,
    info: &ModelInfo,
    origin: (Option<&Sources>, MemoryBudget),
    progress: &(dyn Fn(f32) + Sync),
) -> io::Result<Hash> {
    write_arrays(out, &mut scene, false, info, origin, progress)
}

fn write_arrays(
    out: impl Write,
    scene: &mut Scene,
    keeps: bool,
    info: &ModelInfo,
    (sources, budget): (Option<&Sources>, MemoryBudget),
    progress: &(dyn Fn(f32) + Sync),
) -> io::Result<Hash> {
    if !scene.grids().all(Grid::is_storable) {
        return Err(io::Error::other("scene files hold trees alone: leave --storage out, or make it compact"));
    }
    let (builder, info, sources) = (BUILDER.to_owned(), info.clone(), sources.cloned());
    let stand_ins = scene.stand_ins.iter().map(|coarse| (coarse.side, &coarse.scene.grid)).collect();
    let record = codec::to_bytes(&Record { builder, info, sources, budget, grid: &scene.grid, stand_ins });
    let mut collector = Collector::default();
    scene.grids_mut().try_for_each(|grid| grid.visit_sections(&mut collector)).map_err(io::Error::other)?;
    let head = Head::new(&collector.sections, record);
    progress(0.4);

    let tell = |n_written: usize| progress(0.4 + 0.6 * (n_written as f32 / head.n_bytes() as f32));
    let out = BufWriter::with_capacity(1 << 20, out);
    let mut writer = Writer { out, keeps, n_written: 0, progress: &tell };
    writer.put(&head.to_bytes())?;
    scene.grids_mut().try_for_each(|grid| grid.visit_sections(&mut writer)).map_err(|fault| match fault {
        Fault::Io(error) => error,
        other => io::Error::other(other),
    })?;
    writer.out.flush()?;
    Ok(head.hash)
}

/// Begins a scene file that only its owner may change, so that it is mapped.
pub(crate) fn begin(path: &Path) -> io::Result<NewFile> {
    let new = NewFile::begin(path)?;
    #[cfg(unix)]
    {
        use std::{fs::Permissions, os::unix::fs::PermissionsExt};
        let mode = new.file().metadata()?.permissions().mode();
        new.file().set_permissions(Permissions::from_mode(mode & !0o022))?;
    }
    Ok(new)
}

impl SceneFile {
    /// Opens a file and reads its head.
    pub(crate) fn open(path: &Path) -> Result<Self, Fault> {
        let mut file = files::open(path).map_err(|error| match error {
            ReadError::Io(error) => error,
            other => io::Error::other(other),
        })?;
        let metadata = file.metadata()?;
        let head = read_head(&mut file, metadata.len())?;
        let record = read_record(&head)?;
        Ok(Self { file, metadata, head, record })
    }

    /// The bytes of the whole file, and the facts of its model, of a file whose end may be missing; `None` if its head is not
    /// there, or is damaged.
    pub(crate) fn beginning(path: &Path) -> Option<(u64, ModelInfo)> {
        let mut file = files::open(path).ok()?;
        let mut prefix = [0; PREFIX_BYTES];
        file.read_exact(&mut prefix).ok()?;
        let Extent { n_head_bytes, n_bytes, .. } = Extent::of(&prefix).ok()?;
        // Before anything is allocated.
        if file.metadata().ok()?.len() < n_head_bytes as u64 {
            return None;
        }
        file.seek(SeekFrom::Start(0)).ok()?;
        let head = read_head(&mut file, n_bytes as u64).ok()?;
        Some((n_bytes as u64, read_record(&head).ok()?.info))
    }

    /// The state of the file.
    pub(crate) fn stamp(&self) -> Stamp {
        Stamp::of(&self.metadata)
    }

    /// Whether this program would build the same.
    pub(crate) fn is_by_this_builder(&self) -> bool {
        self.record.builder == BUILDER
    }

    /// Whether building within this budget would give about the same. A grid that had too little memory is built anew only
    /// where there is clearly more: what is free changes from start to start.
    pub(crate) fn suits(&self, budget: MemoryBudget) -> bool {
        !self.record.grid.is_limited() || !budget.clearly_exceeds(self.record.budget)
    }

    /// The open file.
    pub(crate) fn file(&self) -> &File {
        &self.file
    }

    /// Whether nobody else may change the file, as far as this machine tells.
    pub(crate) fn is_private(&self) -> bool {
        #[cfg(unix)]
        {
            use std::os::unix::fs::MetadataExt;
            // SAFETY: `geteuid` always succeeds, and touches nothing.
            let user = unsafe { libc::geteuid() };
            // Of root, everybody depends in any case.
            [user, 0].contains(&self.metadata.uid()) && self.metadata.mode() & 0o022 == 0
        }
        #[cfg(not(unix))]
        false
    }

    /// Whether the file lies on the disk of a folder.
    pub(crate) fn is_on_disk_of(&self, folder: &Path) -> bool {
        #[cfg(unix)]
        {
            use std::os::unix::fs::MetadataExt;
            std::fs::metadata(folder).is_ok_and(|folder| folder.dev() == self.metadata.dev())
        }
        #[cfg(not(unix))]
        {
            let _ = folder;
            false
        }
    }

    /// The scene, mapped if nobody can change the file, and read into memory otherwise. Unless a file that is mapped
    /// `is_trusted`, all of it is checked first; `progress` receives the fraction that is done, 0 to 1, from any thread.
    pub(crate) fn into_scene(
        self,
        is_mapped: bool,
        is_trusted: bool,
        progress: &(dyn Fn(f32) + Sync),
    ) -> Result<Scene, Fault> {
        let Self { mut file, head, record, .. } = self;
        let bytes = if is_mapped {
            FileBytes::map(&file)?
        } else {
            file.seek(SeekFrom::Start(0))?;
            FileBytes::read(file, head.n_bytes())?
        };
        let progress = if is_trusted && is_mapped { None } else { Some(progress) };
        scene_of(Arc::new(bytes), &head, record, progress)
    }
}

/// The scene of a file in memory, which is checked; for tests.
///
/// # Errors
/// The bytes are no scene file, or a damaged one.
pub fn from_bytes(bytes: &[u8]) -> Result<(ModelInfo, Scene), Fault> {
    let head = Head::from_bytes(bytes, bytes.len() as u64)?;
    let record = read_record(&head)?;
    let info = record.info.clone();
    scene_of(Arc::new(FileBytes::copy(bytes)), &head, record, Some(&|_| ())).map(|scene| (info, scene))
}

/// The bytes of a scene's file; for tests.
///
/// # Errors
/// The scene has a grid that no file can hold.
pub fn to_bytes(scene: &mut Scene, info: &ModelInfo) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    write(&mut bytes, scene, info, (None, MemoryBudget::default()), &|_| ())?;
    Ok(bytes)
}

/// Gives a file whose contents were changed the hashes that fit them, to test the checks behind; `None` if its head is of no
/// use.
pub fn with_hashes(mut bytes: Vec<u8>) -> Option<Vec<u8>> {
    let head = Head::repaired(&bytes)?;
    let head_bytes = head.to_bytes();
    bytes[..head_bytes.len()].copy_from_slice(&head_bytes);
    Some(bytes)
}

fn read_head(file: &mut File, n_bytes: u64) -> Result<Head, Fault> {
    let mut start = [0; PREFIX_BYTES];
    file.read_exact(&mut start).map_err(|error| match error.kind() {
        io::ErrorKind::UnexpectedEof => Fault::NotASceneFile,
        _ => error.into(),
    })?;
    let Extent { n_head_bytes, n_bytes: expected, .. } = Extent::of(&start)?;
    // Before anything is allocated.
    if expected as u64 != n_bytes {
        return Err(Damage::Length { of_file: n_bytes, expected: expected as u64 }.into());
    }
    let mut bytes = start.to_vec();
    bytes.resize(n_head_bytes, 0);
    file.read_exact(&mut bytes[PREFIX_BYTES..])?;
    Head::from_bytes(&bytes, n_bytes)
}

fn read_record(head: &Head) -> Result<Record<Grid>, Fault> {
    let damaged = Damage::Content("facts");
    let mut record: Record<Grid> = codec::from_bytes::<_, LONGEST_RECORD>(&head.record).map_err(|_| damaged.clone())?;
    let ModelInfo { shape, n_triangles, found, left_out, .. } = &mut record.info;
    let is_point = |point: &DVec3| point.is_finite();
    let (min, max) = shape.bounds;
    let is_shape = is_point(&min) && is_point(&max) && min.cmple(max).all() && shape.outline.iter().all(is_point);
    let are_few = shape.outline.len() <= MOST_OUTLINE_POINTS && found.len() + left_out.len() <= MOST_LINES;
    expect(is_shape && are_few && (1..=u32::MAX as usize).contains(n_triangles), "facts")?;
    let are_in_order = record.stand_ins.is_sorted_by(|(finer, _), (coarser, _)| finer < coarser);
    let are_sides = record.stand_ins.iter().all(|(side, _)| side.is_finite() && *side > 0.0);
    expect(are_in_order && are_sides && record.stand_ins.len() <= MOST_STAND_INS, "stand-ins")?;
    found.iter_mut().chain(left_out).for_each(|line| *line = printable_line(line));
    Ok(record)
}

/// Checks, with `progress`, and takes a scene.
fn scene_of(
    bytes: Arc<FileBytes>,
    head: &Head,
    record: Record<Grid>,
    progress: Option<&(dyn Fn(f32) + Sync)>,
) -> Result<Scene, Fault> {
    let of_grid = |(side, grid): (f32, Grid)| StandIn { side, scene: grid.into_mapped().into() };
    let stand_ins = record.stand_ins.into_iter().map(of_grid).collect();
    let mut scene = Scene { stand_ins, ..record.grid.into_mapped().into() };
    if let Some(progress) = progress {
        head.check_chunks(&bytes, &|done| progress(0.6 * done))?;
    }
    let mut filler = Filler::new(bytes, head);
    scene.grids_mut().try_for_each(|grid| grid.visit_sections(&mut filler))?;
    filler.finish()?;
    scene.grids().try_for_each(Grid::check_sizes)?;
    if progress.is_some() {
        scene.grids().try_for_each(Grid::check_contents)?;
    }
    Ok(scene)
}
