//! The appearance of a frame: key light, background, clip plane, and the light of path-traced pictures.
//!
//! All values are bounded integers: no NaN can occur, and every machine computes the same bits from them.

use std::{fmt, str::FromStr};

use glam::DVec3;
use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, IntoStaticStr, VariantArray};

use crate::{
    camera::{Camera, UpAxis},
    division::FrameSize,
    names::unknown_name,
    path_light::PathLight,
    sky::SkyId,
    srgb,
};

/// The appearance of a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Appearance {
    /// The key light's direction.
    pub light: Light,
    /// The background.
    pub background: Background,
    /// The clip plane, if any.
    pub clip: Option<Clip>,
    /// More of the light, if it is path traced.
    pub path: PathLight,
    /// The image that lights it in place of sun and sky, if there is one.
    pub sky: Option<SkyId>,
    /// The model's axis that points to the top row of the sky image, and away from the ground.
    pub up: UpAxis,
}

/// The direction of the key light, seen from the target, with the eye straight in front.
///
/// Invariant, on the wire too: the azimuth is in −180..=180 and the elevation in −90..=90.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "(i16, i16)")]
pub struct Light {
    azimuth_deg: i16,
    elevation_deg: i16,
}

/// Invalid angles or text.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "a light comes from AZIMUTH,ELEVATION in whole degrees as in -35,36: from -180 to 180 to the right of the eye, \
     and from -90 to 90 above it"
)]
pub struct LightError;

impl Light {
    /// Named lights to choose from; the first is the default.
    pub const PRESETS: [(&str, Self); 6] = [
        ("left shoulder", Self { azimuth_deg: -35, elevation_deg: 36 }),
        ("eye", Self { azimuth_deg: 0, elevation_deg: 0 }),
        ("right shoulder", Self { azimuth_deg: 35, elevation_deg: 36 }),
        ("above", Self { azimuth_deg: 0, elevation_deg: 80 }),
        ("grazing", Self { azimuth_deg: -80, elevation_deg: 12 }),
        ("behind", Self { azimuth_deg: 150, elevation_deg: 40 }),
    ];

    /// A light from degrees to the right of the eye, and above it.
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

    /// Whether it comes from the eye's side of the target.
    pub fn is_on_eye_side(self) -> bool {
        self.azimuth_deg.abs() < 90 && self.elevation_deg.abs() < 90
    }

    /// The unit vector towards the light, with components to the right, up, and towards the eye.
    pub fn direction(self) -> DVec3 {
        let ([cos_azimuth, sin_azimuth], [cos_elevation, sin_elevation]) =
            (unit_circle(self.azimuth_deg), unit_circle(self.elevation_deg));
        DVec3::new(cos_elevation * sin_azimuth, sin_elevation, cos_elevation * cos_azimuth)
    }
}

/// Cosine and sine of an angle in degrees, by repeated rotation by one degree: `sin_cos` differs between platforms, + − ×
/// do not. At most 180 roundings leave 13 correct digits.
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

/// The background: a gradient, linear in light, between two sRGB-encoded colours.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Background {
    /// The picture's bottom: red, green, blue.
    pub bottom: [u8; 3],
    /// The picture's top: red, green, blue.
    pub top: [u8; 3],
}

/// Text that is not a background.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("a background is one colour RRGGBB as in 000000, or two, bottom and top, as in 424449,1b1f28")]
pub struct BackgroundError;

impl Background {
    /// Named backgrounds to choose from; the first is the default.
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

