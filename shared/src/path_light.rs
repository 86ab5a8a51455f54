//! The light of path-traced pictures: the sun's size, how often light bounces, the exposure, and whether a ground shows shadows;
//! other pictures ignore it.
//!
//! All numbers are bounded integers: no NaN can occur, and every machine computes the same bits from them.

use std::{fmt, ops::RangeInclusive, str::FromStr};

use serde::{Deserialize, Serialize};

/// The light of path-traced pictures.
///
/// Invariant, on the wire too: each number lies in the range of its limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "PathNumbers")]
pub struct PathLight {
    sun_decidegrees: u16,
    bounces: u8,
    exposure_deci_ev: i16,
    has_ground: bool,
}

/// Sun, bounces, exposure and ground as they come in.
type PathNumbers = (u16, u8, i16, bool);

/// A number is out of range.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PathLightError {
    /// Of the sun's diameter.
    #[error("the sun's diameter is from 0 to 90 degrees, with at most one decimal: it is 0.5 in nature")]
    Sun,
    /// Of bounces.
    #[error("light bounces from 0 to {most} times: 4 is enough for most models", most = PathLight::MOST_BOUNCES)]
    Bounces,
    /// Of the exposure.
    #[error("an exposure is from -10 to 10 stops, with at most one decimal: each stop doubles the light")]
    Exposure,
}

impl PathLight {
    /// The most bounces between surfaces.
    pub const MOST_BOUNCES: u8 = 64;
    const SUN_DECIDEGREES: RangeInclusive<u16> = 0..=900;
    const EXPOSURE_DECI_EV: RangeInclusive<i16> = -100..=100;

    /// The sun's diameter in tenths of a degree, bounces of light between surfaces, and exposure in tenths of a stop; without a
    /// ground.
    pub fn new(sun_decidegrees: u16, bounces: u8, exposure_deci_ev: i16) -> Result<Self, PathLightError> {
        if !Self::SUN_DECIDEGREES.contains(&sun_decidegrees) {
            Err(PathLightError::Sun)
        } else if bounces > Self::MOST_BOUNCES {
            Err(PathLightError::Bounces)
        } else if !Self::EXPOSURE_DECI_EV.contains(&exposure_deci_ev) {
            Err(PathLightError::Exposure)
        } else {
            Ok(Self { sun_decidegrees, bounces, exposure_deci_ev, has_ground: false })
        }
    }

    /// Diameter of the sun seen from the model, in degrees, from 0 to 90.
    pub fn sun_degrees(self) -> f64 {
        f64::from(self.sun_decidegrees) / 10.0
    }

    /// Bounces of light between surfaces, 0 to [`PathLight::MOST_BOUNCES`]; without any, surfaces are lit by sun and sky alone.
    pub fn bounces(self) -> u8 {
        self.bounces
    }

    /// Stops by which pictures are brighter, from −10 to 10.
    pub fn exposure_ev(self) -> f64 {
        f64::from(self.exposure_deci_ev) / 10.0
    }

    /// The factor of the exposure: 2 to the power of its stops, by repeated multiplication, because `powf` differs between
    /// platforms.
    pub fn exposure(self) -> f64 {
        const TENTH_OF_A_STOP: f64 = 1.071_773_462_536_293_1;
        let factor = (0..self.exposure_deci_ev.unsigned_abs()).fold(1.0, |factor, _| factor * TENTH_OF_A_STOP);
        if self.exposure_deci_ev < 0 { 1.0 / factor } else { factor }
    }

    /// Whether the background shows the shadows that fall on a ground below the model.
    pub fn has_ground(self) -> bool {
        self.has_ground
    }

    /// The same with a ground, or without.
    #[must_use]
    pub fn with_ground(self, has_ground: bool) -> Self {
        Self { has_ground, ..self }
    }

    /// The same with another diameter of the sun, in tenths of a degree; the nearest that is possible.
    #[must_use]
    pub fn with_sun(self, decidegrees: u16) -> Self {
        Self { sun_decidegrees: decidegrees.min(*Self::SUN_DECIDEGREES.end()), ..self }
    }

    /// The same with another exposure, in tenths of a stop; the nearest that is possible.
    #[must_use]
    pub fn with_exposure(self, deci_ev: i16) -> Self {
        let (least, most) = Self::EXPOSURE_DECI_EV.into_inner();
        Self { exposure_deci_ev: deci_ev.clamp(least, most), ..self }
    }

    /// The same, brighter by tenths of a stop, or darker if negative, as far as is possible.
    #[must_use]
    pub fn brightened_by(self, deci_ev: i16) -> Self {
        self.with_exposure(self.exposure_deci_ev.saturating_add(deci_ev))
    }

    /// Parses the sun's diameter in degrees, in tenths.
    pub fn parse_sun(text: &str) -> Result<u16, PathLightError> {
        tenths(text).filter(|tenths| Self::SUN_DECIDEGREES.contains(tenths)).ok_or(PathLightError::Sun)
    }

    /// Parses bounces.
    pub fn parse_bounces(text: &str) -> Result<u8, PathLightError> {
        text.trim().parse().ok().filter(|&bounces| bounces <= Self::MOST_BOUNCES).ok_or(PathLightError::Bounces)
    }

