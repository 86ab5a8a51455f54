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
use renderer::{cli::scene_args::SceneArgs, server::connect::local_name};

use super::restart::next_delay;
use crate::farm::LocalReporter;

/// A process closes its pipes a moment before its status can be read: how often that is tried, and how long apart.
const STATUS_TRIES: u32 = 100;
const STATUS_PAUSE: Duration = Duration::from_millis(10);

/// Render servers that end with the wall, and start again when they die.
#[derive(Debug)]
pub struct LocalServers {
    program: PathBuf,
    wall: SocketAddr,
    key: Option<PathBuf>,
    scene: SceneArgs,
    children: Vec<Arc<Mutex<Child>>>,
    /// Tells the farm what becomes of them.
    reporter: Option<LocalReporter>,
    /// Whether the wall ends them.
    are_ending: Arc<AtomicBool>,
}

impl LocalServers {
    /// Starts `n_servers` that share this machine's cores and memory, and tells the farm about them.
    pub fn start(&mut self, n_servers: u32, reporter: LocalReporter) -> anyhow::Result<()> {
        self.reporter = Some(reporter);
        if n_servers > 0 {
            self.scene.log_budget(n_servers);
            self.scene = self.scene.shared_by(n_servers);
        }
        let n_cores = thread::available_parallelism().map_or(1, usize::from) as u32;
        (0..n_servers).try_for_each(|_| self.add((n_cores / n_servers).max(1)))
    }

    /// None yet; they will connect to the wall at `address`, with its key file if it has one.
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
            reporter: None,
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
        let name = local_name(self.children.len() + 1);
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
        let watched =
            Watched { name, child, are_ending: Arc::clone(&self.are_ending), reporter: self.reporter.clone() };
        watched.report_start();
        let watch = move || watched.keep_running(command);
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

/// A render server under the eye of its thread.
struct Watched {
    name: String,
    child: Arc<Mutex<Child>>,
    are_ending: Arc<AtomicBool>,
    reporter: Option<LocalReporter>,
}

impl Watched {
    /// Starts it again whenever it dies, until it ends in another way, which its own lines explain, or the wall ends.
    fn keep_running(&self, mut command: Command) {
        let name = &self.name;
        let mut last_delay = None;
        loop {
            let (started_at, oom_kills) = (Instant::now(), oom_kills());
            let status = wait_for_end(&self.child);
            if self.are_ending.load(Relaxed) {
                return;
            }
            let Some(death) = status.and_then(|status| death(status, [oom_kills, self::oom_kills()])) else {
                let status = status.map_or_else(String::new, |status| format!(" ({status})"));
                return self.report_end(format!(
                    "{name} ended{status} and stays away: the log says why; start the wall again to have it back."
                ));
            };
            let delay = next_delay(last_delay, started_at.elapsed());
            last_delay = Some(delay);
            let seconds = delay.as_secs();
            tracing::warn!("render server {name} {death}; it starts again in {seconds} s");
            self.report_end(format!("{name} {death}. It starts again in {seconds} s."));
            thread::sleep(delay);
            let mut child = locked(&self.child);
            // Read under the lock: the wall's end kills the child that is there then.
            if self.are_ending.load(Relaxed) {
                return;
            }
            match command.spawn() {
                Ok(started) => *child = started,
                Err(error) => {
                    tracing::error!("render server {name} cannot be started again: {error}");
                    return self.report_end(format!("{name} cannot be started again: {error}."));
                }
            }
            self.report_start();
        }
    }

    fn report_start(&self) {
        self.reporter.iter().for_each(|reporter| reporter.started(&self.name));
    }

    fn report_end(&self, text: String) {
        if let Some(reporter) = &self.reporter {
            reporter.ended(&self.name, text);
        }
    }
}

/// The likely cause of a kill, and its cure, given how often the system had killed for lack of memory before and after.
fn cause_of_kill(before: Option<u64>, after: Option<u64>) -> String {
    let is_known = before.zip(after).is_some_and(|(before, after)| after > before);
    let (cause, if_so) =
        if is_known { (" because memory ran out", "") } else { (", perhaps because memory ran out", "if so, ") };
    format!(
        "{cause}: {if_so}lower --memory-budget or --local, show a model of fewer triangles, or use a machine with more memory"
    )
}

/// How often the system has killed a process for lack of memory since it started, on Linux. Other programs kill too:
/// without a count that has grown, memory is only a guess.
fn oom_kills() -> Option<u64> {
    let counts = std::fs::read_to_string("/proc/vmstat").ok()?;
    counts.lines().find_map(|line| line.strip_prefix("oom_kill "))?.trim().parse().ok()
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

/// The exit status of a program that panics.
const PANICKED: i32 = 101;

/// Signals: the second has other numbers on other systems.
const SIGKILL: i32 = 9;
const SIGBUS: i32 = if cfg!(target_os = "linux") { 7 } else { 10 };

/// The cause of a process's death, which another may survive; `None` if it ended by itself. Linux sends SIGKILL when memory runs
/// out, and SIGBUS when a mapped file is cut.
fn death(status: ExitStatus, oom_kills: [Option<u64>; 2]) -> Option<String> {
    match signal(status) {
        Some(SIGKILL) => Some(format!("was killed{}", cause_of_kill(oom_kills[0], oom_kills[1]))),
        Some(SIGBUS) => Some("lost a file that it had mapped".to_owned()),
        _ => (status.code() == Some(PANICKED)).then(|| "crashed: the log says where".to_owned()),
    }
}

/// The signal that ended a process.
fn signal(status: ExitStatus) -> Option<i32> {
    #[cfg(unix)]
    return std::os::unix::process::ExitStatusExt::signal(&status);
    #[cfg(not(unix))]
    return None;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_the_cause_only_if_the_system_says_so() {
        let known = cause_of_kill(Some(3), Some(4));
        assert!(known.starts_with(" because memory ran out: lower --memory-budget"), "{known}");
        for (before, after) in [(Some(4), Some(4)), (None, Some(4)), (None, None)] {
            let guessed = cause_of_kill(before, after);
            assert!(guessed.starts_with(", perhaps because memory ran out: if so, lower"), "{guessed}");
        }
    }
}
