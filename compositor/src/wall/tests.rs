//! Wall files and the walls that they describe.

use proptest::prelude::*;

use super::*;

fn config(name: &str) -> Wall {
    Wall::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../wall-config").join(name)).expect("shipped wall file")
}

fn problem(text: &str) -> String {
    Wall::from_toml("a.toml", text).expect_err(text).to_string()
}

#[test]
fn the_default_is_the_paper_s_file() {
    assert_eq!(config("paper-4x3.toml"), Wall::paper());
    assert_eq!(Wall::paper().output_size(), [4096, 2304]);
    assert_eq!(Wall::paper().projectors().len(), 12);
    assert_eq!(Wall::paper().aspect(), 16.0 / 9.0);
}

#[test]
fn the_laptop_s_file_fits_a_laptop() {
    assert_eq!(config("laptop.toml").output_size(), [1280, 720]);
}

const SHIPPED: [&str; 6] =
    ["paper-4x3.toml", "blended-4x3.toml", "curved-3x1.toml", "lcd-5x3.toml", "two-monitors.toml", "laptop.toml"];

#[test]
fn the_curved_wall_s_file_shows_all_shapes() {
    assert!(matches!(config("curved-3x1.toml").surface(), Some(Surface::Cylinder { .. })));
    // Other shapes are there as comments.
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../wall-config/curved-3x1.toml");
    let text = std::fs::read_to_string(path).unwrap();
    let bare = |line: &str| line.trim_start_matches("# ").to_owned() + "\n";
    for name in ["fold", "dome"] {
        let lines = text.lines().skip_while(|line| *line != format!("# [surface.{name}]"));
        let table: String = lines.take_while(|line| *line != "#" && !line.is_empty()).map(bare).collect();
        let text = format!("canvas_m = [3.14, 0.75]\n[grid]\ncolumns = 3\nrows = 1\npixels = [64, 48]\n{table}");
        assert!(Wall::from_toml("other", &text).unwrap().surface().is_some(), "{name}");
    }
}

#[test]
fn numbers_beyond_those_that_a_key_takes_are_refused() {
    let grid = "[grid]\ncolumns = 2\nrows = 1\n";
    for (text, problem) in [
        (
            format!("canvas_m = [2.0, 1.0, 3.0]\n{grid}pixels = [64, 48]\n"),
            "ours:1: canvas_m has 3 numbers, and takes 2",
        ),
        (format!("canvas_m = [2.0, 1.0]\n{grid}pixels = [64, 48, 1]\n"), "ours:5: pixels has 3 numbers, and takes 2"),
        (
            format!(
                "canvas_m = [2.0, 1.0]\n{grid}pixels = [64, 48]\n[surface.dome]\nradius_m = 2\nat_m = [1, 0.5, 9]\n"
            ),
            "at_m has 3 numbers, and takes 2",
        ),
        (
            format!(
                "canvas_m = [2.0, 1.0]\n{grid}pixels = [64, 48]\n[[projector]]\nname = \"row 1 column 1\"\n\
                 warp_px = [[0, 0], [0, 0], [0, 0], [0, 0], [0, 0]]\n"
            ),
            "warp_px has 5 points, and takes 4",
        ),
    ] {
        let error = Wall::from_toml("ours", &text).unwrap_err().to_string();
        assert!(error.contains(problem), "{error}");
    }
}

#[test]
fn what_is_printed_with_all_defaults_is_the_same_wall() {
    for name in SHIPPED {
        let wall = config(name);
        let text = wall.to_toml();
        let printed = Wall::from_toml("printed", &text).unwrap();
        assert_eq!(printed.to_toml(), text, "{name}");
        for (projector, printed) in wall.projectors().iter().zip(printed.projectors()) {
            let sides = |CanvasRect { left, bottom, width, height }| [left, bottom, width, height];
            let differ = std::iter::zip(sides(projector.canvas), sides(printed.canvas)).map(|(a, b)| (a - b).abs());
            assert!(differ.fold(0.0, f64::max) < 1e-8, "{name}");
            assert_eq!(Projector { canvas: projector.canvas, ..printed.clone() }, *projector, "{name}");
        }
    }
}

