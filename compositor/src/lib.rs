//! The wall: divides frames among render servers, composes their samples and shows them.
//!
//! In reading order: [`cli`] is the command line, which starts a wall and checks wall files; [`control`] turns keys, mouse
//! and time into the render goal; [`wall`] is the geometry of the projectors, which [`calibration`] finds in photographs and
//! [`mpcdi`] exchanges with other tools;
//! [`farm`] has frames rendered by render servers, [`gpu`] draws them, and [`window`] shows them; [`overlay`] is the
//! operator's panels, [`remote`] the page in a visitor's hand, [`devices`] are controllers beside keys and mouse, and
//! [`supervisor`] restarts a wall that crashed.

pub mod calibration;
pub mod cli;
pub mod control;
pub mod devices;
pub mod farm;
pub mod gpu;
pub mod mpcdi;
mod overlay;
pub mod remote;
#[cfg(all(unix, not(target_os = "macos")))]
mod supervisor;
#[cfg(not(all(unix, not(target_os = "macos"))))]
#[path = "supervisor/none.rs"]
mod supervisor;
mod svx;
pub mod wall;
mod window;
