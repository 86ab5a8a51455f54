//! Edits one value of a handwritten wall file, and keeps its order, comments and spaces.

use std::path::Path;

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
    files::write(path, |out| out.write_all(text.as_bytes()))
        .map_err(|error| anyhow::anyhow!("{}: the corners cannot be saved: {error}", path.display()))
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
