//! Restarts a full-screen wall when it crashes.
//!
//! Through its [`SupervisorLink`], a socket, the child reports its windows and its first frame. Between two children a
//! [`DesktopCover`] hides the desktop. ARCHITECTURE.md ("Supervisor") says more.

mod desktop_cover;
mod link;

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
use renderer::cli::stop;

use self::desktop_cover::{DesktopCover, WallWindow, XDesktop};
pub(crate) use self::link::SupervisorLink;
use crate::{cli::restart::next_delay, wall::OnLoss};

/// Whether this system has supervisors.
pub(crate) const IS_SUPPORTED: bool = true;

/// How long the cover stays after the report of the first frame, which may reach the screen a little later.
const COVER_LINGER: Duration = Duration::from_millis(250);

/// How often the cover is raised while new windows open beneath it.
const RAISE_INTERVAL: Duration = Duration::from_millis(50);

/// A child that does not end within this time after a stop request is killed.
const STOP_TIMEOUT: Duration = Duration::from_secs(10);

#[derive(Debug)]
enum Event {
    Stop,
    /// The child has opened the window with this X11 identifier.
    Window(u32),
    Shown,
    Ended,
}

/// Runs the wall as a child with the arguments of this process, and again after each crash that follows a frame.
///
/// `on_loss` decides what covers the desktop between a crash and the next first frame. If the child fails before its
/// first frame, this process exits with the same code; if it was killed, with an error.
pub(crate) fn run(on_loss: OnLoss) -> anyhow::Result<()> {
    let (events_sender, events) = mpsc::channel();
    stop::on_signal({
        let events_sender = events_sender.clone();
        // The receiver lives as long as the supervisor.
        move |_| drop(events_sender.send(Event::Stop))
    });
    let desktop = XDesktop::connect();
    let mut supervisor =
        Supervisor { on_loss, desktop, events_sender, events, cover: None, has_shown: false, is_stopping: false };
    let mut last_delay = None;
    loop {
        let (status, shown_for) = supervisor.run_child()?;
        if supervisor.is_stopping || status.success() || !supervisor.has_shown {
            match status.code() {
                Some(0) => return Ok(()),
                Some(code) => std::process::exit(code),
                None => anyhow::bail!("the wall was killed ({status})"),
            }
        }
        let delay = next_delay(last_delay, shown_for);
        last_delay = Some(delay);
        tracing::error!("the wall has died ({status}) and restarts in {} s", delay.as_secs());
        let resume_at = Instant::now() + delay;
        while Instant::now() < resume_at {
            if let Some(Event::Stop) = supervisor.next_event(Some(resume_at)) {
                return Ok(());
            }
        }
    }
}

struct Supervisor {
    on_loss: OnLoss,
    /// `None` without an X server, where the desktop stays visible.
    desktop: Option<XDesktop>,
    events_sender: mpsc::Sender<Event>,
    events: mpsc::Receiver<Event>,
    cover: Option<DesktopCover>,
    /// Whether any child has shown a frame.
    has_shown: bool,
    is_stopping: bool,
}

impl Supervisor {
    /// Starts a child, waits for its end, and covers the desktop after a crash. Returns its status, and how long it has
    /// shown frames.
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
                    // The child may have ended already.
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
                tracing::warn!("the wall does not end within {} s and is killed", STOP_TIMEOUT.as_secs());
                child.kill().context("cannot kill the wall")?;
                kill_at = None;
            }
        }
        let status = child.wait().context("cannot wait for the wall")?;
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

    /// The next event; `None` if none comes before a moment.
    fn next_event(&self, before: Option<Instant>) -> Option<Event> {
        let received = match before {
            Some(before) => self.events.recv_timeout(before.saturating_duration_since(Instant::now())),
            None => self.events.recv().map_err(|_| RecvTimeoutError::Disconnected),
        };
        match received {
            Err(RecvTimeoutError::Disconnected) => unreachable!("the supervisor holds a sender itself"),
            received => received.ok(),
        }
    }

    fn start(&self) -> anyhow::Result<(Child, UnixStream)> {
        let (link, child_link) = UnixStream::pair().context("cannot make a socket for the wall")?;
        let reports = link.try_clone().context("cannot make a socket for the wall")?;
        let program = std::env::current_exe().context("this program cannot find its own file")?;
        let child = Command::new(program)
            .args(std::env::args_os().skip(1))
            .env(link::SUPERVISED, "1")
            .stdin(Stdio::from(OwnedFd::from(child_link)))
            .spawn()
            .context("cannot start the wall")?;
        tracing::info!("the wall is process {}; this one restarts it if it dies", child.id());
        let events_sender = self.events_sender.clone();
        let read_lines = move || {
            for line in BufReader::new(reports).lines().map_while(Result::ok) {
                let event = match line.strip_prefix(link::WINDOW) {
                    Some(id) => id.trim().parse().ok().map(Event::Window),
                    None => (line == link::SHOWN).then_some(Event::Shown),
                };
                // The receiver lives as long as the supervisor.
                event.into_iter().for_each(|event| drop(events_sender.send(event)));
            }
            drop(events_sender.send(Event::Ended));
        };
        thread::Builder::new()
            .name("ear".to_owned())
            .spawn(read_lines)
            .context("cannot start a thread to read the wall's reports")?;
        Ok((child, link))
    }
}
