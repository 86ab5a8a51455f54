//! The resolution of a frame.

use serde::{Deserialize, Serialize};

use super::TILE_SIZE;

/// The resolution of a frame in samples.
///
/// Invariant: at least 1×1, at most [`FrameSize::LARGEST`] on either side and [`FrameSize::MOST_SAMPLES`] in all.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "(u32, u32)", into = "(u32, u32)")]
pub struct FrameSize {
    xres: u32,
    yres: u32,
}

/// The numbers are out of range.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("a frame of {0}×{1} samples: each side must be from 1 to {max}, and their product at most {most}",
    max = FrameSize::LARGEST, most = FrameSize::MOST_SAMPLES)]
pub struct FrameSizeError(u32, u32);

impl TryFrom<(u32, u32)> for FrameSize {
    type Error = FrameSizeError;

    fn try_from((xres, yres): (u32, u32)) -> Result<Self, FrameSizeError> {
        Self::new(xres, yres)
    }
}

impl From<FrameSize> for (u32, u32) {
    #[inline]
    fn from(size: FrameSize) -> Self {
        (size.xres, size.yres)
    }
}

impl FrameSize {
    /// The largest side: seventeen displays of 3840 pixels.
    pub const LARGEST: u32 = 1 << 16;

    /// The most samples: 32 displays of 3840×2160. A wall that asks for them needs 1 GB for each frame; a render server
    /// holds a few chunks of any frame, so no message makes it allocate more.
    pub const MOST_SAMPLES: u32 = 1 << 28;

    /// The paper's frame.
    pub const PAPER: Self = Self { xres: 1024, yres: 512 };

    /// A frame of a single sample.
    pub const ONE: Self = Self { xres: 1, yres: 1 };

    /// A frame of `xres` × `yres` samples.
    pub fn new(xres: u32, yres: u32) -> Result<Self, FrameSizeError> {
        let valid = 1..=Self::LARGEST;
        let n_samples = u64::from(xres) * u64::from(yres);
        if valid.contains(&xres) && valid.contains(&yres) && n_samples <= u64::from(Self::MOST_SAMPLES) {
            Ok(Self { xres, yres })
        } else {
            Err(FrameSizeError(xres, yres))
        }
    }

    /// Samples in a row.
    #[inline]
    pub fn xres(self) -> u32 {
        self.xres
    }

    /// Rows.
    #[inline]
    pub fn yres(self) -> u32 {
        self.yres
    }

    /// Samples in all.
    #[inline]
    pub fn n_samples(self) -> u32 {
        self.xres * self.yres
    }

    /// Columns of tiles; the last may be cut off.
    #[inline]
    pub fn x_tiles(self) -> u32 {
        self.xres.div_ceil(TILE_SIZE)
    }

    /// Rows of tiles; the last may be cut off.
    #[inline]
    pub fn y_tiles(self) -> u32 {
        self.yres.div_ceil(TILE_SIZE)
    }

    pub(super) fn n_tiles(self) -> u32 {
        self.x_tiles() * self.y_tiles()
    }
}

impl std::str::FromStr for FrameSize {
    type Err = String;

    /// Reads `1024x512`.
    fn from_str(text: &str) -> Result<Self, String> {
        let sides = text.split_once(['x', '×']).and_then(|(x, y)| Some((x.parse().ok()?, y.parse().ok()?)));
        let (xres, yres) = sides.ok_or_else(|| format!("\"{text}\" is no size: write it as 1024x512"))?;
        Self::new(xres, yres).map_err(|error| error.to_string())
    }
}

impl std::fmt::Display for FrameSize {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}x{}", self.xres, self.yres)
    }
}