    /// Parses an exposure in stops, in tenths.
    pub fn parse_exposure(text: &str) -> Result<i16, PathLightError> {
        tenths(text).filter(|tenths| Self::EXPOSURE_DECI_EV.contains(tenths)).ok_or(PathLightError::Exposure)
    }
}

/// A number with at most one decimal, in tenths.
fn tenths<T: TryFrom<i32>>(text: &str) -> Option<T> {
    let tenths = text.trim().parse::<f64>().ok()? * 10.0;
    let is_exact = (tenths - tenths.round()).abs() < 1e-6 && tenths.abs() < 1e6;
    is_exact.then(|| T::try_from(tenths.round() as i32).ok()).flatten()
}

impl Default for PathLight {
    /// A sun that is larger than in nature, so that edges of shadows are soft; four bounces; no correction of the exposure; no
    /// ground.
    fn default() -> Self {
        Self { sun_decidegrees: 40, bounces: 4, exposure_deci_ev: 0, has_ground: false }
    }
}

impl fmt::Display for PathLight {
    /// Sun, bounces and exposure, in the words of the options, and `ground` if there is one.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ground = if self.has_ground { ",ground" } else { "" };
        write!(f, "{},{},{}{ground}", self.sun_degrees(), self.bounces, self.exposure_ev())
    }
}

/// Text that is no light of paths.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PathLightTextError {
    /// It has other parts.
    #[error("the light of paths is SUN,BOUNCES,EXPOSURE as in 4,4,0, or with a ground 4,4,0,ground")]
    Parts,
    /// One is out of range.
    #[error(transparent)]
    Number(#[from] PathLightError),
}

impl FromStr for PathLight {
    type Err = PathLightTextError;

    fn from_str(text: &str) -> Result<Self, PathLightTextError> {
        let parts: Vec<_> = text.split(',').collect();
        let &[sun, bounces, exposure, ref ground @ ..] = parts.as_slice() else {
            return Err(PathLightTextError::Parts);
        };
        let has_ground = match ground {
            [] => false,
            [word] if word.trim() == "ground" => true,
            _ => return Err(PathLightTextError::Parts),
        };
        let (sun, bounces) = (Self::parse_sun(sun)?, Self::parse_bounces(bounces)?);
        Ok(Self::new(sun, bounces, Self::parse_exposure(exposure)?)?.with_ground(has_ground))
    }
}

impl TryFrom<PathNumbers> for PathLight {
    type Error = PathLightError;

    fn try_from((sun_decidegrees, bounces, exposure_deci_ev, has_ground): PathNumbers) -> Result<Self, PathLightError> {
        Ok(Self::new(sun_decidegrees, bounces, exposure_deci_ev)?.with_ground(has_ground))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_out_of_range_are_refused() {
        for text in ["", "-1", "90.1", "0.55", "NaN", "inf", "1e300", "x"] {
            assert_eq!(PathLight::parse_sun(text), Err(PathLightError::Sun), "{text}");
        }
        for text in ["", "-1", "65", "1000", "1.5"] {
            assert_eq!(PathLight::parse_bounces(text), Err(PathLightError::Bounces), "{text}");
        }
        for text in ["", "-10.1", "11", "0.01", "NaN", "-inf"] {
            assert_eq!(PathLight::parse_exposure(text), Err(PathLightError::Exposure), "{text}");
        }
        for (sun, bounces, exposure) in [(901, 0, 0), (0, 65, 0), (0, 0, -101), (u16::MAX, u8::MAX, i16::MIN)] {
            let numbers = (sun, bounces, exposure, true);
            assert!(PathLight::try_from(numbers).is_err(), "{numbers:?}");
        }
        assert_eq!(PathLight::parse_sun("0.5"), Ok(5));
        assert_eq!(PathLight::parse_exposure("-1.5"), Ok(-15));
    }

    #[test]
    fn written_lights_are_read_back() {
        for numbers in [(0, 0, 0, false), (5, 4, -15, true), (900, 64, 100, false), (123, 7, -100, true)] {
            let light = PathLight::try_from(numbers).unwrap();
            assert_eq!(light.to_string().parse(), Ok(light));
        }
        for text in ["", "4,4", "4,4,0,0", "91,4,0", "4,65,0", "4,4,11", "4;4;0", "4,4,0,ground,ground", "4,4,0,"] {
            assert!(text.parse::<PathLight>().is_err(), "{text}");
        }
        let changed = PathLight::default().with_sun(u16::MAX).with_exposure(i16::MIN);
        assert_eq!((changed.sun_degrees(), changed.exposure_ev()), (90.0, -10.0));
    }

    #[test]
    fn a_stop_doubles_the_light() {
        for deci_ev in PathLight::EXPOSURE_DECI_EV {
            let light = PathLight::new(0, 0, deci_ev).unwrap();
            let expected = (f64::from(deci_ev) / 10.0).exp2();
            assert!((light.exposure() / expected - 1.0).abs() < 1e-13, "{deci_ev}");
        }
    }
}
