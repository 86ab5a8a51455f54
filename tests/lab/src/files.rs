//! Results as text and files: CSV, aligned tables, and atomic writes whose errors name the file.

use std::path::Path;

use anyhow::{Context, Result};
use channel::files;
use serde::Serialize;

/// One line for each row, after a line with the names of its fields; empty without rows.
pub(crate) fn csv<T: Serialize>(rows: &[T]) -> Result<String> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    Ok(String::from_utf8(writer.into_inner()?)?)
}

/// The rows as aligned columns under the names of their fields, numbers with four significant digits.
pub(crate) fn table<T: Serialize>(rows: &[T]) -> Result<String> {
    let csv = csv(rows)?;
    let cell = |text: &str| match text.parse::<f64>() {
        Ok(x) if text.contains('.') && (x == 0.0 || (1e-3..1e6).contains(&x)) => {
            let n_decimals = if x == 0.0 { 0 } else { (3 - x.log10().floor() as i32).max(0) };
            format!("{x:.*}", n_decimals as usize)
        }
        Ok(x) if text.contains(['.', 'e']) => format!("{x:.1e}"),
        _ => text.to_owned(),
    };
    let mut reader = csv::ReaderBuilder::new().has_headers(false).from_reader(csv.as_bytes());
    let lines: Vec<Vec<String>> =
        reader.records().map(|record| Ok(record?.iter().map(cell).collect())).collect::<Result<_>>()?;
    let width = |column: usize| lines.iter().map(|line| line[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..lines.first().map_or(0, Vec::len)).map(width).collect();
    let aligned = |line: &Vec<String>| {
        let cells = line.iter().zip(&widths).map(|(cell, &width)| format!("{cell:>width$}"));
        cells.collect::<Vec<_>>().join("  ")
    };
    Ok(lines.iter().map(aligned).collect::<Vec<_>>().join("\n"))
}

/// Writes NAME in a folder; a reader sees the old file or the new one.
pub(crate) fn write(folder: &Path, name: &str, content: &[u8]) -> Result<()> {
    let path = folder.join(name);
    files::write(&path, |out| out.write_all(content)).with_context(|| format!("cannot write {}", path.display()))
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
        let rows = [Row { name: "tiled", ms: 1234.56 }, Row { name: "dynamic", ms: 1.5e-9 }];
        assert_eq!(table(&rows).unwrap(), "   name      ms\n  tiled    1235\ndynamic  1.5e-9");
        assert_eq!(table::<Row>(&[]).unwrap(), "");
    }
}
