//! Numbered views of a model, and the file that keeps them.

use std::{
    collections::BTreeMap,
    fmt::{Display, Write},
    ops::RangeInclusive,
    str::FromStr,
};

use glam::DVec3;
use serde::{Deserialize, Deserializer, de::Error};
use toml::Spanned;

use super::{Camera, CameraError, CameraFileError, UpAxis};
use crate::{
    appearance::{Clip, Light},
    path_light::PathLight,
    protocol::LightingMode,
};

/// Numbered views of a model, and its up axis.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Views {
    /// The axis that points up, if it was chosen.
    pub up: Option<UpAxis>,
    views: BTreeMap<u8, View>,
}

/// A kept view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// The camera.
    pub camera: Camera,
    /// The axis that pointed up; `None` in files of a camera alone.
    pub up: Option<UpAxis>,
    /// How the model looked; `None` in files of a camera alone.
    pub look: Option<Look>,
}

/// The parts of a picture's look that belong to a view.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Look {
    /// The key light's direction.
    pub light: Light,
    /// The clip plane, if any.
    pub clip: Option<Clip>,
    /// The rays that light the picture, if they were chosen.
    pub rays: Option<LightingMode>,
    /// More of the light of paths; `None` in files of earlier walls.
    pub path: Option<PathLight>,
}

impl Views {
    /// The numbers of views: the digit keys.
    pub const NUMBERS: RangeInclusive<u8> = 1..=9;

    /// The view with a number.
    pub fn get(&self, number: u8) -> Option<View> {
        self.views.get(&number).copied()
    }

    /// Keeps a view under a number and replaces the one that had it; ignored if the number is not in [`Views::NUMBERS`].
    pub fn keep(&mut self, number: u8, view: View) {
        if Self::NUMBERS.contains(&number) {
            self.views.insert(number, view);
        }
    }

    /// The numbers in use.
    pub fn numbers(&self) -> impl Iterator<Item = u8> {
        self.views.keys().copied()
    }

    /// Reads the text of a file of views; see [`Views::to_toml`].
    pub fn from_toml(text: &str) -> Result<Self, CameraFileError> {
        let at = |offset, problem: &str| {
            let format = "a file of views has up = \"y\" or another axis, and tables [view.1] to [view.9], each with \
                          eye, ll, u and v, each = [x, y, z], and perhaps up, light, clip, rays and path";
            CameraFileError::at(text, offset, problem, format)
        };
        let file: ViewsFile =
            toml::from_str(text).map_err(|error| at(error.span().map_or(0, |span| span.start), error.message()))?;
        let mut views = Self { up: file.up, views: BTreeMap::new() };
        for (name, view) in file.view {
            let start = view.span().start;
            let number = name.parse().ok().filter(|number| Self::NUMBERS.contains(number));
            let number = number.ok_or_else(|| at(start, &format!("\"{name}\" is no number from 1 to 9")))?;
            views.keep(number, view.into_inner().view().map_err(|error| at(start, &error.to_string()))?);
        }
        Ok(views)
    }

    /// Writes a file of views: `up`, and for each a table `view.N` with the camera's `eye`, `ll`, `u` and `v`, exact to
    /// the last bit, and with its own `up`, `light`, `clip` and `rays`, in the words of the options, and `path`: sun, bounces and
    /// exposure.
    pub fn to_toml(&self) -> String {
        let mut text = "# Views of a model: on the wall, keys 1 to 9 go to them.\n".to_owned();
        // Writing to a string cannot fail.
        if let Some(up) = self.up {
            let _ = writeln!(text, "up = \"{up}\"");
        }
        for (number, view) in &self.views {
            let _ = write!(text, "\n[view.{number}]\n{}", view.to_toml());
        }
        text
    }
}

