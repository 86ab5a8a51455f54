//! Scene files: meshes with their grids as memory holds them, built once and mapped by every process that traces them.
//!
//! In reading order: [`bytes`] are a file's, mapped or read; [`section`] is an array of a scene, in memory or in a file, and
//! [`sections`] lists them; [`head`] says where they lie and has their checksums; [`mod@file`] writes and opens scene files;
//! [`fault`] says what is wrong with one, [`part`] is one that arrives
//! from elsewhere, and [`travelling`] one that is given. [`cache`] keeps those of models, with [`lock`]s for processes that build, and
//! [`seals`] of files that were checked; [`store`] loads a scene from wherever it is.
//!
//! # Safety
//!
//! Rays read mapped arrays without checks, so the contents of a file are checked before the first ray: the hashes of all
//! chunks, then all indices and ways (`grid/stored.rs`). That takes longer than a start may, so it is done once: a seal in
//! this user's cache then says that this very file, by its number, length, times and hash, was written or checked on this
//! machine. Any change of the file on this machine breaks the seal. Files that others may write, and files on other disks than
//! the cache, which other machines may write, are checked at each start, and read into memory instead of mapped.

pub(crate) mod bytes;
pub mod cache;
pub mod fault;
pub mod file;
pub(crate) mod head;
pub(crate) mod lock;
pub(crate) mod part;
pub(crate) mod seals;
pub(crate) mod section;
pub(crate) mod sections;
pub mod store;
#[cfg(test)]
mod tests;
pub mod travelling;

pub use fault::{Fault, SceneFileError};
pub use store::SceneStore;
