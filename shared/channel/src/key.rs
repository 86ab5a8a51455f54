//! The key that a wall and its render servers share.

use std::{
    fmt,
    fs::{File, OpenOptions},
    io::{self, Read, Write},
    path::{Path, PathBuf},
};

/// Bytes of a key.
pub const KEY_BYTES: usize = 32;

/// Two hexadecimal digits a byte, and the end of the line.
const FILE_BYTES: usize = 2 * KEY_BYTES + 1;

/// What proves that a machine belongs to the wall: whoever has it is trusted with everything.
///
/// Invariant: came from a file that only its owner can read, or from the system's random numbers.
#[derive(Clone, PartialEq, Eq)]
pub struct Key([u8; KEY_BYTES]);

/// Why there is no key.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    /// It cannot be read.
    #[error("{}: cannot be read: {cause}; `{}` makes a key", path.display(), make_key_command(path))]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Why.
        cause: io::Error,
    },
    /// It cannot be made.
    #[error("{}: cannot be written: {cause}", .path.display())]
    Unwritable {
        /// The file.
        path: PathBuf,
        /// Why.
        cause: io::Error,
    },
    /// There is a file of this name already: it may be the key of a wall that runs.
    #[error("{0}: is there already, and a key is never overwritten: give --key this file, or choose another name")]
    Exists(PathBuf),
    /// Others than its owner may read or write it.
    #[error(
        "{0}: is open to others than its owner (mode {1:03o}): `chmod 600 {0}`, and make a new key if one of them may \
         have read it"
    )]
    OpenToOthers(PathBuf, u32),
    /// The file holds something else.
    #[error("{}: is no key, which is one line of {} hexadecimal digits: copy the wall's key file again, or make a new one: `{}`",
        .0.display(), 2 * KEY_BYTES, make_key_command(&unused_name(.0)))]
    NoKey(PathBuf),
    /// The system gives no random numbers.
    #[error("the system gives no random numbers: {0}")]
    NoRandom(getrandom::Error),
}

impl Key {
    /// A new key from the system's random numbers.
    pub fn random() -> Result<Self, KeyError> {
        let mut bytes = [0; KEY_BYTES];
        getrandom::fill(&mut bytes).map_err(KeyError::NoRandom)?;
        Ok(Self(bytes))
    }

    /// Reads a key file, which on Unix only its owner may be able to read.
    pub fn read(path: &Path) -> Result<Self, KeyError> {
        let unreadable = |cause| KeyError::Unreadable { path: path.to_owned(), cause };
        // Asked before it is opened: opening a pipe would wait for whoever writes into it.
        if !std::fs::metadata(path).map_err(unreadable)?.is_file() {
            return Err(KeyError::NoKey(path.to_owned()));
        }
        let file = File::open(path).map_err(unreadable)?;
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            let mode = file.metadata().map_err(unreadable)?.permissions().mode() & 0o777;
            if mode & 0o077 != 0 {
                return Err(KeyError::OpenToOthers(path.to_owned(), mode));
            }
        }
        // One byte more than the longest key file, which ends in CR LF, shows that a file is longer.
        let mut text = Vec::new();
        file.take(FILE_BYTES as u64 + 2).read_to_end(&mut text).map_err(unreadable)?;
        Self::parse(&text).ok_or_else(|| KeyError::NoKey(path.to_owned()))
    }

    /// Writes the key to a new file that only its owner can read.
    pub fn write(&self, path: &Path) -> Result<(), KeyError> {
        let mut options = OpenOptions::new();
        options.write(true).create_new(true);
        #[cfg(unix)]
        std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
        let unwritable = |cause: io::Error| match cause.kind() {
            io::ErrorKind::AlreadyExists => KeyError::Exists(path.to_owned()),
            _ => KeyError::Unwritable { path: path.to_owned(), cause },
        };
        let mut file = options.open(path).map_err(unwritable)?;
        let mut text: String = self.0.iter().map(|byte| format!("{byte:02x}")).collect();
        text.push('\n');
        file.write_all(text.as_bytes()).and_then(|()| file.sync_all()).map_err(unwritable)
    }

    /// The bytes, for the handshake.
    pub(crate) fn bytes(&self) -> &[u8; KEY_BYTES] {
        &self.0
    }

    fn parse(text: &[u8]) -> Option<Self> {
        let digits = text.strip_suffix(b"\n").unwrap_or(text);
        let digits = digits.strip_suffix(b"\r").unwrap_or(digits);
        if digits.len() != 2 * KEY_BYTES {
            return None;
        }
        let mut bytes = [0; KEY_BYTES];
        for (byte, pair) in bytes.iter_mut().zip(digits.chunks_exact(2)) {
            let digit = |letter: u8| char::from(letter).to_digit(16);
            *byte = (digit(pair[0])? << 4 | digit(pair[1])?) as u8;
        }
        Some(Self(bytes))
    }
}

