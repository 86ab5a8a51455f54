//! Writes pictures of the wall to numbered files.

use std::{
    fs::File,
    io,
    path::{Path, PathBuf},
};

use super::jobs::Outcome;
use crate::gpu::RgbImage;

/// More pictures than this in one folder are surely a mistake.
const MOST_FILES: u32 = 9999;

/// Writes a picture to the next free file of a folder.
pub(super) fn write(folder: &Path, picture: &RgbImage) -> Outcome {
    let path =
        free_file(folder).map_err(|error| format!("no screenshot: cannot write in {}: {error}", folder.display()))?;
    if let Err(error) = picture.write_png(&path) {
        // Only the empty file that kept the name.
        let _ = std::fs::remove_file(&path);
        return Err(error.to_string());
    }
    let path = std::path::absolute(&path).unwrap_or(path);
    Ok(Some(format!("Screenshot written to {}", path.display())))
}

/// Makes the first of `wall-0001.png`, `wall-0002.png` … that does not exist.
fn free_file(folder: &Path) -> io::Result<PathBuf> {
    for number in 1..=MOST_FILES {
        let path = folder.join(format!("wall-{number:04}.png"));
        match File::create_new(&path) {
            Ok(_) => return Ok(path),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(error),
        }
    }
    Err(io::Error::other(format!("there are {MOST_FILES} screenshots already: move some away")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_file_is_ever_written_over() {
        let folder = std::env::temp_dir().join(format!("raywall-screenshots-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join("wall-0002.png"), "mine").unwrap();
        let names: Vec<_> = (0..3).map(|_| free_file(&folder).unwrap()).collect();
        assert_eq!(names, ["wall-0001.png", "wall-0003.png", "wall-0004.png"].map(|name| folder.join(name)));
        assert_eq!(std::fs::read(folder.join("wall-0002.png")).unwrap(), b"mine");
        std::fs::remove_dir_all(&folder).unwrap();
        assert!(free_file(&folder).is_err());
    }
}
