//! Render servers on the wall's own machine: processes of the wall's own program, over real TCP like all others.

use std::{
    net::SocketAddr,
    path::Path,
    process::{Child, Command, Stdio},
};

use anyhow::Context;
use renderer::scene_args::SceneArgs;

/// Render servers that end with the wall.
#[derive(Debug, Default)]
pub struct LocalServers {
    children: Vec<Child>,
}

impl LocalServers {
    /// Starts `n_servers` that share this machine's cores, connect to a wall at `address` with its key file, if it has
    /// one, and make scenes ready as `scene` says.
    pub fn start(n_servers: u32, address: SocketAddr, key: Option<&Path>, scene: &SceneArgs) -> anyhow::Result<Self> {
        let mut servers = Self::default();
        let program = std::env::current_exe().context("this program does not know where it lies")?;
        let n_cores = std::thread::available_parallelism().map_or(1, usize::from) as u32;
        // A wall that listens on every address is reached on loopback.
        let ip = if address.ip().is_unspecified() { loopback_like(address) } else { address.ip() };
        let address = SocketAddr::new(ip, address.port());
        for number in 1..=n_servers {
            let mut command = Command::new(&program);
            command.args(["renderer", "connect", &address.to_string(), "--local"]);
            match key {
                Some(key) => command.arg("--key").arg(key),
                // The wall may listen on an address of this machine that is not loopback.
                None => command.arg("--insecure"),
            };
            let child = command
                .args(["--name", &format!("local-{number}")])
                .args(scene.to_arguments())
                .args(["--threads", &(n_cores / n_servers).max(1).to_string()])
                // Held open as long as this process lives: its end is theirs.
                .stdin(Stdio::piped())
                .stdout(Stdio::null())
                .spawn()
                .with_context(|| format!("cannot start a local render server ({})", program.display()))?;
            servers.children.push(child);
        }
        Ok(servers)
    }
}

impl Drop for LocalServers {
    fn drop(&mut self) {
        for child in &mut self.children {
            // One that has ended by itself is only waited for.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

fn loopback_like(address: SocketAddr) -> std::net::IpAddr {
    if address.is_ipv4() { std::net::Ipv4Addr::LOCALHOST.into() } else { std::net::Ipv6Addr::LOCALHOST.into() }
}