#[test]
fn what_is_shown_when_nobody_renders_is_a_setting() {
    let text = |key: &str| format!("canvas_m = [1, 1]\n{key}[grid]\ncolumns = 1\nrows = 1\npixels = [4, 4]");
    let of = |key: &str| Wall::from_toml("a.toml", &text(key)).unwrap().on_loss();
    assert_eq!(of(""), OnLoss::LastFrame);
    assert_eq!(of("on_loss = \"last-frame\"\n"), OnLoss::LastFrame);
    let black = Wall::from_toml("a.toml", &text("on_loss = \"black\"\n")).unwrap();
    assert!(black.to_toml().contains("on_loss = \"black\""));
    let warped = black.with_warps(&[(0, [[0.5, 0.0], [0.0; 2], [0.0; 2], [0.0; 2]])]).unwrap();
    assert_eq!(warped.on_loss(), OnLoss::Black, "moving a corner changes nothing else");
    let problem = problem(&text("on_loss = \"white\"\n"));
    assert!(problem.starts_with("a.toml:2: ") && problem.contains("`last-frame` or `black`"), "{problem}");
}

#[test]
fn screens_with_bezels_fill_the_canvas_but_for_the_gaps() {
    let wall = config("lcd-5x3.toml");
    let [width_m, height_m] = wall.canvas_m();
    let [first, second, ..] = wall.projectors() else { panic!("fifteen screens") };
    let gap_m = (second.canvas.left - first.canvas.left - first.canvas.width) * width_m;
    assert!((gap_m - 0.0055).abs() < 1e-12, "{gap_m}");
    let last = wall.projectors().last().expect("fifteen screens");
    assert!((last.canvas.left + last.canvas.width - 1.0).abs() < 1e-12 && last.canvas.bottom == 0.0);
    // The pixels of a Full HD panel are squares.
    let pixel_m = [first.canvas.width * width_m / 1920.0, first.canvas.height * height_m / 1080.0];
    assert!((pixel_m[0] / pixel_m[1] - 1.0).abs() < 1e-3, "{pixel_m:?}");
    assert!((0..15).all(|index| wall.is_plain(index)), "nothing overlaps");
}

#[test]
fn overlapping_projectors_share_what_the_file_says() {
    let wall = config("blended-4x3.toml");
    let [first, second, ..] = wall.projectors() else { panic!("twelve projectors") };
    let shared = first.canvas.left + first.canvas.width - second.canvas.left;
    assert!((shared / first.canvas.width - 0.1).abs() < 1e-12);
    // Itself, and those to the right, below, and both.
    assert_eq!(wall.neighbours(0).iter().map(|neighbour| neighbour.projector_idx).collect::<Vec<_>>(), [0, 1, 4, 5]);
    // The projector with the old lamp overlaps three others.
    assert!((wall.black() - (3.0 * 0.002 + 0.003)).abs() < 1e-12, "{}", wall.black());
    assert!(!(0..12).any(|index| wall.is_plain(index)));
}

#[test]
fn a_projector_that_many_others_overlap_is_refused() {
    let one = |index: u32| {
        let x = index * 4;
        format!(
            "[[projector]]\nname = \"{index}\"\npixels = [4, 4]\npixels_at = [{x}, 0]\nat_m = [0, 0]\nsize_m = [1, 1]\n"
        )
    };
    let text: String = std::iter::once("canvas_m = [4.0, 2.25]\n".to_owned()).chain((0..40).map(one)).collect();
    assert!(problem(&text).contains("overlaps 39 others, and 24 are possible"), "{}", problem(&text));
}

#[test]
fn outputs_show_the_pixels_of_their_own_projectors() {
    let wall = config("two-monitors.toml");
    let [left, right] = wall.monitors()[..] else { panic!("two monitors") };
    assert_eq!(left, ("HDMI-1", PixelRect { x: 0, y: 0, width: 2560, height: 1440 }));
    assert_eq!(right, ("DP-1", PixelRect { x: 2560, y: 0, width: 1920, height: 1080 }));
    assert!(Wall::paper().monitors().is_empty());
}

