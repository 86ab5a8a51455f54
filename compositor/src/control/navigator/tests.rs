//! The camera under mouse and keys, and its limits.

use proptest::prelude::*;
use strum::VariantArray;

use super::*;

const ASPECT: f64 = 16.0 / 9.0;

fn navigator() -> Navigator {
    Navigator::new(Shape::of_box(DVec3::ZERO, DVec3::new(1.0, 2.0, 1.0)), UpAxis::Y, ASPECT)
}

/// The middle of that model.
const MIDDLE: DVec3 = DVec3::new(0.5, 1.0, 0.5);

/// Where a point appears on the canvas.
fn project(camera: &Camera, point: DVec3) -> DVec2 {
    let normal = camera.u().cross(camera.v());
    let ray = point - camera.eye();
    let on_plane = camera.eye() + ray * ((camera.ll() - camera.eye()).dot(normal) / ray.dot(normal)) - camera.ll();
    DVec2::new(
        on_plane.dot(camera.u()) / camera.u().length_squared(),
        on_plane.dot(camera.v()) / camera.v().length_squared(),
    )
}

#[test]
fn the_mouse_moves_nothing_unless_a_button_is_down() {
    let mut navigator = navigator();
    assert!(!navigator.move_to(DVec2::new(0.1, 0.9)));
    navigator.press(Drag::Orbit);
    assert!(navigator.move_to(DVec2::new(0.2, 0.9)));
    navigator.release();
    assert!(!navigator.move_to(DVec2::new(0.5, 0.5)));
}

#[test]
fn an_orbited_model_follows_the_hand() {
    let mut navigator = navigator();
    // The point of the model that faces the eye.
    let front = navigator.pivot() + (navigator.camera().eye() - navigator.pivot()).normalize() * 0.1;
    let before = project(&navigator.camera(), front);
    let middle = project(&navigator.camera(), navigator.pivot());
    navigator.press(Drag::Orbit);
    navigator.move_to(DVec2::new(0.55, 0.55));
    let after = project(&navigator.camera(), front);
    assert!(after.x > before.x && after.y > before.y, "{before} {after}");
    let moved = project(&navigator.camera(), navigator.pivot()) - middle;
    assert!(moved.length() < 1e-9, "the pivot moved by {moved}");
}

#[test]
fn a_panned_model_stays_under_the_cursor() {
    let mut navigator = navigator();
    let before = project(&navigator.camera(), navigator.pivot());
    navigator.press(Drag::Pan);
    navigator.move_to(DVec2::new(0.7, 0.4));
    let moved = project(&navigator.camera(), navigator.pivot()) - before;
    assert!((moved - DVec2::new(0.2, -0.1)).length() < 1e-9, "{moved}");
}

#[test]
fn the_wheel_keeps_what_is_under_the_cursor_there() {
    let mut navigator = navigator();
    navigator.move_to(DVec2::new(0.3, 0.6));
    let point = navigator.point_under(DVec2::new(0.3, 0.6));
    let depth = navigator.depth();
    assert!(navigator.wheel(3.0));
    assert!(navigator.depth() < depth);
    assert!((project(&navigator.camera(), point) - DVec2::new(0.3, 0.6)).length() < 1e-9);
    assert!(navigator.wheel(-3.0));
    assert!((navigator.depth() - depth).abs() < 1e-9);
}

#[test]
fn the_wheel_goes_through_the_model_instead_of_stopping_at_its_middle() {
    let mut navigator = navigator();
    (0..200).for_each(|_| _ = navigator.wheel(1.0));
    let (forward, _) = view_plane(&navigator.camera());
    assert!((navigator.camera().eye() - navigator.pivot()).dot(forward) > navigator.size() * 0.5);
}

#[test]
fn flying_takes_time_and_opposite_keys_cancel() {
    let mut navigator = navigator();
    let eye = navigator.camera().eye();
    assert!(!navigator.advance(0.05, 1.0));
    navigator.hold(Direction::Forward);
    navigator.hold(Direction::Forward);
    assert!(navigator.is_moving() && navigator.advance(0.05, 1.0));
    let step = (navigator.camera().eye() - eye).length();
    assert!((step - navigator.size() * 0.02).abs() < 1e-9, "{step}");
    navigator.hold(Direction::Backward);
    assert!(!navigator.advance(0.05, 1.0));
    navigator.release_key(Direction::Backward);
    navigator.advance(3600.0, 1.0);
    assert!((navigator.camera().eye() - eye).length() < navigator.size() * 0.1, "a pause moved the eye too far");
    navigator.release_all();
    assert!(!navigator.is_moving());
}

