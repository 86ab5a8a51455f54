//! Files: the one place that writes them, and that reads small ones.

use std::{
    fs::{self, File, Metadata},
    io::{self, BufWriter, Read, Write},
    path::{Path, PathBuf},
    sync::{Mutex, MutexGuard, PoisonError},
};

use tempfile::{Builder, NamedTempFile};

/// A file cannot be read whole. The text follows the file's name and a colon.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// It does not exist, or the system refuses it. Not the error's source, because the message contains it already.
    #[error("cannot be read: {0}{cure}", cure = cure_of(.0))]
    Io(io::Error),
    /// A folder, a pipe or a device: it may have no end, and opening it may wait for a writer.
    #[error("is a folder or a pipe: name an ordinary file")]
    NotAFile,
    /// It has more bytes than any file of its kind.
    #[error("is longer than {0} bytes")]
    TooLong(u64),
}

fn cure_of(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::NotFound => "; check its name and its folder",
        io::ErrorKind::PermissionDenied => "; give this user the permission to read it",
        _ => "",
    }
}

/// Opens an ordinary file to read it.
///
/// # Errors
/// It does not exist, is not an ordinary file, or cannot be opened.
pub fn open(path: &Path) -> Result<File, ReadError> {
    // Checked before the file is opened: opening a pipe waits for a writer.
    if !fs::metadata(path).map_err(ReadError::Io)?.is_file() {
        return Err(ReadError::NotAFile);
    }
    File::open(path).map_err(ReadError::Io)
}

/// The text of an ordinary file of at most `longest` bytes.
///
/// # Errors
/// As for [`open`]; or it is longer, or not UTF-8.
pub fn read_text(path: &Path, longest: u64) -> Result<String, ReadError> {
    let mut text = String::new();
    let mut start = open(path)?.take(longest + 1);
    let read = start.read_to_string(&mut text);
    // A cut letter at the limit is no UTF-8, so the length comes first.
    if start.limit() == 0 {
        return Err(ReadError::TooLong(longest));
    }
    read.map_err(ReadError::Io)?;
    Ok(text)
}

/// Writes a file beside the old one and renames it when it is complete: after an error, the old file is as it was.
///
/// An existing file keeps its mode and, where the system allows it, its owner; a file that may not be written is not
/// replaced. The target of a link is replaced, and the link stays; a link without a target is replaced itself. Devices,
/// pipes and open descriptors (`/dev/null`, `/dev/stdout`, `/dev/fd/3`) are written directly.
///
/// # Errors
/// `write` fails, or the file or its folder cannot be written.
pub fn write(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<()> {
    let old = old_file(path)?;
    if is_stream(path, old.as_ref()) {
        let mut out = BufWriter::new(stream(path)?);
        write(&mut out)?;
        return out.flush();
    }
    let mut new = NewFile::beside(path, old)?;
    new.part.fill(write)?;
    new.finish()
}

/// Whether both paths lead to one file that exists, be it through links. Another name of the file (a hard link) counts as
/// another file: [`write()`] replaces the name, and leaves the file as it is.
pub fn are_one_file(one: &Path, other: &Path) -> bool {
    one.canonicalize().is_ok_and(|one| other.canonicalize().is_ok_and(|other| one == other))
}

/// Checks that [`write()`] can write this file, before work whose result it takes. The old file stays as it is.
///
/// # Errors
/// The file or its folder cannot be written.
pub fn check(path: &Path) -> io::Result<()> {
    let old = old_file(path)?;
    if is_stream(path, old.as_ref()) { Ok(()) } else { NewFile::beside(path, old).map(drop) }
}

/// A file that another program writes: it lies beside the old one until it is finished. If it is dropped before, the old
/// file is as it was.
#[derive(Debug)]
pub struct NewFile {
    part: Part,
    path: PathBuf,
    old: Option<Metadata>,
}

impl NewFile {
    /// Begins a file that will replace `path`, as [`write()`] does.
    ///
    /// # Errors
    /// It is a device, pipe or descriptor; or the file or its folder cannot be written.
    pub fn begin(path: &Path) -> io::Result<Self> {
        let old = old_file(path)?;
        if is_stream(path, old.as_ref()) {
            return Err(io::Error::other("it is a pipe or a device: name an ordinary file"));
        }
        Self::beside(path, old)
    }

    /// The open file.
    pub fn file(&self) -> &File {
        self.part.file.as_file()
    }

    /// Replaces the old file.
    ///
    /// # Errors
    /// The disk or its folder cannot be written.
    pub fn finish(self) -> io::Result<()> {
        // A disk over the network reports here that it is full; and a power cut must not leave an empty file.
        self.file().sync_all()?;
        self.appear().map(drop)
    }

    /// Replaces the old file without waiting for the disk: for a file whose reader notices if a power cut has emptied it.
    /// Returns the file.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn appear(self) -> io::Result<File> {
        if let Some(old) = &self.old {
            keep_access(self.file(), old)?;
        }
        self.part.persist(&self.path)
    }

    fn beside(path: &Path, old: Option<Metadata>) -> io::Result<Self> {
        let path = match old {
            Some(_) => {
                File::options().write(true).open(path)?;
                path.canonicalize()?
            }
            None => path.to_owned(),
        };
        let mode = if old.is_some() { PRIVATE } else { PUBLIC };
        Ok(Self { part: Part::begin(folder_of(&path), mode)?, path, old })
    }
}

