//! `renderer connect`: serves a wall until told to stop, and reconnects when the wall restarts.

use std::{
    io,
    net::{IpAddr, SocketAddr},
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use anyhow::{Context, bail};
use channel::{
    key::{Key, make_key_command},
    wire::is_same_machine,
};
use shared::protocol::{DEFAULT_PORT, LONGEST_NAME};
use tokio::{
    net::{TcpStream, lookup_host},
    sync::watch,
    time::{sleep, timeout},
};

use crate::{
    cli::{
        between,
        scene_args::SceneArgs,
        stop::{self, Signal},
    },
    grid::MemoryBudget,
    model::scene::SceneSource,
    render::threads,
    server::{
        discover::Search,
        fetch::Fetcher,
        scene_loader::{SceneLoader, Told},
        session::{self, SessionEnd, SessionError},
        synthetic::SyntheticPicture,
    },
};

/// The pause before the first attempt to connect again; it doubles up to [`LONGEST_PAUSE`].
const SHORTEST_PAUSE: Duration = Duration::from_millis(100);

/// Short enough that a restarted wall gets its nodes back at once.
const LONGEST_PAUSE: Duration = Duration::from_secs(1);

/// The longest pause while the wall refuses this server: it says so, and is not asked over and over.
const LONGEST_PAUSE_IF_REFUSED: Duration = Duration::from_secs(30);

/// Time limit of one attempt to connect.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// Connects to a wall and renders what it asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct ConnectArgs {
    /// The wall, as HOST or HOST:PORT [default: one in the network with the same key, once it is there]
    #[arg(value_name = "HOST:PORT", required_if_eq("local", "true"), value_parser = wall_address)]
    pub wall: Option<String>,
    /// The model's file that the wall shows: PLY, OBJ, STL, glTF or GLB, or a scene file of it [default: the wall's own
    /// file, if the wall runs on this machine; else its scene file is fetched from the wall]
    #[arg(long, value_name = "FILE")]
    pub model: Option<PathBuf>,
    /// The sky image that lights the wall [default: the wall's own file, if the wall runs on this machine]
    #[arg(long, value_name = "FILE")]
    pub sky: Option<PathBuf>,
    /// Number of tracing threads [default: one for each core]
    #[arg(long, value_name = "N", value_parser = between(1_u32..=1024))]
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
    /// Never fetch the model from the wall
    #[arg(long, conflicts_with = "fetch_limit")]
    pub no_fetch: bool,
    /// The largest scene file to fetch from the wall, for example 512M or 1.5G [default: half of the free disk, and no more
    /// than the cache may have]
    #[arg(long, value_name = "SIZE")]
    pub fetch_limit: Option<MemoryBudget>,
    /// Options of the grid
    #[command(flatten)]
    pub scene: SceneArgs,
    /// Measure the wall alone: answer at once with noise, for any scene
    #[arg(long, conflicts_with_all = ["model", "sky", "replay"])]
    pub blank: bool,
    /// Measure the wall alone: answer at once with this picture, for any scene
    #[arg(long, value_name = "FILE.png", conflicts_with_all = ["model", "sky"])]
    pub replay: Option<PathBuf>,
    /// Set by a wall that starts a server on its own machine: end with it
    #[arg(long, hide = true)]
    pub local: bool,
}

/// The name of one of the render servers that a wall starts; they are numbered from 1.
pub fn local_name(number: usize) -> String {
    format!("local-{number}")
}

