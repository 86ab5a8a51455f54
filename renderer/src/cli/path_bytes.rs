//! Paths as bytes, between programs of one machine: a file name need not be valid text.

use std::path::{Path, PathBuf};

/// Encodes a path for [`from_bytes`] on the same machine.
pub fn to_bytes(path: &Path) -> Vec<u8> {
    path.as_os_str().as_encoded_bytes().to_vec()
}

/// Decodes a path from [`to_bytes`]. Any other bytes give the path of no file.
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
