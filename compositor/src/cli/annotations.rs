//! Exchanges a model's annotations with Smithsonian Voyager, and exports its measurements.

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use channel::files;
use renderer::cli::{cannot_write, say};
use shared::{
    marks::Marks,
    printable::{counted, printable_line},
};

use crate::{
    control::sidecar::{marks_file, read_marks, write_beside},
    svx,
};

/// Longer files are no documents; bytes.
const LONGEST_DOCUMENT: u64 = 1 << 26;

/// Lists the annotations and measurements of a model, reads or writes annotations as Smithsonian Voyager does, and writes
/// measurements as a table
#[derive(Clone, Debug, clap::Args)]
pub struct AnnotationArgs {
    /// The model, beside which they are kept
    pub model: PathBuf,
    /// Add the annotations of a Voyager document (SVX)
    #[arg(long, value_name = "FILE.svx.json")]
    pub import: Option<PathBuf>,
    /// Write a Voyager document (SVX) with all annotations
    #[arg(long, value_name = "FILE.svx.json")]
    pub export: Option<PathBuf>,
    /// Write a table of all measurements
    #[arg(long, value_name = "FILE.csv")]
    pub csv: Option<PathBuf>,
}

/// Imports, exports or lists; on an error nothing is written.
pub fn run(args: &AnnotationArgs) -> anyhow::Result<()> {
    let AnnotationArgs { model, import, export, csv } = args;
    ensure!(model.is_file(), "{}: there is no such model", model.display());
    let file = marks_file(model);
    let (before, mut marks) = read_marks(&file).map_err(anyhow::Error::msg)?;
    let name = model.file_name().unwrap_or_default().to_string_lossy();
    if let Some(document) = import {
        let n_added = add(&mut marks, document, &name)?;
        write_beside(&file, before.as_deref(), &marks.to_toml()).map_err(anyhow::Error::msg)?;
        say(format_args!("{} added to {}", counted(n_added, "annotation"), file.display()))?;
    }
    if let Some(document) = export {
        write(document, &svx::write(&marks, &name))?;
        say(format_args!("wrote {} to {}", counted(marks.annotations.len(), "annotation"), document.display()))?;
    }
    if let Some(table) = csv {
        write(table, &marks.to_csv(marks.unit))?;
        say(format_args!("wrote {} to {}", counted(marks.measurements.len(), "measurement"), table.display()))?;
    }
    if import.is_none() && export.is_none() && csv.is_none() {
        let annotations = marks.annotations.iter().map(|it| format!("{} at {}", it.label(), it.at()));
        let measurements = marks.measurements.iter().map(|it| format!("{}: {}", it.kind(), it.shown(marks.unit)));
        for line in annotations.chain(measurements) {
            say(line)?;
        }
    }
    Ok(())
}

/// Adds the annotations of a document that are not there yet. Returns their number.
fn add(marks: &mut Marks, document: &Path, model: &str) -> anyhow::Result<usize> {
    let text = files::read_text(document, LONGEST_DOCUMENT).with_context(|| document.display().to_string())?;
    let imported = svx::read(&text, model)
        .map_err(|problem| anyhow::anyhow!("{}: {}", document.display(), printable_line(&problem)))?;
    for line in &imported.left_out {
        tracing::warn!("{line}");
    }
    let n_before = marks.annotations.len();
    let is_new = |marks: &Marks, new: &shared::marks::Annotation| {
        !marks.annotations.iter().any(|old| (old.label(), old.at()) == (new.label(), new.at()))
    };
    for annotation in imported.annotations {
        if is_new(marks, &annotation) {
            marks.annotations.push(annotation);
        }
    }
    ensure!(
        marks.annotations.len() <= Marks::MOST,
        "{}: with these the model would have {} annotations, and {} are possible: delete some of them",
        document.display(),
        marks.annotations.len(),
        Marks::MOST
    );
    marks.unit = marks.unit.or(imported.unit);
    Ok(marks.annotations.len() - n_before)
}

fn write(file: &Path, text: &str) -> anyhow::Result<()> {
    files::write(file, |out| out.write_all(text.as_bytes())).map_err(|error| cannot_write(file, &error))
}
