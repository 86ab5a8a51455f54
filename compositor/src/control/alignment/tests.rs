//! Test patterns and corners, without a window.

use std::{fs, path::Path};

use strum::VariantArray;

use super::*;
use crate::wall::{PixelRect, Rotation};

fn shipped(name: &str) -> Wall {
    Wall::load(&shipped_path(name)).expect("shipped wall file")
}

fn shipped_path(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../wall-config").join(name)
}

fn aligning(file: Option<PathBuf>, wall: Wall) -> Alignment {
    let mut alignment = Alignment::new(file, wall);
    alignment.show(Some(Pattern::Align));
    alignment
}

#[test]
fn a_key_steps_through_all_patterns_and_back_to_frames() {
    let mut alignment = Alignment::new(None, Wall::paper());
    for &pattern in Pattern::VARIANTS {
        assert_eq!(alignment.next_pattern(), Some(pattern));
        assert!(alignment.help(pattern).starts_with(&format!("{pattern}: {}", pattern.help())));
        assert_eq!(alignment.help(pattern).contains("nothing can be saved"), pattern == Pattern::Align);
    }
    assert!(!aligning(Some("a.toml".into()), Wall::paper()).help(Pattern::Align).contains("nothing can be saved"));
    assert_eq!(alignment.next_pattern(), None);
    assert!(alignment.take_shown().is_some_and(|shown| shown.is_ok_and(|shown| shown.is_empty())));
    assert!(alignment.take_shown().is_none(), "nothing has changed since");
}

#[test]
fn every_pattern_lights_every_projector_and_no_pixel_of_another() {
    let wall = shipped("two-monitors.toml");
    for pattern in Pattern::VARIANTS.iter().copied().filter(|&pattern| pattern != Pattern::Overlap) {
        let shown = pattern.shown(&wall, None).expect("small outputs");
        let outputs: Vec<_> = shown.iter().map(|image| image.output).collect();
        assert_eq!(outputs, wall.output_parts(), "one image for each output, and none for pixels of neither");
        for image in shown {
            assert_eq!([image.size.xres(), image.size.yres()], [image.output.width, image.output.height]);
            let is_lit = |x: u32, y: u32| {
                let (x, y) = (x - image.output.x, y - image.output.y);
                let first = 4 * ((image.size.yres() - 1 - y) * image.size.xres() + x) as usize;
                image.rgba[first..first + 3] != [0; 3]
            };
            for projector in wall.projectors().iter().filter(|it| image.output.contains_rect(&it.output)) {
                let PixelRect { x, y, width, height } = projector.output;
                assert!((y..y + height).any(|y| (x..x + width).any(|x| is_lit(x, y))), "{pattern}");
            }
        }
    }
}

#[test]
fn tiny_projectors_have_patterns_too() {
    let text = "canvas_m = [1.0, 1.0]\n[grid]\ncolumns = 3\nrows = 2\npixels = [1, 2]\n";
    let wall = Wall::from_toml("tiny", text).expect("a wall of six pixels");
    for &pattern in Pattern::VARIANTS {
        pattern.shown(&wall, Some(Corner { projector_idx: 5, corner_idx: 2 })).expect("six pixels are enough");
    }
}

#[test]
fn more_pixels_than_a_frame_may_have_are_refused_in_one_line() {
    let text = "canvas_m = [1.0, 1.0]\n[grid]\ncolumns = 1\nrows = 1\npixels = [65536, 8192]\n";
    let wall = Wall::from_toml("huge", text).expect("a large wall");
    let error = Pattern::Names.shown(&wall, None).expect_err("too large").to_string();
    assert!(error.contains("65536×8192") && error.contains("name the output") && !error.contains('\n'), "{error}");
    assert!(Pattern::Overlap.shown(&wall, None).is_ok(), "one sample serves any wall");
}

#[test]
fn a_dragged_corner_follows_the_cursor_in_any_rotation() {
    for (rotation, expected) in [
        (Rotation::None, [10.0, 4.0]),
        (Rotation::Right, [-4.0, 10.0]),
        (Rotation::Half, [-10.0, -4.0]),
        (Rotation::Left, [4.0, -10.0]),
    ] {
        let degrees = rotation.degrees();
        let text = format!(
            "canvas_m = [1.0, 1.0]\n[optics]\nrotation = {degrees}\n[grid]\ncolumns = 1\nrows = 1\npixels = [400, 300]\n"
        );
        let wall = Wall::from_toml("turned", &text).expect("one projector");
        let start = corner_px(&wall.projectors()[0], 0).expect("in front");
        let mut alignment = aligning(None, wall);
        assert!(alignment.press(start + 3.0), "{degrees}");
        assert!(alignment.drag_to(start + 3.0 + DVec2::new(10.0, 4.0)), "{degrees}");
        let moved = &alignment.wall.projectors()[0];
        assert_eq!(moved.warp_px[0], expected, "{degrees}");
        let corner = corner_px(moved, 0).expect("in front");
        assert!((corner - (start + DVec2::new(10.0, 4.0))).length() < 1e-9, "{degrees}: {corner}");
    }
}

