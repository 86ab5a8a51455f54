//! Keeps a wall alive that fills its screens: this program once more, started again whenever it dies.
//!
//! The process that was started is the guard; the wall is its child, and [`SupervisorLink`] the guard's ear in it. Between them is
//! one socket, the child's standard input: the child tells of its windows and of its first frame, and when either ends,
//! the other sees the end of the socket. While there is no wall, a [`cover::DesktopCover`] hides the desktop.

mod cover;
mod restart_delay;
mod ward;

use std::{
    io::{BufRead, BufReader},
    net::Shutdown,
    os::{fd::OwnedFd, unix::net::UnixStream},
    process::{Child, Command, ExitStatus, Stdio},
    sync::mpsc::{self, RecvTimeoutError},
    thread,
    time::{Duration, Instant},
};

use anyhow::Context;

use self::{
    cover::{DesktopCover, WallWindow, XDesktop},
    restart_delay::RestartDelay,
};
use crate::wall::OnLoss;

pub use self::ward::SupervisorLink;

/// Whether walls can have one.
pub const IS_SUPPORTED: bool = true;

/// The picture may reach the screen a little later than the word that it is there.
const COVER_LINGER: Duration = Duration::from_millis(250);

/// While a new window opens beneath it, the cover is put on top so often.
const RAISE_INTERVAL: Duration = Duration::from_millis(50);

/// A wall that is told to end has this long to do so.
const STOP_TIMEOUT: Duration = Duration::from_secs(10);

/// What a guard hears.
#[derive(Debug)]
enum Event {
    /// Somebody wants all to end.
    Stop,
    /// The wall has a window, by the X server's number.
    Window(u32),
    /// The wall's first frame is on screen.
    Shown,
    /// The wall has ended.
    Ended,
}

/// Runs the wall with the arguments of this process until it ends in order, or by a fault before it has shown anything.
///
/// `on_loss` is what is seen from another end of the wall until it is back. If the wall ends with a code that is not 0,
/// having said why, this process ends with the same.
///
/// # Errors
///
/// The wall cannot be started, or was killed before it had shown anything.
pub fn run(on_loss: OnLoss) -> anyhow::Result<()> {
    let (events_sender, events) = mpsc::channel();
    listen_for_signals(events_sender.clone())?;
    let desktop = XDesktop::connect();
    let mut guard =
        Supervisor { on_loss, desktop, events_sender, events, cover: None, has_shown: false, is_stopping: false };
    let mut restart_delay = RestartDelay::default();
    loop {
        let (status, shown_for) = guard.run_child()?;
        if guard.is_stopping || status.success() || !guard.has_shown {
            match status.code() {
                Some(0) => return Ok(()),
                Some(code) => std::process::exit(code),
                None => anyhow::bail!("the wall was killed ({status})"),
            }
        }
        let pause = restart_delay.next_delay(shown_for);
        tracing::error!("the wall has died ({status}) and is started again in {} s", pause.as_secs());
        let resume_at = Instant::now() + pause;
        while Instant::now() < resume_at {
            if let Some(Event::Stop) = guard.next_event(Some(resume_at)) {
                return Ok(());
            }
        }
    }
}

struct Supervisor {
    on_loss: OnLoss,
    /// `None` where desktops cannot be covered.
    desktop: Option<XDesktop>,
    events_sender: mpsc::Sender<Event>,
    events: mpsc::Receiver<Event>,
    cover: Option<DesktopCover>,
    /// Whether any wall has shown a frame.
    has_shown: bool,
    is_stopping: bool,
}

