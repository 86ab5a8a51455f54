//! The channel between the wall and its render servers: messages over a byte stream, encrypted if both have the wall's key;
//! and the files of all programs.
//!
//! In reading order: [`wire`] reads and writes messages, [`secure`] encrypts the stream beneath them, [`key`] is the shared
//! secret, and [`discovery`] finds walls in the network. [`files`] reads and writes files.

pub mod discovery;
pub mod files;
pub mod key;
pub mod secure;
pub mod wire;