#[test]
fn projectors_cover_canvas_and_output_once() {
    let wall = config("laptop.toml");
    let [upper_left, upper_right, lower_left, _] = wall.projectors() else { panic!("four projectors") };
    assert_eq!(upper_left.output, PixelRect { x: 0, y: 0, width: 640, height: 360 });
    assert_eq!(upper_right.output, PixelRect { x: 640, y: 0, width: 640, height: 360 });
    assert_eq!(upper_left.canvas, CanvasRect { left: 0.0, bottom: 0.5, width: 0.5, height: 0.5 });
    assert_eq!(lower_left.canvas, CanvasRect { left: 0.0, bottom: 0.0, width: 0.5, height: 0.5 });
    let area: f64 = Wall::paper().projectors().iter().map(|p| p.canvas.width * p.canvas.height).sum();
    assert!((area - 1.0).abs() < 1e-12);
}

#[test]
fn what_cannot_be_a_wall_is_refused_with_line_and_cure() {
    let grid = |columns: &str, rows: &str, pixels: &str| {
        format!("canvas_m = [4.0, 2.25]\n[grid]\ncolumns = {columns}\nrows = {rows}\npixels = {pixels}\n")
    };
    let refined = |lines: &str| grid("4", "3", "[1024, 768]\n[[projector]]") + lines;
    let explicit = |lines: &str| format!("canvas_m = [4.0, 2.25]\n[[projector]]\n{lines}");
    let cases = [
        (grid("0", "3", "[1024, 768]"), 3, "columns = 0: a wall has from 1 to 64"),
        (grid("4", "65", "[1024, 768]"), 4, "rows = 65"),
        (grid("4", "-3", "[1024, 768]"), 4, "invalid value"),
        (grid("4", "4294967296", "[1024, 768]"), 4, "invalid value"),
        (grid("4", "3", "[0, 768]"), 5, "each may have from 1 to 16384"),
        (grid("4", "3", "[16385, 768]"), 5, "each may have from 1 to 16384"),
        (grid("4", "3", "[1024, 4294967295]"), 5, "each may have from 1 to 21845"),
        (grid("4", "3", "[1024]"), 5, "invalid length 1"),
        (grid("4", "3", "\"1024x768\""), 5, "invalid type"),
        (grid("4", "3", "[1024, 768]\nbezel = 3"), 6, "unknown field `bezel`, expected one of `columns`"),
        ("canvas_m = [nan, 2.25]\n[grid]\ncolumns=4\nrows=3\npixels=[4,4]".into(), 1, "in metres must be from 0.01"),
        ("canvas_m = [4.0, inf]\n[grid]\ncolumns=4\nrows=3\npixels=[4,4]".into(), 1, "in metres"),
        ("canvas_m = [4.0, -1.0]\n[grid]\ncolumns=4\nrows=3\npixels=[4,4]".into(), 1, "in metres"),
        ("canvas_m = [4.0, 2.25]\n".into(), 1, "a wall has at least one projector: add [grid]"),
        (grid("4", "3", "[1024, 768]\noverlap = [0.1, 0.6]"), 6, "from 0 to 0.5"),
        (grid("4", "3", "[1024, 768]\noverlap = [0.1, nan]"), 6, "from 0 to 0.5"),
        (grid("4", "3", "[1024, 768]\nbezel_m = [1.4, 0.0]"), 6, "leave room for screens"),
        (grid("4", "3", "[1024, 768]\nbezel_m = [-0.1, 0.0]"), 6, "must be positive"),
        (grid("4", "3", "[1024, 768]\noverlap = [0.1, 0.1]\nbezel_m = [0.1, 0.1]"), 7, "leave one out"),
        (refined("name = \"left\""), 7, "\"row 1 column 1\" to \"row 3 column 4\""),
        (refined("name = \"row 1 column 1\"\npixels = [4, 4]"), 8, "pixels follows from [grid]"),
        (refined("name = \"row 1 column 1\"\n[[projector]]\nname = \"row 1 column 1\""), 9, "two tables for"),
        (refined("name = \"row 1 column 1\"\nrotation = 45"), 8, "0, 90, 180 or 270"),
        (refined("name = \"row 1 column 1\"\nflip = \"sideways\""), 8, "`none`, `horizontal`, `vertical`"),
        (refined("name = \"row 1 column 1\"\ngamma = 0.2"), 8, "from 1 to 4"),
        (refined("name = \"row 1 column 1\"\ngamma = \"linear\""), 8, "a number such as 2.2, or \"srgb\""),
        (refined("name = \"row 1 column 1\"\nblack_level = -0.1"), 8, "from 0 to 0.25"),
        (refined("name = \"row 1 column 1\"\ngain = [1, 0, 1]"), 8, "from 0.05 to 1"),
        (refined("name = \"row 1 column 1\"\nfall_off = [[1.0, 0.9]]"), 8, "5 rows of 5 numbers each"),
        (refined("name = \"row 1 column 1\"\nwarp_px = [[0, 0], [-2000, 0], [0, 0], [0, 0]]"), 8, "keep their order"),
        (refined("name = \"row 1 column 1\"\nwarp_px = [[0, 0], [nan, 0], [0, 0], [0, 0]]"), 8, "keep their order"),
        (refined("name = \"row 1 column 1\"\noutput = \"DP-1\""), 2, "give one to all, or to none"),
        (explicit("name = \"a\"\nat_m = [0, 0]\nsize_m = [1, 1]"), 3, "\"a\" needs pixels"),
        (explicit("name = \"a\"\npixels = [4, 4]\nat_m = [0, 0]\nsize_m = [5, 1]"), 5, "does not lie on the canvas"),
        (explicit("name = \"a\"\npixels = [4, 4]\nat_m = [0, 0]\nsize_m = [0, 1]"), 5, "does not lie on the canvas"),
        (
            explicit("name = \"a\"\npixels = [4, 4]\npixels_at = [4294967295, 0]\nat_m = [0, 0]\nsize_m = [1, 1]"),
            4,
            "at most 65536",
        ),
        (explicit("name = \"a\"\npixels = [4, 0]\nat_m = [0, 0]\nsize_m = [1, 1]"), 4, "each needs at least one"),
        (
            explicit(
                "name = \"a\"\npixels = [4, 4]\nat_m = [0, 0]\nsize_m = [1, 1]\n[[projector]]\nname = \"b\"\n\
                 pixels = [4, 4]\npixels_at = [3, 3]\nat_m = [1, 1]\nsize_m = [1, 1]",
            ),
            10,
            "\"b\" and \"a\" have pixels in common",
        ),
        (
            explicit(
                "name = \"a\"\npixels = [4, 4]\nat_m = [0, 0]\nsize_m = [1, 1]\n[[projector]]\nname = \"a\"\n\
                 pixels = [4, 4]\nat_m = [1, 1]\nsize_m = [1, 1]",
            ),
            8,
            "two projectors \"a\"",
        ),
        ("canvas_m = [4.0, 2.25]\nframe = [0, 9]".into(), 2, "frame = [0, 9]"),
        ("canvas_m = [4.0, 2.25]\n\n[grid\n".into(), 3, ""),
        ("ply\nformat ascii 1.0\n".into(), 1, ""),
        (
            String::new(),
            1,
            "missing field `canvas_m`: the files in wall-config/ show every key; copy the one that is most like yours",
        ),
    ];
    for (text, line, expected) in cases {
        let problem = problem(&text);
        assert!(problem.starts_with(&format!("a.toml:{line}: ")), "{text}\n{problem}");
        assert!(problem.contains(expected) && !problem.contains('\n'), "{text}\n{problem}");
    }
}

