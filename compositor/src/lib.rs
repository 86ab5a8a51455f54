//! The wall: divides frames among render servers, composes their samples and shows them.

pub mod gpu;
pub mod wall;
