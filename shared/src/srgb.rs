//! sRGB.
