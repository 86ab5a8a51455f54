//! The files that a model's file names: materials, buffers and images.

use std::{
    collections::BTreeMap,
    io::Read,
    path::{Component, Path, PathBuf},
    sync::{Mutex, PoisonError},
};

use channel::files;
use unicode_normalization::UnicodeNormalization;

use crate::formats::sources::Companion;

/// Folders in which programs put images, beside the folder of the model itself.
const FOLDERS: [&str; 6] = ["", "textures", "texture", "../textures", "images", "maps"];

/// Finds files by the names that a model gives them.
#[derive(Debug, Default)]
pub struct Companions {
    /// The model's folder; without one, no file is found.
    folder: Option<PathBuf>,
    /// The model's name without its extension.
    stem: Option<String>,
    /// The files that were looked for, by folder and name, and the first that was found.
    found: Mutex<BTreeMap<(String, String), Companion>>,
}

/// Most files that a model may name for its sources to be kept.
const MOST_FOUND: usize = 10_000;

impl Companions {
    /// Those of a model.
    pub fn beside(model: &Path) -> Self {
        Self {
            folder: Some(model.parent().unwrap_or(Path::new("")).to_owned()),
            stem: model.file_stem().and_then(|stem| stem.to_str()).map(str::to_owned),
            found: Mutex::default(),
        }
    }

    /// All that was looked for so far; `None` if there is too much of it.
    pub(super) fn found(&self) -> Option<Vec<Companion>> {
        let found = self.found.lock().unwrap_or_else(PoisonError::into_inner);
        (found.len() < MOST_FOUND).then(|| found.values().cloned().collect())
    }

    /// The model's name with another extension, if that file is there.
    pub(super) fn of_same_name(&self, extension: &str) -> Option<String> {
        let name = format!("{}.{extension}", self.stem.as_ref()?);
        self.find("", &name).is_ok().then_some(name)
    }

    /// The whole content of a file of at most `longest` bytes, which a file in `folder` names.
    ///
    /// # Errors
    /// A text that names the file and the fault.
    pub(super) fn read(&self, folder: &str, name: &str, longest: u64) -> Result<Vec<u8>, String> {
        let path = self.find(folder, name)?;
        let file = files::open(&path).map_err(|error| format!("{name} {error}"))?;
        let mut bytes = Vec::new();
        let mut start = file.take(longest + 1);
        start.read_to_end(&mut bytes).map_err(|error| format!("{name} cannot be read: {error}"))?;
        if start.limit() == 0 { Err(format!("{name} is longer than {longest} bytes")) } else { Ok(bytes) }
    }

    /// The file itself, if its path leads from `folder`, or from the model's folder, to one that is [allowed](within);
    /// otherwise one of its name beside the model or in a folder of images, however its letters are written: models move
    /// between machines, their paths do not. `folder` is relative to the model's.
    ///
    /// # Errors
    /// A text that names the file and the fault.
    pub(super) fn find(&self, folder: &str, name: &str) -> Result<PathBuf, String> {
        let found = self.look_for(folder, name);
        let mut all = self.found.lock().unwrap_or_else(PoisonError::into_inner);
        if all.len() < MOST_FOUND {
            let first = || Companion::new(folder, name, found.as_deref().ok());
            all.entry((folder.to_owned(), name.to_owned())).or_insert_with(first);
        }
        found
    }

    fn look_for(&self, folder: &str, name: &str) -> Result<PathBuf, String> {
        let missing = || format!("{name} is missing: put it beside the model");
        let here = self.folder.as_deref().ok_or_else(missing)?;
        let [folder, named] = [folder, name].map(|path| path.replace('\\', "/"));
        let base = named.rsplit('/').next().filter(|base| !base.is_empty()).ok_or_else(missing)?;
        let places = [Path::new(&folder).join(&named), PathBuf::from(&named)];
        let allowed = || places.iter().filter_map(|place| within(here, place)).map(|place| here.join(place));
        if let Some(path) = allowed().find(|path| path.is_file()) {
            return Ok(path);
        }
        // Programs on systems that ignore the case of letters write folders as they please too.
        let in_any_case = places.iter().filter_map(|place| within(here, place));
        if let Some(path) = in_any_case.filter_map(|way| follow_in_any_case(here, &way)).find(|path| path.is_file()) {
            return Ok(path);
        }
        let beside = within(here, Path::new(&folder));
        let folders = || beside.iter().cloned().chain(FOLDERS.map(PathBuf::from)).map(|place| here.join(place));
        let same = folders().map(|place| place.join(base)).find(|path| path.is_file());
        let found = same.or_else(|| folders().find_map(|place| find_in_any_case(&place, base)));
        found.ok_or_else(|| match allowed().next() {
            Some(_) => missing(),
            None => format!(
                "{name} is neither below the model's folder nor below the one above it: put it beside the model"
            ),
        })
    }
}

