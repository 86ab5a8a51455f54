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
        /// How smooth it is.
        crease: Crease,
    },
    /// The BLAKE3 hash of a mesh: its vertices, indices and colours, little endian.
    Mesh {
        /// The hash.
        blake3: [u8; 32],
        /// How smooth it is where the file has no normals.
        crease: Crease,
    },
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

impl SceneId {
    /// The most triangles of a statue that a message can request: some GB of a render server's memory.
    pub const LARGEST_STATUE: u32 = 100_000_000;

    /// How smooth the scene is.
    pub fn crease(self) -> Crease {
        match self {
            Self::Statue { crease, .. } | Self::Mesh { crease, .. } => crease,
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
}