#[test]
fn speed_fits_the_model_and_the_person() {
    let step = |size: f64, steps: i32| {
        let mut navigator = Navigator::new(Shape::of_box(DVec3::ZERO, DVec3::splat(size)), UpAxis::Y, ASPECT);
        navigator.change_speed(steps);
        navigator.hold(Direction::Left);
        let eye = navigator.camera().eye();
        navigator.advance(0.05, 1.0);
        (navigator.camera().eye() - eye).length()
    };
    assert!((step(1e6, 0) / step(1e-3, 0) / 1e9 - 1.0).abs() < 1e-9);
    assert!((step(1.0, 2) / step(1.0, 0) - 2.25).abs() < 1e-9);
    assert_eq!(step(1.0, i32::MAX), step(1.0, 10));
    // At any distance, a step covers the same part of it.
    let mut far = navigator();
    far.press(Drag::Dolly);
    (0..6).for_each(|step| _ = far.move_to(DVec2::new(0.5, f64::from(-step))));
    far.hold(Direction::Forward);
    let distance = |navigator: &Navigator| (navigator.camera().eye() - navigator.pivot()).length();
    let before = distance(&far);
    assert!(before > 1e3 * far.size());
    far.advance(0.1, 1.0);
    assert!(distance(&far) < 0.97 * before);
}

#[test]
fn flying_slows_down_before_a_surface_and_passes_it_in_the_end() {
    let mut navigator = navigator();
    let eye = |navigator: &Navigator| navigator.camera().eye();
    let forward = view_plane(&navigator.camera()).0;
    let step = |navigator: &mut Navigator, surface: Option<DVec3>| {
        let before = eye(navigator);
        navigator.set_ahead(surface);
        navigator.advance(0.016, 1.0);
        (eye(navigator) - before).length()
    };
    navigator.hold(Direction::Forward);
    let usual = step(&mut navigator, None);
    let size = navigator.size();
    let ahead = |navigator: &Navigator, part: f64| Some(eye(navigator) + forward * (size * part));
    let (far, near) = (ahead(&navigator, 1.0), ahead(&navigator, 0.01));
    assert!((step(&mut navigator, far) / usual - 1.0).abs() < 0.01, "no slower where there is room");
    let near_step = step(&mut navigator, near);
    assert!(near_step < 0.1 * usual && near_step < 0.01 * size, "{near_step} of {usual}");
    let surface = eye(&navigator) + forward * (size * 0.01);
    let depth = |navigator: &Navigator| (surface - eye(navigator)).dot(forward);
    let n_steps =
        (0..2000).take_while(|_| step(&mut navigator, Some(surface)) > 0.0 && depth(&navigator) > 0.0).count();
    assert!((60..500).contains(&n_steps), "{n_steps}");
    // A point that somebody went to counts before the eye has seen another.
    navigator.release_all();
    navigator.go_to_point(DVec3::new(1.0, 1.0, 1.0));
    navigator.advance(TRANSITION_SECONDS, 1.0);
    navigator.hold(Direction::Left);
    let before = eye(&navigator);
    let distance = (DVec3::ONE - before).length();
    navigator.advance(0.016, 1.0);
    assert!((eye(&navigator) - before).length() < 0.02 * distance.max(1e-3 * size));
}

/// Advances until all transitions have ended.
fn arrive(navigator: &mut Navigator) {
    navigator.advance(TRANSITION_SECONDS, 1.0);
    assert!(!navigator.is_moving());
}