    /// Whether a shaded picture shows nothing else. `samples` come row by row, the bottom row first.
    pub fn fills(self, size: FrameSize, samples: impl IntoIterator<Item = [u8; 3]>) -> bool {
        let color = |height: f32| {
            let light = |channel: usize| [self.bottom, self.top].map(|color| srgb::decode(color[channel]));
            [0, 1, 2].map(light).map(|[bottom, top]| srgb::encode(bottom * (1.0 - height) + top * height))
        };
        let n_rows = size.yres();
        // The rays of a sample are anywhere between its lower and its upper edge.
        let rows = (0..n_rows).map(|row| [row, row + 1].map(|edge| color(edge as f32 / n_rows as f32)));
        let expected = rows.flat_map(|row| std::iter::repeat_n(row, size.xres() as usize));
        samples.into_iter().zip(expected).all(|(sample, [lower, upper])| {
            let is_between = |channel: usize| {
                let (value, edges) = (sample[channel], [lower[channel], upper[channel]]);
                (edges[0].min(edges[1])..=edges[0].max(edges[1])).contains(&value)
            };
            (0..3).all(is_between)
        })
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
        let [bottom, top] = [self.bottom, self.top].map(|[r, g, b]| format!("{r:02x}{g:02x}{b:02x}"));
        if bottom == top { f.write_str(&bottom) } else { write!(f, "{bottom},{top}") }
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

/// A plane that cuts the scene open: triangles beyond it are not seen and cast no shadow.
///
/// [`Clip::plane`] computes its position from the scene's bounds and the camera, with the same arithmetic everywhere.
///
/// Invariant, on the wire too: at most the whole scene is cut away.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "(ClipSide, u16)")]
pub struct Clip {
    side: ClipSide,
    cut_permille: u16,
}

/// The side from which a scene is cut away; a key steps through them in this order.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, Display, EnumString, IntoStaticStr, VariantArray,
)]
#[strum(serialize_all = "lowercase", parse_err_ty = String, parse_err_fn = unknown_name::<Self>)]
pub enum ClipSide {
    /// From large x to small.
    X,
    /// From large y to small.
    Y,
    /// From large z to small.
    Z,
    /// From small x to large.
    #[strum(serialize = "-x")]
    MinusX,
    /// From small y to large.
    #[strum(serialize = "-y")]
    MinusY,
    /// From small z to large.
    #[strum(serialize = "-z")]
    MinusZ,
    /// From the eye, by a plane parallel to the view plane.
    Eye,
}

/// Half of space: the points `p` with `normal·p ≤ offset`, in model space.
///
/// Invariant: all numbers are finite.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClipPlane {
    /// Points away from the kept half.
    pub normal: DVec3,
    /// Offset from the model's origin, in units of the normal's length.
    pub offset: f64,
}

/// Invalid numbers or text for a clip plane.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "a clip plane is SIDE:PERCENT as in y:30: 0 to 100 percent of the scene are cut away, from x, y or z (large to \
     small), from -x, -y or -z (small to large), or from eye"
)]
pub struct ClipError;

impl ClipSide {
    /// The unit normal, which points away from the kept half.
    fn normal(self, camera: &Camera) -> DVec3 {
        match self {
            Self::X => DVec3::X,
            Self::Y => DVec3::Y,
            Self::Z => DVec3::Z,
            Self::MinusX => DVec3::NEG_X,
            Self::MinusY => DVec3::NEG_Y,
            Self::MinusZ => DVec3::NEG_Z,
            Self::Eye => {
                let across = camera.u().normalize().cross(camera.v().normalize()).normalize();
                if across.dot(camera.eye() - camera.ll()) < 0.0 { -across } else { across }
            }
        }
    }
}

impl Clip {
    /// Cuts away `cut_permille` thousandths of the scene's extent from a side.
    pub fn new(side: ClipSide, cut_permille: u16) -> Result<Self, ClipError> {
        if cut_permille <= 1000 { Ok(Self { side, cut_permille }) } else { Err(ClipError) }
    }

    /// A cut from a side, as deep as `other`, or through the middle.
    #[must_use]
    pub fn with_side(side: ClipSide, other: Option<Self>) -> Self {
        Self { side, cut_permille: other.map_or(500, Self::cut_permille) }
    }

    /// The side from which the scene is cut away.
    pub fn side(self) -> ClipSide {
        self.side
    }

    /// The part that is cut away, in thousandths of the scene's extent.
    pub fn cut_permille(self) -> u16 {
        self.cut_permille
    }

    /// A cut that is deeper by thousandths of the scene's extent, or shallower if negative; it stays within the scene.
    #[must_use]
    pub fn deepened_by(self, permille: i16) -> Self {
        Self { cut_permille: self.cut_permille.saturating_add_signed(permille).min(1000), ..self }
    }

