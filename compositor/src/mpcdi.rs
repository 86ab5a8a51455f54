//! MPCDI, the format by which tools for projectors exchange calibrations: a zip with `mpcdi.xml`, warps as PFM, and maps of
//! light as PNG (VESA, "Multiple Projection Common Data Interchange Standard", version 2, 2015).
//!
//! Profile 2d: a picture, the buffer, has a region for each projector, and a warp has a point of the region for each of the
//! projector's pixels. Profile 3d: the region is a view from the eye. Profiles a3 and sl: the warp has points in space.
//! In reading order: [`document`] is `mpcdi.xml`, [`archive`] the zip around it, and [`convert`] goes from warps to meshes,
//! and back; [`view`] reads views, [`points`] points in space, and [`canvas`] lays the canvas there.

pub mod archive;
pub mod canvas;
pub mod convert;
pub mod document;
pub mod points;
pub mod view;

/// The cure of a file that is damaged, or was written wrongly.
const EXPORT_AGAIN: &str = "export it again from the tool that wrote it";
