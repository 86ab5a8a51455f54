//! Bounds of rounding errors in single precision.

/// Relative error of slopes: four roundings of 2⁻²⁴ in a corner's slope and two in a ray's, and ten to spare.
pub(super) const SLOPE_MARGIN: f32 = 1.0 / (1u32 << 20) as f32;

/// Error of edge sides, relative to the sum of absolute products: nine roundings, and seven to spare.
pub(super) const SIDE_MARGIN: f32 = 1.0 / (1u32 << 20) as f32;

/// Error of a triangle's plane, relative to products of sides that are at least half as large: eleven roundings,
/// trebled, so that a value that is small against the margin can be inverted.
pub(super) const PLANE_MARGIN: f32 = 1.0 / (1u32 << 18) as f32;

/// More than the absolute error where products leave the range of normal numbers.
pub(super) const UNDERFLOW_MARGIN: f32 = 1e-36;
