//! Stored pictures, and the difference that still counts as the same picture.

use std::{
    fs::File,
    io::{self, BufReader},
    path::{Path, PathBuf},
};

use compositor::gpu::RgbImage;
use nv_flip::{DEFAULT_PIXELS_PER_DEGREE, FlipImageRgb8, FlipPool, flip, magma_lut};

/// The largest FLIP difference (Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", 2020) of a pixel,
/// from 0 to 1: rounding of every byte stays below, one misplaced 8×8 tile is far above.
const LARGEST_FLIP: f32 = 0.1;

/// Compares a picture with `tests/references/NAME.png`; panics with how to view and accept it.
pub(crate) fn check(name: &str, picture: &RgbImage) {
    let reference_path = folder().join(format!("{name}.png"));
    let output = Path::new(env!("CARGO_TARGET_TMPDIR"));
    let picture_path = output.join(format!("{name}.png"));
    let fail = |problem: &str| -> ! {
        picture.write_png(&picture_path).expect("the folder of test output");
        let [picture, reference] = [&picture_path, &reference_path].map(|path| path.display());
        panic!("{name}: {problem}\nlook at the picture: {picture}\nif it is right: cp {picture} {reference}");
    };
    let reference = read_png(&reference_path).unwrap_or_else(|error| fail(&error.to_string()));
    if reference.size != picture.size {
        fail(&format!("it has {:?} pixels, its reference {:?}", picture.size, reference.size));
    }
    let (largest, map) = flip_difference(&reference, picture);
    if largest > LARGEST_FLIP {
        let map_path = output.join(format!("{name}.differences.png"));
        map.write_png(&map_path).expect("the folder of test output");
        let map = map_path.display();
        fail(&format!("its FLIP difference from the reference is up to {largest:.3}, more than {LARGEST_FLIP}: {map}"));
    }
}

/// Compares a picture with one computed another way; on failure writes both and the map of differences.
pub(crate) fn check_same(name: &str, expected: &RgbImage, picture: &RgbImage) {
    let (largest, map) = flip_difference(expected, picture);
    if largest > LARGEST_FLIP {
        let output = Path::new(env!("CARGO_TARGET_TMPDIR"));
        for (what, picture) in [("expected", expected), ("shown", picture), ("differences", &map)] {
            picture.write_png(&output.join(format!("{name}.{what}.png"))).expect("the folder of test output");
        }
        panic!("{name}: a FLIP difference of {largest:.3}, more than {LARGEST_FLIP}: see {}", output.display());
    }
}

/// Reads a PNG of 8-bit RGB.
pub(crate) fn read_png(path: &Path) -> io::Result<RgbImage> {
    let mut reader = png::Decoder::new(BufReader::new(File::open(path)?)).read_info()?;
    assert_eq!(reader.output_color_type(), (png::ColorType::Rgb, png::BitDepth::Eight), "{}", path.display());
    let mut rgb = vec![0; reader.output_buffer_size().expect("a picture that fits in memory")];
    let info = reader.next_frame(&mut rgb)?;
    Ok(RgbImage { size: [info.width, info.height], rgb })
}

/// The largest difference of a pixel, and a map of all differences.
fn flip_difference(reference: &RgbImage, picture: &RgbImage) -> (f32, RgbImage) {
    let image = |picture: &RgbImage| FlipImageRgb8::with_data(picture.size[0], picture.size[1], &picture.rgb);
    let errors = flip(image(reference), image(picture), DEFAULT_PIXELS_PER_DEGREE);
    let map = errors.apply_color_lut(&magma_lut());
    let map = RgbImage { size: [map.width(), map.height()], rgb: map.to_vec() };
    (FlipPool::from_image(&errors).max_value(), map)
}

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("references")
}

#[test]
fn references_stay_small() {
    for entry in std::fs::read_dir(folder()).expect("tests/references") {
        let entry = entry.expect("tests/references");
        let n_bytes = entry.metadata().expect("a reference").len();
        assert!(n_bytes <= 200_000, "{} has {n_bytes} bytes", entry.path().display());
    }
}

#[test]
fn one_misplaced_tile_is_another_picture() {
    let reference = read_png(&folder().join("wall-statue.png")).unwrap();
    let mut picture = reference.clone();
    // One step of 8 bits everywhere counts as the same picture.
    picture.rgb.iter_mut().for_each(|byte| *byte ^= 1);
    let (rounded, _) = flip_difference(&reference, &picture);
    assert!(rounded > 0.0 && rounded < LARGEST_FLIP, "{rounded}");

    let [width, height] = picture.size;
    for y in 0..8 {
        // In the face: on smooth stone nobody could see a misplaced tile.
        let row = |top: u32| 3 * ((top + y) * width + width / 2 - 4) as usize;
        let (from, to) = (row(height / 4), row(height / 4 + 8));
        picture.rgb.copy_within(from..from + 24, to);
    }
    let (misplaced, _) = flip_difference(&reference, &picture);
    assert!(misplaced > 2.0 * LARGEST_FLIP, "{misplaced}");
}