/// The way from the model's folder to a path that is in it or below it, or below the folder above it, where models share
/// textures: a model from a stranger must not show other files of this machine. Links are followed, as textures are
/// often kept elsewhere: whoever unpacks a stranger's archive should look for them.
fn within(folder: &Path, path: &Path) -> Option<PathBuf> {
    if path.is_absolute() {
        // The empty path is the current folder to all but this function.
        let folder = std::path::absolute(Path::new(".").join(folder)).ok()?;
        let above = folder.parent().unwrap_or(&folder);
        return tidy(path.strip_prefix(above).ok()?).filter(|way| !way.starts_with("..")).map(|way| above.join(way));
    }
    tidy(path).filter(|way| !way.starts_with("../.."))
}

/// A relative path without `.`, and with `..` only at its beginning; `None` if it is none.
fn tidy(path: &Path) -> Option<PathBuf> {
    let mut way = PathBuf::new();
    for part in path.components() {
        match part {
            Component::CurDir => {}
            Component::ParentDir if way.file_name().is_some() => {
                way.pop();
            }
            Component::ParentDir => way.push(".."),
            Component::Normal(name) => way.push(name),
            Component::RootDir | Component::Prefix(_) => return None,
        }
    }
    Some(way)
}

/// The end of a way from a folder, if each of its names is there in some case of letters.
fn follow_in_any_case(folder: &Path, way: &Path) -> Option<PathBuf> {
    way.components().try_fold(folder.to_owned(), |at, part| {
        let next = at.join(part);
        match part {
            Component::Normal(name) if !next.exists() => entries_in_any_case(&at, &name.to_string_lossy()).min(),
            _ => Some(next),
        }
    })
}

fn find_in_any_case(folder: &Path, name: &str) -> Option<PathBuf> {
    // The least name, whatever the order of the folder's entries.
    entries_in_any_case(folder, name).filter(|path| path.is_file()).min()
}

fn entries_in_any_case(folder: &Path, name: &str) -> impl Iterator<Item = PathBuf> {
    // Systems also differ in how they write letters with accents.
    let folded = |name: &str| name.nfc().collect::<String>().to_lowercase();
    let name = folded(name);
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let matching = entries.filter(move |entry| folded(&entry.file_name().to_string_lossy()) == name);
    matching.map(|entry| entry.path())
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn files_are_found_as_other_machines_name_them() {
        let folder = tempfile::tempdir().unwrap();
        let model = folder.path().join("scan/model.obj");
        for name in [
            "scan/a b.png",
            "scan/textures/C.JPG",
            "textures/d.png",
            "scan/sub/e.png",
            "scan/sub/Deep/er.PNG",
            "scan/Bu\u{308}ste.png",
        ] {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, name).unwrap();
        }
        let companions = Companions::beside(&model);
        let found = |name: &str| companions.read("", name, 100).map(|bytes| String::from_utf8(bytes).unwrap());
        for (name, expected) in [
            ("a b.png", "scan/a b.png"),
            ("C:\\scans\\A B.png", "scan/a b.png"),
            ("/home/x/c.jpg", "scan/textures/C.JPG"),
            ("d.png", "textures/d.png"),
            ("sub\\e.png", "scan/sub/e.png"),
            ("SUB/E.PNG", "scan/sub/e.png"),
            (".\\Sub\\deep\\Er.png", "scan/sub/Deep/er.PNG"),
            ("../Scan/Sub/e.png", "scan/sub/e.png"),
            ("B\u{fc}ste.png", "scan/Bu\u{308}ste.png"),
        ] {
            assert_eq!(found(name), Ok(expected.to_owned()), "{name}");
        }
        assert_eq!(found("f.png"), Err("f.png is missing: put it beside the model".to_owned()));
        assert_eq!(companions.read("", "a b.png", 3), Err("a b.png is longer than 3 bytes".to_owned()));
        assert!(found("").is_err() && found("textures").is_err());
        assert!(Companions::default().find("", "a b.png").is_err());
    }

    #[test]
    fn files_farther_away_than_the_folder_above_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["passwd", "scans/shared/a.jpg", "scans/b.jpg", "scans/one/sub/c.jpg", "scans/one/sub/maps/d.jpg"] {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, name).unwrap();
        }
        let companions = Companions::beside(&folder.path().join("scans/one/model.obj"));
        let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
        for (from, name) in [
            ("", "../shared/a.jpg"),
            ("", "sub/../../b.jpg"),
            ("", &path("scans/b.jpg")),
            ("sub", "c.jpg"),
            ("sub", "./maps/d.jpg"),
            ("sub", "../../shared/a.jpg"),
            ("sub", "x/y/c.jpg"),
        ] {
            assert!(companions.read(from, name, 100).is_ok(), "{from} {name}");
        }
        for name in ["../../passwd", "sub/../../../passwd", "../shared/../../passwd", "..\\..\\passwd", &path("passwd")]
        {
            let told = companions.find("", name).unwrap_err();
            assert!(told.starts_with(&format!("{name} is neither below the model's folder")), "{told}");
        }
        let here = std::env::current_dir().unwrap().join("a.png");
        assert!(within(Path::new(""), &here).is_some() && within(Path::new("deep/er"), &here).is_none());
        assert!(companions.find("..", "../passwd").is_err() && companions.find("../..", "passwd").is_err());
    }
}
