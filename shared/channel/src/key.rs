//! The secret key that a wall and its render servers share.

use std::{
    fmt,
    io::{self, Read},
    path::{Path, PathBuf},
};

use crate::files::{self, ReadError};

/// Bytes of a key.
pub const KEY_BYTES: usize = 32;

/// Two hexadecimal digits a byte and a line feed.
const FILE_BYTES: usize = 2 * KEY_BYTES + 1;

/// Proves that a machine belongs to the wall: every holder is fully trusted.
///
/// Invariant: it comes from a file that only its owner can read, or from the system's random numbers.
#[derive(Clone, PartialEq, Eq)]
pub struct Key([u8; KEY_BYTES]);

/// A key cannot be read, written or made.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum KeyError {
    #[error("{}: cannot be read: {cause}; `{}` makes a key", path.display(), make_key_command(path))]
    Unreadable { path: PathBuf, cause: io::Error },
    #[error("{}: cannot be written: {cause}", .path.display())]
    Unwritable { path: PathBuf, cause: io::Error },
    // It may be the key of a running wall.
    #[error("{0}: already exists, and a key is never overwritten: give --key this file, or choose another name")]
    Exists(PathBuf),
    #[error(
        "{0}: is accessible to others than its owner (mode {1:03o}): `chmod 600 {0}`, and make a new key if one of them may \
         have read it"
    )]
    OpenToOthers(PathBuf, u32),
    #[error("{}: is not a key of one line with {} hexadecimal digits: copy the wall's key file again, or make a new one: `{}`",
        .0.display(), 2 * KEY_BYTES, make_key_command(&unused_name(.0)))]
    NoKey(PathBuf),
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

    /// Tells keys apart, and reveals nothing of them.
    pub fn fingerprint(&self) -> [u8; 32] {
        blake3::derive_key("Raywall: fingerprint of a wall's key", &self.0)
    }

    /// A badge by which holders of the key recognise it in a wall's announcement; with another nonce it is another one, so
    /// nobody else learns anything, not even which walls have the same key.
    pub(crate) fn badge(&self, nonce: u64) -> u64 {
        let mut hasher = blake3::Hasher::new_derive_key("Raywall: badge of a wall's key in its announcement");
        hasher.update(&self.0).update(&nonce.to_le_bytes());
        let mut badge = [0; 8];
        hasher.finalize_xof().fill(&mut badge);
        u64::from_le_bytes(badge)
    }

    /// Reads a key file; on Unix, only its owner may have access to it.
    pub fn read(path: &Path) -> Result<Self, KeyError> {
        let unreadable = |cause| KeyError::Unreadable { path: path.to_owned(), cause };
        let file = files::open(path).map_err(|error| match error {
            ReadError::Io(cause) => unreadable(cause),
            ReadError::NotAFile | ReadError::TooLong(_) => KeyError::NoKey(path.to_owned()),
        })?;
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            let mode = file.metadata().map_err(unreadable)?.permissions().mode() & 0o777;
            if mode & 0o077 != 0 {
                return Err(KeyError::OpenToOthers(path.to_owned(), mode));
            }
        }
        // One byte more than the longest key file, which ends in CR LF, reveals a longer file.
        let mut text = Vec::new();
        file.take(FILE_BYTES as u64 + 2).read_to_end(&mut text).map_err(unreadable)?;
        Self::parse(&text).ok_or_else(|| KeyError::NoKey(path.to_owned()))
    }

    /// Writes the key to a new file that only its owner can read.
    pub fn write(&self, path: &Path) -> Result<(), KeyError> {
        let mut text: String = self.0.iter().map(|byte| format!("{byte:02x}")).collect();
        text.push('\n');
        files::write_new_private(path, text.as_bytes()).map_err(|cause| match cause.kind() {
            io::ErrorKind::AlreadyExists => KeyError::Exists(path.to_owned()),
            _ => KeyError::Unwritable { path: path.to_owned(), cause },
        })
    }

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
    /// Hides the bytes: logs are read by others.
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Key(..)")
    }
}

/// The command that makes a key file with the running program, as it was called.
pub fn make_key_command(file: &Path) -> String {
    let program = std::env::args().next().unwrap_or_else(|| "renderer".to_owned());
    let is_wall = Path::new(&program).file_stem().is_some_and(|name| name == "compositor");
    format!("{program}{} key {}", if is_wall { " renderer" } else { "" }, file.display())
}

/// The first step towards a key: to use the file if it is there, or else the command that makes it.
pub fn have_key_advice(file: &Path) -> String {
    match file.exists() {
        true => format!("take the key {}, which is here already", file.display()),
        false => format!("make a key with `{}`", make_key_command(file)),
    }
}

/// A name for a new key beside an unusable file, which must not be overwritten.
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
    fn malformed_keys_are_refused() {
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
