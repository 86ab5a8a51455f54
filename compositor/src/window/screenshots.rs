//! Writes screenshots of the wall to numbered files.

use std::path::Path;

use super::jobs::Outcome;
use crate::{control::numbered_file, gpu::RgbImage};

/// Writes an image to the first of a folder's `wall-0001.png`, `wall-0002.png` … that does not exist.
pub(super) fn write(folder: &Path, image: &RgbImage) -> Outcome {
    let path = numbered_file::create(|number| folder.join(format!("wall-{number:04}.png")))
        .map_err(|error| format!("no screenshot: cannot write in {}: {error}", folder.display()))?;
    if let Err(error) = image.write_png(&path) {
        // Remove the empty file that reserved the name.
        let _ = std::fs::remove_file(&path);
        return Err(error.to_string());
    }
    let path = std::path::absolute(&path).unwrap_or(path);
    Ok(Some(format!("Screenshot written to {}", path.display())))
}