#[test]
fn corners_are_grabbed_near_by_and_nowhere_else() {
    let mut alignment = aligning(None, Wall::paper());
    assert!(!alignment.press(DVec2::new(500.0, 400.0)));
    assert!(!alignment.drag_to(DVec2::ZERO));
    assert!(alignment.press(DVec2::new(1030.0, 5.0)));
    alignment.release();
    assert!(!alignment.drag_to(DVec2::ZERO) && alignment.selected.is_some());
    alignment.next_corner();
    assert!(alignment.move_by(DVec2::new(1.0, 0.0)));
    assert!(!alignment.move_by(DVec2::new(f64::NAN, 0.0)));
    assert!(!alignment.move_by(DVec2::new(-5000.0, 0.0)), "edges would cross");
}

#[test]
fn arrows_move_the_selected_corner_of_the_align_pattern_only() {
    let mut alignment = Alignment::new(None, Wall::of_one_output([640, 360]));
    assert!(!alignment.press_key(NamedKey::Tab, false) && !alignment.press_key(NamedKey::Escape, false));
    alignment.next_pattern();
    assert!(alignment.press_key(NamedKey::Tab, false) && alignment.press_key(NamedKey::ArrowRight, false));
    assert!(alignment.press_key(NamedKey::ArrowDown, true) && !alignment.press_key(NamedKey::Space, false));
    assert_eq!(alignment.wall.projectors()[0].warp_px[0], [1.0, 0.1]);
    assert!(alignment.press_key(NamedKey::Escape, false) && !alignment.press_key(NamedKey::ArrowDown, false));
}

#[test]
fn moves_of_corners_are_undone_and_redone_step_by_step() {
    let mut alignment = aligning(None, Wall::paper());
    let straight = alignment.wall.clone();
    assert!(alignment.press(DVec2::new(1030.0, 5.0)));
    for step in 1..=5 {
        assert!(alignment.drag_to(DVec2::new(1030.0 + f64::from(step), 5.0)), "a drag of five events is one step");
    }
    alignment.release();
    let dragged = alignment.wall.clone();
    assert!(alignment.press_key(NamedKey::ArrowDown, false));
    let nudged = alignment.wall.clone();
    assert!(alignment.press_key(NamedKey::Backspace, false));
    assert_eq!(alignment.wall, straight, "one corner was moved");
    alignment.next_corner();
    assert!(alignment.move_by(DVec2::new(2.0, 2.0)) && alignment.press_key(NamedKey::Backspace, true));
    assert_eq!(alignment.wall, straight, "all corners are reset");
    for _ in 0..3 {
        alignment.undo();
    }
    assert_eq!(alignment.wall, nudged);
    alignment.undo();
    assert_eq!(alignment.wall, dragged);
    alignment.undo();
    assert_eq!(alignment.wall, straight);
    assert_eq!(alignment.undo(), "No corner was moved");
    alignment.redo();
    alignment.redo();
    assert_eq!(alignment.wall, nudged);
    assert!(alignment.press_key(NamedKey::ArrowLeft, false), "a new step");
    assert_eq!(alignment.redo(), "No move of corners was taken back");
}

#[test]
fn the_history_of_moves_is_bounded() {
    let mut alignment = aligning(None, Wall::of_one_output([640, 360]));
    alignment.next_corner();
    assert!((0..1000).all(|_| alignment.move_by(DVec2::new(0.05, 0.0))));
    let n_undone = (0..1000).filter(|_| alignment.undo() != "No corner was moved").count();
    assert_eq!(n_undone, 256);
}