#[test]
fn a_missing_file_names_the_cure() {
    let error = Wall::load(Path::new("no/such.toml")).expect_err("no such file").to_string();
    assert!(error.contains("no/such.toml") && error.contains("wall-config/"), "{error}");
}

proptest! {
    #[test]
    fn any_text_is_a_wall_or_an_error(text in "[\\[\\]a-z_=0-9.,\" \n\u{e9}-]{0,80}") {
        let _ = Wall::from_toml("a.toml", &text);
        let _ = Wall::from_toml("a.toml", &format!("canvas_m = [4.0, 2.25]\n[grid]\n{text}"));
    }

    #[test]
    fn any_grid_is_refused_or_covers_its_output_once(
        columns in 0_u32..80, rows in 0_u32..80, width in 0_u32..20_000, height in 0_u32..20_000,
    ) {
        let text = format!(
            "canvas_m = [4.0, 2.25]\n[grid]\ncolumns = {columns}\nrows = {rows}\npixels = [{width}, {height}]"
        );
        if let Ok(wall) = Wall::from_toml("a.toml", &text) {
            let [output_width, output_height] = wall.output_size();
            prop_assert!(output_width.max(output_height) <= Wall::LARGEST_SIDE);
            let n_pixels = |rect: PixelRect| u64::from(rect.width) * u64::from(rect.height);
            let covered: u64 = wall.projectors().iter().map(|projector| n_pixels(projector.output)).sum();
            prop_assert_eq!(covered, u64::from(output_width) * u64::from(output_height));
        }
    }
}

