//! Lists the files of a folder, to choose a model.

use std::path::{Path, PathBuf};

use renderer::formats::file::is_named_as_model;
use renderer::model::scene::SceneSource;
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
/// The most letters of a filter.
const LONGEST_FILTER: usize = 100;

/// The list of files on screen, and the folder that it shows.
pub(super) struct Browser {
    /// `None` while the list is hidden.
    pub(super) files: Option<FileList>,
    /// The folder's entries, of which those with the typed letters are on screen.
    entries: Vec<FileEntry>,
    folder: PathBuf,
}

impl Browser {
    pub(super) fn new(source: &SceneSource) -> Self {
        Self { files: None, entries: Vec::new(), folder: folder_of(source) }
    }

    pub(super) fn toggle(&mut self) -> Effect {
        if self.files.take().is_some() { Effect::default() } else { self.list_folder(self.folder.clone()) }
    }

    fn list_folder(&mut self, folder: PathBuf) -> Effect {
        let files = FileList { folder: folder.display().to_string(), is_loading: true, ..FileList::default() };
        self.files = Some(files);
        self.entries.clear();
        self.folder = folder.clone();
        Effect::job(move || Ok(Effect { files: Some(list(&folder)), ..Effect::default() }))
    }

    /// Shows the contents of a folder, unless another is on screen now.
    pub(super) fn show(&mut self, list: FileList) {
        if let Some(files) = self.files.as_mut().filter(|files| files.folder == list.folder) {
            self.entries.clone_from(&list.entries);
            let filter = std::mem::take(&mut files.filter);
            *files = list;
            self.set_filter(filter);
        }
    }

    /// Lists the entries whose names have these letters, in either case.
    fn set_filter(&mut self, filter: String) {
        let Some(files) = &mut self.files else { return };
        let letters = filter.to_lowercase();
        let has_letters = |entry: &&FileEntry| entry.name.to_lowercase().contains(&letters);
        files.entries = self.entries.iter().filter(has_letters).cloned().collect();
        // Select the first file.
        files.chosen = files.entries.iter().position(|entry| entry.bytes.is_some()).unwrap_or(0);
        files.filter = filter;
    }

    /// Adds typed letters to the filter.
    pub(super) fn type_text(&mut self, text: &str) {
        let Some(files) = &self.files else { return };
        let letters = text.chars().filter(|letter| !letter.is_control());
        self.set_filter(files.filter.chars().chain(letters).take(LONGEST_FILTER).collect());
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

    /// The command of a key while files are on screen, when all keys belong to them; `None` for letters and keys without.
    pub(super) fn command(&self, key: Key) -> Option<Command> {
        let files = self.files.as_ref()?;
        if key == Key::Ctrl('o') {
            return Some(Command::ToggleFiles);
        }
        let Key::Named(named) = key else { return None };
        let step = match named {
            NamedKey::Escape => return Some(Command::ToggleFiles),
            NamedKey::Enter => return Some(Command::OpenEntry(files.chosen)),
            NamedKey::Backspace if files.filter.is_empty() => return Some(Command::OpenParent),
            NamedKey::Backspace => return Some(Command::Untype),
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

    /// Takes the last letter of the filter away.
    pub(super) fn untype(&mut self) {
        let Some(files) = &self.files else { return };
        let mut filter = files.filter.clone();
        filter.pop();
        self.set_filter(filter);
    }

    pub(super) fn open_parent(&mut self) -> Effect {
        match self.folder.parent().filter(|_| self.files.is_some()) {
            Some(parent) => self.list_folder(parent.to_owned()),
            None => Effect::default(),
        }
    }
}

/// The folder of a model; of the built-in one, that in which the wall was started.
pub(super) fn folder_of(source: &SceneSource) -> PathBuf {
    let folder = match source {
        SceneSource::File(path) => path.parent().map(Path::to_owned).filter(|path| !path.as_os_str().is_empty()),
        SceneSource::Statue { .. } => None,
    };
    let folder = folder.unwrap_or_else(|| PathBuf::from("."));
    std::path::absolute(&folder).unwrap_or(folder)
}

/// Folders and models of a folder, without hidden ones.
pub(super) fn list(folder: &Path) -> FileList {
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
        let is_model = is_named_as_model(Path::new(&name));
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
        assert_eq!(listed.problem, None);
        let mut browser = Browser::new(&SceneSource::File(folder.join("b.PLY")));
        let job = browser.toggle().job.expect("the folder is to be read");
        let is_loading = |browser: &Browser| browser.files.as_ref().map(|files| files.is_loading);
        assert_eq!(is_loading(&browser), Some(true));
        browser.show(job().files.expect("the folder's files"));
        assert_eq!(is_loading(&browser), Some(false));
        assert_eq!(browser.files.as_ref().map(|files| files.chosen), Some(1), "not the first file");
        assert_eq!(browser.command(Key::Named(NamedKey::ArrowDown)), Some(Command::Choose(2)));
        browser.choose(9);
        assert_eq!(browser.files.as_ref().map(|files| files.chosen), Some(3));
        assert_eq!(browser.open(2).0, Some(folder.join("b.PLY")));
        assert!(browser.files.as_ref().is_none());
        std::fs::remove_dir_all(&folder).unwrap();
        assert!(list(&folder).problem.unwrap().contains("Backspace opens the folder above"));
    }

    #[test]
    fn typed_letters_choose_among_the_names_and_backspace_takes_them_away() {
        let mut browser = Browser::new(&SceneSource::File("/scans/a.ply".into()));
        let _job = browser.toggle();
        browser.type_text("S");
        let entry = |name: &str, bytes| FileEntry { name: name.to_owned(), bytes };
        let entries = vec![entry("scans", None), entry("a.ply", Some(4)), entry("Statue s.ply", Some(3))];
        browser.show(FileList { folder: "/scans".to_owned(), entries, ..FileList::default() });
        let names = |browser: &Browser| -> Vec<String> {
            browser.files.iter().flat_map(|files| &files.entries).map(|entry| entry.name.clone()).collect()
        };
        assert_eq!(names(&browser), ["scans", "Statue s.ply"], "letters that were typed too early count");
        assert_eq!(browser.command(Key::Named(NamedKey::Enter)), Some(Command::OpenEntry(1)), "not the first file");
        browser.type_text("\u{8}tA");
        assert_eq!(names(&browser), ["Statue s.ply"]);
        assert_eq!(browser.open(0).0, Some("/scans/Statue s.ply".into()));
        let _job = browser.toggle();
        browser.type_text("x");
        assert_eq!(names(&browser), [""; 0]);
        assert_eq!(browser.command(Key::Letter('q')), None);
        assert_eq!(browser.command(Key::Named(NamedKey::Backspace)), Some(Command::Untype));
        browser.untype();
        assert_eq!(browser.command(Key::Named(NamedKey::Backspace)), Some(Command::OpenParent));
        assert_eq!(browser.command(Key::Ctrl('o')), Some(Command::ToggleFiles));
    }
}
