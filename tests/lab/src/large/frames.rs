//! Frames of a mapped scene file: in this process for their time, and by render servers for their memory.

use std::{
    path::{Path, PathBuf},
    process::Stdio,
    time::Instant,
};

use anyhow::{Result, anyhow, ensure};
use compositor::farm::RenderGoal;
use renderer::{
    grid::GridOptions,
    model::scene::SceneSource,
    render::{scene::Scene, threads},
    scene_file::{SceneStore, cache::Cache, store::StoredScene},
};
use serde::Serialize;
use shared::{
    camera::{Camera, CanvasPart, Shape},
    detail::Detail,
    division::{Division, FrameSize},
    protocol::FrameSpec,
    scene::{SceneId, Treatment},
};

use super::{Files, process};
use crate::{
    farm::{MeasuredFarm, ServerProcess, frame_spec, goal},
    statistics::{median, milliseconds},
};

/// Frames with each camera; their median counts.
const N_FRAMES: usize = 11;

/// Frames after which render servers have read what frames read.
const N_WARM: usize = 20;

/// The eye's distance from the surface in the middle of the picture, as a part of that from which the model is seen whole.
const CLOSE: f64 = 0.1;

/// Time and speed of frames.
#[derive(Clone, Debug, Serialize)]
pub(super) struct FrameFigures {
    #[serde(skip)]
    pub(super) n_triangles: usize,
    #[serde(skip)]
    id: SceneId,
    #[serde(skip)]
    cameras: [Camera; 2],
    pub(super) whole: FrameFigure,
    pub(super) close: FrameFigure,
    /// In motion, where stand-ins show what is finer than samples.
    pub(super) whole_in_motion: FrameFigure,
    pub(super) close_in_motion: FrameFigure,
}

/// Those with one camera: traced and shaded, one ray a sample.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct FrameFigure {
    /// Of the model, or of the stand-in that is shown.
    triangles: usize,
    /// On all cores.
    pub(super) frame_ms: f64,
    /// Samples over the CPU time of one thread.
    pub(super) mpixel_per_core_s: f64,
}

/// Scene files on the disk of a folder, which holds a cache for their seals: the user's own cache has no part in this.
pub(crate) struct MappedScenes(SceneStore);

impl MappedScenes {
    /// The folder for the variable XDG_CACHE_HOME of programs that use the same seals.
    pub(super) fn caches_in(folder: &Path) -> PathBuf {
        folder.join("caches")
    }

    pub(crate) fn in_folder(folder: &Path) -> Result<Self> {
        let cache = Cache::at(Self::caches_in(folder).join("raywall"), 0).map_err(|fault| anyhow!(fault))?;
        Ok(Self(SceneStore::new(Some(cache))))
    }

    /// Maps a scene file, on the current rayon pool.
    pub(crate) fn load(&self, path: &Path) -> Result<StoredScene> {
        let source = SceneSource::File(path.to_owned());
        let stored = self.0.load(&source, Treatment::default(), &GridOptions::default(), &|_, _| ())?;
        ensure!(stored.is_mapped, "{} is not mapped: others may write in its folder", path.display());
        Ok(stored)
    }
}

/// Two views of a model that stands upright: all of it, and the surface in the middle of that view from a tenth of the
/// distance.
pub(crate) fn views(scene: &Scene, shape: &Shape, size: FrameSize) -> [Camera; 2] {
    let aspect = f64::from(size.xres()) / f64::from(size.yres());
    let whole = Camera::view_all(shape, shape.up, aspect, CanvasPart::WHOLE);
    let middle = scene.probe(&whole, [0.5, 0.5], None).map_or(whole.target(), |hit| hit.point);
    [whole, whole.dolly(middle, CLOSE)]
}

/// Maps the scene file, and renders frames on all cores and on one thread in turns.
pub(super) fn measure(files: &Files) -> Result<FrameFigures> {
    let pools = [threads::pool(None)?, threads::pool(Some(1))?];
    let scenes = MappedScenes::in_folder(&files.folder)?;
    let StoredScene { info, scene, .. } = pools[0].install(|| scenes.load(&files.scene))?;

    let size = FrameSize::PAPER;
    let cameras = views(&scene, &info.shape, size);
    let figure = |camera: Camera, detail: Detail| {
        let spec = FrameSpec { detail, ..frame_spec(info.id, camera, size) };
        let mut times_ms = [Vec::new(), Vec::new()];
        // The first frame of each reads the file.
        for frame in 0..=N_FRAMES {
            for (number, pool) in pools.iter().enumerate() {
                let started_at = Instant::now();
                let (_, cpu) = pool.install(|| scene.render_frame(&spec));
                let time = if number == 0 { started_at.elapsed() } else { cpu };
                times_ms[number].extend((frame > 0).then(|| milliseconds(time)));
            }
        }
        let [frame_ms, cpu_ms] = times_ms.map(median);
        let n_triangles = scene.at(detail).n_triangles();
        FrameFigure { triangles: n_triangles, frame_ms, mpixel_per_core_s: f64::from(size.n_samples()) / cpu_ms / 1e3 }
    };
    let [whole, close] = cameras.map(|camera| figure(camera, Detail::FULL));
    let [whole_in_motion, close_in_motion] =
        cameras.map(|camera| figure(camera, Detail::of_samples(&camera, size, info.shape.bounds)));
    let n_triangles = scene.n_triangles();
    Ok(FrameFigures { n_triangles, id: info.id, cameras, whole, close, whole_in_motion, close_in_motion })
}

/// The memory of one render server with the scene, and of two together, after both have rendered frames of both views.
pub(super) fn shared_memory(files: &Files, frames: &FrameFigures) -> Result<Option<[u64; 2]>> {
    let goal = RenderGoal { scene_path: Some(files.scene.clone()), ..goal(Division::Dynamic, 1) };
    let mut servers = Vec::new();
    // Dropped first: a farm that ends before its render servers reports no loss.
    let farm = MeasuredFarm::start(([127, 0, 0, 1], 0).into(), goal)?;
    let mut sums = [None; 2];
    for (number, sum) in sums.iter_mut().enumerate() {
        let name = format!("large-{number}");
        let mut command = files.renderer()?;
        command.args(["connect", &farm.farm.address().to_string(), "--insecure", "--threads", "1", "--name", &name]);
        // It ends with its standard input, and so with this process.
        command.args(["--local", "--model"]).arg(&files.scene).stdin(Stdio::piped());
        servers.push(ServerProcess::spawn(name, &mut command)?);
        for camera in frames.cameras {
            let spec = frame_spec(frames.id, camera, FrameSize::PAPER);
            farm.farm.update_goal(|goal| (goal.spec, goal.min_renderers) = (Some(spec), servers.len() as u32));
            let mut n_frames = 0;
            while n_frames < N_WARM {
                let frame = farm.next_frame()?;
                n_frames += usize::from(frame.spec == spec && frame.stats.nodes.len() == servers.len());
            }
        }
        *sum = servers.iter().map(|server| process::pss(server.id())).sum();
    }
    let [one, two] = sums;
    Ok(one.zip(two).map(|(one, two)| [one, two]))
}