/// The metadata of a file; follows links as far as the system lets it: in /tmp, it refuses those of other users.
fn old_file(path: &Path) -> io::Result<Option<Metadata>> {
    match fs::metadata(path) {
        Ok(metadata) if metadata.is_dir() => Err(io::ErrorKind::IsADirectory.into()),
        Ok(metadata) => Ok(Some(metadata)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
    }
}

/// New files that belong together: they are removed when this is dropped, or a signal ends the program, unless they are kept.
#[derive(Debug, Default)]
pub struct NewFiles(Vec<PartEntry>);

impl NewFiles {
    /// Writes one more, as [`write()`] does.
    ///
    /// # Errors
    /// As for [`write()`].
    pub fn write(&mut self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        write(path, |out| out.write_all(bytes))?;
        parts().push(path.to_owned());
        self.0.push(PartEntry(path.to_owned()));
        Ok(())
    }

    /// Keeps them: all are there.
    pub fn keep(mut self) {
        self.0.clear();
    }
}

impl Drop for NewFiles {
    fn drop(&mut self) {
        for PartEntry(path) in &self.0 {
            // The error that ends the work says more than this one would.
            let _ = fs::remove_file(path);
        }
    }
}

/// Writes a new file that only its owner can read; it appears when it is complete.
///
/// # Errors
/// Something of this name exists already, or the file cannot be written.
pub fn write_new_private(path: &Path, content: &[u8]) -> io::Result<()> {
    // Told before the folder is touched; the last line decides.
    if path.symlink_metadata().is_ok() {
        return Err(io::ErrorKind::AlreadyExists.into());
    }
    let Part { file, _entry } = complete(folder_of(path), PRIVATE, |out| out.write_all(content))?;
    let _parts = parts();
    file.persist_noclobber(path)?;
    Ok(())
}

/// Opens a small file that processes share to read and write it in place, and makes it if it is not there.
///
/// # Errors
/// It cannot be opened or made.
pub fn open_shared(path: &Path) -> io::Result<File> {
    let mut options = File::options();
    options.read(true).write(true).create(true).truncate(false);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, PRIVATE);
    options.open(path)
}

/// Gives a file that [`open_shared`] opened another name in its folder, once it is complete; an older file of that name is
/// replaced.
///
/// # Errors
/// The folder cannot be written.
pub fn give_place(file: &Path, place: &Path) -> io::Result<()> {
    fs::rename(file, place)
}

