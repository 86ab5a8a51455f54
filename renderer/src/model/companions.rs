//! The files that a model's file names: materials, buffers and images.

use std::{
    io::Read,
    path::{Path, PathBuf},
};

use channel::files;

/// Folders in which programs put images, beside the folder of the model itself.
const FOLDERS: [&str; 6] = ["", "textures", "texture", "../textures", "images", "maps"];

/// Finds files by the names that a model gives them.
#[derive(Debug, Default)]
pub struct Companions {
    /// The model's folder; without one, no file is found.
    folder: Option<PathBuf>,
}

impl Companions {
    /// Those of a model.
    pub fn beside(model: &Path) -> Self {
        Self { folder: Some(model.parent().unwrap_or(Path::new("")).to_owned()) }
    }

    /// The whole content of a file of at most `longest` bytes.
    ///
    /// # Errors
    /// A text that names the file and the fault.
    pub(super) fn read(&self, name: &str, longest: u64) -> Result<Vec<u8>, String> {
        let path = self.find(name).ok_or_else(|| format!("{name} is missing: put it beside the model"))?;
        let file = files::open(&path).map_err(|error| format!("{name} {error}"))?;
        let mut bytes = Vec::new();
        let mut start = file.take(longest + 1);
        start.read_to_end(&mut bytes).map_err(|error| format!("{name} cannot be read: {error}"))?;
        if start.limit() == 0 { Err(format!("{name} is longer than {longest} bytes")) } else { Ok(bytes) }
    }

    /// The file itself, if its path leads from the model's folder to it; otherwise one of its name beside the model or in a
    /// folder of images, however its letters are written: models move between machines, their paths do not.
    pub(super) fn find(&self, name: &str) -> Option<PathBuf> {
        let folder = self.folder.as_deref()?;
        let name = name.replace('\\', "/");
        let base = name.rsplit('/').next().filter(|base| !base.is_empty())?;
        let as_named = folder.join(&name);
        if as_named.is_file() {
            return Some(as_named);
        }
        let folders = || FOLDERS.iter().map(|place| folder.join(place));
        let same = folders().map(|place| place.join(base)).find(|path| path.is_file());
        same.or_else(|| folders().find_map(|place| find_in_any_case(&place, base)))
    }
}

fn find_in_any_case(folder: &Path, name: &str) -> Option<PathBuf> {
    let name = name.to_lowercase();
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let entries = std::fs::read_dir(folder).ok()?.flatten();
    let matching = entries.filter(|entry| entry.file_name().to_string_lossy().to_lowercase() == name);
    // The least name, whatever the order of the folder's entries.
    matching.map(|entry| entry.path()).filter(|path| path.is_file()).min()
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn files_are_found_as_other_machines_name_them() {
        let folder = tempfile::tempdir().unwrap();
        let model = folder.path().join("scan/model.obj");
        for name in ["scan/a b.png", "scan/textures/C.JPG", "textures/d.png", "scan/sub/e.png"] {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, name).unwrap();
        }
        let companions = Companions::beside(&model);
        let found = |name: &str| companions.read(name, 100).map(|bytes| String::from_utf8(bytes).unwrap());
        for (name, expected) in [
            ("a b.png", "scan/a b.png"),
            ("C:\\scans\\A B.png", "scan/a b.png"),
            ("/home/x/c.jpg", "scan/textures/C.JPG"),
            ("d.png", "textures/d.png"),
            ("sub\\e.png", "scan/sub/e.png"),
        ] {
            assert_eq!(found(name), Ok(expected.to_owned()), "{name}");
        }
        assert_eq!(found("f.png"), Err("f.png is missing: put it beside the model".to_owned()));
        assert_eq!(companions.read("a b.png", 3), Err("a b.png is longer than 3 bytes".to_owned()));
        assert!(found("").is_err() && found("textures").is_err() && Companions::default().find("a b.png").is_none());
    }
}