#[test]
fn view_all_and_up_axis_start_afresh() {
    let mut navigator = navigator();
    let camera = navigator.camera();
    navigator.press(Drag::Orbit);
    navigator.move_to(DVec2::new(0.9, 0.1));
    let turned = navigator.camera();
    navigator.view_all(&[CanvasPart::WHOLE]);
    assert_eq!((navigator.camera(), navigator.destination().0), (turned, camera));
    arrive(&mut navigator);
    assert_eq!(navigator.camera(), camera);
    for _ in UpAxis::VARIANTS {
        navigator.next_up_axis(&[CanvasPart::WHOLE]);
        arrive(&mut navigator);
        let up = navigator.up().direction();
        assert!(navigator.camera().v().dot(up) > 0.0);
    }
    assert_eq!(navigator.camera(), camera);
}

#[test]
fn a_transition_is_smooth_and_a_hand_stops_it() {
    let mut navigator = navigator();
    let (start, end) = (navigator.camera(), navigator.camera().orbit(DVec3::Y, UpAxis::Y, 2.0, 0.5));
    navigator.go_to(end, DVec2::ZERO);
    let mut longest: f64 = 0.0;
    let mut before = start.eye();
    for _ in 0..60 {
        navigator.advance(TRANSITION_SECONDS / 60.0, 1.0);
        longest = longest.max((navigator.camera().eye() - before).length());
        before = navigator.camera().eye();
    }
    assert_eq!(navigator.camera(), end);
    let way = (end.eye() - start.eye()).length();
    assert!(longest < 0.06 * way, "a step of {longest} on a way of {way}");
    navigator.go_to(start, DVec2::ZERO);
    navigator.advance(TRANSITION_SECONDS / 2.0, 1.0);
    navigator.press(Drag::Orbit);
    let camera = navigator.camera();
    assert!(!navigator.advance(1.0, 1.0) && navigator.camera() == camera);
}

/// The left half of the canvas, as a panel on the right leaves it.
const LEFT: [CanvasPart; 1] = [CanvasPart { max: DVec2::new(0.5, 1.0), ..CanvasPart::WHOLE }];

#[test]
fn views_are_kept_without_the_room_for_panels() {
    let mut navigator = navigator();
    navigator.make_room(&LEFT);
    navigator.press(Drag::Orbit);
    navigator.move_to(DVec2::new(0.6, 0.55));
    navigator.release();
    let shown = navigator.camera();
    let middle = navigator.pivot();
    assert!((project(&shown, middle).x - 0.25).abs() < 0.08, "{}", project(&shown, middle));
    let kept = navigator.destination_without_panels();
    assert!((project(&kept, middle).x - 0.5).abs() < 0.08, "{}", project(&kept, middle));
    assert_eq!((kept.eye(), navigator.camera_without_panels()), (shown.eye(), kept));
    // With the panel it is the view that was kept, and without the panel the middle of the canvas is its middle.
    let error = |a: &Camera, b: &Camera| (project(a, middle) - project(b, middle)).length();
    navigator.view_all(&LEFT);
    arrive(&mut navigator);
    navigator.go_to_view(kept, None, &LEFT);
    arrive(&mut navigator);
    assert!(error(&navigator.camera(), &shown) < 1e-9);
    navigator.make_room(&[CanvasPart::WHOLE]);
    assert_eq!(navigator.camera(), kept);
    navigator.make_room(&LEFT);
    assert!(error(&navigator.camera(), &shown) < 1e-9);
}

#[test]
fn a_view_that_panels_have_not_moved_is_kept_as_it_is() {
    let mut navigator = navigator();
    navigator.make_room(&LEFT);
    let camera = navigator.camera().orbit(DVec3::Y, UpAxis::Y, 1.0, 0.2);
    navigator.set_camera(camera);
    assert_eq!(navigator.destination_without_panels(), camera);
    navigator.make_room(&LEFT);
    navigator.go_to_point(DVec3::new(0.9, 1.5, 0.8));
    arrive(&mut navigator);
    assert_eq!(navigator.destination_without_panels(), navigator.camera());
}

