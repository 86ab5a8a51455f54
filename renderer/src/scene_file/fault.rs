//! Faults of scene files.

use std::{io, path::PathBuf};

use shared::scene::Crease;

use crate::scene_file::head::VERSION;

/// A scene file cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{}: {fault}", path.display())]
pub struct SceneFileError {
    /// The file.
    pub path: PathBuf,
    /// The cause, with its cure. Not the error's source, because the message contains it already.
    pub fault: Fault,
}

/// Why a scene file cannot be used. The text follows the file's name and a colon.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum Fault {
    #[error("is no scene file: name a model, or build one with `renderer build`")]
    NotASceneFile,
    #[error("is a scene file of a machine with another byte order: build it on this one with `renderer build`")]
    ByteOrder,
    #[error(
        "is a scene file of version {0}, this program reads version {VERSION}: build it again with `renderer build`"
    )]
    Version(u32),
    #[error("{0}: copy the scene file again, or build it again with `renderer build`")]
    Damaged(#[from] Damage),
    #[error(
        "was built with --crease {of_file}, not {asked}: leave --crease out, or build it again with `renderer build`"
    )]
    OtherCrease { of_file: Crease, asked: Crease },
    #[error("cannot be read: {0}")]
    Io(#[from] io::Error),
}

/// The damage to a scene file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum Damage {
    #[error("its beginning is damaged")]
    Head,
    #[error("it has {of_file} bytes in place of {expected}")]
    Length { of_file: u64, expected: u64 },
    #[error("its {}th megabyte is damaged", .0 + 1)]
    Chunk(usize),
    #[error("its {0} are damaged")]
    Content(&'static str),
}
