//! The code under fuzzing: see `tests/src/decoders.rs`.

#![allow(unfulfilled_lint_expectations, reason = "the wall's crate asks for documentation, this one does not")]

#[path = "../src/decoders.rs"]
pub mod decoders;
#[path = "../../compositor/src/farm/frame_buffer.rs"]
#[allow(dead_code)]
mod frame_buffer;
#[path = "../../compositor/src/remote/message.rs"]
#[allow(dead_code)]
mod message;
#[path = "../../compositor/src/devices/osc.rs"]
#[allow(dead_code)]
mod osc;
#[path = "../../compositor/src/control/show/file.rs"]
#[allow(dead_code)]
mod show_file;
#[path = "../../compositor/src/farm/tile_row.rs"]
mod tile_row;
#[path = "../../compositor/src"]
mod compositor {
    #[allow(dead_code)]
    pub(crate) mod mpcdi;
    #[allow(dead_code, unused_imports)]
    pub(crate) mod wall;
}

/// Where `message.rs` looks for it.
mod control {
    pub(crate) mod show {
        pub(crate) use crate::show_file::MOST_CAPTION;
    }
}

/// Where `osc.rs` looks for it.
mod remote {
    pub(crate) use crate::message;
}

use compositor::{mpcdi as mpcdi_file, wall};
