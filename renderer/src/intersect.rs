//! Follows rays through a grid, alone or in packets, and decides what they hit.
//!
//! [`ray`] is a ray and its hit; [`triangle`] decides whether one is hit, with [`exact`] sums where rounding would spoil the
//! sign. [`walk`] follows single rays, with [`filter`] before each list of triangles; [`packet`] follows many together,
//! compiled by [`kernel`] for each instruction set that [`simd`] knows. [`clip`] leaves out what a plane cuts away.

pub mod clip;
mod exact;
#[expect(clippy::needless_range_loop, reason = "an axis or a corner indexes several arrays at once")]
pub mod filter;
mod instructions;
mod kernel;
mod packet;
pub mod ray;
pub(crate) mod simd;
pub mod triangle;
pub(crate) mod walk;

pub use instructions::InstructionSet;
pub use packet::{MOST_PACKETS, Packet, PacketScratch};
pub use walk::RayCost;
