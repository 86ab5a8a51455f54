//! How wall and render servers talk: messages over a byte stream, encrypted where both hold the wall's key.
//!
//! In reading order: [`wire`] reads and writes messages, [`secure`] encrypts the stream beneath them, [`key`] is what both
//! ends must hold.

pub mod key;
pub mod secure;
pub mod wire;
