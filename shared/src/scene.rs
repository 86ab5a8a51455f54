//! The identity of a scene: wall and render servers must mean the same triangles.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Deserializer, Serialize, de};

/// Names a scene by its content, so that no render server can mix another model into the picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum SceneId {
    /// The built-in statue with about this many triangles: the same bits on every machine.
    Statue {
        /// Requested number; the generator makes the nearest possible one.
        ///
        /// Invariant on the wire: at most [`SceneId::LARGEST_STATUE`].
        #[serde(deserialize_with = "statue_triangles")]
        triangles: u32,
        /// How its surface is made.
        treatment: Treatment,
    },
    /// The BLAKE3 hash of a mesh, as it is in its file: its vertices, indices and colours, little endian.
    Mesh {
        /// The hash.
        blake3: [u8; 32],
        /// How its surface is made.
        treatment: Treatment,
    },
}

/// How a scene's surface is made of its model's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Treatment {
    /// How smooth it is where the model has no normals.
    pub crease: Crease,
    /// How exactly it lies where the model's does.
    pub precision: Precision,
}

impl Treatment {
    /// Every triangle is flat, and where it is in the model.
    pub const FLAT: Self = Self { crease: Crease::FLAT, precision: Precision::EXACT };
}

/// The largest angle between triangles that one smooth surface may have, in whole degrees; 0 leaves all triangles flat.
///
/// Invariant: at most 180.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "u8")]
pub struct Crease(u8);

impl Crease {
    /// Every triangle is flat, even in a file with normals.
    pub const FLAT: Self = Self(0);

    /// The angle, at most 180.
    pub fn degrees(self) -> u8 {
        self.0
    }
}

impl Default for Crease {
    /// Rounds scans, and what CAD programs divide into facets; chamfers stay sharp.
    fn default() -> Self {
        Self(40)
    }
}

/// The angle is out of range.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the crease must be from 0 (flat) to 180 whole degrees")]
pub struct CreaseError;

impl TryFrom<u8> for Crease {
    type Error = CreaseError;

    fn try_from(degrees: u8) -> Result<Self, CreaseError> {
        if degrees <= 180 { Ok(Self(degrees)) } else { Err(CreaseError) }
    }
}

impl FromStr for Crease {
    type Err = CreaseError;

    fn from_str(text: &str) -> Result<Self, CreaseError> {
        text.parse::<u8>().map_err(|_| CreaseError)?.try_into()
    }
}

impl fmt::Display for Crease {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// How exactly a scene keeps positions: as the model has them, or in so many bits for each coordinate.
///
/// Invariant: from 8 to 21 bits, or 0 for exact ones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "u8")]
pub struct Precision(u8);

impl Precision {
    /// Positions are those of the model.
    pub const EXACT: Self = Self(0);

    /// The bits of each coordinate, unless positions are exact.
    pub fn bits(self) -> Option<u32> {
        (self != Self::EXACT).then_some(self.0.into())
    }
}

/// The number of bits is out of range.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("positions are exact, or have from 8 to 21 bits for each coordinate")]
pub struct PrecisionError;

impl TryFrom<u8> for Precision {
    type Error = PrecisionError;

    fn try_from(bits: u8) -> Result<Self, PrecisionError> {
        // With 21 bits, three coordinates fill eight bytes.
        if matches!(bits, 0 | 8..=21) { Ok(Self(bits)) } else { Err(PrecisionError) }
    }
}

impl FromStr for Precision {
    type Err = PrecisionError;

    fn from_str(text: &str) -> Result<Self, PrecisionError> {
        match text.parse::<u8>() {
            Err(_) if text == "exact" => Ok(Self::EXACT),
            Ok(bits) if bits > 0 => bits.try_into(),
            _ => Err(PrecisionError),
        }
    }
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if *self == Self::EXACT { f.write_str("exact") } else { self.0.fmt(f) }
    }
}

impl SceneId {
    /// The most triangles of a statue that a message can request: some GB of a render server's memory.
    pub const LARGEST_STATUE: u32 = 100_000_000;

    /// How the scene's surface is made.
    pub fn treatment(self) -> Treatment {
        match self {
            Self::Statue { treatment, .. } | Self::Mesh { treatment, .. } => treatment,
        }
    }
}

fn statue_triangles<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u32, D::Error> {
    let triangles = u32::deserialize(deserializer)?;
    if triangles > SceneId::LARGEST_STATUE {
        return Err(de::Error::custom("a statue of more triangles than a message may request"));
    }
    Ok(triangles)
}

impl fmt::Display for SceneId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Statue { triangles, .. } => write!(f, "statue of {triangles} triangles"),
            Self::Mesh { blake3, .. } => {
                write!(f, "mesh ")?;
                blake3[..6].iter().try_for_each(|byte| write!(f, "{byte:02x}"))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn creases_are_whole_degrees_up_to_180() {
        for (text, degrees) in
            [("0", Some(0)), ("40", Some(40)), ("180", Some(180)), ("181", None), ("-1", None), ("1.5", None)]
        {
            assert_eq!(text.parse().ok().map(Crease::degrees), degrees, "{text}");
        }
        assert_eq!(Crease::FLAT.to_string().parse(), Ok(Crease::FLAT));
    }

    #[test]
    fn positions_are_exact_or_have_from_8_to_21_bits() {
        for (text, bits) in [
            ("exact", Some(None)),
            ("8", Some(Some(8))),
            ("21", Some(Some(21))),
            ("7", None),
            ("22", None),
            ("0", None),
        ] {
            let precision = text.parse::<Precision>().ok();
            assert_eq!(precision.map(Precision::bits), bits, "{text}");
            assert!(precision.is_none_or(|precision| precision.to_string() == text));
        }
    }
}
