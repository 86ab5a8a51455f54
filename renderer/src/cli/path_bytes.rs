//! Paths as bytes, between programs of one machine: a file's name need not be text.

use std::path::{Path, PathBuf};

/// A path as [`from_bytes`] reads it on the same machine.
pub fn to_bytes(path: &Path) -> Vec<u8> {
    path.as_os_str().as_encoded_bytes().to_vec()
}

/// The path that [`to_bytes`] wrote. Bytes that no such path has name a file that is not there.
pub fn from_bytes(bytes: Vec<u8>) -> PathBuf {
    #[cfg(unix)]
    {
        use std::os::unix::ffi::OsStringExt;
        std::ffi::OsString::from_vec(bytes).into()
    }
    #[cfg(not(unix))]
    String::from_utf8_lossy(&bytes).into_owned().into()
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn a_path_that_is_no_text_comes_out_as_it_went_in() {
        let bytes = b"/models/b\xfcste.ply".to_vec();
        let path = from_bytes(bytes.clone());
        assert!(path.to_str().is_none());
        assert_eq!(to_bytes(&path), bytes);
    }
}
