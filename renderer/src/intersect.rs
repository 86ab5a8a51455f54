//! Traces rays through a grid, alone or in packets, and decides their hits.
//!
//! [`ray`] holds a ray and its hit; [`triangle`] decides whether a ray hits a triangle, with sums from [`exact`] where
//! rounding could change the answer. [`rays`] traces many rays of any origins: a [`stream`] of them by [`descent`]s from
//! the root or [`entry_points`] to the leaves of the tree, a [`bundle`] where they go together, or by a [`walk`] through
//! uniform cells, with [`filter`] before each list of triangles; [`packet`] traces many rays together, and is compiled for
//! each instruction set of [`crate::simd`]. [`margins`] bounds rounding errors. [`clip`] traces rays in a scene that a plane cuts open.

mod bundle;
pub mod clip;
#[expect(clippy::needless_range_loop, reason = "an axis indexes several arrays at once")]
mod descent;
#[expect(clippy::needless_range_loop, reason = "an axis indexes several arrays at once")]
mod entry_points;
mod exact;
#[expect(clippy::needless_range_loop, reason = "an axis or a corner indexes several arrays at once")]
pub mod filter;
mod grid_ray;
mod margins;
mod packet;
pub mod ray;
mod rays;
mod starts;
mod stream;
pub mod triangle;
pub(crate) mod walk;

pub use packet::{MOST_PACKETS, Packet, PacketScratch};
pub use rays::RayCost;

pub use crate::simd::InstructionSet;
