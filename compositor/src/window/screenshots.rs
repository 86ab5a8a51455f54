//! Writes screenshots of the wall to numbered files.

use std::path::Path;

use channel::files;

use super::effect::Effect;
use crate::gpu::RgbImage;

/// Writes an image to the first of a folder's `wall-0001.png`, `wall-0002.png` … that does not exist.
pub(super) fn write(folder: &Path, image: &RgbImage) -> Result<Effect, String> {
    let path = files::write_numbered(|number| folder.join(format!("wall-{number:04}.png")), |out| image.encode(out))
        .map_err(|error| format!("no screenshot: cannot write in {}: {error}", folder.display()))?;
    let path = std::path::absolute(&path).unwrap_or(path);
    Ok(Effect::note(format!("Screenshot written to {}", path.display())))
}
