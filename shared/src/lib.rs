//! What the wall and its render servers agree on: pictures, cameras, the division of frames, and messages.
//!
//! Everything here is a pure function or plain data: no socket, no clock, no thread.
//! In reading order: [`camera`] makes rays, [`division`] says who renders which of them, [`curve`] in which order,
//! [`scene`] names what is rendered and [`structure`] how it is kept, [`look`] how it looks, [`srgb`] encodes what comes out, [`protocol`] says all of it on the wire, [`codec`] in bytes.

pub mod appearance;
pub mod camera;
pub mod codec;
pub mod curve;
pub mod division;
pub mod printable;
pub mod protocol;
pub mod scene;
pub mod srgb;
pub mod structure;
