//! Measures how long a wall takes from an action of a remote to the frame that shows it, and how many remotes change that.
//!
//!     target/release/compositor --size 1024x512 --local 0 --listen 127.0.0.1:7117 --remote 127.0.0.1:7180 &
//!     target/release/renderer connect 127.0.0.1:7117 --insecure --blank &
//!     cargo run --release -p lab --example remote_delay -- 127.0.0.1:7180
//!
//! One remote alone and a crowd alternate, so that a busy machine slows both alike. Everybody in the crowd looks at the live
//! picture. Times are from before an action is sent until the wall's word is received that its frame is on screen.

use std::{
    io::{Read, Write},
    net::{SocketAddr, TcpStream},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

use anyhow::Context;
use clap::Parser;
use lab::statistics::{milliseconds, quantiles};
use serde_json::Value;
use tungstenite::{Message, WebSocket, client::IntoClientRequest};

/// Measures how a wall follows remotes
#[derive(Parser)]
struct Args {
    /// The address of a running wall's remote
    remote: SocketAddr,
    /// Remotes in the crowd
    #[arg(long, default_value_t = 100)]
    remotes: u32,
    /// Remotes of the crowd that steer
    #[arg(long, default_value_t = 10)]
    steering: u32,
    /// Actions a second of each remote that steers
    #[arg(long, default_value_t = 60.0)]
    rate: f64,
    /// Seconds of each round
    #[arg(long, default_value_t = 4.0)]
    seconds: f64,
    /// Rounds of one remote alone, and of the crowd
    #[arg(long, default_value_t = 5)]
    rounds: u32,
}

fn main() -> anyhow::Result<()> {
    let args: Args = renderer::cli::parse();
    println!("{:<34}{:>10}{:>9}{:>9}{:>10}", "from an action to its frame", "actions", "p50 ms", "p99 ms", "frames/s");
    let cases = [("one remote", 1, 1), ("crowd", args.remotes, args.steering)];
    let mut measured = cases.map(|_| (Vec::new(), 0.0));
    for _ in 0..args.rounds {
        for ((_, n_remotes, n_steering), (delays_ms, n_frames)) in cases.iter().zip(&mut measured) {
            let (delays, frames) = round(&args, *n_remotes, *n_steering)?;
            delays_ms.extend(delays);
            *n_frames += frames;
        }
    }
    for ((name, n_remotes, n_steering), (delays_ms, n_frames)) in cases.iter().zip(measured) {
        let (n_delays, rate) = (delays_ms.len(), n_frames / (f64::from(args.rounds) * args.seconds));
        let [p50, p99] = quantiles(delays_ms, [0.5, 0.99]);
        let case = format!("{name}: {n_remotes}, {n_steering} steering");
        println!("{case:<34}{n_delays:>10}{p50:>9.1}{p99:>9.1}{rate:>10.1}");
    }
    Ok(())
}

/// One round: the delays in milliseconds, and the frames that the wall has shown.
fn round(args: &Args, n_remotes: u32, n_steering: u32) -> anyhow::Result<(Vec<f64>, f64)> {
    let ends = Arc::new(AtomicBool::new(false));
    let start = |index| {
        let interval = (index < n_steering).then(|| Duration::from_secs_f64(1.0 / args.rate));
        Remote::start(args.remote, interval, Arc::clone(&ends))
    };
    let remotes: Vec<_> = (0..n_remotes).map(start).collect::<anyhow::Result<_>>()?;
    // Until all look.
    thread::sleep(Duration::from_millis(500));
    let before = frames_shown(args.remote)?;
    thread::sleep(Duration::from_secs_f64(args.seconds));
    let n_frames = frames_shown(args.remote)? - before;
    ends.store(true, Relaxed);
    let mut delays_ms = Vec::new();
    for remote in remotes {
        delays_ms.extend(remote.join().map_err(|_| anyhow::anyhow!("a remote has failed"))??);
    }
    Ok((delays_ms, n_frames))
}

/// The wall's counter.
fn frames_shown(remote: SocketAddr) -> anyhow::Result<f64> {
    let mut stream = TcpStream::connect(remote)?;
    write!(stream, "GET /metrics HTTP/1.1\r\nHost: {remote}\r\n\r\n")?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer)?;
    let value = answer.split("\nraywall_frames_shown_total ").nth(1).and_then(|rest| rest.lines().next());
    Ok(value.context("the wall has no such figure")?.trim().parse()?)
}

struct Remote {
    socket: WebSocket<TcpStream>,
    /// When actions were sent that are not shown yet, by their tags.
    sent: Vec<(u64, Instant)>,
    delays_ms: Vec<f64>,
}

impl Remote {
    /// A remote that looks at the live picture, and steers if it has an interval; it returns its delays in milliseconds.
    fn start(
        remote: SocketAddr,
        interval: Option<Duration>,
        ends: Arc<AtomicBool>,
    ) -> anyhow::Result<JoinHandle<anyhow::Result<Vec<f64>>>> {
        let stream = TcpStream::connect(remote)?;
        stream.set_nodelay(true)?;
        let mut request = format!("ws://{remote}/api/socket").into_client_request()?;
        request.headers_mut().insert("Sec-WebSocket-Protocol", "raywall".parse()?);
        let (socket, _) = tungstenite::client(request, stream).context("the wall lets no remote in")?;
        let mut remote = Self { socket, sent: Vec::new(), delays_ms: Vec::new() };
        remote.socket.send(Message::text(r#"{"do":"watch","pictures":true}"#))?;
        Ok(thread::spawn(move || {
            let mut next_at = Instant::now();
            let mut tag = 0_u64;
            while !ends.load(Relaxed) {
                if let Some(interval) = interval.filter(|_| Instant::now() >= next_at) {
                    tag += 1;
                    // There and back, so that the camera stays where it is.
                    let x = if tag % 120 < 60 { 0.004 } else { -0.004 };
                    remote.sent.push((tag, Instant::now()));
                    remote.socket.send(Message::text(format!(r#"{{"do":"orbit","x":{x},"y":0,"tag":{tag}}}"#)))?;
                    next_at += interval;
                }
                let wait = interval.map_or(Duration::from_millis(100), |_| next_at - Instant::now().min(next_at));
                remote.hear(wait.max(Duration::from_micros(200)))?;
            }
            Ok(remote.delays_ms)
        }))
    }

    /// Hears one message, if one comes in time.
    fn hear(&mut self, wait: Duration) -> anyhow::Result<()> {
        self.socket.get_ref().set_read_timeout(Some(wait))?;
        let message = match self.socket.read() {
            Ok(message) => message,
            Err(tungstenite::Error::Io(_)) => return Ok(()),
            Err(error) => return Err(error.into()),
        };
        let Message::Text(text) = message else { return Ok(()) };
        if !text.starts_with(r#"{"shown""#) {
            return Ok(());
        }
        let shown: Value = serde_json::from_str(&text)?;
        let index = self.sent.iter().position(|(tag, _)| shown["shown"] == *tag);
        if let Some((_, sent_at)) = index.map(|index| self.sent.swap_remove(index)) {
            self.delays_ms.push(milliseconds(sent_at.elapsed()));
        }
        Ok(())
    }
}
