//! Annotations in documents of Smithsonian Voyager (SVX), a JSON format. Pure.
//!
//! The format is that of the schemas in its repository, `document.schema.json` and `model.schema.json`: a document lists models,
//! and each has annotations with a title, a lead, a position and a direction, in the coordinates of the model's file.

use glam::DVec3;
use serde::Deserialize;
use serde_json::{Value, json};
use shared::{
    marks::{Annotation, Marks, Unit},
    printable::{counted, printable_line},
};

/// The type that every document names.
const TYPE: &str = "application/si-dpo-3d.document+json";

/// Annotations that were read from a document.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Imported {
    pub annotations: Vec<Annotation>,
    /// The unit of the model, if the document names one that is known.
    pub unit: Option<Unit>,
    /// Those that are left out, each with the reason; a line each.
    pub left_out: Vec<String>,
}

/// Reads the annotations of the document's model whose file is called `model`, or of its only model with annotations.
///
/// # Errors
/// One line: it is no document, or no model fits.
pub(crate) fn read(text: &str, model: &str) -> Result<Imported, String> {
    let no_document = |fault: String| format!("no Voyager document (SVX): {fault}");
    let document: Document = serde_json::from_str(text).map_err(|error| no_document(error.to_string()))?;
    if document.asset.kind != TYPE {
        return Err(no_document(format!("asset.type is not {TYPE}")));
    }
    let mut annotated: Vec<_> = document.models.into_iter().filter(|model| !model.annotations.is_empty()).collect();
    if annotated.len() > 1 {
        annotated.retain(|it| it.files().any(|uri| uri.rsplit('/').next() == Some(model)));
    }
    match <[Model; 1]>::try_from(annotated) {
        Ok([model]) => Ok(model.read()),
        Err(none) if none.is_empty() => Err(format!("it has no annotations of {model}")),
        Err(several) => Err(format!("{} of it have annotations of {model}", counted(several.len(), "model"))),
    }
}

/// The document of a model with these marks; `model` is the name of its file.
pub(crate) fn write(marks: &Marks, model: &str) -> String {
    let annotation = |(annotation, number): (&Annotation, u32)| {
        let mut object = json!({
            "id": format!("annotation-{number}"),
            "titles": { "EN": annotation.label() },
            "leads": { "EN": annotation.text() },
            "position": annotation.at().to_array(),
        });
        if let Some(direction) = annotation.direction() {
            object["direction"] = json!(direction.to_array());
        }
        object
    };
    // Voyager has no unit of a model's own.
    let unit = marks.unit.map_or_else(|| Unit::Metre.to_string(), |unit| unit.to_string());
    let document = json!({
        "asset": { "type": TYPE, "version": "1.0", "generator": "Raywall" },
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "model": 0 }],
        "models": [{
            "units": unit,
            "derivatives": [{
                "usage": "Web3D", "quality": "High", "assets": [{ "uri": model, "type": "Model" }]
            }],
            "annotations": marks.annotations.iter().zip(1..).map(annotation).collect::<Vec<_>>(),
        }],
    });
    format!("{document:#}\n")
}

#[derive(Deserialize)]
struct Document {
    asset: Asset,
    #[serde(default)]
    models: Vec<Model>,
}

#[derive(Deserialize)]
struct Asset {
    #[serde(rename = "type")]
    kind: String,
}

#[derive(Deserialize)]
struct Model {
    #[serde(default)]
    units: String,
    #[serde(default)]
    derivatives: Vec<Value>,
    #[serde(default)]
    annotations: Vec<Value>,
}

/// An annotation; other members are of no use here.
#[derive(Deserialize)]
struct Table {
    #[serde(default)]
    title: String,
    #[serde(default)]
    titles: Value,
    #[serde(default)]
    lead: String,
    #[serde(default)]
    leads: Value,
    position: DVec3,
    direction: Option<DVec3>,
}

impl Model {
    /// The files of its derivatives.
    fn files(&self) -> impl Iterator<Item = &str> {
        let assets = self.derivatives.iter().filter_map(|derivative| derivative["assets"].as_array()).flatten();
        assets.filter_map(|asset| asset["uri"].as_str())
    }

    fn read(self) -> Imported {
        let (mut annotations, mut left_out) = (Vec::new(), Vec::new());
        for value in self.annotations {
            let id = value["id"].as_str().unwrap_or("without id").to_owned();
            match annotation(value) {
                Ok(annotation) => annotations.push(annotation),
                Err(fault) => left_out.push(printable_line(&format!("annotation {id} is left out: {fault}"))),
            }
        }
        Imported { annotations, unit: self.units.parse().ok(), left_out }
    }
}

fn annotation(value: Value) -> Result<Annotation, String> {
    let table: Table = serde_json::from_value(value).map_err(|error| error.to_string())?;
    let [label, text] =
        [(&table.titles, &table.title), (&table.leads, &table.lead)].map(|(all, one)| in_language(all, one));
    let label = shortened(label, Annotation::LONGEST_LABEL);
    let text = shortened(text, Annotation::LONGEST_TEXT);
    // Some tools write a direction of zeros.
    let direction = table.direction.filter(|direction| direction.try_normalize().is_some());
    Annotation::new(&label, &text, table.position, direction, None).map_err(|error| error.to_string())
}

/// A text in English, or else in the first language that it has, or without one.
fn in_language<'a>(all: &'a Value, one: &'a str) -> &'a str {
    let first = || all.as_object().and_then(|all| all.values().find_map(Value::as_str));
    all["EN"].as_str().or_else(first).unwrap_or(one)
}

fn shortened(text: &str, longest: usize) -> String {
    let text = printable_line(text);
    match text.char_indices().nth(longest) {
        Some(_) => text.chars().take(longest - 1).chain(['…']).collect(),
        None => text,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn document(models: &Value) -> String {
        json!({ "asset": { "type": TYPE }, "models": models }).to_string()
    }

    #[test]
    fn the_model_of_the_file_is_found_among_several() {
        let model = |uri: &str, title: &str| {
            json!({ "units": "yd", "derivatives": [{ "assets": [{ "uri": uri }] }],
                "annotations": [{ "title": title, "position": [0, 0, 0], "direction": [0, 0, 0] }] })
        };
        let two = document(&json!([model("web/a.glb", "a"), model("b.glb", "b")]));
        let read_of = |name| read(&two, name).map(|it| it.annotations[0].label().to_owned());
        assert_eq!([read_of("a.glb"), read_of("b.glb")], [Ok("a".to_owned()), Ok("b".to_owned())]);
        assert!(read_of("c.glb").unwrap_err().contains("no annotations of c.glb"));
        let one = read(&document(&json!([model("a.glb", "a")])), "c.ply").unwrap();
        assert_eq!((one.unit, one.annotations[0].direction(), one.left_out.len()), (None, None, 0));
    }

    #[test]
    fn what_is_no_annotation_is_left_out_with_its_reason() {
        let models = json!([{ "annotations": [
            { "id": "x\n", "title": "t", "position": [1, 2] }, { "title": "", "position": [0, 0, 0] }, 7 ] }]);
        let read = read(&document(&models), "a.ply").unwrap();
        assert!(read.annotations.is_empty() && read.left_out.len() == 3, "{read:?}");
        assert!(read.left_out.iter().all(|line| !line.contains('\n')) && read.left_out[1].contains("label"));
    }
}