/// Writes the first file of `name(1)`, `name(2)` … that does not exist, all in one folder; returns its path.
///
/// # Errors
/// `write` fails, the folder cannot be written, or it has [`MOST_NUMBERED`] of these files.
pub fn write_numbered(
    name: impl Fn(u32) -> PathBuf,
    write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> io::Result<PathBuf> {
    persist_numbered(complete(folder_of(&name(1)), PUBLIC, write)?, name)
}

/// Copies an ordinary file, with its mode, to the first of `name(1)`, `name(2)` … that does not exist, all in one folder.
/// Returns the copy's path, `None` if there is no such file.
///
/// # Errors
/// As for [`open`] and [`write_numbered`].
pub fn copy_numbered(path: &Path, name: impl Fn(u32) -> PathBuf) -> io::Result<Option<PathBuf>> {
    let mut old = match open(path) {
        Ok(file) => file,
        Err(ReadError::Io(error)) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(ReadError::Io(error)) => return Err(error),
        Err(error) => return Err(io::Error::other(error)),
    };
    let copy = complete(folder_of(&name(1)), PRIVATE, |out| io::copy(&mut old, out).map(drop))?;
    keep_access(copy.file.as_file(), &old.metadata()?)?;
    persist_numbered(copy, name).map(Some)
}

/// More numbered files than this in one folder are a mistake.
const MOST_NUMBERED: u32 = 9999;

/// A new file's mode before the user's mask.
const PUBLIC: u32 = 0o666;
/// Of keys, and of files that take an old file's mode later.
const PRIVATE: u32 = 0o600;

/// Whether it is a device, pipe or descriptor, which has no file beside it. A redirected descriptor is a file that others
/// go on writing: it must not be replaced, nor written from its start.
fn is_stream(path: &Path, old: Option<&Metadata>) -> bool {
    let is_named = ["/dev/stdout", "/dev/stderr"].iter().any(|name| path == Path::new(name));
    is_named || old.is_some_and(|old| !old.is_file()) || path.starts_with("/dev/fd") || path.starts_with("/proc")
}

fn stream(path: &Path) -> io::Result<Box<dyn Write>> {
    Ok(match path.to_str() {
        Some("/dev/stdout") => Box::new(io::stdout()),
        Some("/dev/stderr") => Box::new(io::stderr()),
        _ => Box::new(File::options().write(true).truncate(true).open(path)?),
    })
}

/// Removes all incomplete files, for a program that ends at once. Whoever writes files from now on waits for that end.
pub fn give_up() {
    let parts = parts();
    for part in &*parts {
        // One that was just renamed is gone.
        let _ = fs::remove_file(part);
    }
    // Never unlocked: nothing begins or appears any more.
    std::mem::forget(parts);
}

/// The files that are being written, under their random names, and those that are incomplete without others.
static PARTS: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

fn parts() -> MutexGuard<'static, Vec<PathBuf>> {
    PARTS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A file under a random name; it is removed if it is not renamed.
#[derive(Debug)]
struct Part {
    file: NamedTempFile,
    /// Dropped after the file.
    _entry: PartEntry,
}

impl Part {
    /// An empty file.
    fn begin(folder: &Path, mode: u32) -> io::Result<Self> {
        let create = |path: &Path| {
            let mut options = File::options();
            // Fails if anything is there, be it a link.
            options.write(true).create_new(true);
            #[cfg(unix)]
            std::os::unix::fs::OpenOptionsExt::mode(&mut options, mode);
            options.open(path)
        };
        let _ = mode; // unused where files have no mode
        let mut parts = parts();
        let file = Builder::new().prefix(".raywall-").suffix(".part").rand_bytes(16).make_in(folder, create)?;
        parts.push(file.path().to_owned());
        Ok(Self { _entry: PartEntry(file.path().to_owned()), file })
    }

    fn fill(&mut self, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<()> {
        let mut out = BufWriter::new(self.file.as_file_mut());
        write(&mut out)?;
        out.flush()
    }

    fn persist(self, path: &Path) -> io::Result<File> {
        let Self { file, _entry } = self;
        let _parts = parts();
        Ok(file.persist(path)?)
    }
}

/// An entry of [`PARTS`], until it is dropped.
#[derive(Debug)]
struct PartEntry(PathBuf);

impl Drop for PartEntry {
    fn drop(&mut self) {
        parts().retain(|path| *path != self.0);
    }
}

/// A complete file on disk under a random name.
fn complete(folder: &Path, mode: u32, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<Part> {
    let mut part = Part::begin(folder, mode)?;
    part.fill(write)?;
    part.file.as_file().sync_all()?;
    Ok(part)
}

/// Renames a complete file to the first name that is free.
fn persist_numbered(Part { mut file, _entry }: Part, name: impl Fn(u32) -> PathBuf) -> io::Result<PathBuf> {
    let _parts = parts();
    for number in 1..=MOST_NUMBERED {
        let path = name(number);
        file = match file.persist_noclobber(&path) {
            Ok(_) => return Ok(path),
            Err(taken) if taken.error.kind() == io::ErrorKind::AlreadyExists => taken.file,
            Err(failed) => return Err(failed.error),
        };
    }
    Err(io::Error::other(format!("there are {MOST_NUMBERED} of these files already: move some away")))
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Gives a file the mode of an old one, and its owner if the system allows it.
fn keep_access(file: &File, old: &Metadata) -> io::Result<()> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::{MetadataExt, fchown};
        // Only root may change the owner. Before the mode, as it clears parts of it.
        let _ = fchown(file, Some(old.uid()), Some(old.gid()));
    }
    file.set_permissions(old.permissions())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<_> =
            fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn a_failure_leaves_the_old_file_and_nothing_beside_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("stats.json");
        let fail = |out: &mut dyn Write| {
            out.write_all(&[b'x'; 1 << 16])?;
            Err(io::Error::from(io::ErrorKind::StorageFull))
        };
        assert_eq!(write(&path, fail).unwrap_err().kind(), io::ErrorKind::StorageFull);
        assert!(names(folder.path()).is_empty());
        write(&path, |out| out.write_all(b"old")).unwrap();
        write(&path, fail).unwrap_err();
        assert_eq!(fs::read(&path).unwrap(), b"old");
        write(&path, |out| out.write_all(b"new")).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        write_numbered(|number| folder.path().join(number.to_string()), fail).unwrap_err();
        assert_eq!(names(folder.path()), ["stats.json"]);
        assert!(write(Path::new("/no/such/folder/a"), |_| Ok(())).is_err());
        assert!(write(folder.path(), |_| Ok(())).is_err(), "a folder");
    }

    #[test]
    fn files_that_belong_together_are_kept_or_go_together() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let mut new = NewFiles::default();
        new.write(&path("a"), b"1").unwrap();
        new.write(&path("no/such/b"), b"2").unwrap_err();
        assert_eq!(names(folder.path()), ["a"]);
        assert!(parts().contains(&path("a")), "a signal would leave it");
        drop(new);
        assert!(names(folder.path()).is_empty() && !parts().contains(&path("a")));
        let mut new = NewFiles::default();
        new.write(&path("a"), b"1").unwrap();
        new.keep();
        assert!(names(folder.path()) == ["a"] && !parts().contains(&path("a")));
    }

    #[test]
    fn one_file_has_many_paths() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        assert!(!are_one_file(&path("a"), &path("a")), "there is none");
        fs::write(path("a"), "a").unwrap();
        fs::write(path("b"), "a").unwrap();
        assert!(are_one_file(&path("a"), &path("./a")) && !are_one_file(&path("a"), &path("b")));
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(path("a"), path("link")).unwrap();
            assert!(are_one_file(&path("link"), &path("a")) && !are_one_file(&path("link"), &path("b")));
        }
    }

    #[test]
    fn what_cannot_be_written_is_told_before_the_work() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("wall.png");
        check(&path).unwrap();
        assert!(names(folder.path()).is_empty(), "a check leaves nothing");
        fs::write(&path, "old").unwrap();
        check(&path).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(check(&folder.path().join("no/wall.png")).unwrap_err().kind(), io::ErrorKind::NotFound);
        assert_eq!(check(folder.path()).unwrap_err().kind(), io::ErrorKind::IsADirectory);
    }

    #[test]
    fn a_file_of_another_program_appears_when_it_is_finished() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("film.mp4");
        fs::write(&path, "old").unwrap();
        let new = NewFile::begin(&path).unwrap();
        new.file().write_all(b"half").unwrap();
        drop(new);
        assert_eq!((fs::read(&path).unwrap(), names(folder.path()).len()), (b"old".to_vec(), 1));
        let new = NewFile::begin(&path).unwrap();
        new.file().write_all(b"new").unwrap();
        new.finish().unwrap();
        assert_eq!((fs::read(&path).unwrap(), names(folder.path()).len()), (b"new".to_vec(), 1));
        assert!(NewFile::begin(folder.path()).is_err());
    }

    #[test]
    fn no_numbered_file_is_overwritten() {
        let folder = tempfile::tempdir().unwrap();
        let name = |number| folder.path().join(format!("wall-{number:04}.png"));
        fs::write(name(2), "mine").unwrap();
        for number in [1, 3, 4] {
            let path = write_numbered(name, |out| write!(out, "{number}")).unwrap();
            assert_eq!(path, name(number));
            assert_eq!(fs::read_to_string(path).unwrap(), number.to_string());
        }
        assert_eq!(fs::read(name(2)).unwrap(), b"mine");
        assert!(write_numbered(|_| folder.path().join("no/wall.png"), |_| Ok(())).is_err());
    }

    #[test]
    fn a_text_is_read_up_to_its_limit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("text");
        fs::write(&path, "four").unwrap();
        assert_eq!(read_text(&path, 4).unwrap(), "four");
        assert_eq!(read_text(&path, 3).unwrap_err().to_string(), "is longer than 3 bytes");
        fs::write(&path, "aé").unwrap();
        assert!(matches!(read_text(&path, 1), Err(ReadError::TooLong(1))), "the limit cuts a letter");
        fs::write(&path, [0xff]).unwrap();
        assert!(matches!(read_text(&path, 4), Err(ReadError::Io(_))));
        let missing = read_text(&folder.path().join("no"), 4).unwrap_err().to_string();
        assert!(missing.starts_with("cannot be read: ") && missing.ends_with("; check its name and its folder"));
    }

    #[cfg(unix)]
    mod unix {
        use std::os::unix::fs::{PermissionsExt, symlink};

        use super::*;

        #[test]
        fn links_are_followed_and_devices_stay_devices() {
            let folder = tempfile::tempdir().unwrap();
            let [file, link, lost, device] = ["file", "link", "lost", "device"].map(|name| folder.path().join(name));
            fs::write(&file, "old").unwrap();
            symlink("file", &link).unwrap();
            write(&link, |out| out.write_all(b"new")).unwrap();
            assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
            assert_eq!(fs::read(&file).unwrap(), b"new");
            symlink("/no/such/file", &lost).unwrap();
            write(&lost, |out| out.write_all(b"found")).unwrap();
            assert!(fs::symlink_metadata(&lost).unwrap().is_file());
            symlink("/dev/null", &device).unwrap();
            write(&device, |out| out.write_all(b"gone")).unwrap();
            assert!(!fs::metadata("/dev/null").unwrap().is_file());
            if cfg!(target_os = "linux") {
                let full = write(Path::new("/dev/full"), |out| out.write_all(b"x")).unwrap_err();
                assert_eq!(full.kind(), io::ErrorKind::StorageFull);
            }
        }

        #[test]
        fn an_open_descriptor_is_not_replaced() {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("redirected");
            let file = File::create(&path).unwrap();
            let descriptor = format!("/dev/fd/{}", std::os::fd::AsRawFd::as_raw_fd(&file));
            write(Path::new(&descriptor), |out| out.write_all(b"told")).unwrap();
            assert_eq!(fs::read(&path).unwrap(), b"told");
            assert_eq!(file.metadata().unwrap().len(), 4);
        }

        #[test]
        fn a_planted_link_beside_the_file_is_not_followed() {
            let folder = tempfile::tempdir().unwrap();
            let [path, victim] = ["wall.png", "victim"].map(|name| folder.path().join(name));
            fs::write(&victim, "precious").unwrap();
            for name in [format!("wall.png.{}.part", std::process::id()), "wall.png.part".into(), "wall.png.tmp".into()]
            {
                symlink(&victim, folder.path().join(name)).unwrap();
            }
            write(&path, |out| {
                let n_parts = names(folder.path()).iter().filter(|name| name.starts_with(".raywall-")).count();
                assert_eq!(n_parts, 1);
                out.write_all(b"picture")
            })
            .unwrap();
            assert_eq!(fs::read(&victim).unwrap(), b"precious");
            assert!(fs::symlink_metadata(&path).unwrap().is_file());
        }

        #[test]
        fn an_existing_file_keeps_its_mode() {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("file");
            let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
            File::create(folder.path().join("other")).unwrap();
            write(&path, |out| out.write_all(b"1")).unwrap();
            assert_eq!(mode(&path), mode(&folder.path().join("other")), "a new file's is the user's choice");
            for kept in [0o600, 0o640, 0o666, 0o755] {
                fs::set_permissions(&path, fs::Permissions::from_mode(kept)).unwrap();
                write(&path, |out| out.write_all(b"2")).unwrap();
                assert_eq!(mode(&path), kept);
            }
            fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
            let copy = copy_numbered(&path, |number| path.with_extension(number.to_string())).unwrap().unwrap();
            assert_eq!((mode(&copy), fs::read(copy).unwrap()), (0o600, b"2".to_vec()));
            assert_eq!(copy_numbered(&folder.path().join("no"), |_| path.clone()).unwrap(), None);
            let key = folder.path().join("key");
            write_new_private(&key, b"secret").unwrap();
            assert_eq!(mode(&key), 0o600);
            assert_eq!(write_new_private(&key, b"other").unwrap_err().kind(), io::ErrorKind::AlreadyExists);
            assert_eq!(fs::read(&key).unwrap(), b"secret");
            symlink("/no/such/file", folder.path().join("lost")).unwrap();
            assert!(write_new_private(&folder.path().join("lost"), b"x").is_err());
        }

        #[test]
        fn only_ordinary_files_are_read() {
            let folder = tempfile::tempdir().unwrap();
            let pipe = folder.path().join("pipe");
            assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
            for path in [&pipe, folder.path(), Path::new("/dev/zero")] {
                let error = read_text(path, 10).unwrap_err().to_string();
                assert_eq!(error, "is a folder or a pipe: name an ordinary file", "{}", path.display());
            }
        }
    }
}
