//! Shows: scenes one after the other, each a model, a view of it and a caption, shown for a time.
//!
//! In reading order: [`mod@file`] reads and writes a show's file, [`player`] decides which scene is due, and a [`cue`] is a scene
//! whose model was read. The window and the wall without one carry shows out.

mod cue;
mod file;
mod player;

pub(crate) use self::{
    cue::Cue,
    file::{Ending, MOST_CAPTION, Place, Show, ShowScene, add_scene, read},
    player::{Player, Step},
};