    /// The plane in a scene with these bounds, seen by this camera; `None` if the scene has no bounds.
    pub fn plane(self, (min, max): (DVec3, DVec3), camera: &Camera) -> Option<ClipPlane> {
        let normal = self.side.normal(camera);
        // The bounds' extent along the normal.
        let far = (normal * min).max(normal * max);
        let near = (normal * min).min(normal * max);
        let (far, near) = (far.x + far.y + far.z, near.x + near.y + near.z);
        let offset = far - (far - near) * (f64::from(self.cut_permille) / 1000.0);
        (min.cmple(max).all() && offset.is_finite() && normal.is_finite()).then_some(ClipPlane { normal, offset })
    }
}

impl TryFrom<(ClipSide, u16)> for Clip {
    type Error = ClipError;

    fn try_from((side, cut_permille): (ClipSide, u16)) -> Result<Self, ClipError> {
        Self::new(side, cut_permille)
    }
}

impl fmt::Display for Clip {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.side, f64::from(self.cut_permille) / 10.0)
    }
}

impl FromStr for Clip {
    type Err = ClipError;

    fn from_str(text: &str) -> Result<Self, ClipError> {
        let (name, percent) = text.split_once(':').ok_or(ClipError)?;
        let side = name.trim().parse().map_err(|_| ClipError)?;
        let percent: f64 = percent.trim().trim_end_matches('%').parse().map_err(|_| ClipError)?;
        if (0.0..=100.0).contains(&percent) { Self::new(side, (percent * 10.0).round() as u16) } else { Err(ClipError) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cut_takes_its_part_of_the_scene_from_its_side() {
        let (min, max) = (DVec3::new(-1.0, 2.0, 10.0), DVec3::new(3.0, 4.0, 20.0));
        let camera = Camera::look_at(DVec3::new(1.0, 3.0, 99.0), DVec3::ONE, DVec3::Y, 0.7, 2.0).unwrap();
        let kept = |clip: &str, point: DVec3| {
            let ClipPlane { normal, offset } = clip.parse::<Clip>().unwrap().plane((min, max), &camera).unwrap();
            normal.dot(point) <= offset
        };
        let at = |part: f64| min + (max - min) * part;
        for clip in ["x:30", "y:30", "z:30"] {
            assert!(kept(clip, at(0.69)) && !kept(clip, at(0.71)), "{clip}");
        }
        for clip in ["-x:30", "-y:30", "-z:30.5"] {
            assert!(kept(clip, at(0.31)) && !kept(clip, at(0.29)), "{clip}");
        }
        // The nearest corner goes first, and the farthest stays.
        assert!(kept("eye:50", min) && !kept("eye:50", max) && kept("eye:0", max - 1e-9) && !kept("eye:99.9", at(0.5)));
    }

    #[test]
    fn invalid_cuts_are_refused() {
        for text in ["", "x", "x:", "w:3", "x:101", "x:-1", "x:NaN", "x:inf", "eye:1e9", "-eye:3"] {
            assert!(text.parse::<Clip>().is_err(), "{text}");
        }
        assert!(Clip::try_from((ClipSide::X, 1001)).is_err());
        let half = Clip::new(ClipSide::Eye, 500).unwrap();
        assert_eq!((half.deepened_by(-600).cut_permille(), half.deepened_by(600).cut_permille()), (0, 1000));
        let camera = Camera::look_at(DVec3::Z, DVec3::ZERO, DVec3::Y, 0.7, 2.0).unwrap();
        assert_eq!(half.plane((DVec3::INFINITY, DVec3::NEG_INFINITY), &camera), None, "a scene of nothing");
    }

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
    fn invalid_colours_are_refused() {
        for text in ["", "red", "12345", "1234567", "+12345", "000000,", "000000,000000,000000", "ÿÿÿ"] {
            assert!(text.parse::<Background>().is_err(), "{text}");
        }
        assert_eq!("#0a0b0c".parse(), Ok(Background::plain([10, 11, 12])));
    }

    #[test]
    fn written_appearances_are_read_back() {
        for (_, light) in Light::PRESETS {
            assert_eq!(light.to_string().parse(), Ok(light));
        }
        for (_, background) in Background::PRESETS {
            assert_eq!(background.to_string().parse(), Ok(background));
        }
        for (permille, from) in (0..=1000).step_by(7).zip(ClipSide::VARIANTS.iter().copied().cycle()) {
            let clip = Clip::new(from, permille).unwrap();
            assert_eq!(clip.to_string().parse(), Ok(clip));
        }
    }
}
