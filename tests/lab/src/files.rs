//! Results as files: CSV, and atomic writes whose errors name the file.

use std::path::Path;

use anyhow::{Context, Result};
use renderer::render::image::write_atomically;
use serde::Serialize;

/// One line for each row, after a line with the names of its fields; empty without rows.
pub fn csv<T: Serialize>(rows: &[T]) -> Result<String> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    Ok(String::from_utf8(writer.into_inner()?)?)
}

/// Writes NAME in a folder; a reader sees the old file or the new one.
pub fn write(folder: &Path, name: &str, content: &[u8]) -> Result<()> {
    let path = folder.join(name);
    write_atomically(&path, |out| out.write_all(content)).with_context(|| format!("cannot write {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Serialize)]
    struct Row {
        name: &'static str,
        ms: f64,
    }

    #[test]
    fn rows_become_lines_under_their_names() {
        assert_eq!(csv(&[Row { name: "tiled", ms: 1.5 }]).unwrap(), "name,ms\ntiled,1.5\n");
        assert_eq!(csv::<Row>(&[]).unwrap(), "");
    }
}
