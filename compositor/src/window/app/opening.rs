//! Choosing a model among the files of a folder.

use std::{
    path::{Path, PathBuf},
    sync::mpsc,
};

use renderer::model::scene::SceneSource;
use winit::keyboard::NamedKey;

use super::App;
use crate::{
    control::input::{Command, Key},
    overlay::{FileEntry, FileList},
};

/// A folder with more entries than this is shown in part.
const MOST_ENTRIES: usize = 2000;
/// What Page Up and Page Down pass over.
const PAGE: isize = 15;

/// The folder that is looked at, and what others read of it.
pub(super) struct Browser {
    folder: PathBuf,
    listings: (mpsc::Sender<FileListing>, mpsc::Receiver<FileListing>),
}

/// What was read of a folder.
struct FileListing {
    folder: PathBuf,
    list: FileList,
}

impl Browser {
    /// Begins at the folder of a model.
    pub(super) fn new(source: &SceneSource) -> Self {
        let folder = match source {
            SceneSource::Ply(path) => path.parent().map(Path::to_owned).filter(|path| !path.as_os_str().is_empty()),
            SceneSource::Statue { .. } => None,
        };
        let folder = folder.unwrap_or_else(|| PathBuf::from("."));
        Self { folder: std::path::absolute(&folder).unwrap_or(folder), listings: mpsc::channel() }
    }
}

impl App<'_> {
    /// Shows the folder, or no longer.
    pub(super) fn toggle_files(&mut self) {
        if self.overlay.files.take().is_none() {
            self.list_folder(self.browser.folder.clone());
        }
    }

    fn list_folder(&mut self, folder: PathBuf) {
        self.overlay.files = Some(FileList { folder: folder.display().to_string(), ..FileList::default() });
        self.browser.folder = folder.clone();
        let sender = self.browser.listings.0.clone();
        self.jobs.add(move || {
            let list = list(&folder);
            // Nobody waits for it once the window is closed.
            let _ = sender.send(FileListing { folder, list });
            Ok(None)
        });
    }

    /// Takes what was read of the folder that is still looked at.
    pub(super) fn take_listing(&mut self) {
        while let Ok(FileListing { folder, list }) = self.browser.listings.1.try_recv() {
            if self.overlay.files.is_some() && folder == self.browser.folder {
                self.overlay.files = Some(list);
            }
        }
    }

    /// Opens a file of the folder, or a folder in it.
    pub(super) fn open_entry(&mut self, index: usize) {
        let Some(entry) = self.overlay.files.as_ref().and_then(|files| files.entries.get(index)) else { return };
        let path = self.browser.folder.join(&entry.name);
        if entry.bytes.is_some() {
            self.overlay.files = None;
            self.loader.load(SceneSource::Ply(path));
        } else {
            self.list_folder(path);
        }
    }

    /// What a key does while files are shown; `None` if what it always does.
    pub(super) fn files_key(&mut self, key: Key) -> Option<Command> {
        let files = self.overlay.files.as_mut()?;
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

    /// Marks another entry.
    pub(super) fn choose(&mut self, index: usize) {
        if let Some(files) = &mut self.overlay.files {
            files.chosen = index.min(files.entries.len().saturating_sub(1));
        }
    }

    /// Shows the folder above.
    pub(super) fn open_parent(&mut self) {
        if let Some(parent) = self.browser.folder.parent().filter(|_| self.overlay.files.is_some()) {
            self.list_folder(parent.to_owned());
        }
    }
}

/// Folders and PLY files of a folder, hidden ones left out.
fn list(folder: &Path) -> FileList {
    let mut list = FileList { folder: folder.display().to_string(), ..FileList::default() };
    let entries = match std::fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(error) => {
            list.problem = Some(format!("This folder cannot be read ({error}): Backspace is the folder above"));
            return list;
        }
    };
    for entry in entries.flatten() {
        // Names that are no text cannot be shown, and such a file can still be dropped on the window.
        let Ok(name) = entry.file_name().into_string() else { continue };
        // Of links, what they lead to counts.
        let Ok(metadata) = std::fs::metadata(entry.path()) else { continue };
        let is_ply = Path::new(&name).extension().is_some_and(|ending| ending.eq_ignore_ascii_case("ply"));
        if name.starts_with('.') || !(metadata.is_dir() || metadata.is_file() && is_ply) {
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
    // The first file is most likely wanted.
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
        for (name, text) in [("b.PLY", "ply"), ("A.ply", "ply\n"), ("notes.txt", ""), (".c.ply", "")] {
            std::fs::write(folder.join(name), text).unwrap();
        }
        let listed = list(&folder);
        let entry = |name: &str, bytes| FileEntry { name: name.to_owned(), bytes };
        assert_eq!(listed.entries, [entry("scans", None), entry("A.ply", Some(4)), entry("b.PLY", Some(3))]);
        assert_eq!((listed.chosen, listed.problem), (1, None));
        std::fs::remove_dir_all(&folder).unwrap();
        assert!(list(&folder).problem.unwrap().contains("Backspace is the folder above"));
    }
}
