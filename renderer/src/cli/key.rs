//! `renderer key`: makes the key that a wall and its render servers share.

use std::path::PathBuf;

use channel::key::Key;

use crate::cli::say;

/// Where to write the key.
#[derive(Clone, Debug, clap::Args)]
pub struct KeyArgs {
    /// The file to write; an existing file is never overwritten
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
}

/// Makes a key file and prints what to do with it.
///
/// # Errors
/// The file exists already, or cannot be written.
pub fn run(args: &KeyArgs) -> anyhow::Result<()> {
    Key::random()?.write(&args.file)?;
    let file = args.file.display();
    say(format_args!(
        "wrote {file}: copy it to the wall and to every render server (scp -p), and start both with --key {file}"
    ))
}
