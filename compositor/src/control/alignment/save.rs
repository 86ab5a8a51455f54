//! Edits one value of a handwritten wall file, and keeps its order, comments and spaces.

use std::path::{Path, PathBuf};

use anyhow::Context;
use channel::files;
use serde::Deserialize;
use toml::Spanned;

use crate::wall::{Wall, WallError, read_text};

/// The parts of the file that are edited.
#[derive(Deserialize)]
struct Names {
    #[serde(default)]
    projector: Vec<Named>,
}

#[derive(Deserialize)]
struct Named {
    name: Spanned<String>,
    warp_px: Option<Spanned<toml::Value>>,
}

/// Writes the corners of all projectors of `wall` to its file. On an error, for example in a file that has changed to
/// another wall or has no place for the corners, the file stays as it was.
pub(crate) fn save_warps(path: &Path, wall: &Wall) -> anyhow::Result<()> {
    let text = text_with_warps(path, wall)?;
    files::write(path, |out| out.write_all(text.as_bytes()))
        .map_err(|error| anyhow::anyhow!("{}: the corners cannot be saved: {error}", path.display()))
}

/// Writes `wall` to a new file beside its file, or into the current folder, and returns the new file.
pub(crate) fn save_aside(path: Option<&Path>, wall: &Wall) -> anyhow::Result<PathBuf> {
    // A file that has no place for the corners any more is written anew.
    let text = path.and_then(|path| text_with_warps(path, wall).ok()).unwrap_or_else(|| wall.to_toml());
    let file = unused_beside(path.unwrap_or(Path::new("wall.toml")), "corners")?;
    files::write(&file, |out| out.write_all(text.as_bytes()))
        .map_err(|error| anyhow::anyhow!("{}: the corners cannot be saved: {error}", file.display()))?;
    Ok(file)
}

/// Copies a wall file to a new file beside it, and returns that file.
pub(crate) fn keep_old(path: &Path) -> anyhow::Result<PathBuf> {
    let text = read_text(path).map_err(|cause| WallError::Unreadable { path: path.display().to_string(), cause })?;
    let file = unused_beside(path, "old")?;
    files::write(&file, |out| out.write_all(text.as_bytes()))
        .map_err(|error| anyhow::anyhow!("{}: the old file cannot be kept: {error}", file.display()))?;
    Ok(file)
}

/// A new name beside a wall file, for example `my-wall.corners-1.toml`.
fn unused_beside(path: &Path, kind: &str) -> anyhow::Result<PathBuf> {
    let names = (1..=MOST_ASIDE).map(|number| path.with_extension(format!("{kind}-{number}.toml")));
    let unused = names.into_iter().find(|name| !name.exists());
    unused.with_context(|| format!("{}: too many files of kind {kind} beside it: remove some", path.display()))
}

/// The most files of a kind beside a wall file.
const MOST_ASIDE: u32 = 1000;

/// The text of the wall's file with the corners of all projectors of `wall`.
fn text_with_warps(path: &Path, wall: &Wall) -> anyhow::Result<String> {
    let unreadable = |cause| WallError::Unreadable { path: path.display().to_string(), cause };
    let old_text = read_text(path).map_err(unreadable)?;
    let old = Wall::from_toml(&path.display().to_string(), &old_text)?;
    let mut text = old_text;
    for (projector, old_projector) in wall.projectors().iter().zip(old.projectors()) {
        if projector.warp_px != old_projector.warp_px {
            text = with_warp(&text, &projector.name, projector.warp_px);
        }
    }
    // Write only a text that parses to exactly these projectors.
    let written = Wall::from_toml(&path.display().to_string(), &text);
    anyhow::ensure!(
        written.is_ok_and(|written| written.projectors() == wall.projectors()),
        "{}: the corners cannot be put into this file: give each projector a [[projector]] table with its name on a \
         line of its own, and do not change the file while the wall runs",
        path.display()
    );
    Ok(text)
}

/// The text of a wall file with new corners of one projector.
fn with_warp(text: &str, name: &str, warp_px: [[f64; 2]; 4]) -> String {
    let names = toml::from_str::<Names>(text).map(|names| names.projector).unwrap_or_default();
    match names.iter().find(|named| named.name.get_ref() == name) {
        Some(Named { warp_px: Some(old), .. }) => {
            let (before, after) = (&text[..old.span().start], &text[old.span().end..]);
            format!("{before}{warp_px:?}{after}")
        }
        Some(Named { name, .. }) => {
            let line_end = text[name.span().end..].find('\n').map_or(text.len(), |length| name.span().end + length);
            let (before, after) = text.split_at(line_end);
            format!("{before}\nwarp_px = {warp_px:?}{after}")
        }
        None => {
            let name = toml::Value::String(name.to_owned());
            format!("{}\n\n[[projector]]\nname = {name}\nwarp_px = {warp_px:?}\n", text.trim_end())
        }
    }
}
