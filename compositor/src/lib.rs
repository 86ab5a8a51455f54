//! The wall: divides frames among render servers, composes their samples and shows them.
//!
//! In reading order: [`args`] is the command line and [`run`] starts a wall from it; [`model`] is what is shown, [`kept`]
//! what lies in files beside it, [`wall`] where, [`farm`] has it rendered by others, [`local`] by processes of this
//! machine; [`gpu`] draws it.
//! [`window`] shows it: [`input`] and [`navigator`] are what keys and mouse do, [`refinement`] how finely it is rendered
//! while the camera moves and at rest, [`overlay`] is what an operator reads, [`kiosk`] when visitors
//! have gone, [`display_environment`] and [`screensaver`]
//! deal with the session around, and [`guard`] starts it again when it dies. [`headless`] shows it without a window.
//! [`stats`] and [`report`] say what all of it took; [`mod@bench`] is the paper's experiment, [`check`] looks at wall
//! files, and with [`alignment`] walls are set up.

pub mod alignment;
pub mod args;
pub mod bench;
pub mod check;
pub mod display_environment;
pub mod farm;
pub mod gpu;
#[cfg(all(unix, not(target_os = "macos")))]
pub mod guard;
#[cfg(not(all(unix, not(target_os = "macos"))))]
#[path = "guard/none.rs"]
pub mod guard;
pub mod headless;
pub mod input;
pub mod kept;
pub mod kiosk;
pub mod local;
pub mod model;
pub mod navigator;
pub mod overlay;
pub mod refinement;
pub mod report;
pub mod run;
pub mod screensaver;
pub mod stats;
pub mod wall;
pub mod window;
