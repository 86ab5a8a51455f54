//! The overlay as a person or a screen reader sees it.

mod places;
mod switches;

use std::cell::RefCell;

use egui::accesskit::Toggled;
use egui_kittest::{Harness, kittest::NodeT, kittest::Queryable};
use glam::DVec3;
use shared::{
    division::FrameSize,
    protocol::{Encoding, SceneState},
    structure::Storage,
};

use super::*;
use crate::{
    farm::stats::{NodeFrameStats, NodeId, NodeStatus},
    wall::Wall,
};

/// The commands that come of showing `model` and of `act`.
fn commands_of(model: &OverlayModel, act: impl FnOnce(&mut Harness<'_>)) -> Vec<Command> {
    let commands = RefCell::new(Vec::new());
    let mut harness = Harness::builder()
        .with_size([1600.0, 900.0])
        .with_context_setup(apply_style)
        .build_ui(|ui| commands.borrow_mut().extend(show(ui, model).commands));
    harness.run();
    act(&mut harness);
    harness.run();
    drop(harness);
    commands.into_inner()
}

fn node(id: u32, name: &str, scene: Option<SceneState>) -> NodeStatus {
    NodeStatus {
        id: NodeId(id),
        name: name.to_owned(),
        address: ([10, 0, 0, id as u8], 40_000).into(),
        threads: 8,
        scene,
        is_silent: false,
        n_failures: 0,
        round_trip_ms: Some(0.25),
    }
}

pub(super) fn running() -> OverlayModel {
    let nodes = [("north", 0.75, 20.0), ("south", 0.25, 5.0)].into_iter().zip(1..);
    let frame = FrameStats {
        frame: 7,
        size: FrameSize::PAPER,
        division: Division::Tiled,
        render_ms: 23.46,
        interval_ms: 23.46,
        place_ms: 1.5,
        imbalance: 1.6,
        attempts: 1,
        is_healed: false,
        n_lost: 0,
        n_healed: 0,
        fetching: Vec::new(),
        bytes_in: 1_573_000,
        bytes_out: 420,
        nodes: nodes
            .map(|((name, share, trace_ms), id)| NodeFrameStats {
                id: NodeId(id),
                name: name.to_owned(),
                address: None,
                n_failures: 0,
                round_trip_ms: None,
                share,
                trace_ms,
                trace_cpu_ms: trace_ms,
                busy_ms: trace_ms,
                network_ms: 1.25,
                idle_ms: 3.5,
                taken_over: 0,
                encoding: Encoding::Lz4,
                mbit_per_s: 612.0,
                bytes_in: 786_500,
                bytes_out: 210,
            })
            .collect(),
        tasks: Default::default(),
    };
    let display = DisplayStats { upload_ms: 0.5, draw_ms: 2.25, present_ms: 0.125, latency_ms: 41.0 };
    OverlayModel {
        panel: true,
        frame: Some(frame),
        display: Some(display),
        frames_per_second: Some(24.25),
        status: FarmStatus {
            nodes: vec![
                node(
                    1,
                    "north",
                    Some(SceneState::Ready {
                        triangles: 1_000_000,
                        bytes: 39_000_000,
                        grid: Some(Structure { storage: Storage::Tree, density: 64.0 }),
                    }),
                ),
                node(2, "south", Some(SceneState::Ready { triangles: 1_000_000, bytes: 1, grid: None })),
            ],
            n_healed: 3,
            n_lost: 0,
            notices: Default::default(),
            probed: None,
            seen: None,
            way: None,
            percent: None,
        },
        model: Some(ModelSummary {
            name: "statue".to_owned(),
            n_triangles: 1_000_000,
            is_solid: true,
            extent: DVec3::new(1.0, 1.9, 1.0),
            found: Vec::new(),
            left_out: Vec::new(),
        }),
        min_renderers: 1,
        ..Default::default()
    }
}

#[test]
fn every_figure_has_its_name() {
    commands_of(&running(), |harness| {
        for label in [
            "24.2 frames/s",
            "41 ms from camera to picture",
            "render 23.5",
            "place 1.5",
            "upload 0.5",
            "draw 2.2",
            "present 0.1",
            "nodes 2",
            "resolution 1024x512",
            "received 1.6 MB",
            "sent 420 B",
            "imbalance ×1.60",
            "attempts 1",
            "1 000 000 triangles, y up",
        ] {
            harness.get_by_label(label);
        }
    });
}

#[test]
fn the_panel_of_the_model_says_what_is_left_out() {
    let mut model = running();
    let summary = model.model.as_mut().expect("a model");
    (summary.n_triangles, summary.found) = (1, vec!["2 materials, 1 image of up to 8x8 texels".to_owned()]);
    summary.left_out = (1..=6).map(|number| format!("image {number} is left out")).collect();
    commands_of(&model, |harness| {
        for label in ["1 triangle, y up", "2 materials, 1 image of up to 8x8 texels", "image 4 is left out"] {
            harness.get_by_label(label);
        }
        assert!(harness.query_by_label("image 5 is left out").is_none());
        harness.get_by_label("2 more lines in the log");
    });
}

#[test]
fn foreign_texts_forge_no_lines() {
    let mut model = running();
    let foreign = |text: &str| format!("{text}\n\u{202e}\u{1b}[31mx");
    model.status.nodes[1].name = foreign("south");
    model.status.nodes[1].scene = Some(SceneState::Missing { reason: foreign("no file") });
    model.messages = vec![foreign("problem")];
    model.note = Some(foreign("note"));
    let entries = vec![FileEntry { name: foreign("dragon"), bytes: Some(1) }];
    let files = Some(FileList { folder: foreign("models"), entries, ..FileList::default() });
    commands_of(&model, |harness| {
        for label in ["south [31mx", "no file [31mx", "problem [31mx", "note [31mx"] {
            harness.get_by_label(label);
        }
    });
    commands_of(&OverlayModel { files, ..model }, |harness| {
        for label in ["models [31mx", "dragon [31mx", "problem [31mx"] {
            harness.get_by_label(label);
        }
    });
}

#[test]
fn every_render_server_has_its_row() {
    let mut model = running();
    let south = "south has another file: start it with --model dragon.ply";
    model.status.nodes[1].scene = Some(SceneState::Missing { reason: south.to_owned() });
    model.status.nodes.push(node(3, "west", Some(SceneState::Loading { progress: 0.42 })));
    model.status.nodes.push(node(4, "east", None));
    model.status.n_lost = 2;
    commands_of(&model, |harness| {
        for label in [
            "Render servers: 1 of 4 ready, 2 lost, 3 frames healed",
            "north",
            "10.0.0.1:40000, 8 threads, LZ4",
            "share 75 %",
            "trace 20.0",
            "ready",
            "south",
            south,
            "no model",
            "share 25 %",
            "trace 5.0",
            "west",
            "loading 42 %",
            "east",
            "connected",
        ] {
            harness.get_by_label(label);
        }
        assert_eq!(harness.get_all_by_label("idle 3.5").count(), 2);
        assert_eq!(harness.get_all_by_label("network 1.2").count(), 2);
        assert_eq!(harness.get_all_by_label("bytes 787 KB").count(), 2);
        assert_eq!(harness.get_all_by_label("ping 0.2").count(), 4);
        assert_eq!(harness.get_all_by_label("trace –").count(), 2, "no figures without a share");
    });
}

#[test]
fn without_render_servers_the_wall_says_how_to_start_one() {
    let mut model = running();
    model.status.nodes.clear();
    model.join.command = "renderer connect 10.0.0.9:7117".to_owned();
    commands_of(&model, |harness| {
        harness.get_by_label("No render server is connected.");
        harness.get_by_label("renderer connect 10.0.0.9:7117");
    });
}

#[test]
fn too_few_render_servers_are_counted_before_the_first_frame() {
    const WAITING: &str = "Waiting for render servers: 2 of 3 are ready.";
    let model = OverlayModel { min_renderers: 3, frame: None, ..running() };
    commands_of(&model, |harness| _ = harness.get_by_label(WAITING));
    let model = OverlayModel { min_renderers: 3, ..running() };
    commands_of(&model, |harness| assert!(harness.query_by_label(WAITING).is_none()));
}

#[test]
fn a_message_stays_until_it_is_dismissed() {
    let model = OverlayModel { messages: vec!["a.ply: no such file".to_owned()], ..running() };
    let commands = commands_of(&model, |harness| {
        harness.get_by_label("a.ply: no such file");
        harness.get_by_label("Dismiss").click();
    });
    assert_eq!(commands, [Command::DismissMessage]);
}

#[test]
fn reading_a_model_shows_how_far_it_is() {
    let model = OverlayModel { loading: Some(("dragon.ply".to_owned(), 0.5)), frames_per_second: None, ..running() };
    commands_of(&model, |harness| {
        harness.get_by_label("Reading dragon.ply: 50 %");
        harness.get_by_label("loading");
        assert!(harness.query_by_label("at rest").is_none());
    });
}

#[test]
fn a_resting_wall_says_what_it_does() {
    for (percent, is_refining, n_samples, label) in [
        (Some(43), true, [16, 256], "refining: 43 %"),
        (None, true, [16, 256], "refining"),
        (None, true, [256, 256], "finished"),
        (None, false, [1, 1], "at rest"),
    ] {
        let status = FarmStatus { percent, ..running().status };
        let model = OverlayModel { frames_per_second: None, is_refining, n_samples, status, ..running() };
        commands_of(&model, |harness| _ = harness.get_by_label(label));
    }
}

#[test]
fn help_lists_every_key_and_every_gesture() {
    let model = OverlayModel { help: true, ..running() };
    let commands = commands_of(&model, |harness| {
        for binding in crate::control::input::KEYS {
            harness.get_by_label(&binding.names());
            harness.get_by_label(binding.help);
        }
        for (gesture, effect) in crate::control::input::MOUSE {
            harness.get_by_label(gesture);
            harness.get_by_label(effect);
        }
        let last = harness.get_by_label(crate::control::input::MOUSE[crate::control::input::MOUSE.len() - 1].1).rect();
        assert!(last.max.y < 768.0, "{last:?} is below the edge of a window as high as most");
        harness.get_by_label("Close (F1)").click();
    });
    assert_eq!(commands, [Command::ToggleHelp]);
}

#[test]
fn a_hidden_overlay_covers_nothing() {
    let areas = RefCell::new(Vec::new());
    let mut harness = Harness::new_ui(|ui| *areas.borrow_mut() = show(ui, &OverlayModel::default()).areas);
    harness.run();
    drop(harness);
    assert!(areas.into_inner().is_empty());
}

#[test]
fn more_render_servers_than_fit_are_scrolled() {
    let mut model = running();
    model.status.nodes = (1..=40).map(|id| node(id, &format!("node-{id}"), None)).collect();
    let areas = RefCell::new(Vec::new());
    let mut harness =
        Harness::builder().with_size([1600.0, 900.0]).build_ui(|ui| *areas.borrow_mut() = show(ui, &model).areas);
    harness.run();
    drop(harness);
    let areas = areas.into_inner();
    assert!(areas[0].max.y <= 900.0 && areas[0].height() > 700.0, "{areas:?}");
}

#[test]
fn every_bar_says_its_figures() {
    commands_of(&running(), |harness| {
        harness.get_by_label("north: tracing 20.0 ms, network 1.2 ms, idle 3.5 ms");
        harness.get_by_label("south: tracing 5.0 ms, network 1.2 ms, idle 3.5 ms");
    });
}

#[test]
fn a_dozen_render_servers_fit_without_scrolling() {
    let mut model = running();
    model.status.nodes = (1..=12)
        .map(|id| node(id, &format!("node-{id}"), Some(SceneState::Ready { triangles: 9, bytes: 9, grid: None })))
        .collect();
    for frame in 0..50 {
        model.history.add(FrameTimes { render_ms: 20.0, latency_ms: 30.0 + f64::from(frame) });
    }
    commands_of(&model, |harness| {
        harness.get_by_label("Last frames, to 100 ms");
        let last = harness.get_by_label_contains("node-12: tracing");
        assert!(last.rect().max.y < 880.0, "{:?}", last.rect());
        harness.get_by_label("Record (C)").click();
    });
}

#[test]
fn the_model_its_views_and_the_clicked_point_are_shown() {
    let pick = Pick { triangle: Some(123_456), point: DVec3::new(0.25, -1.5, 30.0), normal: DVec3::Y, distance: 2.5 };
    let model = OverlayModel { views: vec![1, 4], pick: Some(pick), is_playing: true, ..running() };
    let commands = commands_of(&model, |harness| {
        harness.get_by_label("Triangle 123 456 at (0.25000, -1.5000, 30.0000), 2.5000 from the eye");
        harness.get_by_label("1.0000 × 1.9000 × 1.0000 in its own unit");
        harness.get_by_label("39 MB in memory, 39 bytes a triangle");
        harness.get_by_label("Grid: masks, 64 cells a triangle");
        harness.get_by_label("view 4").click();
        harness.run();
        harness.get_by_label("Stop (Space)").click();
        harness.run();
        harness.get_by_label("Open (Ctrl+O)").click();
    });
    assert_eq!(commands, [Command::GoToView(4), Command::TogglePlaying, Command::ToggleFiles]);
}

#[test]
fn files_are_listed_and_can_be_opened() {
    let entry = |name: &str, bytes| FileEntry { name: name.to_owned(), bytes };
    let entries = vec![entry("scans", None), entry("dragon.ply", Some(23_000_000))];
    let files = FileList { folder: "/models".to_owned(), entries, chosen: 1, ..FileList::default() };
    let model = OverlayModel { files: Some(files), help: true, ..running() };
    let commands = commands_of(&model, |harness| {
        harness.get_by_label("/models");
        harness.get_by_label("23 MB");
        let chosen = harness.get_by_label("dragon.ply").accesskit_node().toggled();
        assert_eq!(chosen, Some(Toggled::True));
        harness.get_by_label("scans/").click();
        harness.run();
        harness.get_by_label("Close (Esc)").click();
    });
    assert_eq!(commands, [Command::OpenEntry(0), Command::ToggleFiles]);
    let problem = Some("This folder cannot be read".to_owned());
    let loading = FileList { is_loading: true, ..FileList::default() };
    for (files, label) in [
        (FileList { problem, ..FileList::default() }, "This folder cannot be read"),
        (loading, "Looking …"),
        (FileList::default(), "No model is in this folder."),
    ] {
        commands_of(&OverlayModel { files: Some(files), ..OverlayModel::default() }, |harness| {
            harness.get_by_label(label);
        });
    }
}

#[test]
fn a_note_is_shown_without_the_panel_and_takes_no_clicks() {
    let model = OverlayModel { note: Some("View 3 is kept".to_owned()), ..OverlayModel::default() };
    let areas = RefCell::new(Vec::new());
    let mut harness =
        Harness::builder().with_size([800.0, 600.0]).build_ui(|ui| *areas.borrow_mut() = show(ui, &model).areas);
    harness.run();
    let note = harness.get_by_label("View 3 is kept").rect();
    assert!(note.min.y > 540.0 && (note.center().x - 400.0).abs() < 1.0, "{note:?}");
    drop(harness);
    assert!(areas.into_inner().is_empty(), "the mouse is still the model's");
}

#[test]
fn no_window_is_too_small_for_any_panel() {
    let files =
        Some(FileList { entries: vec![FileEntry { name: "a.ply".to_owned(), bytes: Some(1) }], ..FileList::default() });
    let wall = Wall::of_one_output([4, 4]);
    let region = ProjectorRegion::new(&wall.projectors()[0], Rect::ZERO).expect("upright");
    let model =
        OverlayModel { files, tint: Tint::Cost, regions: vec![region], note: Some("a".to_owned()), ..running() };
    for side in [1.0, 17.0, 64.0] {
        let mut harness = Harness::builder().with_size([side, side]).with_context_setup(apply_style).build_ui(|ui| {
            show(ui, &model);
        });
        harness.run();
    }
}

/// A wall of one projector on each of `n_monitors` side by side; all show a frame.
fn columns(n_monitors: usize) -> OverlayModel {
    let projector = |index: usize| {
        format!(
            "[[projector]]\nname = \"column {index}\"\noutput = \"DP-{index}\"\npixels = [4, 4]\nat_m = [{index}, 0]\n\
             size_m = [1, 1]\n"
        )
    };
    let projectors: String = (0..n_monitors).map(projector).collect();
    let wall = Wall::from_toml("columns", &format!("canvas_m = [{n_monitors}, 1]\n{projectors}")).expect("a wall");
    let outputs = (0..n_monitors)
        .map(|index| OutputState { monitor: Some(format!("DP-{index}")), shows: OutputContent::Frame(41) });
    OverlayModel { wall: WallDrawing::new(&wall), outputs: outputs.collect(), ..running() }
}

#[test]
fn each_projector_is_drawn_with_what_its_output_shows() {
    let mut model = columns(3);
    model.outputs[1].shows = OutputContent::MonitorMissing;
    model.outputs[2].shows = OutputContent::Nothing;
    commands_of(&model, |harness| {
        let at = |label| harness.get_by_label(label).rect();
        let drawn =
            ["column 0 on DP-0: frame 41", "column 1 on DP-1: monitor missing", "column 2 on DP-2: nothing yet"]
                .map(at);
        assert!(drawn[0].max.x <= drawn[1].min.x + 0.5 && drawn[1].max.x <= drawn[2].min.x + 0.5, "{drawn:?}");
        for label in ["3 projectors, 3 outputs", "DP-0", "frame 41", "monitor missing", "nothing yet"] {
            harness.get_by_label(label);
        }
    });
    let mut harness = Harness::builder().with_size([1600.0, 900.0]).build_ui(|ui| {
        show(ui, &OverlayModel { wall: WallDrawing::new(&Wall::paper()), ..columns(1) });
    });
    harness.run();
    harness.get_by_label("12 projectors, 1 output");
    harness.get_by_label("row 3 column 4 on DP-0: frame 41");
}

#[test]
fn of_many_outputs_those_that_show_nothing_are_named() {
    let mut model = columns(9);
    model.outputs[7].shows = OutputContent::MonitorMissing;
    commands_of(&model, |harness| {
        harness.get_by_label("8 of 9 outputs show frames");
        harness.get_by_label("DP-7");
        assert!(harness.query_by_label("DP-6").is_none());
    });
}
