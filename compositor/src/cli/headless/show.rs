//! A show without a window: each scene once, for its time, with its caption on standard output.

use std::{
    path::{Path, PathBuf},
    sync::mpsc,
    thread,
    time::{Duration, Instant},
};

use anyhow::{Context, bail};
use renderer::{cli::say, model::scene::SceneSource, scene_file::SceneStore};
use shared::{
    appearance::Appearance,
    camera::{Camera, CameraPath, CanvasPart, Look},
    detail::Detail,
    division::FrameSize,
    printable::counted,
    protocol::{FrameSpec, LightingMode, SampleRange, ShadingMode},
    scene::Treatment,
    sky::SkyId,
};

use super::{Headless, Wakeup, Wakeups, film::holds_pictures, milliseconds, warn_if_blank};
use crate::{
    cli::report::Report,
    control::show::{Cue, Player, Show, ShowScene, Step},
    farm::{Farm, Frame},
};

/// What scenes are shown with, unless they say otherwise.
pub(crate) struct Setting {
    pub(crate) source: SceneSource,
    pub(crate) treatment: Treatment,
    pub(crate) store: SceneStore,
    pub(crate) size: FrameSize,
    pub(crate) view: ShadingMode,
    pub(crate) rays: Option<LightingMode>,
    pub(crate) samples: SampleRange,
    pub(crate) appearance: Appearance,
    pub(crate) sky: Option<SkyId>,
    /// The canvas's width over its height.
    pub(crate) aspect: f64,
    /// Where the last picture of each scene goes.
    pub(crate) pictures: Option<PathBuf>,
}

impl Setting {
    /// The frame of a scene at its beginning.
    fn spec(&self, cue: &Cue) -> FrameSpec {
        let Appearance { light, clip, path, .. } = self.appearance;
        let Look { light, clip, rays, path: of_scene } =
            cue.look(Look { light, clip, rays: self.rays, path: Some(path) });
        let whole = || Camera::view_all(&cue.model.shape, cue.up, self.aspect, CanvasPart::WHOLE);
        FrameSpec {
            scene: cue.model.scene,
            camera: cue.camera.unwrap_or_else(whole),
            size: self.size,
            view: self.view,
            rays: rays.unwrap_or_default(),
            samples: self.samples,
            detail: Detail::FULL,
            appearance: Appearance {
                light,
                clip,
                path: of_scene.unwrap_or(path),
                sky: self.sky,
                up: cue.up,
                ..self.appearance
            },
        }
    }
}

/// A scene that was read, by its number; or why it cannot be shown.
type Read = (usize, Result<Box<Cue>, String>);

/// A show in the making.
struct Playing<'a> {
    setting: &'a Setting,
    farm: &'a Farm,
    player: Player,
    wake: mpsc::SyncSender<Wakeup>,
    read: (mpsc::Sender<Read>, mpsc::Receiver<Read>),
    cue: Option<(usize, Box<Cue>)>,
    change: u32,
    /// The scene whose first frame is awaited, and the path of its camera.
    entered: Option<(usize, Option<CameraPath>)>,
    /// The path on the wall, and since when.
    path: Option<(CameraPath, Instant)>,
    /// The frame that is asked for.
    spec: Option<FrameSpec>,
    n_shown: usize,
}

impl Headless {
    /// Plays a show once, in its own time. Missing scenes are left out with a line in the log.
    ///
    /// # Errors
    /// None of the scenes was shown, or one's picture cannot be written.
    pub(crate) fn show_show(
        &mut self,
        farm: &Farm,
        (wake, wakeups): (mpsc::SyncSender<Wakeup>, &Wakeups),
        show: Show,
        setting: &Setting,
    ) -> anyhow::Result<Report> {
        let show = show.unattended();
        let n_scenes = show.scenes.len();
        let mut playing = Playing {
            setting,
            farm,
            player: Player::new(show, Instant::now()),
            wake,
            read: mpsc::channel(),
            cue: None,
            change: 0,
            entered: None,
            path: None,
            spec: None,
            n_shown: 0,
        };
        let (mut report, mut ended_at) = (Report::default(), Instant::now());
        let mut change_on_wall = 0;
        while playing.go_on() {
            if let Some(frame) = farm.take_frame() {
                let is_first = std::mem::replace(&mut change_on_wall, frame.change) != frame.change;
                if is_first {
                    self.write_scene(&playing, report.n_frames() > 0)?;
                }
                let display = self.show(&frame)?;
                report.add(&frame, display, milliseconds(ended_at.elapsed()));
                ended_at = Instant::now();
                if is_first {
                    playing.on_first_frame(&frame, n_scenes)?;
                }
            }
            playing.move_camera();
            let left =
                playing.next_at().map_or(Duration::from_secs(1), |at| at.saturating_duration_since(Instant::now()));
            if wakeups.recv_timeout(left) == Ok(Wakeup::Stop) {
                break;
            }
        }
        self.write_scene(&playing, report.n_frames() > 0)?;
        let n_left_out = playing.player.problems().len();
        if n_left_out > 0 && playing.n_shown == 0 {
            bail!("no scene was shown: the warnings above say why");
        }
        if n_left_out > 0 {
            say(format_args!("{} of {n_scenes} left out: the warnings say why", counted(n_left_out, "scene")))?;
        }
        Ok(report)
    }

