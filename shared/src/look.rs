//! What a picture looks like beside what it shows: from where it is lit, and what is behind the model.
//!
//! All of it is whole numbers within bounds, so that every machine makes the same bits of it and none is NaN.

use std::{fmt, str::FromStr};

use glam::DVec3;
use serde::{Deserialize, Serialize};

/// The look of a picture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Look {
    /// From where the key light comes.
    pub light: Light,
    /// What is behind the model.
    pub background: Background,
}

/// From where the key light comes, as seen from what is looked at, with the eye straight in front.
///
/// Invariant, on the wire too: the azimuth is in −180..=180 and the elevation in −90..=90.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "(i16, i16)", into = "(i16, i16)")]
pub struct Light {
    azimuth_deg: i16,
    elevation_deg: i16,
}

/// Why angles or a text are no light.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "a light comes from AZIMUTH,ELEVATION in whole degrees as in -35,36: from -180 to 180 to the right of the eye, \
     and from -90 to 90 above it"
)]
pub struct LightError;

impl Light {
    /// Lights to choose from, with what they are called; the first is the default.
    pub const PRESETS: [(&str, Self); 6] = [
        ("left shoulder", Self { azimuth_deg: -35, elevation_deg: 36 }),
        ("eye", Self { azimuth_deg: 0, elevation_deg: 0 }),
        ("right shoulder", Self { azimuth_deg: 35, elevation_deg: 36 }),
        ("above", Self { azimuth_deg: 0, elevation_deg: 80 }),
        ("grazing", Self { azimuth_deg: -80, elevation_deg: 12 }),
        ("behind", Self { azimuth_deg: 150, elevation_deg: 40 }),
    ];

    /// Takes degrees: to the right of the eye, and above it.
    pub fn new(azimuth_deg: i16, elevation_deg: i16) -> Result<Self, LightError> {
        let is_valid = (-180..=180).contains(&azimuth_deg) && (-90..=90).contains(&elevation_deg);
        if is_valid { Ok(Self { azimuth_deg, elevation_deg }) } else { Err(LightError) }
    }

    /// Degrees to the right of the eye, −180 to 180.
    pub fn azimuth_deg(self) -> i16 {
        self.azimuth_deg
    }

    /// Degrees above the eye, −90 to 90.
    pub fn elevation_deg(self) -> i16 {
        self.elevation_deg
    }

    /// Whether it comes from the eye's side of what is looked at, and not from beside it or beyond.
    pub fn is_on_eye_side(self) -> bool {
        self.azimuth_deg.abs() < 90 && self.elevation_deg.abs() < 90
    }

    /// The direction towards the light, of unit length: to the right, up, and towards the eye.
    pub fn direction(self) -> DVec3 {
        let ([cos_azimuth, sin_azimuth], [cos_elevation, sin_elevation]) =
            (unit_circle(self.azimuth_deg), unit_circle(self.elevation_deg));
        DVec3::new(cos_elevation * sin_azimuth, sin_elevation, cos_elevation * cos_azimuth)
    }
}

/// Cosine and sine of an angle in degrees, by turning again and again by one degree: `sin_cos` differs between platforms,
/// + − × do not. At most 180 roundings, so right to 13 digits.
fn unit_circle(degrees: i16) -> [f64; 2] {
    const COS_1: f64 = 0.999_847_695_156_391_2;
    const SIN_1: f64 = 0.017_452_406_437_283_51;
    let sin_step = if degrees < 0 { -SIN_1 } else { SIN_1 };
    (0..degrees.unsigned_abs())
        .fold([1.0, 0.0], |[cos, sin], _| [cos * COS_1 - sin * sin_step, cos * sin_step + sin * COS_1])
}

impl Default for Light {
    /// Above the eye's left shoulder.
    fn default() -> Self {
        Self::PRESETS[0].1
    }
}

impl TryFrom<(i16, i16)> for Light {
    type Error = LightError;

    fn try_from((azimuth_deg, elevation_deg): (i16, i16)) -> Result<Self, LightError> {
        Self::new(azimuth_deg, elevation_deg)
    }
}

impl From<Light> for (i16, i16) {
    fn from(Light { azimuth_deg, elevation_deg }: Light) -> Self {
        (azimuth_deg, elevation_deg)
    }
}

impl fmt::Display for Light {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{},{}", self.azimuth_deg, self.elevation_deg)
    }
}

impl FromStr for Light {
    type Err = LightError;

