//! Aligns a wall from photographs of patterns. Pure: no clock, file, socket, window or GPU.
//!
//! In reading order: [`pattern`] is what projectors show, [`photograph`] what a camera sees of it; `crossing` finds the
//! crossings of checkerboards, `lattice` puts them together, and [`identify`] says which projector shows them; [`solve`]
//! works out where projectors' pixels lie, with the camera's [`lens`], and `adjust` refines it; [`place`] lays the canvas
//! there. On a wall that is not flat `bent` solves, `bundle` refines, `unroll` lays the canvas there and makes
//! meshes, and `shape` says whether the wall has the shape of its file.
//! [`verdict`] says which projectors were found, and whether to believe it, with a [`finding`] on each; `again` aligns a
//! wall again after a bump, `bent_again` one that is not flat. [`light`] finds projectors' light in the same way.
//! `noise` measures the noise of crossings, and `fitting` has what several of these compute.

mod adjust;
mod again;
mod bent;
mod bent_again;
mod bent_verdict;
mod bundle;
mod crossing;
pub mod finding;
mod fitting;
pub mod identify;
mod lattice;
pub mod lens;
pub mod light;
mod noise;
pub mod pattern;
pub mod photograph;
pub mod place;
mod shape;
pub mod solve;
mod unroll;
pub mod verdict;

pub use self::{
    again::{check_again, judge_again},
    finding::Finding,
    identify::Codebook,
    light::{LightVerdict, judge_light},
    pattern::Plan,
    photograph::Photograph,
    place::Placement,
    verdict::{Reading, Verdict, judge},
};