#[test]
fn saved_corners_can_be_read_and_the_rest_of_the_file_stays() {
    let folder = std::env::temp_dir().join(format!("corners-{}", std::process::id()));
    fs::create_dir_all(&folder).expect("a folder");
    for name in ["paper-4x3.toml", "blended-4x3.toml", "two-monitors.toml", "laptop.toml"] {
        let file = folder.join(name);
        fs::copy(shipped_path(name), &file).expect("a copy");
        let wall = Wall::load(&file).expect("shipped");
        let mut alignment = aligning(Some(file.clone()), wall);
        // The second projector has corners of its own in one file, and not even a table in others.
        for _ in 0..6 {
            alignment.next_corner();
        }
        assert!(alignment.move_by(DVec2::new(-3.35, 2.0)));
        alignment.save().expect("saved");
        alignment.next_corner();
        assert!(alignment.move_by(DVec2::new(-1.0, -2.0)));
        alignment.save().expect("saved over the last");
        assert!(alignment.save().expect("no mistake").contains("nothing to save"));
        assert_eq!(Wall::load(&file).expect("still a wall file"), alignment.wall, "{name}");
        let (before, after) = (fs::read_to_string(shipped_path(name)), fs::read_to_string(&file));
        let (before, after) = (before.expect("text"), after.expect("text"));
        let is_kept = |line: &&str| line.starts_with("warp_px") || after.lines().any(|it| it == *line);
        assert!(before.lines().all(|line| is_kept(&line)), "{name}\n{after}");
        assert!(after.lines().count() <= before.lines().count() + 5, "{name}\n{after}");
    }
    fs::remove_dir_all(&folder).expect("removed");
}

#[test]
fn corners_that_are_not_saved_are_told_of_and_kept_aside() {
    let folder = std::env::temp_dir().join(format!("corners-aside-{}", std::process::id()));
    fs::create_dir_all(&folder).unwrap();
    let file = folder.join("ours.toml");
    fs::copy(shipped_path("blended-4x3.toml"), &file).unwrap();
    let mut alignment = aligning(Some(file.clone()), Wall::load(&file).unwrap());
    assert_eq!((alignment.unsaved_note(), alignment.save_aside().unwrap()), (None, None));
    for number in [1, 2] {
        alignment.show(Some(Pattern::Align));
        alignment.next_corner();
        assert!(alignment.move_by(DVec2::new(2.0, 2.0)));
        assert_eq!(alignment.unsaved_note(), None, "still in hand");
        alignment.press_key(NamedKey::Escape, false);
        assert!(alignment.unsaved_note().unwrap().contains("Ctrl+S saves them in "));
        let kept = folder.join(format!("ours.corners-{number}.toml"));
        assert!(alignment.save_aside().unwrap().unwrap().contains(&format!("--wall {}", kept.display())));
        assert_eq!(Wall::load(&kept).unwrap(), alignment.wall);
    }
    assert_eq!(fs::read(&file).unwrap(), fs::read(shipped_path("blended-4x3.toml")).unwrap());
    // Even where the file is no wall any more.
    fs::write(&file, "").unwrap();
    alignment.save_aside().unwrap();
    let corners = |wall: &Wall| wall.projectors().iter().map(|projector| projector.warp_px).collect::<Vec<_>>();
    assert_eq!(corners(&Wall::load(&folder.join("ours.corners-3.toml")).unwrap()), corners(&alignment.wall));
    fs::copy(shipped_path("blended-4x3.toml"), &file).unwrap();
    alignment.save().unwrap();
    assert_eq!((alignment.unsaved_note(), alignment.save_aside().unwrap()), (None, None));
    fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn corners_without_a_place_leave_the_file_unchanged() {
    let folder = std::env::temp_dir().join(format!("no-corners-{}", std::process::id()));
    fs::create_dir_all(&folder).expect("a folder");
    let file = folder.join("inline.toml");
    let text =
        "canvas_m = [1.0, 1.0]\nprojector = [{ name = \"a\", pixels = [40, 30], at_m = [0, 0], size_m = [1, 1] }]\n";
    fs::write(&file, text).expect("written");
    let wall = Wall::load(&file).expect("a wall file");
    let mut alignment = aligning(Some(file.clone()), wall.clone());
    alignment.next_corner();
    assert!(alignment.move_by(DVec2::new(1.0, 1.0)));
    let error = alignment.save().expect_err("no place").to_string();
    assert!(error.contains("[[projector]]") && !error.contains('\n'), "{error}");
    assert_eq!(fs::read_to_string(&file).expect("text"), text);
    fs::remove_dir_all(&folder).expect("removed");
    let mut alignment = aligning(None, wall);
    assert!(alignment.save().expect("no mistake").contains("nothing to save"));
    alignment.next_corner();
    assert!(alignment.move_by(DVec2::new(1.0, 1.0)));
    let error = alignment.save().expect_err("no file").to_string();
    assert!(error.contains("--wall FILE"), "{error}");
}
