//! Places of panels and texts: nothing lies over anything else that must be read.

use super::*;

/// A model of which everything is long: names, numbers, paths.
fn long() -> OverlayModel {
    let mut model = columns(3);
    let name = "a-render-server-with-a-very-long-name.in-the-machine-room.example.org";
    model.status.nodes.iter_mut().for_each(|node| node.name = name.to_owned());
    let frame = model.frame.as_mut().expect("a frame");
    (frame.bytes_in, frame.bytes_out, frame.render_ms) = (987_654_321, 87_654_321, 123_456.7);
    frame.size = FrameSize::new(16_384, 4096).expect("the largest");
    for node in &mut frame.nodes {
        (node.name, node.bytes_in, node.mbit_per_s, node.trace_ms) = (name.to_owned(), 987_654_321, 98_765.0, 54_321.0);
    }
    model.outputs.iter_mut().for_each(|output| output.monitor = Some(name.to_owned()));
    model.model.as_mut().expect("a model").name = format!("{name}.ply");
    model
}

#[test]
fn no_text_lies_over_another_in_any_window() {
    for size in [[355.0, 200.0], [711.0, 533.0], [900.0, 600.0], [1422.0, 800.0]] {
        let model = long();
        let mut harness = Harness::builder().with_size(size).with_context_setup(apply_style).build_ui(|ui| {
            show(ui, &model);
        });
        harness.run();
        let window = Rect::from_min_size(egui::Pos2::ZERO, size.into());
        let labels: Vec<_> =
            harness.query_all_by_role(egui::accesskit::Role::Label).map(|label| label.rect()).collect();
        assert!(labels.len() > 20, "{size:?}: {labels:?}");
        for (index, label) in labels.iter().enumerate().filter(|(_, label)| window.contains_rect(**label)) {
            for other in &labels[..index] {
                let shared = label.intersect(*other);
                assert!(shared.width() < 1.0 || shared.height() < 3.0, "{size:?}: {label:?} lies over {other:?}");
            }
        }
    }
}

#[test]
fn a_help_that_is_longer_than_the_window_has_a_scroll_bar_that_is_seen() {
    /// The least opacity of a bar, of 255.
    const SEEN: u8 = 60;
    let is_bar = |shape: &egui::epaint::ClippedShape| match &shape.shape {
        egui::Shape::Rect(bar) => {
            bar.rect.width() <= style::SCROLL_BAR && bar.rect.height() > 100.0 && bar.fill.a() >= SEEN
        }
        _ => false,
    };
    for (size, needs_bar) in [([889.0, 667.0], true), ([1600.0, 1400.0], false)] {
        let model = OverlayModel { help: true, ..running() };
        let mut harness = Harness::builder().with_size(size).with_context_setup(apply_style).build_ui(|ui| {
            show(ui, &model);
        });
        harness.run();
        assert_eq!(harness.output().shapes.iter().any(is_bar), needs_bar, "{size:?}");
    }
}

#[test]
fn test_patterns_are_free_of_panels_but_not_of_messages() {
    let model = OverlayModel {
        is_aligning: true,
        note: Some("align: drag a corner".to_owned()),
        tint: Tint::Nodes,
        ..running()
    };
    commands_of(&model, |harness| {
        harness.get_by_label("align: drag a corner");
        assert!(harness.query_by_label("24.2 frames/s").is_none());
    });
}

#[test]
fn messages_are_seen_without_the_panel_and_above_dialogs() {
    let messages = vec!["a.ply: no such file".to_owned()];
    for (panel, help) in [(false, false), (false, true), (true, true)] {
        let model = OverlayModel { panel, help, messages: messages.clone(), ..running() };
        assert!(model.is_visible());
        let commands = commands_of(&model, |harness| harness.get_by_label("Dismiss").click());
        assert_eq!(commands, [Command::DismissMessage]);
    }
}

/// A model with a tint, which needs a legend.
fn tinted(tint: Tint, mut model: OverlayModel) -> OverlayModel {
    let task = crate::farm::stats::FrameTask {
        node: NodeId(1),
        task: Division::Tiled.task(0, 1),
        trace_cpu_ns: 8192 * 2500,
        costs: Default::default(),
    };
    model.frame.as_mut().expect("a frame").tasks = [task].into_iter().collect();
    OverlayModel { tint, ..model }
}

#[test]
fn a_legend_lies_over_no_panel_in_any_window() {
    for size in [[355.0, 400.0], [600.0, 500.0], [889.0, 667.0], [1422.0, 800.0]] {
        let model = tinted(Tint::Cost, long());
        let output = RefCell::new(OverlayOutput::default());
        let mut harness = Harness::builder().with_size(size).with_context_setup(apply_style).build_ui(|ui| {
            *output.borrow_mut() = show(ui, &model);
        });
        harness.run();
        let legend = harness.get_by_label("CPU time: 0").rect();
        let window = Rect::from_min_size(egui::Pos2::ZERO, size.into());
        assert!(window.contains_rect(legend), "{size:?}: {legend:?}");
        let panels = &output.borrow().panels;
        assert!(!panels.is_empty());
        for panel in panels {
            assert!(!panel.intersects(legend), "{size:?}: {legend:?} lies over {panel:?}");
        }
    }
}

#[test]
fn colours_on_the_picture_have_a_legend() {
    let model = tinted(Tint::Nodes, OverlayModel { panel: false, ..running() });
    commands_of(&model, |harness| {
        harness.get_by_label("north");
    });
    commands_of(&OverlayModel { tint: Tint::Cost, ..model.clone() }, |harness| {
        harness.get_by_label("2.5 µs a tile");
    });
    commands_of(&OverlayModel { tint: Tint::None, view: ShadingMode::Cost, panel: true, ..model }, |harness| {
        harness.get_by_label("triangle tests");
    });
}
