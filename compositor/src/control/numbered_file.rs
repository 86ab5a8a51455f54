//! Files with numbers in their names, none of which is ever overwritten.

use std::{fs::File, io, path::PathBuf};

/// More numbered files than this in one folder are a mistake.
const MOST_FILES: u32 = 9999;

/// Creates the first file that does not exist, of `name(1)`, `name(2)` …
pub(crate) fn create(name: impl Fn(u32) -> PathBuf) -> io::Result<PathBuf> {
    for number in 1..=MOST_FILES {
        let path = name(number);
        match File::create_new(&path) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            created => return created.map(|_| path),
        }
    }
    Err(io::Error::other(format!("there are {MOST_FILES} of these files already: move some away")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_file_is_overwritten() {
        let folder = std::env::temp_dir().join(format!("raywall-numbered-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let name = |number| folder.join(format!("wall-{number:04}.png"));
        std::fs::write(name(2), "mine").unwrap();
        let names: Vec<_> = (0..3).map(|_| create(name).unwrap()).collect();
        assert_eq!(names, [1, 3, 4].map(name));
        assert_eq!(std::fs::read(name(2)).unwrap(), b"mine");
        std::fs::remove_dir_all(&folder).unwrap();
        assert!(create(name).is_err());
    }
}
