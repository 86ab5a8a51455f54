//! stub
use crate::model::{companions::Companions, file::Draft};
use std::io::BufRead;
/// stub
#[derive(Debug, thiserror::Error)]
pub enum Problem {
    /// stub
    #[error("glTF and GLB are not read yet: export PLY, OBJ or STL")]
    Stub,
}
/// stub
pub fn read_text(_: impl BufRead, _: u64, _: &Companions) -> Result<Draft, Problem> {
    Err(Problem::Stub)
}
/// stub
pub fn read_binary(_: impl BufRead, _: u64, _: &Companions) -> Result<Draft, Problem> {
    Err(Problem::Stub)
}
