//! Edits values of a handwritten wall file, and keeps its order, comments and spaces.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use anyhow::Context;
use channel::files;
use serde::Deserialize;
use toml::Spanned;

use crate::wall::{Gamma, Projector, Wall, WallError, mesh::Mesh, read_text};

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
    mesh: Option<Spanned<toml::Value>>,
    gamma: Option<Spanned<toml::Value>>,
    black_level: Option<Spanned<toml::Value>>,
    gain: Option<Spanned<toml::Value>>,
    fall_off: Option<Spanned<toml::Value>>,
}

impl Named {
    fn value(&self, key: &str) -> Option<&Spanned<toml::Value>> {
        match key {
            "warp_px" => self.warp_px.as_ref(),
            "mesh" => self.mesh.as_ref(),
            "gamma" => self.gamma.as_ref(),
            "black_level" => self.black_level.as_ref(),
            "gain" => self.gain.as_ref(),
            _ => self.fall_off.as_ref(),
        }
    }
}

/// Writes meshes that have no file yet into new files beside the wall's, and returns the wall with what these hold.
pub(crate) fn save_meshes(path: &Path, wall: &Wall) -> anyhow::Result<Wall> {
    let mut projectors = wall.projectors().to_vec();
    let name = |run: u32, index: usize| path.with_extension(format!("mesh-{run}-{}.pfm", index + 1));
    let is_unused = |run: &u32| !(0..projectors.len()).any(|index| name(*run, index).exists());
    let run = (1..=MOST_ASIDE).find(is_unused);
    let run = run.with_context(|| format!("{}: too many mesh files beside it: remove some", path.display()))?;
    for (index, projector) in projectors.iter_mut().enumerate() {
        let Some(mesh) = projector.mesh.clone().filter(|mesh| mesh.file().is_empty()) else { continue };
        let (file, bytes) = (name(run, index), mesh.to_pfm(wall.canvas_m()));
        files::write(&file, |out| out.write_all(&bytes))
            .map_err(|error| anyhow::anyhow!("{}: the mesh cannot be saved: {error}", file.display()))?;
        let file = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        *projector = projector.clone().with_mesh(Arc::new(Mesh::from_pfm(file, &bytes, wall.canvas_m())?));
    }
    Ok(wall.with_projectors(projectors)?)
}

/// Writes the corners, the names of meshes and the light of all projectors of `wall` to its file. On an error, for example
/// in a file that has changed to another wall or has no place for the corners, the file stays as it was.
pub(crate) fn save_projectors(path: &Path, wall: &Wall) -> anyhow::Result<()> {
    let text = text_with_projectors(path, wall)?;
    files::write(path, |out| out.write_all(text.as_bytes()))
        .map_err(|error| anyhow::anyhow!("{}: the corners cannot be saved: {error}", path.display()))
}

/// Writes `wall` to a new file beside its file, or into the current folder, and returns the new file.
pub(crate) fn save_aside(path: Option<&Path>, wall: &Wall) -> anyhow::Result<PathBuf> {
    // A file that has no place for the corners any more is written anew.
    let text = path.and_then(|path| text_with_projectors(path, wall).ok()).unwrap_or_else(|| wall.to_toml());
    let file = unused_beside(path.unwrap_or(Path::new("wall.toml")), "corners")?;
    files::write(&file, |out| out.write_all(text.as_bytes()))
        .map_err(|error| anyhow::anyhow!("{}: the corners cannot be saved: {error}", file.display()))?;
    Ok(file)
}

