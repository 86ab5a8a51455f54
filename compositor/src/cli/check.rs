//! Checks a wall file before anybody climbs a ladder: its errors, its defaults, and a drawing of it.

mod drawing;

use std::path::PathBuf;

use anyhow::Context;
use channel::files;
use clap::builder::{PathBufValueParser, TypedValueParser};
use glam::{DVec2, DVec4};
use renderer::cli::{picture_args::with_ending, say};
use shared::printable::printable_line;

use crate::{
    farm::MOST_FRAMES,
    wall::{OnLoss, PixelRect, Wall, homography::apply},
};

/// Checks a wall file, and prints it with every default filled in.
#[derive(Clone, Debug, clap::Args)]
pub struct CheckArgs {
    /// The wall file
    pub file: PathBuf,
    /// Draw the wall into this file
    #[arg(long, value_name = "FILE.svg",
        value_parser = PathBufValueParser::new().try_map(|path| with_ending(path, "svg")))]
    pub svg: Option<PathBuf>,
}

/// Prints the summary and the complete file, and draws the wall if asked to; each error names the cure.
pub fn run(args: &CheckArgs) -> anyhow::Result<()> {
    let wall = Wall::load(&args.file)?;
    if let Some(path) = &args.svg {
        let svg = drawing::draw(&wall, &args.file.display().to_string());
        files::write(path, |out| out.write_all(svg.as_bytes())).with_context(|| {
            format!("cannot write the drawing {}: --svg FILE.svg puts it elsewhere", path.display())
        })?;
    }
    for line in summary(&wall) {
        say(format_args!("# {}", printable_line(&line)))?;
    }
    match &args.svg {
        Some(path) => say(format_args!("# drawn in {}\n", path.display()))?,
        None => say("# --svg FILE.svg draws the wall\n")?,
    }
    say(wall.to_toml().trim_end())
}

/// A wall at a glance, and its likely mistakes.
fn summary(wall: &Wall) -> Vec<String> {
    let [width, height] = wall.output_size();
    let [width_m, height_m] = wall.canvas_m();
    let n_projectors = wall.projectors().len();
    let projectors = match n_projectors {
        1 => "1 projector or screen".to_owned(),
        n => format!("{n} projectors or screens"),
    };
    let (lit, shared) = lit_parts(wall);
    let frame = wall.frame_size();
    let [sample_width_mm, sample_height_mm] =
        [1e3 * width_m / f64::from(frame.xres()), 1e3 * height_m / f64::from(frame.yres())];
    let mut lines = vec![
        format!("{projectors} on {width_m} m × {height_m} m, {width}×{height} pixels in all"),
        format!("{:.1} % of the canvas is lit, {:.1} % by several of them", 100.0 * lit, 100.0 * shared),
        format!("a sample of a {frame} frame is {sample_width_mm:.2} mm × {sample_height_mm:.2} mm"),
        frame_memory(wall),
    ];
    lines.extend(too_large_output(wall));
    if wall.black() > 0.0 {
        lines.push(format!(
            "black is lifted everywhere to {:.4} of white, the sum where most projectors overlap",
            wall.black()
        ));
    }
    for (monitor, part) in wall.monitors() {
        lines.push(format!("output {monitor} shows {}×{} pixels", part.width, part.height));
    }
    lines.push(match wall.on_loss() {
        OnLoss::LastFrame => "if no render server is left or the program crashes, the last frame stays".to_owned(),
        OnLoss::Black => "if no render server is left or the program crashes, the wall is black".to_owned(),
    });
    let is_cut =
        |index: &usize| wall.projectors()[*index].is_warped() && n_projectors > 1 && wall.neighbours(*index).len() == 1;
    if let Some(index) = (0..n_projectors).find(is_cut) {
        lines.push(format!(
            "\"{}\" is warped and overlaps no other: its edges end at whole pixels, which an overlap would hide",
            wall.projectors()[index].name
        ));
    }
    let falls_short = |index: &usize| wall.neighbours(*index)[0].raster_fades != DVec4::ZERO;
    if let Some(index) = (0..n_projectors).find(falls_short) {
        lines.push(format!(
            "the pixels of \"{}\" do not reach all of its rectangle: move its corners inwards, or make at_m and size_m smaller",
            wall.projectors()[index].name
        ));
    }
    lines
}