    fn from_str(text: &str) -> Result<Self, LightError> {
        let (azimuth, elevation) = text.split_once(',').ok_or(LightError)?;
        let degrees = |text: &str| text.trim().parse().map_err(|_| LightError);
        Self::new(degrees(azimuth)?, degrees(elevation)?)
    }
}

/// What is behind the model: one colour at the bottom of the picture, one at its top, and linear light between them.
///
/// Colours are red, green and blue, sRGB-encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Background {
    /// At the bottom.
    pub bottom: [u8; 3],
    /// At the top.
    pub top: [u8; 3],
}

/// Why a text is no background.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("a background is one colour as in 000000, red, green and blue, or two as in 424449,1b1f28: bottom and top")]
pub struct BackgroundError;

impl Background {
    /// Backgrounds to choose from, with what they are called; the first is the default.
    pub const PRESETS: [(&str, Self); 5] = [
        ("dusk", Self { bottom: [66, 68, 73], top: [27, 31, 40] }),
        ("black", Self::plain([0; 3])),
        ("grey", Self::plain([119; 3])),
        ("white", Self::plain([255; 3])),
        ("sky", Self { bottom: [214, 220, 224], top: [92, 134, 178] }),
    ];

    /// One colour everywhere.
    pub const fn plain(color: [u8; 3]) -> Self {
        Self { bottom: color, top: color }
    }
}

impl Default for Background {
    /// Dark, and darker towards the top.
    fn default() -> Self {
        Self::PRESETS[0].1
    }
}

impl fmt::Display for Background {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let color = |f: &mut fmt::Formatter<'_>, [r, g, b]: [u8; 3]| write!(f, "{r:02x}{g:02x}{b:02x}");
        color(f, self.bottom)?;
        if self.top == self.bottom {
            return Ok(());
        }
        f.write_str(",")?;
        color(f, self.top)
    }
}

impl FromStr for Background {
    type Err = BackgroundError;

    fn from_str(text: &str) -> Result<Self, BackgroundError> {
        let color = |text: &str| {
            let text = text.trim().trim_start_matches('#');
            let number = u32::from_str_radix(text, 16).map_err(|_| BackgroundError)?;
            let is_color = text.len() == 6 && !text.starts_with('+');
            let [_, r, g, b] = number.to_be_bytes();
            if is_color { Ok([r, g, b]) } else { Err(BackgroundError) }
        };
        match text.split_once(',') {
            Some((bottom, top)) => Ok(Self { bottom: color(bottom)?, top: color(top)? }),
            None => color(text).map(Self::plain),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lights_come_from_where_their_angles_say() {
        for (azimuth, elevation) in (-180..=180).step_by(7).flat_map(|a| (-90..=90).step_by(9).map(move |e| (a, e))) {
            let light = Light::new(azimuth, elevation).unwrap();
            let (azimuth, elevation) = (f64::from(azimuth).to_radians(), f64::from(elevation).to_radians());
            let expected =
                DVec3::new(elevation.cos() * azimuth.sin(), elevation.sin(), elevation.cos() * azimuth.cos());
            assert!((light.direction() - expected).length() < 1e-13, "{light}");
            assert_eq!(light.is_on_eye_side(), expected.z > 1e-9, "{light}");
        }
    }

    #[test]
    fn angles_beyond_the_circle_are_no_light() {
        for angles in [(181, 0), (-181, 0), (0, 91), (0, -91), (i16::MIN, i16::MAX)] {
            assert!(Light::try_from(angles).is_err(), "{angles:?}");
        }
        for text in ["", "12", "1,2,3", "a,b", "NaN,0", "1.5,2", "0,99999"] {
            assert!(text.parse::<Light>().is_err(), "{text}");
        }
    }

    #[test]
    fn colours_that_are_none_are_refused() {
        for text in ["", "red", "12345", "1234567", "+12345", "000000,", "000000,000000,000000", "ÿÿÿ"] {
            assert!(text.parse::<Background>().is_err(), "{text}");
        }
        assert_eq!("#0a0b0c".parse(), Ok(Background::plain([10, 11, 12])));
    }

    #[test]
    fn what_is_written_is_read() {
        for (_, light) in Light::PRESETS {
            assert_eq!(light.to_string().parse(), Ok(light));
        }
        for (_, background) in Background::PRESETS {
            assert_eq!(background.to_string().parse(), Ok(background));
        }
    }
}
