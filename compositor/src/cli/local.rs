//! Render servers on the wall's own machine: processes of the wall's own program, connected over TCP like all others.

use std::{
    net::SocketAddr,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
};

use anyhow::Context;
use renderer::cli::scene_args::SceneArgs;

/// Render servers that end with the wall.
#[derive(Debug)]
pub struct LocalServers {
    program: PathBuf,
    wall: SocketAddr,
    key: Option<PathBuf>,
    scene: SceneArgs,
    children: Vec<Child>,
}

impl LocalServers {
    /// Starts `n_servers` that share this machine's cores and connect to the wall at `address`, with its key file if it has
    /// one.
    pub fn start(n_servers: u32, address: SocketAddr, key: Option<&Path>, scene: &SceneArgs) -> anyhow::Result<Self> {
        let mut servers = Self::empty(address, key, scene)?;
        let n_cores = std::thread::available_parallelism().map_or(1, usize::from) as u32;
        (0..n_servers).try_for_each(|_| servers.add((n_cores / n_servers).max(1)))?;
        Ok(servers)
    }

    /// None yet.
    pub fn empty(address: SocketAddr, key: Option<&Path>, scene: &SceneArgs) -> anyhow::Result<Self> {
        let program = std::env::current_exe().context("the path of this program is unknown")?;
        // A wall that listens on every address is reached on loopback.
        let ip = if address.ip().is_unspecified() { loopback_like(address) } else { address.ip() };
        let wall = SocketAddr::new(ip, address.port());
        Ok(Self { program, wall, key: key.map(Path::to_owned), scene: *scene, children: Vec::new() })
    }

    /// Starts one more, with `n_threads`.
    pub fn add(&mut self, n_threads: u32) -> anyhow::Result<()> {
        let mut command = Command::new(&self.program);
        command.args(["renderer", "connect", &self.wall.to_string(), "--local"]);
        match &self.key {
            Some(key) => command.arg("--key").arg(key),
            // The wall may listen on an address of this machine that is not loopback.
            None => command.arg("--insecure"),
        };
        let child = command
            .args(["--name", &format!("local-{}", self.children.len() + 1)])
            .args(self.scene.to_arguments())
            .args(["--threads", &n_threads.to_string()])
            // Open as long as this process lives: render servers end with their standard input.
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .with_context(|| format!("cannot start a local render server ({})", self.program.display()))?;
        self.children.push(child);
        Ok(())
    }
}

impl Drop for LocalServers {
    fn drop(&mut self) {
        for child in &mut self.children {
            // Killing fails for one that has already ended.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

fn loopback_like(address: SocketAddr) -> std::net::IpAddr {
    if address.is_ipv4() { std::net::Ipv4Addr::LOCALHOST.into() } else { std::net::Ipv6Addr::LOCALHOST.into() }
}