impl View {
    /// The lines of a view in a file, which [`ViewTable`] reads.
    pub(crate) fn to_toml(self) -> String {
        let Self { camera, up, look } = self;
        let mut text = camera.to_toml();
        // Writing to a string cannot fail.
        let mut add = |name: &str, value: Option<&dyn Display>| {
            value.into_iter().for_each(|value| _ = writeln!(text, "{name} = \"{value}\""));
        };
        add("up", up.as_ref().map(|up| up as _));
        if let Some(Look { light, clip, rays, path }) = look {
            add("light", Some(&light));
            add("clip", clip.as_ref().map(|clip| clip as _));
            add("rays", rays.as_ref().map(|rays| rays as _));
            add("path", path.as_ref().map(|path| path as _));
        }
        text
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ViewsFile {
    up: Option<UpAxis>,
    #[serde(default)]
    view: BTreeMap<String, Spanned<ViewTable>>,
}

/// A view in a file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ViewTable {
    eye: DVec3,
    ll: DVec3,
    u: DVec3,
    v: DVec3,
    up: Option<UpAxis>,
    #[serde(default, deserialize_with = "from_text")]
    light: Option<Light>,
    #[serde(default, deserialize_with = "from_text")]
    clip: Option<Clip>,
    rays: Option<LightingMode>,
    #[serde(default, deserialize_with = "from_text")]
    path: Option<PathLight>,
}

impl ViewTable {
    pub(crate) fn view(self) -> Result<View, CameraError> {
        let Self { eye, ll, u, v, up, light, clip, rays, path } = self;
        let has_look = light.is_some() || clip.is_some() || rays.is_some() || path.is_some();
        let look = has_look.then(|| Look { light: light.unwrap_or_default(), clip, rays, path });
        Ok(View { camera: Camera::new(eye, ll, u, v)?, up, look })
    }
}

fn from_text<'de, T: FromStr<Err: Display>, D: Deserializer<'de>>(input: D) -> Result<Option<T>, D::Error> {
    String::deserialize(input)?.parse().map(Some).map_err(D::Error::custom)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use strum::VariantArray;

    use super::{super::pose::tests::any_camera, *};
    use crate::appearance::ClipSide;

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
        let dim = told(&format!("[view.1]\n{view}light = \"200,0\""));
        assert!(dim.starts_with("line 6:") && dim.contains("from -180 to 180"), "{dim}");
    }

    #[test]
    fn a_camera_alone_is_a_view() {
        let views =
            Views::from_toml("[view.1]\neye = [0, 0, 1]\nll = [0, 0, 0]\nu = [1, 0, 0]\nv = [0, 1, 0]").unwrap();
        let View { up, look, .. } = views.get(1).unwrap();
        assert_eq!((up, look), (None, None));
    }

    proptest! {
        #[test]
        fn a_file_keeps_every_bit(
            cameras in proptest::collection::btree_map(0..12u8, any_camera(), 0..9),
            look in proptest::option::of((-180..=180i16, -90..=90i16, proptest::option::of(0..=1000u16), 0..4usize, -100..=101i16)),
            up in proptest::option::of(0..UpAxis::VARIANTS.len()),
        ) {
            let mut views = Views { up: up.map(|up| UpAxis::VARIANTS[up]), ..Views::default() };
            let look = look.map(|(azimuth, elevation, cut, rays, exposure)| Look {
                light: Light::new(azimuth, elevation).unwrap(),
                clip: cut.map(|cut| Clip::new(ClipSide::VARIANTS[usize::from(cut) % ClipSide::VARIANTS.len()], cut).unwrap()),
                rays: LightingMode::VARIANTS.get(rays).copied(),
                path: PathLight::new(5, 3, exposure).ok(),
            });
            cameras.iter().for_each(|(&number, &camera)| views.keep(number, View { camera, up: views.up, look }));
            prop_assert!(views.numbers().all(|number| Views::NUMBERS.contains(&number)));
            prop_assert_eq!(Views::from_toml(&views.to_toml()).unwrap(), views);
        }
    }
}