impl fmt::Debug for Key {
    /// Says nothing: what is logged is read by others.
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Key(..)")
    }
}

/// The line that makes a key file with the program that runs, as it was called.
pub fn make_key_command(file: &Path) -> String {
    let program = std::env::args().next().unwrap_or_else(|| "renderer".to_owned());
    let is_wall = Path::new(&program).file_stem().is_some_and(|name| name == "compositor");
    format!("{program}{} key {}", if is_wall { " renderer" } else { "" }, file.display())
}

/// A name for a new key beside one that is no good, and that the new one must not overwrite.
fn unused_name(path: &Path) -> PathBuf {
    let mut name = path.to_owned().into_os_string();
    name.push(".new");
    name.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_is_read_as_it_was_written_and_never_overwritten() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("wall.key");
        let key = Key::random().unwrap();
        key.write(&path).unwrap();
        assert_eq!(Key::read(&path).unwrap(), key);
        assert!(matches!(Key::random().unwrap().write(&path), Err(KeyError::Exists(_))));
        assert_eq!(Key::read(&path).unwrap(), key);
    }

    #[test]
    fn no_two_keys_are_equal_and_none_is_shown() {
        assert_ne!(Key::random().unwrap(), Key::random().unwrap());
        assert_eq!(format!("{:?}", Key::random().unwrap()), "Key(..)");
    }

    #[test]
    fn what_is_no_key_is_refused() {
        let digits = "0123456789abcdefABCDEF00112233440123456789abcdefABCDEF0011223344";
        assert!(Key::parse(digits.as_bytes()).is_some());
        assert!(Key::parse(format!("{digits}\n").as_bytes()).is_some());
        assert!(Key::parse(format!("{digits}\r\n").as_bytes()).is_some());
        for bad in ["", "\n", &digits[1..], &format!("{digits}0"), &format!("{digits}\n\n"), &format!(" {digits}")] {
            assert!(Key::parse(bad.as_bytes()).is_none(), "{bad:?}");
        }
        assert!(Key::parse(digits.replace('7', "g").as_bytes()).is_none());
        assert!(Key::parse(&[0xff; 2 * KEY_BYTES]).is_none());
    }

    #[cfg(unix)]
    #[test]
    fn a_file_that_others_may_read_is_refused_with_the_cure() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("wall.key");
        Key::random().unwrap().write(&path).unwrap();
        for mode in [0o640, 0o604, 0o620] {
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
            let error = Key::read(&path).unwrap_err().to_string();
            assert!(error.contains(&format!("mode {mode:o}")) && error.contains("chmod 600"), "{error}");
        }
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o400)).unwrap();
        Key::read(&path).unwrap();
        assert!(matches!(Key::read(folder.path()), Err(KeyError::NoKey(_))), "a folder");
        assert!(matches!(Key::read(Path::new("/dev/zero")), Err(KeyError::NoKey(_))), "endless");
    }
}
