//! The identity of a scene: wall and render servers must mean the same triangles.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Names a scene by its content, so that no render server ever mixes another model into the picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum SceneId {
    /// The built-in statue with about this many triangles: the same bits on every machine.
    Statue {
        /// As asked for; the generator makes the nearest number that it can.
        triangles: u32,
    },
    /// The BLAKE3 hash of a mesh: its vertices, indices and colours, little endian.
    Mesh {
        /// The hash.
        blake3: [u8; 32],
    },
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
