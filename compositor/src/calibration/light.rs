//! Finds projectors' light from photographs of patterns of light: gamma, black, the strength of each colour, and the
//! fall-off within each field.
//!
//! In reading order: `ink` is what squares of these patterns show, `sample` what a photograph shows of them; `response`
//! finds the camera's curve, `levels` what is light and what is not within each photograph, and the projectors' gammas;
//! `field` finds fall-off, exposures, and the camera's vignetting, `colour` the strengths of colours, `black` the light of
//! black; [`solve`] puts them together, and [`verdict`] says whether to believe it. `arrow` solves their equations.
//!
//! The camera needs no calibration, and photographs no exposure times: squares of fine stripes and dots give from a
//! sixteenth to three quarters of the light whatever the projector's gamma is, so they calibrate the camera in each
//! photograph, and the camera then measures the projector's greys.

mod arrow;
mod black;
mod colour;
mod field;
mod ink;
mod levels;
mod response;
mod sample;
pub mod solve;
pub mod verdict;

pub(super) use self::{ink::Ink, sample::samples};
pub use self::{
    sample::{ColourAt, LightShot, Sample},
    verdict::{LightVerdict, judge_light},
};