#[test]
fn going_to_a_point_brings_it_near_into_the_middle_and_orbits_around_it() {
    let mut navigator = navigator();
    let point = DVec3::new(0.9, 1.5, 0.8);
    let distance = |camera: &Camera| (point - camera.eye()).dot(view_plane(camera).0);
    let before = distance(&navigator.camera());
    navigator.go_to_point(point);
    arrive(&mut navigator);
    let camera = navigator.camera();
    assert!((project(&camera, point) - DVec2::splat(0.5)).length() < 1e-9);
    assert!(distance(&camera) < before * 0.5 && distance(&camera) > 0.0);
    navigator.press(Drag::Orbit);
    navigator.move_to(DVec2::new(0.1, 0.3));
    assert!((project(&navigator.camera(), point) - DVec2::splat(0.5)).length() < 1e-9);
    navigator.release();
    // The whole model is visible again, and orbits around its middle.
    navigator.view_all(&[CanvasPart::WHOLE]);
    arrive(&mut navigator);
    assert_eq!(navigator.pivot(), DVec3::new(0.5, 1.0, 0.5));
}

#[test]
fn the_wheel_goes_to_the_surface_under_the_cursor() {
    let mut navigator = navigator();
    let at = DVec2::new(0.4, 0.7);
    navigator.move_to(at);
    assert!(navigator.needs_surface());
    // Much nearer than the middle of the model.
    let eye = navigator.camera().eye();
    let surface = eye + (navigator.point_under(at) - eye) * 0.3;
    navigator.set_under_cursor(Some(surface));
    let distance = (surface - eye).length();
    (0..10).for_each(|_| _ = navigator.wheel(1.0));
    let left = (surface - navigator.camera().eye()).length();
    assert!((left / distance - DOLLY_FACTOR_PER_NOTCH.powi(-10)).abs() < 1e-9, "{left} of {distance}");
    assert!((project(&navigator.camera(), surface) - at).length() < 1e-9);
    // Another point lies under the cursor once it has moved.
    navigator.move_to(DVec2::splat(0.5));
    assert!(navigator.needs_surface());
}

#[test]
fn a_path_plays_in_its_own_time_once_or_repeatedly() {
    let mut navigator = navigator();
    let turned = |yaw: f64| navigator.camera().orbit(DVec3::Y, UpAxis::Y, yaw, 0.0);
    let keys = vec![(0.0, turned(0.0)), (1.0, turned(0.5)), (4.0, turned(2.0))];
    let path = Arc::new(CameraPath::new(keys, UpAxis::Z).unwrap());
    navigator.play(Arc::clone(&path), false);
    assert!(navigator.is_playing() && navigator.up() == UpAxis::Z);
    navigator.advance(1.0, 1.0);
    assert_eq!(navigator.camera(), path.at(1.0));
    navigator.advance(7.0, 1.0);
    assert_eq!(navigator.camera(), path.at(4.0));
    assert!(!navigator.is_moving());
    navigator.play(Arc::clone(&path), true);
    navigator.advance(5.0, 1.0);
    assert_eq!(navigator.camera(), path.at(1.0));
    navigator.wheel(1.0);
    assert!(!navigator.is_moving());
}

proptest! {
    #[test]
    fn no_input_breaks_the_camera(
        corner in -1e6..1e6f64, size in prop_oneof![Just(0.0), 1e-6..1e6f64, Just(f64::NEG_INFINITY)],
        steps in proptest::collection::vec(
            (0..14u8, prop_oneof![-2.0..2.0f64, Just(f64::NAN), -1e18..1e18f64], -2.0..2.0f64), 1..60),
    ) {
        let shape = Shape::of_box(DVec3::splat(corner), DVec3::splat(corner + size));
        let mut navigator = Navigator::new(shape, UpAxis::Z, ASPECT);
        let first = navigator.camera();
        for (kind, a, b) in steps {
            match kind {
                0 => navigator.press(Drag::Orbit),
                1 => navigator.press(Drag::Pan),
                2 => navigator.press(Drag::Dolly),
                3 => _ = navigator.wheel(a * 20.0),
                4 => { navigator.hold(Direction::Forward); navigator.advance(a, 4.0); }
                5 => navigator.next_up_axis(&[CanvasPart::WHOLE]),
                6 => navigator.go_to(first.orbit(DVec3::ZERO, UpAxis::X, a, b), DVec2::ZERO),
                7 => navigator.go_to_point(DVec3::new(a, b, corner)),
                8 => {
                    navigator.set_under_cursor(Some(DVec3::new(b, a, corner)));
                    navigator.set_ahead(Some(DVec3::new(a, b, corner)));
                }
                9 => {
                    let keys = vec![(0.0, navigator.camera()), (0.5, first), (1.0, navigator.destination_without_panels())];
                    navigator.play(Arc::new(CameraPath::new(keys, UpAxis::Y).unwrap()), b > 0.0);
                }
                10 => _ = navigator.change_speed(a as i32),
                11 => navigator.set_model(Shape::of_box(DVec3::splat(b), DVec3::splat(a)), UpAxis::X, &[CanvasPart::WHOLE]),
                12 => {
                    let wild = Drive { fly: DVec3::splat(a), pan: DVec2::new(a, b), orbit: DVec2::splat(b), nearer: a, roll: b };
                    navigator.set_drive(wild.with(Drive::default()));
                }
                _ => navigator.release(),
            }
            navigator.move_to(DVec2::new(a, b));
            navigator.advance(b, 1.0);
            let camera = navigator.camera();
            prop_assert!(Camera::new(camera.eye(), camera.ll(), camera.u(), camera.v()).is_ok());
        }
    }
}