#[test]
fn native_frames_have_a_sample_for_each_pixel_and_no_more_than_frames_can_have() {
    let size = |wall: &Wall| <(u32, u32)>::from(wall.native_size());
    assert_eq!(size(&Wall::paper()), (4096, 2304));
    assert_eq!(size(&Wall::of_one_output([1366, 768])), (1366, 768));
    assert_eq!(size(&Wall::of_one_output([1, 1])), (1, 1));
    assert_eq!(size(&Wall::of_one_output([16384, 4096])), (16384, 4096));
    assert_eq!(size(&Wall::of_one_output([38_400, 2160])), (38_400, 2160), "ten displays side by side");
    assert_eq!(size(&Wall::of_one_output([16_384, 16_384])), (16_384, 16_384));
    assert_eq!(size(&Wall::of_one_output([65_536, 65_536])), (16_384, 16_384));
    // A third of the canvas has a thousand columns; the rest has fewer.
    let parts = [(0.0, 1.0 / 3.0, [1000, 600], 0), (1.0 / 3.0, 2.0 / 3.0, [500, 700], 1000)];
    let projectors = parts.map(|(left, width, [columns, rows], x)| {
        let canvas = CanvasRect { left, bottom: 0.0, width, height: 1.0 };
        Projector::plain(x.to_string(), canvas, PixelRect { x, y: 0, width: columns, height: rows })
    });
    let wall = Wall::new([3.0, 1.0], FrameSize::PAPER, projectors.to_vec()).unwrap();
    assert_eq!(size(&wall), (3000, 700));
    // Slivers of a canvas would need more samples than there can be.
    let canvas = CanvasRect { left: 0.0, bottom: 0.0, width: 1e-4, height: 1e-4 };
    let sliver = Projector::plain("sliver".into(), canvas, PixelRect { x: 0, y: 0, width: 16384, height: 1 });
    let wall = Wall::new([1.0, 1.0], FrameSize::PAPER, vec![sliver]).unwrap();
    assert_eq!(size(&wall), (65_536, 4));
}

