//! `renderer connect`: serves a wall until told to stop, and reconnects when the wall restarts.

use std::{
    io,
    net::{IpAddr, SocketAddr},
    path::PathBuf,
    sync::Arc,
    time::Duration,
};

use anyhow::{Context, bail};
use channel::key::{Key, make_key_command};
use shared::protocol::{DEFAULT_PORT, LONGEST_NAME};
use tokio::{
    net::{TcpStream, lookup_host},
    time::{sleep, timeout},
};

use crate::{
    cli::scene_args::SceneArgs,
    render::threads,
    server::{
        scene_loader::SceneLoader,
        session::{self, SessionEnd},
        synthetic::SyntheticPicture,
    },
};

/// The pause before the first attempt to connect again; it doubles up to [`LONGEST_PAUSE`].
const SHORTEST_PAUSE: Duration = Duration::from_millis(100);

/// Short enough that a restarted wall gets its nodes back at once.
const LONGEST_PAUSE: Duration = Duration::from_secs(1);

/// Time limit of one attempt to connect.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// Connects to a wall and renders what it asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct ConnectArgs {
    /// The wall, as HOST or HOST:PORT
    #[arg(value_name = "HOST:PORT")]
    pub wall: String,
    /// The PLY file that the wall shows; needed where the wall's own path does not reach
    #[arg(long, value_name = "FILE")]
    pub model: Option<PathBuf>,
    /// Number of tracing threads [default: one for each core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// The name that the wall shows [default: this machine's name]
    #[arg(long, value_name = "NAME")]
    pub name: Option<String>,
    /// The wall's key file: talk only to a wall that has it, and encrypt everything
    #[arg(long, value_name = "FILE", conflicts_with = "insecure")]
    pub key: Option<PathBuf>,
    /// Talk to a wall on another machine without encryption or authentication
    #[arg(long)]
    pub insecure: bool,
    /// Options of the grid
    #[command(flatten)]
    pub scene: SceneArgs,
    /// Measure the wall alone: answer at once with noise, for any scene
    #[arg(long, conflicts_with_all = ["model", "replay"])]
    pub blank: bool,
    /// Measure the wall alone: answer at once with this picture, for any scene
    #[arg(long, value_name = "FILE.png", conflicts_with = "model")]
    pub replay: Option<PathBuf>,
    /// Set by a wall that starts a server on its own machine: read the files that it names, and end with it
    #[arg(long, hide = true)]
    pub local: bool,
}

/// Serves the wall until the process is told to stop, or, with `--local`, until the wall ends.
///
/// # Errors
/// The arguments cannot work.
pub fn run(args: ConnectArgs) -> anyhow::Result<()> {
    let name = name(args.name)?;
    let trust = match &args.key {
        Some(path) => TrustPolicy::Key(Key::read(path)?),
        None if args.insecure => TrustPolicy::Anyone,
        None => TrustPolicy::ThisMachine,
    };
    let pool = Arc::new(threads::pool(args.threads.map(|n| n as usize))?);
    let loader = match &args.replay {
        Some(picture) => SceneLoader::synthetic(pool, SyntheticPicture::read(picture)?),
        None if args.blank => SceneLoader::synthetic(pool, SyntheticPicture::noise()),
        None => SceneLoader::start(pool, args.model, args.scene.options(), args.local)?,
    };
    // This thread reads, writes and sends heartbeats; it never traces.
    let runtime = tokio::runtime::Builder::new_current_thread()
        .thread_name("work")
        .enable_all()
        .build()
        .context("cannot start the network")?;
    runtime.block_on(async {
        tokio::select! {
            ended = keep_connected(&args.wall, &trust, &name, &loader) => ended,
            signal = stop_signal() => signal.context("cannot listen for signals"),
            () = wait_for_stdin_end(), if args.local => Ok(()),
        }
    })
}

/// Which walls to trust.
#[derive(Debug)]
enum TrustPolicy {
    /// Walls on this machine, unencrypted.
    ThisMachine,
    /// Walls that have the key, encrypted.
    Key(Key),
    /// All walls, unencrypted: `--insecure`.
    Anyone,
}

impl TrustPolicy {
    fn key(&self) -> Option<&Key> {
        if let Self::Key(key) = self { Some(key) } else { None }
    }
}