#[test]
fn a_hand_on_a_remote_moves_the_camera_as_the_mouse_does_and_leaves_the_mouse_its_drag() {
    for drag in [Drag::Orbit, Drag::Pan, Drag::Dolly] {
        let (mut by_mouse, mut by_remote) = (navigator(), navigator());
        by_mouse.press(drag);
        let by = DVec2::new(0.06, -0.04);
        assert!(by_mouse.move_to(DVec2::splat(0.5) + by) && by_remote.nudge(Nudge::Drag(drag, by)));
        let moved = by_mouse.camera().eye() - by_remote.camera().eye();
        assert!(moved.length() < 1e-12, "{drag:?}: {moved}");
        by_mouse.nudge(Nudge::Roll(0.1));
        assert!(by_mouse.is_dragging());
    }
    let mut navigator = navigator();
    navigator.view_all(&[]);
    let before = navigator.camera();
    assert!(!navigator.nudge(Nudge::Drag(Drag::Pan, DVec2::ZERO)) && navigator.camera() == before);
    let at = DVec2::new(0.3, 0.6);
    let point = navigator.point_under(at);
    assert!(navigator.nudge(Nudge::Dolly { factor: 0.5, at }));
    assert!((project(&navigator.camera(), point) - at).length() < 1e-9, "the point stays under the fingers");
}

#[test]
fn a_device_drives_as_long_as_it_is_held_out() {
    let mut navigator = navigator();
    navigator.view_all(&[]);
    navigator.set_drive(Drive { orbit: DVec2::X, ..Drive::default() });
    assert!(navigator.is_moving() && navigator.is_driven() && !navigator.is_flying());
    let start = navigator.camera();
    let drive = |navigator: &mut Navigator, steps: u32| {
        (0..steps).for_each(|_| assert!(navigator.advance(0.016, 1.0)));
        navigator.camera()
    };
    let (one, two) = (drive(&mut navigator, 10), drive(&mut navigator, 10));
    let angle = |a: Camera, b: Camera| (a.eye() - MIDDLE).angle_between(b.eye() - MIDDLE);
    assert!((angle(start, one) - angle(one, two)).abs() < 1e-6, "as fast all the time");
    // A tenth of a second at the most, and the same whichever steps it takes.
    let mut late = navigator.clone();
    late.advance(100.0, 1.0);
    (0..2).for_each(|_| _ = navigator.advance(0.05, 1.0));
    assert!((late.camera().eye() - navigator.camera().eye()).length() < 1e-9);
    navigator.set_drive(Drive { nearer: 1.0, ..Drive::default() });
    let before = navigator.camera().eye();
    assert!(navigator.advance(0.1, 1.0));
    let distance = |eye: DVec3| (eye - MIDDLE).length();
    assert!(distance(navigator.camera().eye()) < distance(before), "nearer");
    // Pulled out.
    navigator.set_drive(Drive::default());
    assert!(!navigator.is_moving() && !navigator.advance(0.1, 1.0));
}
