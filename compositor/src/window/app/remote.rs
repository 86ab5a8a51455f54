//! Remotes: their orders become commands and motions, as keys and mouse do, and they learn the wall's state.

use std::time::{Duration, Instant};

use glam::DVec2;
use renderer::{formats::file::is_named_as_model, model::scene::SceneSource};
use shared::{
    appearance::Light,
    printable::{printable, printable_line},
    protocol::SceneState,
};
use winit::event_loop::ActiveEventLoop;

use super::{App, opening, probing::Purpose, showing::due};
use crate::{
    control::{
        input::Command,
        marks::MarkCommand,
        navigator::{Drag, Nudge},
        show::{Player, SceneEdit},
    },
    farm::stats::{FrameStats, NodeStatus},
    remote::{
        Order, Remote, Shown, Thumbnail,
        message::Action,
        state::{Controls, FarmState, Node, Show, WallState},
    },
    window::effect::Effect,
};

/// Remotes learn the state at most so often.
const STATE_INTERVAL: Duration = Duration::from_millis(100);
/// A new picture is made for them at most so often.
const PICTURE_INTERVAL: Duration = Duration::from_millis(250);
/// Actions that wait for their frame; of more, the oldest are forgotten.
const MOST_UNSHOWN: usize = 1024;

/// The wall's end of the remote, if it has one.
pub(super) struct RemoteControl {
    remote: Option<Remote>,
    /// The models beside the present one, once they were listed.
    pub(super) models: Vec<String>,
    /// Whether the state may have changed since it was told.
    pub(super) has_news: bool,
    told_at: Option<Instant>,
    /// The frame of the last picture, and when it was made.
    pictured: Option<(u64, Instant)>,
    wants_picture: bool,
    /// When actions were carried out that no frame shows yet.
    unshown: Vec<(Instant, Shown)>,
    n_shown: u64,
}

impl RemoteControl {
    pub(super) fn new(remote: Option<Remote>) -> Self {
        Self {
            remote,
            models: Vec::new(),
            has_news: true,
            told_at: None,
            pictured: None,
            wants_picture: false,
            unshown: Vec::new(),
            n_shown: 0,
        }
    }

    /// A frame with the motions until then is on screen.
    pub(super) fn on_shown(&mut self, moved_at: Instant) {
        self.n_shown += 1;
        self.has_news = true;
        for (_, shown) in self.unshown.extract_if(.., |(acted_at, _)| *acted_at <= moved_at) {
            shown.tell();
        }
    }
}

