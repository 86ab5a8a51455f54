//! Lists the files of a folder, to choose a model.

use std::path::{Path, PathBuf};

use renderer::model::{file::ENDINGS, scene::SceneSource};
use winit::keyboard::NamedKey;

use crate::{
    control::input::{Command, Key},
    overlay::{FileEntry, FileList},
    window::effect::Effect,
};

/// At most this many entries of a folder are shown.
const MOST_ENTRIES: usize = 2000;
/// Entries that Page Up and Page Down skip.
const PAGE: isize = 15;

/// The list of files on screen, and the folder that it shows.
pub(super) struct Browser {
    /// `None` while the list is hidden.
    pub(super) files: Option<FileList>,
    folder: PathBuf,
}

impl Browser {
    pub(super) fn new(source: &SceneSource) -> Self {
        let folder = match source {
            SceneSource::File(path) => path.parent().map(Path::to_owned).filter(|path| !path.as_os_str().is_empty()),
            SceneSource::Statue { .. } => None,
        };
        let folder = folder.unwrap_or_else(|| PathBuf::from("."));
        Self { files: None, folder: std::path::absolute(&folder).unwrap_or(folder) }
    }

    pub(super) fn toggle(&mut self) -> Effect {
        if self.files.take().is_some() { Effect::default() } else { self.list_folder(self.folder.clone()) }
    }

    fn list_folder(&mut self, folder: PathBuf) -> Effect {
        let files = FileList { folder: folder.display().to_string(), is_loading: true, ..FileList::default() };
        self.files = Some(files);
        self.folder = folder.clone();
        Effect::job(move || Ok(Effect { files: Some(list(&folder)), ..Effect::default() }))
    }

    /// Shows the contents of a folder, unless another is on screen now.
    pub(super) fn show(&mut self, list: FileList) {
        if let Some(files) = self.files.as_mut().filter(|files| files.folder == list.folder) {
            *files = list;
        }
    }

    /// Opens an entry: returns a file to load, or lists a folder.
    pub(super) fn open(&mut self, index: usize) -> (Option<PathBuf>, Effect) {
        let Some(entry) = self.files.as_ref().and_then(|files| files.entries.get(index)) else {
            return (None, Effect::default());
        };
        let path = self.folder.join(&entry.name);
        if entry.bytes.is_some() {
            self.files = None;
            (Some(path), Effect::default())
        } else {
            (None, self.list_folder(path))
        }
    }

    /// The command of a key while files are on screen; `None` for keys with their usual command.
    pub(super) fn command(&self, key: Key) -> Option<Command> {
        let files = self.files.as_ref()?;
        let Key::Named(named) = key else { return None };
        let step = match named {
            NamedKey::Escape => return Some(Command::ToggleFiles),
            NamedKey::Enter => return Some(Command::OpenEntry(files.chosen)),
            NamedKey::Backspace => return Some(Command::OpenParent),
            NamedKey::ArrowUp => -1,
            NamedKey::ArrowDown => 1,
            NamedKey::PageUp => -PAGE,
            NamedKey::PageDown => PAGE,
            NamedKey::Home => -(MOST_ENTRIES as isize),
            NamedKey::End => MOST_ENTRIES as isize,
            _ => return None,
        };
        Some(Command::Choose(files.chosen.saturating_add_signed(step)))
    }

    /// Selects an entry, or the last one if there are fewer.
    pub(super) fn choose(&mut self, index: usize) {
        if let Some(files) = &mut self.files {
            files.chosen = index.min(files.entries.len().saturating_sub(1));
        }
    }

    pub(super) fn open_parent(&mut self) -> Effect {
        match self.folder.parent().filter(|_| self.files.is_some()) {
            Some(parent) => self.list_folder(parent.to_owned()),
            None => Effect::default(),
        }
    }
}

/// Folders and models of a folder, without hidden ones.
fn list(folder: &Path) -> FileList {
    let mut list = FileList { folder: folder.display().to_string(), ..FileList::default() };
    let entries = match std::fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(error) => {
            list.problem = Some(format!("This folder cannot be read ({error}): Backspace opens the folder above"));
            return list;
        }
    };
    for entry in entries.flatten() {
        // Names that are not UTF-8 cannot be shown; those files can still be dropped on the window.
        let Ok(name) = entry.file_name().into_string() else { continue };
        // Metadata of a link's target.
        let Ok(metadata) = std::fs::metadata(entry.path()) else { continue };
        let ending = Path::new(&name).extension().unwrap_or_default();
        let is_model = ENDINGS.iter().any(|known| ending.eq_ignore_ascii_case(known));
        if name.starts_with('.') || !(metadata.is_dir() || metadata.is_file() && is_model) {
            continue;
        }
        list.entries.push(FileEntry { name, bytes: metadata.is_file().then_some(metadata.len()) });
        if list.entries.len() == MOST_ENTRIES {
            break;
        }
    }
    list.entries.sort_by(|a, b| {
        (a.bytes.is_some(), a.name.to_lowercase(), &a.name).cmp(&(b.bytes.is_some(), b.name.to_lowercase(), &b.name))
    });
    // Select the first file.
    list.chosen = list.entries.iter().position(|entry| entry.bytes.is_some()).unwrap_or(0);
    list
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folders_come_first_and_only_models_are_listed() {
        let folder = std::env::temp_dir().join(format!("raywall-browser-{}", std::process::id()));
        std::fs::create_dir_all(folder.join("scans")).unwrap();
        std::fs::create_dir_all(folder.join(".hidden")).unwrap();
        for (name, text) in [("b.PLY", "ply"), ("A.ply", "ply\n"), ("notes.txt", ""), (".c.ply", ""), ("d.glb", "")] {
            std::fs::write(folder.join(name), text).unwrap();
        }
        let listed = list(&folder);
        let entry = |name: &str, bytes| FileEntry { name: name.to_owned(), bytes };
        assert_eq!(
            listed.entries,
            [entry("scans", None), entry("A.ply", Some(4)), entry("b.PLY", Some(3)), entry("d.glb", Some(0))]
        );
        assert_eq!((listed.chosen, listed.problem), (1, None));
        let mut browser = Browser::new(&SceneSource::File(folder.join("b.PLY")));
        let job = browser.toggle().job.expect("the folder is to be read");
        let is_loading = |browser: &Browser| browser.files.as_ref().map(|files| files.is_loading);
        assert_eq!(is_loading(&browser), Some(true));
        browser.show(job().files.expect("the folder's files"));
        assert_eq!(is_loading(&browser), Some(false));
        assert_eq!(browser.command(Key::Named(NamedKey::ArrowDown)), Some(Command::Choose(2)));
        browser.choose(9);
        assert_eq!(browser.files.as_ref().map(|files| files.chosen), Some(3));
        assert_eq!(browser.open(2).0, Some(folder.join("b.PLY")));
        assert!(browser.files.as_ref().is_none());
        std::fs::remove_dir_all(&folder).unwrap();
        assert!(list(&folder).problem.unwrap().contains("Backspace opens the folder above"));
    }
}
