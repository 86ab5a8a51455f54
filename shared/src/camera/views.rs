//! Numbered views of a model, and the file that keeps them.

use std::{collections::BTreeMap, fmt::Write, ops::RangeInclusive};

use serde::Deserialize;
use toml::Spanned;

use super::{Camera, CameraError, CameraFileError, CameraVectors, UpAxis};

/// Numbered views of a model, and its up axis.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Views {
    /// The axis that points up, if it was chosen.
    pub up: Option<UpAxis>,
    views: BTreeMap<u8, Camera>,
}

impl Views {
    /// The numbers of views: the digit keys.
    pub const NUMBERS: RangeInclusive<u8> = 1..=9;

    /// The view with a number.
    pub fn get(&self, number: u8) -> Option<Camera> {
        self.views.get(&number).copied()
    }

    /// Keeps a view under a number and replaces the one that had it; ignored if the number is not in [`Views::NUMBERS`].
    pub fn keep(&mut self, number: u8, camera: Camera) {
        if Self::NUMBERS.contains(&number) {
            self.views.insert(number, camera);
        }
    }

    /// The numbers in use.
    pub fn numbers(&self) -> impl Iterator<Item = u8> {
        self.views.keys().copied()
    }

    /// Reads the text of a file of views; see [`Views::to_toml`].
    pub fn from_toml(text: &str) -> Result<Self, CameraFileError> {
        let at = |offset, problem: &str| {
            let format = "a file of views has up = \"x\", \"y\" or \"z\", and tables [view.1] to [view.9], each with \
                          eye, ll, u and v, each = [x, y, z]";
            CameraFileError::at(text, offset, problem, format)
        };
        let file: ViewsFile =
            toml::from_str(text).map_err(|error| at(error.span().map_or(0, |span| span.start), error.message()))?;
        let mut views = Self { up: file.up, views: BTreeMap::new() };
        for (name, view) in file.view {
            let start = view.span().start;
            let number = name.parse().ok().filter(|number| Self::NUMBERS.contains(number));
            let number = number.ok_or_else(|| at(start, &format!("\"{name}\" is no number from 1 to 9")))?;
            views.keep(
                number,
                view.into_inner().try_into().map_err(|error: CameraError| at(start, &error.to_string()))?,
            );
        }
        Ok(views)
    }

    /// Writes a file of views: `up`, and for each a table `view.N` with the camera's `eye`, `ll`, `u` and `v`, exact to
    /// the last bit.
    pub fn to_toml(&self) -> String {
        let mut text = "# Views of a model: on the wall, keys 1 to 9 go to them.\n".to_owned();
        // Writing to a string cannot fail.
        if let Some(up) = self.up {
            let _ = writeln!(text, "up = \"{up}\"");
        }
        for (number, camera) in &self.views {
            let _ = write!(text, "\n[view.{number}]\n{}", camera.to_toml());
        }
        text
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ViewsFile {
    up: Option<UpAxis>,
    #[serde(default)]
    view: BTreeMap<String, Spanned<CameraVectors>>,
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use strum::VariantArray;

    use super::{super::pose::tests::any_camera, *};

    #[test]
    fn a_wrong_file_says_where_and_what_would_be_right() {
        let told = |text: &str| Views::from_toml(text).unwrap_err().to_string();
        let view = "eye = [0, 0, 1]\nll = [0, 0, 0]\nu = [1, 0, 0]\nv = [0, 1, 0]\n";
        assert!(Views::from_toml(&format!("[view.3]\n{view}")).unwrap().get(3).is_some());
        let tenth = told(&format!("up = \"z\"\n[view.10]\n{view}"));
        assert!(tenth.contains("\"10\" is no number from 1 to 9") && tenth.contains("[view.1]"), "{tenth}");
        assert!(told(&format!("\n\n[view.1]\n{view}zoom = 3")).starts_with("line 8:"), "an unknown key");
        assert!(told("up = \"w\"").starts_with("line 1:"));
        let flat = told(&format!("[view.1]\n{}", view.replace("v = [0, 1, 0]", "v = [3, 0, 0]")));
        assert!(flat.contains("no area"), "{flat}");
    }

    proptest! {
        #[test]
        fn a_file_keeps_every_bit(
            cameras in proptest::collection::btree_map(0..12u8, any_camera(), 0..9),
            up in proptest::option::of(0..3usize),
        ) {
            let mut views = Views { up: up.map(|up| UpAxis::VARIANTS[up]), ..Views::default() };
            cameras.iter().for_each(|(&number, &camera)| views.keep(number, camera));
            prop_assert!(views.numbers().all(|number| Views::NUMBERS.contains(&number)));
            prop_assert_eq!(Views::from_toml(&views.to_toml()).unwrap(), views);
        }
    }
}
