//! A sky image's identity: wall and render servers must mean the same light.

use std::fmt;

use serde::{Deserialize, Serialize};

/// The BLAKE3 hash of a sky image: width, height and linear red, green and blue of its texels, as little-endian numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct SkyId(pub [u8; 32]);

impl fmt::Display for SkyId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "sky ")?;
        self.0[..6].iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}