/// Copies a wall file to a new file beside it, and returns that file.
pub(crate) fn keep_old(path: &Path) -> anyhow::Result<PathBuf> {
    let text = read_text(path).map_err(|cause| WallError::Unreadable { path: path.display().to_string(), cause })?;
    let file = unused_beside(path, "old")?;
    files::write(&file, |out| out.write_all(text.as_bytes())).map_err(|error| {
        anyhow::anyhow!(
            "{}: the old file cannot be kept: {error}: make its folder writable, or calibrate a copy of the wall file",
            file.display()
        )
    })?;
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

/// The text of the wall's file with the corners, meshes and light of all projectors of `wall`.
fn text_with_projectors(path: &Path, wall: &Wall) -> anyhow::Result<String> {
    let unreadable = |cause| WallError::Unreadable { path: path.display().to_string(), cause };
    let old_text = read_text(path).map_err(unreadable)?;
    let old = Wall::from_toml(&path.display().to_string(), &old_text)?;
    let mut text = old_text;
    for (projector, old_projector) in wall.projectors().iter().zip(old.projectors()) {
        if projector.warp_px != old_projector.warp_px {
            text = with_key(&text, &projector.name, "warp_px", &format!("{:?}", projector.warp_px));
        }
        let mesh = projector.mesh.as_ref().filter(|_| projector.mesh != old_projector.mesh);
        if let Some(mesh) = mesh {
            let file = toml::Value::String(mesh.file().to_owned()).to_string();
            text = with_key(&text, &projector.name, "mesh", &file);
        }
        for (key, value) in
            light(projector).into_iter().zip(light(old_projector)).filter(|(new, old)| new != old).map(|it| it.0)
        {
            text = with_key(&text, &projector.name, key, &value);
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

/// The keys and values of a projector's light.
fn light(Projector { gamma, black_level, gain, fall_off, .. }: &Projector) -> Vec<(&'static str, String)> {
    let gamma = match gamma {
        Gamma::Srgb => "\"srgb\"".to_owned(),
        Gamma::Power(exponent) => format!("{exponent:?}"),
    };
    let rows = fall_off.clone().map(<Vec<Vec<f64>>>::from).unwrap_or_default();
    let rows: String = rows.iter().map(|row| format!("    {row:?},\n")).collect();
    vec![
        ("fall_off", format!("[\n{rows}]")),
        ("gain", format!("{gain:?}")),
        ("black_level", format!("{black_level:?}")),
        ("gamma", gamma),
    ]
}

/// The text of a wall file with a new value of one projector's key.
fn with_key(text: &str, name: &str, key: &str, value: &str) -> String {
    let names = toml::from_str::<Names>(text).map(|names| names.projector).unwrap_or_default();
    let named = names.iter().find(|named| named.name.get_ref() == name);
    let old = named.and_then(|named| named.value(key));
    match (named, old) {
        (_, Some(old)) => format!("{}{value}{}", &text[..old.span().start], &text[old.span().end..]),
        (Some(Named { name, .. }), None) => {
            let line_end = text[name.span().end..].find('\n').map_or(text.len(), |length| name.span().end + length);
            let (before, after) = text.split_at(line_end);
            format!("{before}\n{key} = {value}{after}")
        }
        (None, _) => {
            let name = toml::Value::String(name.to_owned());
            format!("{}\n\n[[projector]]\nname = {name}\n{key} = {value}\n", text.trim_end())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wall::FallOff;

    #[test]
    fn light_goes_into_tables_that_are_there_and_new_ones_and_the_rest_stays() {
        let text = "# Ours.\ncanvas_m = [2.0, 1.0]\n[optics]\ngamma = 2.2 # all\n[grid]\ncolumns = 2\nrows = 1\n\
                    pixels = [64, 48]\noverlap = [0.2, 0.0]\n[[projector]]\nname = \"row 1 column 2\"\n\
                    gain = [1.0, 0.9, 1.0] # an old lamp\n";
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("ours.toml");
        std::fs::write(&path, text).expect("written");
        let wall = Wall::load(&path).expect("a wall");
        let mut projectors = wall.projectors().to_vec();
        let fall_off = FallOff::new(std::array::from_fn(|row| [0.9, 1.0, 0.95, 0.9, 0.8 - 0.01 * row as f64]));
        projectors[0].fall_off = Some(fall_off.expect("parts"));
        projectors[0].black_level = 0.003;
        projectors[1].gamma = Gamma::Srgb;
        projectors[1].gain = [0.8, 0.75, 1.0];
        let lit = wall.with_projectors(projectors).expect("a wall");
        save_projectors(&path, &lit).expect("saved");
        assert_eq!(Wall::load(&path).expect("a wall").projectors(), lit.projectors());
        let written = std::fs::read_to_string(&path).expect("text");
        assert!(written.starts_with("# Ours.\n") && written.contains("gamma = 2.2 # all"), "{written}");
        assert!(written.contains("gain = [0.8, 0.75, 1.0] # an old lamp"), "{written}");
    }
}
