//! The agreement between the wall and its render servers: cameras, the division of frames, appearance, and messages.
//!
//! Everything here is a pure function or plain data: no socket, no clock, no thread.
//! In reading order: [`camera`] makes rays, [`division`] says which node renders which samples, [`curve`] in which order,
//! [`scene`] names the scene and [`structure`] its grid, [`appearance`] is light, background and clip plane,
//! [`path_light`] sun, bounces, exposure and ground of path-traced pictures, [`sky`] names the image that lights them,
//! [`noise`] is the noise that they may keep, [`detail`] how coarse a frame may be, [`srgb`] encodes light, [`marks`] are annotations and measurements, [`protocol`] defines
//! the messages and [`codec`] their bytes; [`names`], [`printable`] and [`toml_text`] help with text.

pub mod appearance;
pub mod camera;
pub mod codec;
pub mod curve;
pub mod detail;
pub mod division;
pub mod marks;
pub mod names;
pub mod noise;
pub mod path_light;
pub mod printable;
pub mod protocol;
pub mod scene;
pub mod sky;
pub mod srgb;
pub mod structure;
pub mod toml_text;