/// Serves the wall until the process is told to stop, or, with `--local`, until the wall ends.
pub fn run(args: ConnectArgs) -> anyhow::Result<()> {
    let name = name(args.name)?;
    let key = args.key.as_deref().map(Key::read).transpose()?;
    let only_this_machine = key.is_none() && !args.insecure;
    let (stop, mut told_to_stop) = watch::channel(());
    stop::on_signal(move |signal| {
        // A terminal sends Ctrl-C to the wall too, and a local server ends with its wall.
        if !(args.local && signal == Signal::Interrupt) {
            stop.send_replace(());
        }
    });
    let wall = WallAddress::default();
    let search = args.wall.is_none().then(|| Search::new(args.insecure));
    args.wall.into_iter().for_each(|named| wall.set(named));
    let pool = Arc::new(threads::pool(args.threads.map(|n| n as usize))?);
    let loader = match &args.replay {
        Some(picture) => SceneLoader::synthetic(pool, SyntheticPicture::read(picture)?),
        None if args.blank => SceneLoader::synthetic(pool, SyntheticPicture::noise()),
        None => {
            // The wall has read the same file, and tells of it.
            let told = match args.local {
                false => Told::Everything,
                // All local servers have the same budget.
                true if name == local_name(1) => Told::Shortage,
                true => Told::Nothing,
            };
            if let (false, Some(path)) = (args.local, &args.model) {
                args.scene.warn_of_scene_file(&SceneSource::File(path.clone()));
            }
            args.scene.log_budget(1);
            // One that the wall has started has the wall's own file.
            let fetcher = (!args.no_fetch && !args.local).then(|| Fetcher {
                wall: wall.clone(),
                key: key.clone(),
                only_this_machine,
                limit: args.fetch_limit,
            });
            let files = (args.model, args.sky);
            SceneLoader::start(pool, files, args.scene.options(), args.scene.store(), told, fetcher)?
        }
    };
    // A local server ends with its wall, before it complains about the connection.
    let patience = if args.local { LONGEST_PAUSE } else { SHORTEST_PAUSE };
    // This thread reads, writes and sends heartbeats; it traces only probes and looks, a few rays each.
    let runtime = tokio::runtime::Builder::new_current_thread()
        .thread_name("work")
        .enable_all()
        .build()
        .context("cannot start the network")?;
    let ended = runtime.block_on(async {
        tokio::select! {
            ended = keep_connected(&wall, search, key.as_ref(), only_this_machine, &name, &loader, patience) => ended,
            _ = told_to_stop.changed() => match stop::unfinished() {
                // The wall speaks for its own servers.
                Some(stopped) if !args.local => Err(stopped.into()),
                _ => Ok(()),
            },
            () = wait_for_stdin_end(), if args.local => Ok(()),
        }
    });
    // Nobody waits for the chunks that are being rendered: with thousands of triangles in one place each takes seconds.
    runtime.shutdown_background();
    ended
}

/// HOST:PORT of the wall; of one that is looked for, empty until it was found.
#[derive(Clone, Debug, Default)]
pub(crate) struct WallAddress(Arc<Mutex<String>>);

impl WallAddress {
    pub(crate) fn get(&self) -> String {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn set(&self, address: String) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = address;
    }
}

/// Serves the wall at an address, or one after the other that a search finds.
async fn keep_connected(
    wall: &WallAddress,
    mut search: Option<Search>,
    key: Option<&Key>,
    only_this_machine: bool,
    name: &str,
    loader: &SceneLoader,
    patience: Duration,
) -> anyhow::Result<()> {
    let mut pause = SHORTEST_PAUSE;
    let mut last_failure = String::new();
    let mut has_ended = false;
    loop {
        let mut longest_pause = LONGEST_PAUSE;
        let mut found = None;
        if let Some(search) = &mut search {
            let address = search.next(key).await;
            wall.set(address.to_string());
            found = Some(address);
        }
        let host = wall.get();
        let mut is_joined = false;
        let ended = match connect(&host, only_this_machine).await? {
            Ok(mut stream) => {
                let security = if key.is_some() { "with a key" } else { "unencrypted" };
                let on_welcome = || {
                    tracing::info!("connected to the wall at {host}, {security}");
                    search.iter_mut().zip(found).for_each(|(search, address)| search.joined(address));
                };
                has_ended = false;
                let is_local = match (stream.local_addr(), stream.peer_addr()) {
                    (Ok(here), Ok(wall)) => is_same_machine(here, wall),
                    _ => false,
                };
                let (input, output) = stream.split();
                let SessionEnd { was_accepted, reason } =
                    session::run(input, output, key, name, loader, is_local, on_welcome).await;
                if matches!(reason, Err(SessionError::Refused(_))) {
                    longest_pause = LONGEST_PAUSE_IF_REFUSED;
                } else if was_accepted {
                    pause = SHORTEST_PAUSE;
                    last_failure.clear();
                }
                is_joined = was_accepted;
                match reason {
                    Err(error) if !(was_accepted && error.is_end()) => Err(error.to_string()),
                    _ => Ok(()),
                }
            }
            // Nothing new: a wall that has ended does not listen.
            Err(error) if has_ended && error.kind() == io::ErrorKind::ConnectionRefused => Ok(()),
            Err(error) => Err(error.to_string()),
        };
        if let (Some(search), Some(address), false) = (&mut search, found, is_joined) {
            search.failed(address);
        }
        sleep(patience).await;
        match ended {
            Ok(()) if has_ended => {}
            Ok(()) => {
                tracing::info!("the wall at {host} has closed the connection; trying again until it answers");
                has_ended = true;
            }
            // Report a repeated failure once.
            Err(failure) if failure != last_failure => {
                tracing::warn!("{host}: {failure}; trying again until it answers");
                last_failure = failure;
            }
            Err(_) => {}
        }
        sleep(pause.saturating_sub(patience)).await;
        pause = (pause * 2).min(longest_pause);
    }
}

