//! Faults of scene files.

use std::{io, path::PathBuf};

use shared::scene::Treatment;

use crate::scene_file::head::VERSION;

/// A scene file cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{}: {fault}{}", path.display(), fault.cure())]
pub struct SceneFileError {
    /// The file.
    pub path: PathBuf,
    /// The cause. Not the error's source, because the message contains it already.
    pub fault: Fault,
}

/// Why a scene file cannot be used. The text follows the file's name and a colon; the cure is left out, as files in the
/// cache need none.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum Fault {
    #[error("is no scene file")]
    NotASceneFile,
    #[error("is a scene file of a machine with another byte order")]
    ByteOrder,
    #[error("is a scene file of version {0}, this program reads version {VERSION}")]
    Version(u32),
    #[error("{0}")]
    Damaged(#[from] Damage),
    #[error("was built with {}, not {}", options(of_file), options(asked))]
    OtherTreatment { of_file: Treatment, asked: Treatment },
    #[error("cannot be read: {0}")]
    Io(#[from] io::Error),
}

impl Fault {
    /// The cure for a scene file that an operator has named: the end of the line.
    fn cure(&self) -> &'static str {
        match self {
            Self::NotASceneFile => ": name a model, or build a scene file with `renderer build`",
            Self::ByteOrder => ": build it on this one with `renderer build`",
            Self::Version(_) => ": build it again with `renderer build`",
            Self::Damaged(_) => ": copy the scene file again, or build it again with `renderer build`",
            Self::OtherTreatment { .. } => {
                ": leave --crease and --geometry out, or build it again with `renderer build`"
            }
            Self::Io(_) => "",
        }
    }
}

/// The options that ask for a treatment.
fn options(treatment: &Treatment) -> String {
    format!("--crease {} --geometry {}", treatment.crease, treatment.precision)
}

/// The damage to a scene file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum Damage {
    #[error("its beginning is damaged")]
    Head,
    #[error("it has {of_file} bytes in place of {expected}")]
    Length { of_file: u64, expected: u64 },
    #[error("its megabyte number {} is damaged", .0 + 1)]
    Chunk(usize),
    #[error("its part \"{0}\" is damaged")]
    Content(&'static str),
}
