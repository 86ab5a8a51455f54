//! Shows: scenes one after the other, each a model, a view of it and a caption, shown for a time.
//!
//! In reading order: [`mod@file`] reads and writes a show's file, [`edit`] changes one, [`player`] decides which scene is due, and a [`cue`] is a scene
//! whose model was read. The window and the wall without one carry shows out.

mod cue;
mod edit;
mod file;
mod player;

pub(crate) use self::{
    cue::Cue,
    edit::{SceneEdit, SceneMap, edit_scene},
    file::{Ending, MOST_CAPTION, Place, Show, ShowScene, add_scene, read},
    player::{Player, Step},
};