#[test]
fn a_mesh_beside_the_wall_file_bends_its_projector() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("ours.toml").display().to_string();
    let text = |mesh: &str| {
        format!(
            "canvas_m = [2.0, 1.0]\n[grid]\ncolumns = 2\nrows = 1\npixels = [40, 30]\n\
             [[projector]]\nname = \"row 1 column 2\"\nmesh = \"{mesh}\""
        )
    };
    // Metres: the lower edge of the right half is bowed.
    let points = [[0.9, 1.0], [1.5, 1.0], [2.0, 1.0], [0.9, 0.1], [1.5, 0.0], [2.0, 0.1]].map(DVec2::from);
    let points = points.map(|at| at / DVec2::new(2.0, 1.0));
    let mesh = mesh::Mesh::new("right.pfm".to_owned(), [3, 2], &points).unwrap();
    std::fs::write(folder.path().join("right.pfm"), mesh.to_pfm([2.0, 1.0])).unwrap();
    let wall = Wall::from_toml(&file, &text("right.pfm")).unwrap();
    let projector = &wall.projectors()[1];
    let CanvasRect { left, bottom, width, height } = projector.canvas;
    let sides = [left, bottom, width, height].map(|side| (side * 1e4).round() / 1e4);
    assert_eq!(sides, [0.45, 0.0, 0.55, 1.0], "the part of the canvas that the mesh lights");
    assert!(!wall.is_plain(1) && wall.is_plain(0) == (wall.neighbours(0).len() == 1));
    assert!(wall.canvas_at(DVec2::new(60.0, 30.0)).distance(DVec2::new(0.75, 0.0)) < 1e-6);
    // What is printed names the same mesh, and corners can be moved on top of it.
    assert!(wall.to_toml().contains("mesh = \"right.pfm\""));
    assert_eq!(Wall::from_toml(&file, &wall.to_toml()).unwrap().projectors()[1].mesh, projector.mesh);
    let moved = wall.with_warps(&[(1, [[2.0, 1.0], [0.0; 2], [0.0; 2], [0.0; 2]])]).unwrap();
    assert!(moved.canvas_at(DVec2::new(42.0, 1.0)).distance(DVec2::new(0.45, 1.0)) < 1e-6);

    let problem = |mesh: &str| Wall::from_toml(&file, &text(mesh)).expect_err(mesh).to_string();
    assert!(problem("none.pfm").contains("ours.toml:8: mesh = \"none.pfm\": "), "{}", problem("none.pfm"));
    for outside in ["../right.pfm", "/etc/passwd", "", ".."] {
        assert!(problem(outside).contains("name it without a folder"), "{}", problem(outside));
    }
    std::fs::write(folder.path().join("cut.pfm"), &mesh.to_pfm([2.0, 1.0])[..40]).unwrap();
    assert!(problem("cut.pfm").contains("no PFM file"), "{}", problem("cut.pfm"));
    let flat = |bytes: &[u8]| {
        std::fs::write(folder.path().join("flat.pfm"), bytes).unwrap();
        problem("flat.pfm")
    };
    assert!(flat(&mesh.to_pfm([0.0, 1.0])).contains("all lie on one place or line"), "{}", problem("flat.pfm"));
    std::fs::write(folder.path().join("mirrored.pfm"), mesh.to_pfm([-2.0, 1.0])).unwrap();
    assert!(problem("mirrored.pfm").contains("beyond the canvas"), "{}", problem("mirrored.pfm"));
}

#[test]
fn fall_off_is_read_and_printed_again() {
    let row = "[0.7, 0.9, 1.0, 0.9, 0.7]";
    let text = format!(
        "canvas_m = [1, 1]\n[optics]\nfall_off = [{row}, {row}, {row}, {row}, {row}]\n[grid]\ncolumns = 1\nrows = 1\n\
         pixels = [4, 4]"
    );
    let wall = Wall::from_toml("a.toml", &text).unwrap();
    let fall_off = wall.projectors()[0].fall_off.as_ref().expect("of all projectors");
    assert!((fall_off.excess(DVec2::new(0.5, 0.3)) - 1.0 / 0.7).abs() < 1e-9);
    assert!(!wall.is_plain(0));
    assert_eq!(Wall::from_toml("a.toml", &wall.to_toml()).unwrap(), wall);
}

#[test]
fn a_projector_with_a_mesh_needs_no_place() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("ours.toml").display().to_string();
    let points = [[0.1, 0.9], [0.8, 1.0], [0.1, 0.1], [0.8, 0.0]].map(DVec2::from);
    let mesh = mesh::Mesh::new("a.pfm".to_owned(), [2, 2], &points).unwrap();
    std::fs::write(folder.path().join("a.pfm"), mesh.to_pfm([2.0, 1.0])).unwrap();
    let head = "canvas_m = [2.0, 1.0]\n[[projector]]\nname = \"a\"\npixels = [40, 30]\n";
    let wall = Wall::from_toml(&file, &format!("{head}mesh = \"a.pfm\"")).unwrap();
    let canvas = wall.projectors()[0].canvas;
    assert!((canvas.left - 0.1).abs() < 1e-6 && (canvas.width - 0.7).abs() < 1e-6, "{canvas:?}");
    // A place that the file gives nevertheless changes nothing, and none is printed.
    let placed = Wall::from_toml(&file, &format!("{head}at_m = [9, 9]\nsize_m = [1, 1]\nmesh = \"a.pfm\"")).unwrap();
    assert_eq!(placed, wall);
    assert!(!wall.to_toml().contains("at_m"), "{}", wall.to_toml());
    assert!(Wall::from_toml(&file, head).unwrap_err().to_string().contains("\"a\" needs at_m"));
}

