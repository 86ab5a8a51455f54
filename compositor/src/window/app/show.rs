//! The show on the wall: carries out what its player decides, and fades from scene to scene.

use std::{
    path::PathBuf,
    sync::Arc,
    time::{Duration, Instant},
};

use renderer::model::scene::SceneSource;
use shared::camera::{CameraPath, Look};

use super::App;
use crate::{
    control::{
        model::Model,
        show::{self, Cue, Ending, Place, Player, SceneEdit, SceneMap, Show, ShowScene, Step},
    },
    overlay::Caption,
    window::{effect::Effect, model_loader::Prepared},
};

/// The time between two pictures of a fade.
const FADE_STEP: Duration = Duration::from_millis(16);
/// Changes whose frames may still come: more than there are frames in flight.
const MOST_AWAITED: usize = 8;
/// The time of a scene that was kept with a key.
const KEPT_SECONDS: Duration = Duration::from_secs(15);

pub(super) struct ShowControl {
    file: PathBuf,
    pub(super) player: Player,
    /// The model of scenes that name none.
    default: SceneSource,
    /// The look of scenes that say nothing of it.
    usual: Look,
    /// The number of the last change from scene to scene: frames tell it again.
    pub(super) change: u32,
    /// The scene that was read last.
    read: Option<(usize, Box<Cue>)>,
    /// Scenes whose first frame may still come.
    awaited: Vec<Awaited>,
    fade: Option<Fade>,
    /// Whether the wall's own model is loaded because no scene can be shown.
    stands_in: bool,
}

/// A scene that was entered.
struct Awaited {
    change: u32,
    index: usize,
    path: Option<Arc<CameraPath>>,
    repeats_path: bool,
}

/// A change that is seen.
struct Fade {
    since: Instant,
    /// The caption of the picture before.
    old_caption: String,
}

impl ShowControl {
    /// Plays the show of a file, whose scenes are of `default` unless they name a model, and look `usual` unless they say
    /// otherwise.
    pub(super) fn new((file, show): (PathBuf, Show), default: SceneSource, usual: Look, now: Instant) -> Self {
        let player = Player::new(show, now);
        Self { file, player, default, usual, change: 0, read: None, awaited: Vec::new(), fade: None, stands_in: false }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.player.show().scenes.is_empty()
    }

    /// Takes an edited show.
    pub(super) fn take_edit(&mut self, (show, map): (Show, SceneMap)) {
        self.player.set_show(show, map);
        self.read = None;
        self.awaited.retain_mut(|awaited| {
            let now = map.now(awaited.index);
            awaited.index = now.unwrap_or(awaited.index);
            now.is_some()
        });
    }

    /// The model that was to stand in for the scenes cannot be shown either.
    pub(super) fn forget_stand_in(&mut self) {
        self.stands_in = false;
    }

    /// Whether the wall fades into a frame of this change, the first.
    pub(super) fn fades(&self) -> bool {
        !self.player.show().fade.is_zero()
    }

    /// The new picture's part of the light; 1 without a fade.
    pub(super) fn fade_part(&self, now: Instant) -> f64 {
        let Some(fade) = &self.fade else { return 1.0 };
        let passed = now.saturating_duration_since(fade.since).as_secs_f64();
        let part = (passed / self.player.show().fade.as_secs_f64()).min(1.0);
        // Without a jolt at either end.
        part * part * (3.0 - 2.0 * part)
    }

    /// When the next picture of a fade is due.
    pub(super) fn fades_at(&self, now: Instant) -> Option<Instant> {
        self.fade.as_ref().map(|_| now + FADE_STEP)
    }

    /// Ends a fade that is over.
    pub(super) fn end_fade(&mut self, now: Instant) {
        let is_over = self.fade_part(now) >= 1.0;
        self.fade.take_if(|_| is_over);
    }

    /// The caption of the picture that is seen most, in a `free` part of the canvas of which some parts are `covered`.
    pub(super) fn caption(&self, free: egui::Rect, covered: &[egui::Rect], now: Instant) -> Option<Caption> {
        let part = self.fade_part(now) as f32;
        let old = self.fade.as_ref().map(|fade| fade.old_caption.as_str()).filter(|_| part < 0.5);
        let text = old.or_else(|| self.player.shown().map(|(_, scene)| scene.caption.as_str()))?;
        let opacity = if self.fade.is_some() { (2.0 * part - 1.0).abs() } else { 1.0 };
        (!text.is_empty()).then(|| Caption::new(text, opacity, free, covered))
    }

