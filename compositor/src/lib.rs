//! The wall: divides frames among render servers, composes their samples and shows them.
//!
//! In reading order, a room each: [`cli`] is the command line, starts a wall from it, with a window or without, and
//! checks wall files; [`control`] is what is shown, and how keys, mouse and time change it; [`wall`] is where it is shown;
//! [`farm`] has it rendered by others and [`gpu`] draws it. [`window`] shows it, [`overlay`] is what an operator reads,
//! and [`supervisor`] starts a wall again when it dies. [`mod@bench`] is the paper's experiment.

pub mod bench;
pub mod cli;
pub mod control;
pub mod farm;
pub mod gpu;
pub mod overlay;
#[cfg(all(unix, not(target_os = "macos")))]
pub mod supervisor;
#[cfg(not(all(unix, not(target_os = "macos"))))]
#[path = "supervisor/none.rs"]
pub mod supervisor;
pub mod wall;
pub mod window;