impl App<'_> {
    /// Carries out what remotes have ordered; several motions make one picture.
    pub(super) fn take_orders(&mut self, event_loop: &ActiveEventLoop) {
        let mut has_moved = false;
        while let Some(order) = self.remote.remote.as_mut().and_then(Remote::take) {
            match order {
                Order::Picture => self.remote.wants_picture = true,
                Order::Act(action, shown) => {
                    let now = Instant::now();
                    has_moved |= self.act(event_loop, action);
                    let unshown = &mut self.remote.unshown;
                    if unshown.len() == MOST_UNSHOWN {
                        unshown.remove(0);
                    }
                    unshown.extend(shown.map(|shown| (now, shown)));
                }
            }
        }
        if has_moved {
            self.want_picture();
        }
    }

    /// Carries out one action. Returns whether it moved the camera, which a picture must show.
    pub(super) fn act(&mut self, event_loop: &ActiveEventLoop, action: Action) -> bool {
        self.kiosk.touch(Instant::now());
        if action.is_steering() && self.touch_show() {
            self.redraw();
            return false;
        }
        let command = match action {
            Action::Orbit { x, y } => return self.nudge(Nudge::Drag(Drag::Orbit, DVec2::new(x, y))),
            Action::Pan { x, y } => return self.nudge(Nudge::Drag(Drag::Pan, DVec2::new(x, y))),
            Action::Dolly { factor, x, y } => return self.nudge(Nudge::Dolly { factor, at: DVec2::new(x, y) }),
            Action::Roll { degrees } => return self.nudge(Nudge::Roll(degrees.to_radians())),
            Action::GoTo { x, y } => {
                self.probe_at(Purpose::GoTo, DVec2::new(x, y));
                return false;
            }
            Action::Open { model } => {
                self.open_beside(&model);
                return false;
            }
            Action::KeepScene { caption, seconds } => {
                let effect = self.keep_scene(printable_line(&caption), seconds.map(Duration::from_secs_f64));
                self.apply(effect);
                return false;
            }
            Action::EditScene { scene, caption, seconds } => {
                let caption = caption.map(|caption| printable_line(&caption));
                return self.act_on_scene(scene, SceneEdit::Change { caption, seconds });
            }
            Action::MoveScene { scene, to } => return self.act_on_scene(scene, SceneEdit::Move { to: to - 1 }),
            Action::DeleteScene { scene } => return self.act_on_scene(scene, SceneEdit::Delete),
            Action::PlayShow | Action::PauseShow => {
                let (plays, now) = (action == Action::PlayShow, Instant::now());
                let effect = self.order_show(|show| if plays { show.play(now) } else { show.pause(now) });
                self.apply(effect);
                self.redraw();
                return false;
            }
            Action::NextScene => Command::NextScene,
            Action::PreviousScene => Command::PreviousScene,
            Action::ListModels => {
                self.list_models();
                return false;
            }
            // The conversation has dealt with these.
            Action::Leave | Action::Watch { .. } => return false,
            Action::ViewAll => Command::ViewAll,
            Action::GoToView { number } => Command::GoToView(number),
            Action::GoToAnnotation { number } => Command::Mark(MarkCommand::GoTo(number)),
            Action::DeleteAnnotation { number } => Command::Mark(MarkCommand::Delete(number)),
            Action::Annotate { x, y, label, text } => {
                self.annotate_at(DVec2::new(x, y), (label, text));
                return false;
            }
            Action::KeepView { number } => Command::KeepView(number),
            Action::Play => Command::TogglePlaying,
            Action::Light { azimuth_deg, elevation_deg } => {
                Command::SetLight(Light::new(azimuth_deg, elevation_deg).unwrap_or_default())
            }
            Action::Sun { degrees } => Command::SetSun((degrees * 10.0).round() as u16),
            Action::Ground { on } => Command::SetGround(on),
            Action::Exposure { stops } => Command::SetExposure((stops * 10.0).round() as i16),
            Action::Background { colors } => Command::SetBackground(colors),
            Action::Cut { side, permille } => Command::SetClip(Action::clip(side, permille)),
            Action::Division { division } => Command::SetDivision(division),
            Action::Rays { rays } => Command::SetLighting(rays),
            Action::Shading { shading } => Command::SetShading(shading),
            Action::Dismiss => Command::DismissMessage,
        };
        self.perform(event_loop, command);
        false
    }

    /// Moves the camera by a hand, wherever it is. Returns whether it moved.
    pub(super) fn nudge(&mut self, nudge: Nudge) -> bool {
        self.camera.navigator.as_mut().is_some_and(|navigator| navigator.nudge(nudge))
    }

    /// Opens a model of the folder in which the present one is.
    fn open_beside(&mut self, name: &str) {
        let Some(model) = &self.model else { return };
        let path = opening::folder_of(&model.source).join(name);
        if is_named_as_model(&path) && path.is_file() {
            self.loader.load(SceneSource::File(path));
        } else {
            self.apply(Effect::note(format!("There is no model {name} here")));
        }
        self.redraw();
    }

    fn list_models(&mut self) {
        let Some(model) = &self.model else { return };
        let folder = opening::folder_of(&model.source);
        let list = move || {
            let files = opening::list(&folder).entries.into_iter().filter(|entry| entry.bytes.is_some());
            Ok(Effect { models: Some(files.map(|entry| entry.name).collect()), ..Effect::default() })
        };
        self.apply(Effect::job(list));
    }

    /// Changes a scene of the show; the camera stays.
    fn act_on_scene(&mut self, number: usize, edit: SceneEdit) -> bool {
        let effect = self.edit_scene(Some(number), edit);
        self.apply(effect);
        false
    }

    /// Shows the code that opens the remote, or hides it.
    pub(super) fn toggle_remote(&mut self) -> Effect {
        let Some(remote) = &self.remote.remote else {
            return Effect::note("The wall has no remote: start it with --remote, as its manual says");
        };
        let shown = &mut self.overlay.remote_link;
        *shown = if shown.is_some() { None } else { Some(remote.link().to_owned()) };
        Effect::default()
    }

    /// Tells remotes what is new, and returns when to call this again.
    pub(super) fn tell_remotes(&mut self, now: Instant) -> Option<Instant> {
        self.remote.remote.as_ref()?;
        let rests_at = self.overlay.frames_per_second.and_then(|_| self.presentation.rate.rests_at());
        let note_ends_at = self.overlay.note.as_ref().and_then(|_| self.messages.note_ends_at());
        let (has_ended, ends_at) = due(&[rests_at, note_ends_at], now);
        let may_tell_at = self.remote.told_at.map_or(now, |told_at| told_at + STATE_INTERVAL);
        let has_news = self.remote.has_news || has_ended;
        if has_news && now >= may_tell_at {
            if self.overlay_changed() {
                self.redraw();
            }
            let state = self.remote_state();
            self.remote.remote.iter().for_each(|remote| remote.publish(&state));
            (self.remote.has_news, self.remote.told_at) = (false, Some(now));
        }
        let next_state_at = self.remote.has_news.then_some(may_tell_at);
        [ends_at, next_state_at, self.picture_for_remotes(now)].into_iter().flatten().min()
    }

    /// Makes a picture if somebody looks and there is a new one. Returns when to call this again.
    fn picture_for_remotes(&mut self, now: Instant) -> Option<Instant> {
        let control = &mut self.remote;
        let (remote, frame) = (control.remote.as_ref()?, self.presentation.frame.as_ref()?);
        let is_new = control.pictured.is_none_or(|(number, _)| number != frame.stats.frame);
        let is_wanted = control.wants_picture || is_new && remote.is_watched();
        if !is_wanted {
            return None;
        }
        let may_show_at = control.pictured.map_or(now, |(_, at)| at + PICTURE_INTERVAL);
        if now < may_show_at {
            return Some(may_show_at);
        }
        remote.show(Thumbnail::new(frame.spec.size, &frame.rgba));
        (control.wants_picture, control.pictured) = (false, Some((frame.stats.frame, now)));
        None
    }

    fn remote_state(&self) -> WallState {
        let overlay = &self.overlay;
        let appearance = overlay.appearance;
        let player = self.show.as_ref().map(|show| &show.player);
        let scene = player.and_then(Player::shown);
        let show = Show {
            model: overlay.model.as_ref().map(|model| model.name.clone()).unwrap_or_default(),
            n_triangles: overlay.model.as_ref().map_or(0, |model| model.n_triangles),
            loading: overlay.loading.clone(),
            aspect: self.wall.wall.aspect(),
            views: overlay.views.clone(),
            annotations: self.annotation_labels(),
            annotation: self.shown_annotation(),
            has_path: self.camera.has_path(),
            is_playing: overlay.is_playing,
            n_scenes: player.map(|player| player.show().scenes.len()),
            scene: scene.map(|(index, _)| index + 1),
            caption: scene.map(|(_, scene)| scene.caption.clone()).filter(|caption| !caption.is_empty()),
            scene_seconds: scene.and_then(|(_, scene)| scene.ending.after).map(|after| after.as_secs_f64()),
            is_show_playing: player.is_some_and(Player::is_playing),
            own_certificate: self.remote.remote.as_ref().and_then(Remote::own_seal),
            note: overlay.note.clone(),
        };
        let controls = Controls {
            models: self.remote.models.clone(),
            light_deg: [appearance.light.azimuth_deg(), appearance.light.elevation_deg()],
            sun_deg: appearance.path.sun_degrees(),
            exposure_stops: appearance.path.exposure_ev(),
            has_ground: appearance.path.has_ground(),
            background: appearance.background.to_string(),
            cut: appearance.clip.map(|clip| (clip.side().to_string(), clip.cut_permille())),
            division: overlay.division.to_string(),
            rays: overlay.rays.map(|rays| rays.to_string()),
            shading: overlay.view.to_string(),
            is_locked: self.kiosk.is_locked,
        };
        let display = overlay.display.unwrap_or_default();
        let frame = overlay.frame.as_ref();
        let ms = |value: fn(&FrameStats) -> f64| frame.map_or(0.0, value);
        let farm = FarmState {
            frames_shown: self.remote.n_shown,
            frames_per_second: overlay.frames_per_second,
            resolution: frame.map(|frame| frame.size.to_string()).unwrap_or_default(),
            samples: overlay.n_samples[0],
            render_ms: ms(|frame| frame.render_ms),
            place_ms: ms(|frame| frame.place_ms),
            upload_ms: display.upload_ms,
            draw_ms: display.draw_ms,
            latency_ms: display.latency_ms,
            imbalance: ms(|frame| frame.imbalance),
            nodes_lost: overlay.status.n_lost,
            frames_healed: overlay.status.n_healed,
            nodes: overlay.status.nodes.iter().map(|node| self.remote_node(node)).collect(),
            alerts: self.alerts(),
        };
        WallState { show, controls, farm }
    }

    /// The wall's messages, and scenes of the show that were left out.
    fn alerts(&self) -> Vec<String> {
        let messages = self.messages.all(&self.overlay.status, &self.outputs.missing());
        let of_show = self.show.iter().flat_map(|show| show.player.problems());
        messages.into_iter().chain(of_show).map(|line| printable_line(&line)).collect()
    }

    fn remote_node(&self, node: &NodeStatus) -> Node {
        let (state, detail) = match &node.scene {
            _ if node.is_silent => ("silent", String::new()),
            None => ("joining", String::new()),
            Some(SceneState::Loading { progress }) => ("loading", format!("{:.0} %", progress * 100.0)),
            Some(SceneState::Fetching(transfer)) => ("fetching", transfer.to_string()),
            Some(SceneState::Missing { reason }) => ("missing", printable_line(reason)),
            Some(SceneState::Ready { .. }) => ("ready", String::new()),
        };
        let frame = self.overlay.frame.as_ref();
        let in_frame = frame.and_then(|frame| frame.nodes.iter().find(|of_frame| of_frame.id == node.id));
        Node {
            name: printable(&node.name),
            address: node.address.to_string(),
            threads: node.threads,
            state,
            detail,
            busy_ms: in_frame.map_or(0.0, |node| node.busy_ms),
            share: in_frame.map_or(0.0, |node| node.share),
            losses: node.n_failures,
            round_trip_ms: node.round_trip_ms,
        }
    }
}