    /// A frame of this change is the first on the wall. Returns the path that the camera takes now, and whether it repeats.
    fn on_shown(&mut self, change: u32, now: Instant) -> Option<(Arc<CameraPath>, bool)> {
        let index = self.awaited.iter().position(|awaited| awaited.change == change)?;
        let Awaited { index, path, repeats_path, .. } = self.awaited.drain(..=index).next_back()?;
        let old_caption = self.player.shown().map(|(_, scene)| scene.caption.clone()).unwrap_or_default();
        let path_time = path.as_ref().map(|path| Duration::from_secs_f64(path.duration_seconds()));
        self.player.on_shown(index, path_time, now);
        self.fade = self.fades().then_some(Fade { since: now, old_caption });
        let (number, n_scenes) = (index + 1, self.player.show().scenes.len());
        let caption = self.player.shown().map(|(_, scene)| scene.caption.as_str()).unwrap_or_default();
        tracing::info!("scene {number} of {n_scenes}: {caption}");
        // A later scene was entered meanwhile: its camera is the present one.
        path.filter(|_| self.awaited.is_empty() && self.player.is_playing()).map(|path| (path, repeats_path))
    }
}

impl App<'_> {
    /// Takes the steps of the show that are due, and returns when to call this again.
    pub(super) fn advance_show(&mut self, now: Instant) -> Option<Instant> {
        loop {
            let show = self.show.as_mut()?;
            // One change after the other.
            if let Some(fades_at) = show.fades_at(now) {
                return Some(fades_at);
            }
            match show.player.advance(now) {
                Some(Step::Prepare(index)) => {
                    let scene = show.player.show().scenes[index].clone();
                    self.loader.prepare(index, scene, show.default.clone());
                }
                Some(Step::Enter(index)) => self.enter(index),
                None => return show.player.wakes_at(),
            }
        }
    }

    /// Takes a scene that was read, and has render servers load its model.
    pub(super) fn take_prepared(&mut self, index: usize, prepared: Prepared) {
        self.loader.load_next();
        let Some(show) = &mut self.show else { return };
        let now = Instant::now();
        // One that was edited meanwhile is read again.
        if prepared.as_ref().is_ok_and(|cue| show.player.show().scenes.get(index) != Some(&cue.scene)) {
            return;
        }
        let read = prepared.map(|cue| {
            let next = (cue.model.scene, cue.model.path());
            show.read = Some((index, cue));
            self.farm.update_goal(|goal| goal.next_scene = Some(next));
        });
        let problem = read.as_ref().err().cloned();
        if show.player.on_read(index, read, now)
            && let Some(problem) = problem
        {
            tracing::warn!("scene {} is left out: {problem}", index + 1);
        }
        if show.player.is_stuck() && self.model.is_none() && !show.stands_in {
            tracing::warn!("no scene of {} can be shown: {} is until one can", show.file.display(), show.default);
            show.stands_in = true;
            self.loader.load(show.default.clone());
        }
        self.redraw();
    }

    fn enter(&mut self, index: usize) {
        let Some(show) = &mut self.show else { return };
        let Some((_, cue)) = show.read.take().filter(|(read, _)| *read == index) else { return };
        let parts = self.free_parts();
        let is_same_model = self.model.as_ref() == Some(&cue.model);
        if !is_same_model {
            self.announce(&cue.model);
        }
        let Some(show) = &mut self.show else { return };
        show.change += 1;
        if show.awaited.len() == MOST_AWAITED {
            show.awaited.remove(0);
        }
        let (path, repeats_path) = (cue.path.clone(), cue.repeats_path());
        show.awaited.push(Awaited { change: show.change, index, path, repeats_path });
        self.picture.set_look(cue.look(show.usual));
        self.camera.enter(&cue, is_same_model, &parts);
        self.model = Some(cue.model);
        self.want_picture();
        self.redraw();
    }

    /// The first frame of a change is on the wall.
    pub(super) fn on_change_shown(&mut self, change: u32, now: Instant) {
        let path = self.show.as_mut().and_then(|show| show.on_shown(change, now));
        if let Some((path, repeats)) = path {
            self.camera.begin_path(path, repeats, now);
        }
    }

    /// A hand is on the wall, or on a remote. Returns whether it ended a scene, and so moves nothing.
    pub(super) fn touch_show(&mut self) -> bool {
        let Some(show) = &mut self.show else { return false };
        let ends = show.player.touch();
        if !ends {
            show.player.steer(Instant::now());
        }
        self.remote.has_news = true;
        ends
    }

    /// Another model is on the wall: one that was opened by hand, unless it stands in for the scenes.
    pub(super) fn leave_show(&mut self) {
        let Some(show) = &mut self.show else { return };
        if std::mem::take(&mut show.stands_in) {
            return;
        }
        show.player.leave(Instant::now());
        show.awaited.clear();
        show.fade = None;
        self.farm.update_goal(|goal| goal.next_scene = None);
    }

    /// An order to the show.
    pub(super) fn order_show(&mut self, order: impl FnOnce(&mut Player)) -> Effect {
        let Some(show) = &mut self.show else { return Effect::note(NO_SHOW) };
        if show.is_empty() {
            return Effect::note("The show has no scenes yet: Ctrl+K keeps the present view as one");
        }
        order(&mut show.player);
        // Nothing else may change on a wall at rest.
        self.remote.has_news = true;
        Effect::default()
    }

    /// Keeps the present view as the last scene of the show.
    pub(super) fn keep_scene(&self, caption: String, seconds: Option<Duration>) -> Effect {
        let Some(show) = &self.show else { return Effect::note(NO_SHOW) };
        let (Some(model), Some((camera, up))) = (&self.model, self.camera.present_view()) else {
            return Effect::default();
        };
        let has_models = show.player.show().scenes.iter().any(|scene| scene.model.is_some());
        if model.path().is_none() && has_models {
            return Effect::problem("the scene is not kept: the built-in model can be in no show of other models");
        }
        let Look { light, clip, rays, path } = self.picture.look();
        let scene = ShowScene {
            model: Model::path(model),
            place: Place::Camera(camera),
            up: Some(up),
            light: Some(light),
            clip,
            rays,
            path_light: path,
            caption,
            ending: Ending { after: Some(seconds.unwrap_or(KEPT_SECONDS)), by_touch: false, waits: false },
        };
        let file = show.file.clone();
        Effect::job(move || {
            let show = show::add_scene(&file, &scene)?;
            let note = format!("Scene {} is kept in {}", show.scenes.len(), file.display());
            Ok(Effect { show: Some(Box::new((show, SceneMap::Same))), ..Effect::note(note) })
        })
    }

    /// Changes a scene of the show, by its number from 1; without one, the scene on the wall.
    pub(super) fn edit_scene(&self, number: Option<usize>, edit: SceneEdit) -> Effect {
        let Some(show) = &self.show else { return Effect::note(NO_SHOW) };
        let shown = show.player.shown().map(|(index, _)| index);
        let index = number.map_or(shown, |number| number.checked_sub(1));
        let scene = index.and_then(|index| Some((index, show.player.show().scenes.get(index)?.clone())));
        let Some((index, scene)) = scene else { return Effect::note("The show has no such scene") };
        let file = show.file.clone();
        Effect::job(move || {
            let (show, map) = show::edit_scene(&file, (index, &scene), &edit)?;
            let Some(map) = map else {
                let note = format!("Scene {} has changed meanwhile, and is left so", index + 1);
                return Ok(Effect { show: Some(Box::new((show, SceneMap::Same))), ..Effect::note(note) });
            };
            let note = match map {
                SceneMap::Same => format!("Scene {} is changed", index + 1),
                SceneMap::Moved { to, .. } => format!("Scene {} is scene {} now", index + 1, to + 1),
                SceneMap::Deleted(_) => format!("Scene {} is deleted", index + 1),
            };
            Ok(Effect { show: Some(Box::new((show, map))), ..Effect::note(note) })
        })
    }

    /// Moves the scene on the wall to the place of the one before, or after.
    pub(super) fn move_scene(&self, is_later: bool) -> Effect {
        let shown = self.show.as_ref().and_then(|show| Some((show.player.shown()?.0, show.player.show().scenes.len())));
        let to = shown.and_then(|(index, n_scenes)| match is_later {
            true => Some(index + 1).filter(|&to| to < n_scenes),
            false => index.checked_sub(1),
        });
        to.map_or_else(Effect::default, |to| self.edit_scene(None, SceneEdit::Move { to }))
    }
}

const NO_SHOW: &str = "The wall plays no show: start it with --show FILE.toml, as its manual says";
