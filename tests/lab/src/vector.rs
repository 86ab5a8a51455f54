//! Vectors of three numbers of any type: `f32`, `f64`, and integers, which are exact.
//!
//! All methods under test use these, so that they round in the same order.

use std::ops::{Add, Mul, Sub};

#[inline(always)]
pub(crate) fn add<R: Copy + Add<Output = R>>(a: [R; 3], b: [R; 3]) -> [R; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

#[inline(always)]
pub(crate) fn sub<R: Copy + Sub<Output = R>>(a: [R; 3], b: [R; 3]) -> [R; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
pub(crate) fn dot<R: Copy + Add<Output = R> + Mul<Output = R>>(a: [R; 3], b: [R; 3]) -> R {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
pub(crate) fn cross<R: Copy + Sub<Output = R> + Mul<Output = R>>(a: [R; 3], b: [R; 3]) -> [R; 3] {
    [a[1] * b[2] - b[1] * a[2], a[2] * b[0] - b[2] * a[0], a[0] * b[1] - b[0] * a[1]]
}
