//! Render servers that answer at once, for measurements of the wall and its links.

use std::{
    net::SocketAddr,
    path::PathBuf,
    process::{Child, Command},
};

use anyhow::Context;

/// What they are and where they run.
#[derive(clap::Args)]
pub(crate) struct BlankArgs {
    /// They answer with this picture in place of noise
    #[arg(long, value_name = "FILE.png")]
    pub(crate) replay: Option<PathBuf>,
    /// Where to listen; in a network namespace, say, with a link of so many Mbit/s
    #[arg(long, default_value = "127.0.0.1:0")]
    pub(crate) listen: SocketAddr,
    /// What to start render servers with, such as "ip netns exec other"
    #[arg(long, default_value = "")]
    pub(crate) through: String,
}

/// Render servers, until this is dropped.
pub(crate) struct BlankServers(pub(crate) Vec<Child>);

impl BlankServers {
    /// Starts so many for the wall at `address`, each with one thread.
    pub(crate) fn start(n_servers: u32, address: SocketAddr, args: &BlankArgs) -> anyhow::Result<Self> {
        let example = std::env::current_exe()?;
        let folder = example.parent().and_then(|examples| examples.parent()).context("an example lies in a folder")?;
        let program = folder.join("renderer").display().to_string();
        let mut servers = Self(vec![]);
        for number in 1..=n_servers {
            let mut words = args.through.split_whitespace().chain([program.as_str()]);
            let mut command = Command::new(words.next().context("there is the program at least")?);
            command.args(words).args(["connect", &address.to_string(), "--insecure", "--threads", "1"]);
            match &args.replay {
                Some(picture) => command.arg("--replay").arg(picture),
                None => command.arg("--blank"),
            };
            command.args(["--name", &format!("blank-{number}")]).env("RUST_LOG", "warn");
            servers.0.push(command.spawn().context("the program `renderer` is not built: cargo build --release")?);
        }
        Ok(servers)
    }
}

impl Drop for BlankServers {
    fn drop(&mut self) {
        for server in &mut self.0 {
            let _ = server.kill();
            let _ = server.wait();
        }
    }
}