impl Supervisor {
    /// Starts a wall and waits for its end; if that was no orderly one, the desktop is hidden. Also says how long frames
    /// were shown.
    fn run_child(&mut self) -> anyhow::Result<(ExitStatus, Duration)> {
        let (mut child, link) = self.start()?;
        let mut windows: Vec<WallWindow> = Vec::new();
        let (mut shown_at, mut kill_at): (Option<Instant>, Option<Instant>) = (None, None);
        loop {
            let raise_at = self.cover.as_ref().map(|_| Instant::now() + RAISE_INTERVAL);
            match self.next_event(kill_at.into_iter().chain(raise_at).min()) {
                Some(Event::Stop) => {
                    self.is_stopping = true;
                    kill_at = Some(Instant::now() + STOP_TIMEOUT);
                    // One that has ended a moment before needs no word.
                    let _ = link.shutdown(Shutdown::Write);
                }
                Some(Event::Window(id)) => windows.push(WallWindow { id, rect: None }),
                Some(Event::Shown) => {
                    self.has_shown = true;
                    shown_at = Some(Instant::now());
                    self.desktop.iter().for_each(|desktop| desktop.find(&mut windows));
                }
                Some(Event::Ended) => break,
                None => {}
            }
            if shown_at.is_some_and(|shown_at| shown_at.elapsed() >= COVER_LINGER) {
                self.cover = None;
            } else if let Some(cover) = self.cover.as_ref().filter(|_| !windows.is_empty()) {
                cover.raise();
            }
            if kill_at.is_some_and(|kill_at| Instant::now() >= kill_at) {
                tracing::warn!("the wall does not end, and is killed");
                child.kill().context("the wall cannot be killed")?;
                kill_at = None;
            }
        }
        let status = child.wait().context("the wall cannot be waited for")?;
        if let Some(desktop) = &self.desktop
            && !self.is_stopping
            && !status.success()
            && self.has_shown
        {
            if self.cover.is_none() {
                self.cover = desktop.cover(&windows, self.on_loss);
            }
            desktop.forget(&windows);
        }
        Ok((status, shown_at.map_or(Duration::ZERO, |shown_at| shown_at.elapsed())))
    }

    /// What happens next, if it does before a moment.
    fn next_event(&self, before: Option<Instant>) -> Option<Event> {
        let Some(before) = before else {
            return Some(self.events.recv().expect("this guard can tell itself"));
        };
        match self.events.recv_timeout(before.saturating_duration_since(Instant::now())) {
            Ok(event) => Some(event),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => unreachable!("this guard can tell itself"),
        }
    }

    /// Starts the wall, and a thread that hears it.
    fn start(&self) -> anyhow::Result<(Child, UnixStream)> {
        let (link, childs_end) = UnixStream::pair().context("no socket for the wall")?;
        let child_output = link.try_clone().context("no socket for the wall")?;
        let program = std::env::current_exe().context("this program does not know where it lies")?;
        let child = Command::new(program)
            .args(std::env::args_os().skip(1))
            .env(ward::GUARDED, "1")
            .stdin(Stdio::from(OwnedFd::from(childs_end)))
            .spawn()
            .context("the wall does not start")?;
        tracing::info!("the wall is process {}; this one starts it again if it dies", child.id());
        let events_sender = self.events_sender.clone();
        let read_lines = move || {
            for line in BufReader::new(child_output).lines().map_while(Result::ok) {
                let event = match line.strip_prefix(ward::WINDOW) {
                    Some(id) => id.trim().parse().ok().map(Event::Window),
                    None => (line == ward::SHOWN).then_some(Event::Shown),
                };
                // The guard hears as long as it lives.
                event.into_iter().for_each(|event| drop(events_sender.send(event)));
            }
            drop(events_sender.send(Event::Ended));
        };
        thread::Builder::new().name("ear".to_owned()).spawn(read_lines).context("no thread to hear the wall")?;
        Ok((child, link))
    }
}

/// Has SIGTERM and Ctrl-C heard on a thread of their own.
fn listen_for_signals(events_sender: mpsc::Sender<Event>) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().context("no signals are heard")?;
    let listen = move || {
        while runtime.block_on(renderer::server::connect::stop_signal()).is_ok()
            && events_sender.send(Event::Stop).is_ok()
        {}
    };
    thread::Builder::new().name("signals".to_owned()).spawn(listen).context("no thread to hear signals")?;
    Ok(())
}