/// HOST:PORT of the wall that an argument names. The error names the cause and the cure.
fn wall_address(named: &str) -> Result<String, String> {
    let address = with_port(named);
    let (host, port) = address.rsplit_once(':').unwrap_or((&address, ""));
    let cure = format!("write it as HOST or HOST:PORT, for example wall.example:{DEFAULT_PORT}");
    if host.is_empty() {
        return Err(format!("the wall has no name: {cure}"));
    }
    if !matches!(port.parse::<u16>(), Ok(1..)) {
        return Err(format!("no wall can be reached on port {port:?}: {cure}"));
    }
    Ok(address)
}

/// The address with a port: [`DEFAULT_PORT`] unless it names one.
pub fn with_port(wall: &str) -> String {
    match wall.trim_matches(['[', ']']).parse::<IpAddr>() {
        Ok(address) => SocketAddr::new(address, DEFAULT_PORT).to_string(),
        Err(_) if wall.contains(':') => wall.to_owned(),
        Err(_) => format!("{wall}:{DEFAULT_PORT}"),
    }
}

/// Connects once, to this machine or to any. The outer error is permanent; the inner one may go away on another attempt.
pub(super) async fn connect(host: &str, only_this_machine: bool) -> anyhow::Result<io::Result<TcpStream>> {
    let addresses: Vec<SocketAddr> = match lookup_host(host).await {
        Ok(addresses) => addresses.collect(),
        // The system's own words differ from one attempt to the next.
        Err(_) => {
            let told = "no machine of this name is known: check the name and this machine's network, or give the wall's address";
            return Ok(Err(io::Error::new(io::ErrorKind::NotFound, told)));
        }
    };
    if only_this_machine
        && let Some(address) = addresses.iter().find(|address| !address.ip().to_canonical().is_loopback())
    {
        bail!(
            "{address} is another machine: give --key a copy of the wall's key file{}, or add --insecure if you trust \
             everybody on the network between",
            match Path::new("wall.key").exists() {
                true => ", perhaps the wall.key that is here".to_owned(),
                false => format!(", which `{}` makes", make_key_command("wall.key".as_ref())),
            }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_name_is_told_in_plain_words_and_may_be_known_later() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let failure = runtime.block_on(connect("no-such-wall.invalid:7117", true)).unwrap().unwrap_err();
        assert!(failure.to_string().starts_with("no machine of this name is known: check the name"), "{failure}");
    }

    #[test]
    fn an_address_needs_no_port() {
        for (wall, address) in [
            ("wall.example", "wall.example:7117"),
            ("wall.example:80", "wall.example:80"),
            ("192.0.2.1", "192.0.2.1:7117"),
            ("::1", "[::1]:7117"),
            ("[::1]", "[::1]:7117"),
            ("[::1]:80", "[::1]:80"),
        ] {
            assert_eq!(wall_address(wall).unwrap(), address);
        }
    }

    #[test]
    fn an_address_where_no_wall_can_be_is_refused() {
        for (wall, cause) in [
            (":7117", "has no name"),
            ("wall.example:0", "port \"0\""),
            ("[::1]:00", "port \"00\""),
            ("wall.example:65536", "port \"65536\""),
            ("no port:here", "port \"here\""),
        ] {
            let error = wall_address(wall).unwrap_err();
            assert!(error.contains(cause) && error.contains("wall.example:7117"), "{error}");
        }
    }
}