async fn keep_connected(wall: &str, trust: &TrustPolicy, name: &str, loader: &SceneLoader) -> anyhow::Result<()> {
    let host = if wall.contains(':') { wall.to_owned() } else { format!("{wall}:{DEFAULT_PORT}") };
    let mut pause = SHORTEST_PAUSE;
    let mut last_failure = String::new();
    loop {
        let failure = match connect(&host, trust).await? {
            Ok(mut stream) => {
                let security = if trust.key().is_some() { "with a key" } else { "unencrypted" };
                tracing::info!("connected to the wall at {host}, {security}");
                let (input, output) = stream.split();
                let SessionEnd { was_accepted, reason } = session::run(input, output, trust.key(), name, loader).await;
                if was_accepted {
                    pause = SHORTEST_PAUSE;
                    last_failure.clear();
                }
                reason.map_or_else(|error| error.to_string(), |()| "the wall closed the connection".to_owned())
            }
            Err(error) => error.to_string(),
        };
        // Report a repeated failure once.
        if failure != last_failure {
            tracing::warn!("{host}: {failure}; trying again until it answers");
            last_failure = failure;
        }
        sleep(pause).await;
        pause = (pause * 2).min(LONGEST_PAUSE);
    }
}

/// Connects once. The outer error is permanent; the inner one may go away on another attempt.
async fn connect(host: &str, trust: &TrustPolicy) -> anyhow::Result<io::Result<TcpStream>> {
    let addresses: Vec<SocketAddr> = match lookup_host(host).await {
        Ok(addresses) => addresses.collect(),
        Err(error) if error.kind() == io::ErrorKind::InvalidInput => {
            bail!("\"{host}\" is not an address: write it as HOST:PORT, for example wall.example:{DEFAULT_PORT}")
        }
        Err(error) => return Ok(Err(error)),
    };
    if matches!(trust, TrustPolicy::ThisMachine)
        && let Some(address) = addresses.iter().find(|address| !is_loopback(address.ip()))
    {
        bail!(
            "{address} is another machine: give --key a copy of the wall's key file, which `{}` makes, \
             or add --insecure if you trust everybody on the network between",
            make_key_command("wall.key".as_ref())
        );
    }
    let connecting = timeout(CONNECT_TIMEOUT, TcpStream::connect(&*addresses)).await;
    let stream = connecting.unwrap_or_else(|_| Err(io::Error::new(io::ErrorKind::TimedOut, "no answer")));
    Ok(stream.inspect(limit_send_buffer))
}

/// Bytes in the send buffer cannot be cancelled: on a slow link, the next motion waits for them.
#[cfg(target_os = "linux")]
const MOST_UNSENT_BYTES: u32 = 16 * 1024;

/// Has the system send at once, and buffer little. If it refuses, latency is higher.
fn limit_send_buffer(stream: &TcpStream) {
    let _ = stream.set_nodelay(true);
    #[cfg(target_os = "linux")]
    let _ = socket2::SockRef::from(stream).set_tcp_notsent_lowat(MOST_UNSENT_BYTES);
}

fn is_loopback(address: IpAddr) -> bool {
    address.to_canonical().is_loopback()
}

fn name(given: Option<String>) -> anyhow::Result<String> {
    let name = given.unwrap_or_else(|| {
        let host_name = std::fs::read_to_string("/proc/sys/kernel/hostname").or_else(|_| std::env::var("COMPUTERNAME"));
        host_name.map_or_else(|_| "renderer".to_owned(), |name| name.trim().chars().take(16).collect())
    });
    if name.is_empty() || name.len() > LONGEST_NAME {
        bail!("--name \"{name}\": a name has 1 to {LONGEST_NAME} bytes");
    }
    Ok(name)
}

/// Waits for the end of standard input: a pipe that closes when the wall's process ends, even by a crash.
async fn wait_for_stdin_end() {
    let (ended, end) = tokio::sync::oneshot::channel();
    std::thread::spawn(move || {
        // The content does not matter, and an error is an end too.
        let _ = io::copy(&mut io::stdin(), &mut io::sink());
        let _ = ended.send(());
    });
    let _ = end.await;
}

/// Waits for Ctrl-C or, on Unix, SIGTERM.
pub async fn stop_signal() -> io::Result<()> {
    #[cfg(unix)]
    {
        let mut terminate = tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate())?;
        tokio::select! {
            interrupted = tokio::signal::ctrl_c() => interrupted,
            _ = terminate.recv() => Ok(()),
        }
    }
    #[cfg(not(unix))]
    tokio::signal::ctrl_c().await
}
