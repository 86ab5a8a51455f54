//! Switches and settings on the panels: each widget asks for the command that its name says.

use renderer::model::solid::UNFILLED;
use shared::{
    appearance::{Background, Clip, ClipSide, Light},
    camera::UpAxis,
};

use super::*;

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
    assert_eq!(commands, [Command::SetShading(ShadingMode::Normals)]);
}

#[test]
fn the_rays_can_be_switched() {
    let commands = commands_of(&running(), |harness| harness.get_by_label("shadows").click());
    assert_eq!(commands, [Command::SetLighting(Some(LightingMode::Shadows))]);
}

#[test]
fn light_and_background_can_be_set() {
    let appearance = Appearance { background: Background::plain([0; 3]), ..Appearance::default() };
    let commands = commands_of(&OverlayModel { appearance, ..running() }, |harness| {
        harness.get_by_label("Light (L): left shoulder");
        assert_eq!(harness.get_by_label("black").accesskit_node().toggled(), Some(Toggled::True));
        harness.get_by_label("white").click();
        harness.run();
        harness.get_by_role_and_label(egui::accesskit::Role::Slider, "light up").focus();
        harness.run();
        harness.key_press(egui::Key::ArrowRight);
    });
    let light = Light::new(-35, 37).unwrap();
    assert_eq!(commands, [Command::SetBackground(Background::plain([255; 3])), Command::SetLight(light)]);
}

#[test]
fn the_light_of_paths_can_be_set_where_paths_light_pictures() {
    for (rays, is_there) in [(None, true), (Some(LightingMode::Primary), false), (Some(LightingMode::Path), true)] {
        let model = OverlayModel { rays, ..running() };
        commands_of(&model, |harness| {
            let slider = harness.query_by_role_and_label(egui::accesskit::Role::Slider, "exposure ([ and ])");
            assert_eq!(slider.is_some(), is_there, "{rays:?}");
        });
    }
    let slide = |appearance: Appearance, name: &str| {
        let model = OverlayModel { appearance, rays: Some(LightingMode::Path), ..running() };
        commands_of(&model, |harness| {
            harness.get_by_role_and_label(egui::accesskit::Role::Slider, name).focus();
            harness.run();
            harness.key_press(egui::Key::ArrowRight);
        })
    };
    assert!(matches!(slide(Appearance::default(), "exposure ([ and ])")[..], [Command::SetExposure(1..)]));
    assert!(matches!(slide(Appearance::default(), "sun")[..], [Command::SetSun(41..)]));
}

#[test]
fn the_model_can_be_cut_open() {
    let commands = commands_of(&running(), |harness| {
        assert_eq!(harness.get_by_label("cut from none").accesskit_node().toggled(), Some(Toggled::True));
        assert!(harness.query_by_label("cut away").is_none());
        harness.get_by_label("cut from -y").click();
    });
    assert_eq!(commands, [Command::SetClip(Some(Clip::new(ClipSide::MinusY, 500).unwrap()))]);
    let appearance = Appearance { clip: Some(Clip::new(ClipSide::Eye, 250).unwrap()), ..Appearance::default() };
    let commands = commands_of(&OverlayModel { appearance, ..running() }, |harness| {
        let label = harness.get_by_role_and_label(egui::accesskit::Role::Slider, "cut away");
        label.focus();
        harness.run();
        harness.key_press(egui::Key::ArrowRight);
        harness.run();
        harness.get_by_label("cut from x").click();
        harness.run();
        harness.get_by_label("cut from none").click();
    });
    let [Command::SetClip(Some(deeper)), rest @ ..] = &*commands else { panic!("{commands:?}") };
    assert!(deeper.side() == ClipSide::Eye && deeper.cut_permille() > 250, "{deeper}");
    assert_eq!(rest, [Command::SetClip(Some(Clip::new(ClipSide::X, 250).unwrap())), Command::SetClip(None)]);
}

#[test]
fn a_cut_says_what_it_shows() {
    let appearance = Appearance { clip: "eye:25".parse().ok(), ..Appearance::default() };
    let pick = Pick { triangle: None, point: DVec3::ZERO, normal: DVec3::Y, distance: 1.0 };
    let mut model = OverlayModel { appearance, pick: Some(pick), ..running() };
    commands_of(&model, |harness| {
        harness.get_by_label("Cut at (0.0000, 0.0000, 0.0000), 1.0000 from the eye");
        assert!(harness.query_by_label(UNFILLED).is_none());
    });
    model.model.as_mut().unwrap().is_solid = false;
    commands_of(&model, |harness| {
        harness.get_by_label(UNFILLED);
    });
}

#[test]
fn the_tint_can_be_switched() {
    let commands = commands_of(&running(), |harness| harness.get_by_label("who").click());
    assert_eq!(commands, [Command::SetTint(Tint::Nodes)]);
}

#[test]
fn the_resolution_and_the_samples_so_far_are_shown_and_can_be_switched() {
    for (is_refining, toggled) in [(true, Toggled::True), (false, Toggled::False)] {
        let model = OverlayModel { is_refining, n_samples: [4, 16], ..running() };
        let commands = commands_of(&model, |harness| {
            harness.get_by_label("samples: 4 of 16");
            harness.get_by_label("resolution 1024x512");
            let switch = harness.get_by_label("resolution follows the motion (M)");
            assert_eq!(switch.accesskit_node().toggled(), Some(toggled));
            switch.click();
        });
        assert_eq!(commands, [Command::ToggleRefinement]);
    }
    for (is_refining, has_noise_limit, label) in [
        (true, false, "samples: 16, finished"),
        (true, true, "samples: up to 16, finished"),
        (false, false, "samples: 16"),
    ] {
        let model = OverlayModel { is_refining, has_noise_limit, n_samples: [16, 16], ..running() };
        commands_of(&model, |harness| {
            harness.get_by_label(label);
        });
    }
}

#[test]
fn storage_and_density_can_be_switched() {
    let structure = Some(Structure { storage: Storage::RowDisplacement, density: 8.0 });
    let commands = commands_of(&OverlayModel { structure, ..running() }, |harness| {
        let toggled = |label| harness.get_by_label(label).accesskit_node().toggled();
        let expected = [Some(Toggled::True), Some(Toggled::True), Some(Toggled::False), Some(Toggled::False)];
        assert_eq!(["row-displacement", "8", "as started", "32"].map(toggled), expected);
        harness.get_by_label("plain").click();
        harness.run();
        harness.get_by_label("128").click();
        harness.run();
        harness.get_by_label("as started").click();
    });
    let expected = [Command::SetStorage(Some(Storage::Plain)), Command::SetDensity(128), Command::SetStorage(None)];
    assert_eq!(commands, expected);
}

#[test]
fn a_guessed_axis_is_called_a_guess() {
    let overlay = OverlayModel { up: UpAxis::Z, up_is_guessed: true, ..running() };
    commands_of(&overlay, |harness| _ = harness.get_by_label_contains("z up, as guessed (U)"));
}
