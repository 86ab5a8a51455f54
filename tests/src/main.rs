//! All integration tests, in one binary.

#[cfg(test)]
mod accuracy;
#[cfg(all(test, target_os = "linux"))]
mod aligning;
#[cfg(test)]
mod bad_input;
#[cfg(test)]
mod bench;
#[cfg(all(test, target_os = "linux"))]
mod browser;
#[cfg(test)]
mod bumped;
#[cfg(test)]
mod calibrating;
#[cfg(test)]
mod churn;
#[cfg(test)]
mod cluster;
#[cfg(test)]
#[allow(unreachable_pub, reason = "tests/fuzz has it in a library")]
mod decoders;
#[cfg(all(test, target_os = "linux"))]
mod devices;
#[cfg(all(test, target_os = "linux"))]
mod discovery;
#[cfg(test)]
mod farm;
#[cfg(test)]
#[cfg(target_os = "linux")]
mod fetching;
#[cfg(test)]
mod film;
#[cfg(test)]
mod formats;
#[cfg(test)]
#[path = "../../compositor/src/farm/frame_buffer.rs"]
#[allow(unreachable_pub, reason = "the compositor does not export it")]
mod frame_buffer;
#[cfg(test)]
mod fuzzing;
#[cfg(all(test, target_os = "linux"))]
mod guard;
#[cfg(all(test, target_os = "linux"))]
mod http;
#[cfg(test)]
mod large;
#[cfg(test)]
mod liars;
#[cfg(test)]
mod lighting;
#[cfg(test)]
mod losses;
#[cfg(test)]
mod map_grid;
#[cfg(all(test, target_os = "linux"))]
mod marks;
#[cfg(test)]
mod measuring;
#[cfg(test)]
mod mpcdi;
#[cfg(test)]
mod mpcdi_space;
#[cfg(test)]
mod operator;
#[cfg(test)]
mod optics;
#[cfg(all(test, target_os = "linux"))]
mod outputs;
#[cfg(test)]
mod pictures;
#[cfg(test)]
mod ply_suite;
#[cfg(test)]
mod present_cpu;
#[cfg(test)]
mod process;
#[cfg(test)]
mod proxy;
#[cfg(test)]
mod random;
#[cfg(test)]
mod readme;
#[cfg(test)]
mod references;
#[cfg(all(test, target_os = "linux"))]
mod refinement;
#[cfg(all(test, target_os = "linux"))]
mod remote;
#[cfg(all(test, target_os = "linux"))]
mod remote_page;
#[cfg(test)]
mod room;
#[cfg(test)]
mod scene_files;
#[cfg(all(test, target_os = "linux"))]
mod show;
#[cfg(test)]
#[path = "../../compositor/src/control/show/file.rs"]
#[allow(dead_code, unreachable_pub, reason = "the compositor does not export it, and its tests are there")]
mod show_file;
#[cfg(all(test, unix))]
mod stopping;
#[cfg(test)]
#[path = "../../compositor/src/farm/tile_row.rs"]
mod tile_row;
#[cfg(test)]
mod trust;
#[cfg(all(test, target_os = "linux"))]
mod window;
#[cfg(all(test, target_os = "linux"))]
mod x_drop;
#[cfg(all(test, target_os = "linux"))]
mod x_monitors;
#[cfg(all(test, target_os = "linux"))]
mod x_session;
#[cfg(all(test, target_os = "linux"))]
mod x_touch;

#[cfg(test)]
use compositor::{devices::osc, mpcdi as mpcdi_file, remote::message, wall};
