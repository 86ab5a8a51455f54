//! The unit of a model's coordinates.

use serde::Deserialize;
use strum::{Display, EnumString, VariantArray};

use crate::names::unknown_name;

/// A unit of length; without one, a model's coordinates are in a unit of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Display, EnumString, VariantArray)]
#[strum(parse_err_ty = String, parse_err_fn = unknown_name::<Self>)]
#[expect(missing_docs, reason = "the names say it")]
pub enum Unit {
    #[serde(rename = "mm")]
    #[strum(serialize = "mm")]
    Millimetre,
    #[serde(rename = "cm")]
    #[strum(serialize = "cm")]
    Centimetre,
    #[serde(rename = "m")]
    #[strum(serialize = "m")]
    Metre,
    #[serde(rename = "km")]
    #[strum(serialize = "km")]
    Kilometre,
    #[serde(rename = "in")]
    #[strum(serialize = "in")]
    Inch,
    #[serde(rename = "ft")]
    #[strum(serialize = "ft")]
    Foot,
}
