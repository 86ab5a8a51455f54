//! Stopping: SIGTERM and Ctrl-C end every program within a second, whatever it does.
//!
//! A program that serves registers a handler with [`on_signal`] and ends in its own way. All other work is cut off: the
//! process ends at once, leaves no incomplete file, says in one line what it was at, and its exit code is 128 + the
//! signal's number.

use std::{
    io::{self, Write},
    sync::{
        Arc, Mutex, MutexGuard, OnceLock, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    thread,
};

use anyhow::Context;
use channel::files;
use shared::printable::printable_line;

/// A signal that asks the program to stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Signal {
    /// SIGINT: Ctrl-C.
    Interrupt = 2,
    /// SIGTERM.
    Terminate = 15,
}

impl Signal {
    /// The exit code of a program whose work the signal cuts off: the one that shells show for it.
    pub fn exit_code(self) -> u8 {
        128 + self as u8
    }
}

/// Work was cut off. The text says what it was.
#[derive(Debug, thiserror::Error)]
#[error("{line}")]
pub struct Stopped {
    /// The signal that asked for it.
    pub signal: Signal,
    line: String,
}

impl Stopped {
    /// The error for a signal that has come, if one has.
    pub fn by_signal(line: impl Into<String>) -> Option<Self> {
        Some(Self { signal: *RECEIVED.get()?, line: line.into() })
    }
}

type Handler = Arc<dyn Fn(Signal) + Send + Sync>;
type Line = Box<dyn Fn() -> String + Send>;

/// The first signal that has come.
static RECEIVED: OnceLock<Signal> = OnceLock::new();
static HANDLER: Mutex<Option<Handler>> = Mutex::new(None);
/// The tasks in progress, by number; the newest is the last.
static TASKS: Mutex<Vec<(u64, Line)>> = Mutex::new(Vec::new());

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A task that a signal cuts off, until it is dropped.
pub struct Task(u64);

impl Task {
    /// Begins a task that reads well after "stopped while", for example "loading dragon.ply".
    pub fn named(name: impl Into<String>) -> Self {
        let name = name.into();
        Self::with_line(move || format!("stopped while {name}"))
    }

    /// Begins a task; `line` says what a signal has cut off.
    pub fn with_line(line: impl Fn() -> String + Send + 'static) -> Self {
        static N_TASKS: AtomicU64 = AtomicU64::new(0);
        let number = N_TASKS.fetch_add(1, Ordering::Relaxed);
        lock(&TASKS).push((number, Box::new(line)));
        Self(number)
    }
}

impl Drop for Task {
    fn drop(&mut self) {
        lock(&TASKS).retain(|(number, _)| *number != self.0);
    }
}

/// Starts to listen for signals, on a thread of its own. Call it once, at the start of a program.
pub fn listen() {
    // Without this thread, the system ends the program without a word.
    if let Err(error) = try_to_listen() {
        tracing::warn!("{error:#}");
    }
}

fn try_to_listen() -> anyhow::Result<()> {
    let failed = "cannot listen for signals";
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().context(failed)?;
    #[cfg(unix)]
    let listen = {
        use tokio::signal::unix::{SignalKind, signal};
        let _guard = runtime.enter();
        let mut interrupt = signal(SignalKind::interrupt()).context(failed)?;
        let mut terminate = signal(SignalKind::terminate()).context(failed)?;
        // It comes where a file would grow beyond a limit (ulimit -f), and ends a program that does not listen for it. One that
        // does is told by the write, which fails like any other.
        let mut too_large = signal(SignalKind::from_raw(libc::SIGXFSZ)).context(failed)?;
        async move {
            loop {
                tokio::select! {
                    _ = too_large.recv() => (),
                    _ = interrupt.recv() => receive(Signal::Interrupt),
                    _ = terminate.recv() => receive(Signal::Terminate),
                }
            }
        }
    };
    #[cfg(not(unix))]
    let listen = async {
        while tokio::signal::ctrl_c().await.is_ok() {
            receive(Signal::Interrupt);
        }
    };
    let listen = move || runtime.block_on(listen);
    thread::Builder::new().name("signals".to_owned()).spawn(listen).context(failed)?;
    Ok(())
}

/// From now on, signals call `handler` on the thread that listens, and the program ends in its own way.
pub fn on_signal(handler: impl Fn(Signal) + Send + Sync + 'static) {
    *lock(&HANDLER) = Some(Arc::new(handler));
}

/// Does what a signal does.
pub fn receive(signal: Signal) {
    let first = *RECEIVED.get_or_init(|| signal);
    // Called without the lock: a handler may wait for the main thread.
    let handler = lock(&HANDLER).clone();
    match handler {
        Some(handler) => handler(signal),
        None => cut_off(first),
    }
}

/// The error for a program that has been told to stop, if that cuts off a task.
pub fn unfinished() -> Option<Stopped> {
    Stopped::by_signal(line()?)
}

/// The newest task's line about itself.
fn line() -> Option<String> {
    // All of them are asked: each also clears its progress bar.
    lock(&TASKS).iter().map(|(_, line)| line()).reduce(|_, newer| newer)
}

fn cut_off(signal: Signal) -> ! {
    files::give_up();
    let line = line().unwrap_or_else(|| "stopped before the end".to_owned());
    // Nobody may listen any more.
    let _ = writeln!(io::stderr(), "{}", printable_line(&line));
    end(signal.exit_code())
}

/// Ends the process without its libraries' exit handlers: other threads still use these libraries, a graphics driver for
/// example.
fn end(exit_code: u8) -> ! {
    #[cfg(unix)]
    // SAFETY: `_exit` takes any status, and touches nothing of this process.
    unsafe {
        libc::_exit(exit_code.into())
    }
    #[cfg(not(unix))]
    std::process::exit(exit_code.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_cut_off_without_a_signal() {
        assert_eq!([Signal::Interrupt, Signal::Terminate].map(Signal::exit_code), [130, 143]);
        let _task = Task::named("testing");
        assert!(unfinished().is_none());
    }
}
