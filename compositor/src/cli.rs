//! The command line: starts a wall with or without a window, checks, calibrates, imports and exports walls, and reports measurements.

pub mod annotations;
mod announcing;
pub mod args;
pub mod calibrate;
pub mod check;
pub mod device_args;
pub mod export;
pub mod headless;
pub mod import;
pub mod local;
pub mod remote_args;
pub mod report;
pub(crate) mod restart;
pub mod run;

use std::path::Path;

/// Refuses to write over a file that is there; the message names the cure.
fn ensure_new(path: &Path, cure: &str) -> anyhow::Result<()> {
    anyhow::ensure!(
        !path.exists() || path.is_file() || path.is_dir(),
        "{} is no ordinary file, and this writes only new ones: {cure}",
        path.display()
    );
    anyhow::ensure!(!path.exists(), "{} is there already: {cure}, or remove it", path.display());
    Ok(())
}
