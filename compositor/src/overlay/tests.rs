//! The overlay as a person or a screen reader finds it.

use std::cell::RefCell;

use egui::accesskit::Toggled;
use egui_kittest::{Harness, kittest::NodeT, kittest::Queryable};
use shared::{
    division::FrameSize,
    protocol::{Encoding, SceneState},
};

use super::*;
use crate::stats::{NodeFrameStats, NodeId, NodeStatus};

/// What commands come of showing `model` and doing something with it.
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

fn running() -> OverlayModel {
    let nodes = [("north", 0.75, 20.0), ("south", 0.25, 5.0)].into_iter().zip(1..);
    let frame = FrameStats {
        frame: 7,
        size: FrameSize::PAPER,
        division: Division::Tiled,
        render_ms: 23.46,
        place_ms: 1.5,
        imbalance: 1.6,
        attempts: 1,
        n_lost: 0,
        n_healed: 0,
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
    };
    let display = DisplayStats { upload_ms: 0.5, draw_ms: 2.25, present_ms: 0.125, latency_ms: 41.0 };
    OverlayModel {
        panel: true,
        frame: Some(frame),
        display: Some(display),
        frames_per_second: Some(24.25),
        status: FarmStatus {
            nodes: vec![
                node(1, "north", Some(SceneState::Ready { triangles: 1_000_000, bytes: 1 })),
                node(2, "south", Some(SceneState::Ready { triangles: 1_000_000, bytes: 1 })),
            ],
            n_healed: 3,
            n_lost: 0,
            message: None,
            probed: None,
        },
        model: Some(ModelSummary { name: "statue".to_owned(), n_triangles: 1_000_000, n_rejected: 0 }),
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
            "10.0.0.1:40000, 8 threads",
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
fn the_division_in_force_is_marked_and_can_be_switched() {
    let commands = commands_of(&running(), |harness| {
        let toggled = |label| harness.get_by_label(label).accesskit_node().toggled();
        assert_eq!((toggled("tiled"), toggled("interleaved")), (Some(Toggled::True), Some(Toggled::False)));
        harness.get_by_label("interleaved").click();
    });
    assert_eq!(commands, [Command::SetDivision(Division::Interleaved)]);
}

#[test]
fn the_view_can_be_switched() {
    let commands = commands_of(&running(), |harness| harness.get_by_label("normals").click());
    assert_eq!(commands, [Command::SetView(View::Normals)]);
}

#[test]
fn the_rays_can_be_switched() {
    let commands = commands_of(&running(), |harness| harness.get_by_label("shadows").click());
    assert_eq!(commands, [Command::SetRays(RayTree::Shadows)]);
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
fn too_few_render_servers_are_counted() {
    let model = OverlayModel { min_renderers: 3, ..running() };
    commands_of(&model, |harness| {
        harness.get_by_label("Waiting for render servers: 2 of 3 are ready.");
    });
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
    let model = OverlayModel { loading: Some(("dragon.ply".to_owned(), 0.5)), ..running() };
    commands_of(&model, |harness| {
        harness.get_by_label("Reading dragon.ply: 50 %");
    });
}

#[test]
fn help_lists_every_key_and_every_gesture() {
    let model = OverlayModel { help: true, ..running() };
    let commands = commands_of(&model, |harness| {
        for binding in crate::input::KEYS {
            harness.get_by_label(&binding.names());
            harness.get_by_label(binding.help);
        }
        for (gesture, effect) in crate::input::MOUSE {
            harness.get_by_label(gesture);
            harness.get_by_label(effect);
        }
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
