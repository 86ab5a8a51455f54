//! The identity of a scene: wall and render servers must mean the same triangles.

use std::fmt;

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
    },
    /// The BLAKE3 hash of a mesh: its vertices, indices and colours, little endian.
    Mesh {
        /// The hash.
        blake3: [u8; 32],
    },
}

impl SceneId {
    /// The most triangles of a statue that a message can request: some GB of a render server's memory.
    pub const LARGEST_STATUE: u32 = 100_000_000;
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
            Self::Statue { triangles } => write!(f, "statue of {triangles} triangles"),
            Self::Mesh { blake3 } => {
                write!(f, "mesh ")?;
                blake3[..6].iter().try_for_each(|byte| write!(f, "{byte:02x}"))
            }
        }
    }
}
