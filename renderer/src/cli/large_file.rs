//! Warns of files that may not fit into memory before they are read, which can take minutes.

use shared::printable::counted;

use crate::{cli::free_memory::available_bytes, model::scene::SceneSource};

/// Warns of a model's file that may not fit, before it is read: `n_copies` programs on this machine read it.
pub fn warn_of_large_file(source: &SceneSource, n_copies: u32) {
    let SceneSource::File(path) = source else { return };
    let Ok(file) = std::fs::metadata(path) else { return };
    let line = file_warning(file.len(), n_copies, available_bytes());
    line.iter().for_each(|line| tracing::warn!("{source}: {line}"));
}

/// A mesh takes about as many bytes as a binary file of it.
fn file_warning(n_bytes: u64, n_copies: u32, available: Option<u64>) -> Option<String> {
    let gigabytes = |n_bytes: u64| n_bytes as f64 / 1e9;
    let available = available.filter(|&available| n_bytes.saturating_mul(n_copies.into()) > available)?;
    Some(format!(
        "the file has {:.1} GB, {} on this machine will hold it, and {:.1} GB of memory are free: use fewer render servers \
         here, a model of fewer triangles, or a machine with more memory",
        gigabytes(n_bytes),
        counted(n_copies, "program"),
        gigabytes(available)
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_beyond_the_free_memory_are_told() {
        let warning = |n_bytes, n_copies| file_warning(n_bytes, n_copies, Some(4_000_000_000)).unwrap_or_default();
        assert_eq!((warning(1_000_000_000, 3).as_str(), warning(0, 100).as_str()), ("", ""));
        assert!(warning(1_000_000_000, 5).starts_with("the file has 1.0 GB, 5 programs on this machine will hold it"));
        assert!(file_warning(u64::MAX, 9, None).is_none(), "free memory is unknown");
    }
}
