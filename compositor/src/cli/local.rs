//! Render servers on the wall's own machine: processes of the wall's own program, connected over TCP like all others.

use std::{
    io,
    net::SocketAddr,
    path::{Path, PathBuf},
    process::{Child, ChildStdout, Command, ExitStatus, Stdio},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    thread,
    time::{Duration, Instant},
};

use anyhow::Context;
use renderer::cli::scene_args::SceneArgs;

use super::restart::next_delay;

/// A process closes its pipes a moment before its status can be read: how often that is tried, and how long apart.
const STATUS_TRIES: u32 = 100;
const STATUS_PAUSE: Duration = Duration::from_millis(10);

/// Render servers that end with the wall, and start again when they are killed.
#[derive(Debug)]
pub struct LocalServers {
    program: PathBuf,
    wall: SocketAddr,
    key: Option<PathBuf>,
    scene: SceneArgs,
    children: Vec<Arc<Mutex<Child>>>,
    /// Whether the wall ends them.
    are_ending: Arc<AtomicBool>,
}

impl LocalServers {
    /// Starts `n_servers` that share this machine's cores and connect to the wall at `address`, with its key file if it has
    /// one.
    pub fn start(n_servers: u32, address: SocketAddr, key: Option<&Path>, scene: &SceneArgs) -> anyhow::Result<Self> {
        let mut servers = Self::empty(address, key, scene)?;
        let n_cores = thread::available_parallelism().map_or(1, usize::from) as u32;
        (0..n_servers).try_for_each(|_| servers.add((n_cores / n_servers).max(1)))?;
        Ok(servers)
    }

    /// None yet.
    pub fn empty(address: SocketAddr, key: Option<&Path>, scene: &SceneArgs) -> anyhow::Result<Self> {
        let program = std::env::current_exe().context("the path of this program is unknown")?;
        // A wall that listens on every address is reached on loopback.
        let ip = if address.ip().is_unspecified() { loopback_like(address) } else { address.ip() };
        let wall = SocketAddr::new(ip, address.port());
        Ok(Self {
            program,
            wall,
            key: key.map(Path::to_owned),
            scene: *scene,
            children: Vec::new(),
            are_ending: Arc::default(),
        })
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
        let name = format!("local-{}", self.children.len() + 1);
        command
            .args(["--name", &name])
            .args(self.scene.to_arguments())
            .args(["--threads", &n_threads.to_string()])
            // Open as long as this process lives: render servers end with their standard input.
            .stdin(Stdio::piped())
            // It prints nothing there; the pipe's end tells that it has ended.
            .stdout(Stdio::piped());
        let child = command
            .spawn()
            .with_context(|| format!("cannot start a local render server ({})", self.program.display()))?;
        let child = Arc::new(Mutex::new(child));
        self.children.push(Arc::clone(&child));
        let are_ending = Arc::clone(&self.are_ending);
        let watch = move || keep_running(&name, &child, command, &are_ending);
        thread::Builder::new().name("local".to_owned()).spawn(watch).context("cannot watch a local render server")?;
        Ok(())
    }
}

impl Drop for LocalServers {
    fn drop(&mut self) {
        self.are_ending.store(true, Relaxed);
        for child in &self.children {
            let mut child = locked(child);
            // Killing fails for one that has already ended.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

fn loopback_like(address: SocketAddr) -> std::net::IpAddr {
    if address.is_ipv4() { std::net::Ipv4Addr::LOCALHOST.into() } else { std::net::Ipv6Addr::LOCALHOST.into() }
}

/// Starts a render server again whenever it was killed, until it ends in another way, which its own lines explain, or
/// the wall ends.
fn keep_running(name: &str, child: &Mutex<Child>, mut command: Command, are_ending: &AtomicBool) {
    let mut last_delay = None;
    loop {
        let started_at = Instant::now();
        let status = wait_for_end(child);
        if are_ending.load(Relaxed) || !status.is_some_and(was_killed) {
            return;
        }
        let delay = next_delay(last_delay, started_at.elapsed());
        last_delay = Some(delay);
        tracing::warn!(
            "render server {name} was killed, most likely by the system because memory ran out, and restarts in {} s: \
             lower --memory-budget or --local, show a model of fewer triangles, or use a machine with more memory",
            delay.as_secs()
        );
        thread::sleep(delay);
        let mut child = locked(child);
        // Read under the lock: the wall's end kills the child that is there then.
        if are_ending.load(Relaxed) {
            return;
        }
        match command.spawn() {
            Ok(started) => *child = started,
            Err(error) => return tracing::error!("render server {name} cannot be started again: {error}"),
        }
    }
}

fn locked(child: &Mutex<Child>) -> MutexGuard<'_, Child> {
    child.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Waits for the end of a child by its pipe; `None` if its status cannot be read.
fn wait_for_end(child: &Mutex<Child>) -> Option<ExitStatus> {
    let mut pipe: ChildStdout = locked(child).stdout.take()?;
    // An error is an end too.
    let _ = io::copy(&mut pipe, &mut io::sink());
    (0..STATUS_TRIES).find_map(|_| {
        let status = locked(child).try_wait();
        status.ok().flatten().or_else(|| {
            thread::sleep(STATUS_PAUSE);
            None
        })
    })
}

/// Whether the process was ended by SIGKILL: Linux sends it when memory runs out.
fn was_killed(status: ExitStatus) -> bool {
    #[cfg(unix)]
    return std::os::unix::process::ExitStatusExt::signal(&status) == Some(9);
    #[cfg(not(unix))]
    return false;
}