/// The memory that the wall's finest frames take.
fn frame_memory(wall: &Wall) -> String {
    let native = wall.native_size();
    let megabytes = 4.0 * f64::from(native.n_samples()) / 1e6;
    let most = MOST_FRAMES as f64 * megabytes;
    format!(
        "at rest a frame has {native} samples: {megabytes:.0} MB on the GPU, as much again for its upload, and up to \
         {most:.0} MB in main memory"
    )
}

/// Most GPUs draw on at most this many pixels a side.
const USUAL_LARGEST_TEXTURE: u32 = 16_384;

/// A window that most GPUs cannot draw on. Frames may be larger: they are cut.
fn too_large_output(wall: &Wall) -> Option<String> {
    let largest = wall.output_parts().into_iter().max_by_key(|part| part.width.max(part.height))?;
    let PixelRect { width, height, .. } = largest;
    (width.max(height) > USUAL_LARGEST_TEXTURE).then(|| {
        format!(
            "one window of {width}×{height} pixels asks for a GPU that draws on {} a side, and most draw on \
             {USUAL_LARGEST_TEXTURE}: name the output of each projector, so that each has a window",
            width.max(height)
        )
    })
}

/// The parts of the canvas that at least one projector lights, and that at least two do.
fn lit_parts(wall: &Wall) -> (f64, f64) {
    /// Points a side: a thousandth of the canvas is not missed.
    const SIDE: u32 = 2500;
    let mut n_lit = vec![0_u8; (SIDE * SIDE) as usize];
    for projector in wall.projectors() {
        let Some(raster_from_image) = projector.raster_from_image() else { continue };
        let canvas = projector.canvas;
        let steps = |from: f64, extent: f64| {
            let step = |edge: f64| (edge * f64::from(SIDE) - 0.5).clamp(-1.0, f64::from(SIDE));
            (step(from).ceil().max(0.0) as u32)..(step(from + extent).floor() + 1.0) as u32
        };
        for j in steps(canvas.bottom, canvas.height) {
            for i in steps(canvas.left, canvas.width) {
                let point = DVec2::new(f64::from(i) + 0.5, f64::from(j) + 0.5) / f64::from(SIDE);
                let image =
                    projector.mesh.as_ref().map_or(canvas.rect_from_canvas(point), |mesh| mesh.image_near(point));
                let is_within = |at: DVec2| at.cmpge(DVec2::ZERO).all() && at.cmple(DVec2::ONE).all();
                let is_lit = is_within(image) && apply(raster_from_image, image).is_some_and(is_within);
                let count = &mut n_lit[(j * SIDE + i) as usize];
                *count = count.saturating_add(u8::from(is_lit));
            }
        }
    }
    let part = |least: u8| n_lit.iter().filter(|&&count| count >= least).count() as f64 / f64::from(SIDE * SIDE);
    (part(1), part(2))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn shipped(name: &str) -> Wall {
        Wall::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../wall-config").join(name)).expect("shipped wall file")
    }

    #[test]
    fn the_summary_says_what_is_lit() {
        let lines = summary(&shipped("paper-4x3.toml"));
        assert_eq!(lines[0], "12 projectors or screens on 4 m × 2.25 m, 4096×2304 pixels in all");
        assert_eq!(lines[1], "100.0 % of the canvas is lit, 0.0 % by several of them");
        let memory = "at rest a frame has 4096x2304 samples: 38 MB on the GPU, as much again for its upload, and up to \
                      226 MB in main memory";
        assert_eq!(lines[3], memory);
        let lines = summary(&shipped("blended-4x3.toml"));
        assert!(lines[1].starts_with("100.0 % of the canvas is lit, 14."), "{lines:?}");
        assert!(lines[4].starts_with("black is lifted everywhere to 0.0090 of white"), "{lines:?}");
        let lines = summary(&shipped("lcd-5x3.toml"));
        assert!(lines[1].starts_with("98.9 % of the canvas is lit, 0.0 %"), "{lines:?}");
        let lines = summary(&shipped("two-monitors.toml"));
        let expected = [
            "output HDMI-1 shows 2560×1440 pixels",
            "output DP-1 shows 1920×1080 pixels",
            "if no render server is left or the program crashes, the last frame stays",
        ];
        assert_eq!(lines[4..], expected);
        let black = summary(&shipped("two-monitors.toml").with_on_loss(OnLoss::Black));
        assert_eq!(
            black.last().map(String::as_str),
            Some("if no render server is left or the program crashes, the wall is black")
        );
    }

    #[test]
    fn the_summary_says_what_a_large_wall_asks_of_the_gpu() {
        let displays = |outputs: &str| {
            let display = |column: u32| {
                let output =
                    if outputs.is_empty() { String::new() } else { format!("output = \"{outputs}-{column}\"\n") };
                format!(
                    "[[projector]]\nname = \"{column}\"\npixels = [3840, 2160]\npixels_at = [{}, 0]\n\
                     at_m = [{column}, 0]\nsize_m = [1, 1]\n{output}",
                    3840 * column
                )
            };
            let text = format!("canvas_m = [10, 1]\n{}", (0..10).map(display).collect::<String>());
            summary(&Wall::from_toml("ten", &text).expect("a wall")).join("\n")
        };
        let lines = displays("DP");
        assert!(lines.contains("38400x2160 samples: 332 MB on the GPU") && !lines.contains("one window"), "{lines}");
        let lines = displays("");
        assert!(lines.contains("one window of 38400×2160 pixels") && lines.contains("name the output"), "{lines}");
    }

    #[test]
    fn the_summary_says_what_to_mend() {
        let warped = |warp_px: &str, overlap: &str| {
            let text = format!(
                "canvas_m = [2.0, 1.0]\n[grid]\ncolumns = 2\nrows = 1\npixels = [100, 100]\n{overlap}\n\
                 [[projector]]\nname = \"row 1 column 2\"\nwarp_px = {warp_px}"
            );
            summary(&Wall::from_toml("warped", &text).expect("a wall")).join("\n")
        };
        let (inwards, outwards) = ("[[2, 2], [-2, 2], [-2, -2], [2, -2]]", "[[0, 0], [3, 0], [0, 0], [0, 0]]");
        let overlap = "overlap = [0.2, 0.0]";
        assert!(warped(inwards, "").contains("\"row 1 column 2\" is warped and overlaps no other"));
        assert!(warped(outwards, overlap).contains("the pixels of \"row 1 column 2\" do not reach"));
        let lines = warped(inwards, overlap);
        assert!(!lines.contains("warped") && !lines.contains("reach"), "{lines}");
    }

    #[test]
    fn a_drawing_is_written_only_where_it_is_asked_for() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../wall-config/laptop.toml");
        run(&CheckArgs { file: file.clone(), svg: None }).unwrap();
        assert!(!Path::new("laptop.svg").exists(), "written without --svg");
        let svg = std::env::temp_dir().join(format!("check-{}.svg", std::process::id()));
        run(&CheckArgs { file, svg: Some(svg.clone()) }).unwrap();
        assert!(std::fs::read_to_string(&svg).unwrap().starts_with("<svg"));
        std::fs::remove_file(svg).unwrap();
    }

    #[test]
    fn every_projector_is_in_the_drawing_by_name() {
        for name in ["paper-4x3.toml", "blended-4x3.toml", "curved-3x1.toml", "two-monitors.toml", "laptop.toml"] {
            let wall = shipped(name);
            let svg = drawing::draw(&wall, name);
            for projector in wall.projectors() {
                assert!(svg.contains(&format!(">{}<", projector.name)), "{name}: {}", projector.name);
            }
        }
    }

    #[test]
    fn the_drawing_in_the_readme_is_what_is_drawn() {
        let reference_path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/references/check-blended-4x3.svg");
        let svg = drawing::draw(&shipped("blended-4x3.toml"), "wall-config/blended-4x3.toml");
        let is_the_same = std::fs::read_to_string(&reference_path).is_ok_and(|reference| reference == svg);
        assert!(
            is_the_same,
            "look at the drawing of `compositor check wall-config/blended-4x3.toml --svg {}`",
            reference_path.display()
        );
    }

    #[test]
    fn names_cannot_break_the_drawing() {
        let text = "canvas_m = [1.0, 1.0]\n[[projector]]\nname = \"<b>&\\\"\"\npixels = [4, 4]\nat_m = [0, 0]\nsize_m = [1, 1]";
        let svg = drawing::draw(&Wall::from_toml("a.toml", text).unwrap(), "a&b");
        assert!(svg.contains("&lt;b&gt;&amp;\"") && !svg.contains("<b>"), "{svg}");
    }
}