    /// Writes the last picture of the scene on the wall.
    fn write_scene(&self, playing: &Playing<'_>, has_picture: bool) -> anyhow::Result<()> {
        let (Some(folder), Some((index, _))) = (&playing.setting.pictures, playing.player.shown()) else {
            return Ok(());
        };
        if has_picture {
            self.image()?.write_png(&folder.join(format!("scene-{:04}.png", index + 1)))?;
        }
        Ok(())
    }
}

impl Playing<'_> {
    /// Takes the steps that are due. Returns whether the show goes on.
    fn go_on(&mut self) -> bool {
        let now = Instant::now();
        while let Ok((index, read)) = self.read.1.try_recv() {
            let read = read.map(|cue| {
                self.farm.update_goal(|goal| goal.next_scene = Some((cue.model.scene, cue.model.path())));
                self.cue = Some((index, cue));
            });
            let problem = read.as_ref().err().cloned().unwrap_or_default();
            if self.player.on_read(index, read, now) {
                tracing::warn!("scene {} is left out: {problem}", index + 1);
            }
        }
        while let Some(step) = self.player.advance(now) {
            match step {
                Step::Prepare(index) => self.prepare(index),
                Step::Enter(index) => self.enter(index, now),
            }
        }
        self.player.is_playing() && !self.player.is_stuck()
    }

    /// Reads a scene on a thread of its own: frames go on meanwhile.
    fn prepare(&self, index: usize) {
        let scene: ShowScene = self.player.show().scenes[index].clone();
        let Setting { source, treatment, store, .. } = self.setting;
        let (source, treatment, store) = (source.clone(), *treatment, store.clone());
        let (answers, wake) = (self.read.0.clone(), self.wake.clone());
        let read = move || {
            let cue = Cue::read(&scene, &source, treatment, &store, &|_| ()).map(Box::new);
            // The show may have ended.
            let _ = answers.send((index, cue));
            let _ = wake.try_send(Wakeup::Farm);
        };
        if let Err(error) = thread::Builder::new().name("model loader".to_owned()).spawn(read) {
            let _ = self.read.0.send((index, Err(format!("cannot start a thread to load the model: {error}"))));
        }
    }

    fn enter(&mut self, index: usize, now: Instant) {
        let Some((_, cue)) = self.cue.take().filter(|(read, _)| *read == index) else { return };
        self.change += 1;
        self.path = None;
        self.entered = Some((index, cue.path.as_deref().cloned()));
        let (spec, change, path) = (self.setting.spec(&cue), self.change, cue.model.path());
        self.spec = Some(spec);
        self.farm.update_goal(|goal| {
            (goal.spec, goal.scene_path, goal.change, goal.moved_at) = (Some(spec), path, change, now);
            goal.repeat = false;
        });
    }

    fn on_first_frame(&mut self, frame: &Frame, n_scenes: usize) -> anyhow::Result<()> {
        let Some((index, path)) = self.entered.take_if(|_| frame.change == self.change) else { return Ok(()) };
        warn_if_blank(frame);
        self.n_shown += 1;
        let now = Instant::now();
        let path_time = path.as_ref().map(|path| Duration::from_secs_f64(path.duration_seconds()));
        self.player.on_shown(index, path_time, now);
        self.path = path.map(|path| (path, now));
        let caption = self.player.shown().map(|(_, scene)| scene.caption.clone()).unwrap_or_default();
        say(format_args!("scene {} of {n_scenes}: {caption}", index + 1))
    }

    /// Moves the camera along the scene's path.
    fn move_camera(&mut self) {
        let (Some((path, since)), Some(spec)) = (&self.path, &mut self.spec) else { return };
        let camera = path.at(since.elapsed().as_secs_f64());
        if self.entered.is_none() && camera != spec.camera {
            spec.camera = camera;
            let spec = *spec;
            self.farm.update_goal(|goal| (goal.spec, goal.moved_at) = (Some(spec), Instant::now()));
        }
    }

    fn next_at(&self) -> Option<Instant> {
        let step = self.path.as_ref().map(|_| Instant::now() + Duration::from_millis(16));
        step.into_iter().chain(self.player.wakes_at()).min()
    }
}

/// Makes the folder for the pictures of scenes, unless it holds those of another show.
pub(crate) fn make_folder(folder: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder)
        .with_context(|| format!("--pictures {} cannot be made: name another folder", folder.display()))?;
    if holds_pictures(folder, "scene-")? {
        bail!("{} holds pictures of a show: give --pictures another folder", folder.display());
    }
    Ok(())
}
