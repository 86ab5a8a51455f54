//! The code under fuzzing: see `tests/src/decoders.rs`.

#[path = "../src/decoders.rs"]
pub mod decoders;
#[path = "../../compositor/src/farm/frame_buffer.rs"]
#[allow(dead_code)]
mod frame_buffer;
#[path = "../../compositor/src/farm/tile_row.rs"]
mod tile_row;
#[path = "../../compositor/src"]
mod compositor {
    #[allow(dead_code, unused_imports)]
    pub(crate) mod wall;
}

use compositor::wall;