#[test]
fn the_shape_of_a_wall_is_read_checked_and_kept() {
    let text =
        |surface: &str| format!("canvas_m = [3.0, 1.0]\n{surface}\n[grid]\ncolumns = 3\nrows = 1\npixels = [4, 4]");
    let fold = Wall::from_toml("a.toml", &text("[surface.fold]\nat_m = 1.5\nangle = 120")).unwrap();
    assert_eq!(fold.surface(), Some(Surface::Fold { at_m: 1.5, angle: 120.0 }));
    assert_eq!(Wall::from_toml("a.toml", &fold.to_toml()).unwrap().surface(), fold.surface());
    assert_eq!(fold.with_warps(&[]).unwrap().surface(), fold.surface());
    let wrong = problem(&text("[surface.cylinder]\nradius_m = 0.4\nat_m = 1.5"));
    assert!(wrong.starts_with("a.toml:2: radius_m = 0.4") && wrong.contains("at most a turn"), "{wrong}");
    let wrong = problem(&text("[surface.fold]\nat_m = 1.5\nangle = 180"));
    assert!(wrong.contains("leave [surface] out for a flat wall"), "{wrong}");
    let wrong = problem(&text("[surface.sphere]\nradius_m = 2"));
    assert!(wrong.starts_with("a.toml:2: ") && wrong.contains("`cylinder`, `fold`, `dome`"), "{wrong}");
    let wrong = problem(&text("[surface]"));
    assert!(wrong.starts_with("a.toml:2: ") && wrong.contains("[surface.fold] or [surface.dome]"), "{wrong}");
    let both = "[surface.cylinder]\nradius_m = 2\nat_m = 1.5\n[surface.fold]\nat_m = 1.5\nangle = 120";
    assert!(problem(&text(both)).contains("leave out the others"), "{}", problem(&text(both)));
    for unrolled in [Unrolling::Azimuthal, Unrolling::Longitude] {
        let name = format!("{unrolled:?}").to_lowercase();
        let dome = text(&format!("[surface.dome]\nradius_m = 2\nat_m = [1.5, 0.5]\nunrolled = \"{name}\""));
        let dome = Wall::from_toml("a.toml", &dome).unwrap();
        assert_eq!(dome.surface(), Some(Surface::Dome { radius_m: 2.0, at_m: [1.5, 0.5], unrolled }));
        assert_eq!(Wall::from_toml("a.toml", &dome.to_toml()).unwrap().surface(), dome.surface());
    }
    let plain = Wall::from_toml("a.toml", &text("[surface.dome]\nradius_m = 2\nat_m = [1.5, 0.5]")).unwrap();
    assert!(matches!(plain.surface(), Some(Surface::Dome { unrolled: Unrolling::Azimuthal, .. })));
    let wrong = problem(&text("[surface.dome]\nradius_m = 0.5\nat_m = [1.5, 0.5]"));
    assert!(wrong.starts_with("a.toml:2: radius_m = 0.5") && wrong.contains("170 degrees"), "{wrong}");
    for radius in ["0", "-1", "inf", "nan", "1e300"] {
        let wrong = problem(&text(&format!("[surface.dome]\nradius_m = {radius}\nat_m = [1.5, 0.5]")));
        assert!(wrong.contains("a radius is above 0 and at most 100000 m"), "{wrong}");
    }
    let wrong = problem(&text("[surface.dome]\nradius_m = 2\nat_m = [1e9, 0.5]"));
    assert!(wrong.contains("at_m = [1000000000.0, 0.5]: the dome's middle lies on the canvas"), "{wrong}");
}
