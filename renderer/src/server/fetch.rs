//! Fetches the wall's scene file, for a render server that does not have the model.
//!
//! It comes over a connection of its own to the wall's port, so frames never wait behind it.

use std::{
    io,
    path::Path,
    time::{Duration, Instant},
};

use channel::{
    key::Key,
    secure::{self, SecureError},
    wire::{Incoming, MessageReader, MessageWriter, WireError},
};
use shared::{
    printable::{bytes, printable},
    protocol::{FETCH_SILENCE_LIMIT, HANDSHAKE_TIMEOUT, ToServer, ToWall, Transfer},
    scene::SceneId,
};
use tokio::{
    io::{AsyncRead, AsyncWrite},
    time::{sleep, timeout},
};

use crate::{
    cli::free_memory::free_disk,
    grid::MemoryBudget,
    scene_file::{
        cache::{Cache, FOLDER_VARIABLE},
        fault::Fault,
        part::Part,
    },
    server::connect::{WallAddress, connect},
};

/// Pieces that are asked for ahead, about a chunk each: more than a network holds, and less than delays a frame much that
/// begins meanwhile.
const MOST_ASKED: usize = 3;

/// Connections that end without a piece, one after the other, before it is called a failure.
const MOST_FAILURES: u32 = 3;

/// The pause before another connection.
const PAUSE: Duration = Duration::from_millis(300);

/// The part of the free disk that a wall may fill unless a limit is set: one in…
const PART_OF_FREE_DISK: u64 = 2;

/// How often it is asked whether the scene is still wanted.
const WANTED_INTERVAL: Duration = Duration::from_millis(100);

/// How often the progress is told, and over which time the rate is measured.
const REPORT_INTERVAL: Duration = Duration::from_millis(250);

/// Fetches scenes from one wall.
#[derive(Clone, Debug)]
pub(crate) struct Fetcher {
    pub(crate) wall: WallAddress,
    pub(crate) key: Option<Key>,
    pub(crate) only_this_machine: bool,
    /// The most bytes that a scene file may have, if the operator has set it.
    pub(crate) limit: Option<MemoryBudget>,
}

/// Why a scene is not fetched. The text holds the cure.
#[derive(Debug, thiserror::Error)]
pub(crate) enum FetchError {
    #[error("{0}")]
    Wire(#[from] WireError),
    #[error("{0}")]
    Secure(#[from] SecureError),
    #[error("{0}")]
    Connect(String),
    #[error("the wall does not give it: {0}")]
    Refused(String),
    #[error("its scene file has {n_bytes}, more than {limit}", n_bytes = bytes(*.n_bytes))]
    TooLarge { n_bytes: u64, limit: String },
    #[error("the wall's scene file: {0}; open the model there again, and build both programs from one commit")]
    Damaged(Fault),
    #[error(
        "its scene file cannot be written to {folder}: {error}; free some of the disk, or name a folder on another with {FOLDER_VARIABLE}"
    )]
    Disk { folder: String, error: io::Error },
    #[error("the wall spoke out of turn: build both programs from one commit")]
    OutOfTurn,
    #[error("no answer")]
    NoAnswer,
    /// Another order has come.
    #[error("it is no longer wanted")]
    Unwanted,
}

impl FetchError {
    /// Whether another connection may help.
    fn is_transient(&self) -> bool {
        matches!(
            self,
            Self::Wire(WireError::Io(_) | WireError::Silent(_)) | Self::Secure(SecureError::Io(_)) | Self::NoAnswer
        )
    }
}

/// The state of a transfer, for those that watch it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Progress {
    /// The wall makes the scene file; 0 to 1.
    Awaited(f32),
    Arriving(Transfer),
}

/// Whether the scene is still wanted, and who is told of the progress.
pub(crate) struct Watch<'a> {
    pub(crate) is_wanted: &'a (dyn Fn() -> bool + Sync),
    pub(crate) report: &'a (dyn Fn(Progress) + Sync),
}

impl Fetcher {
    /// Tells walls apart whose files may stand for each other's: by their key, or their address if they have none.
    pub(crate) fn origin(&self) -> [u8; 32] {
        self.key.as_ref().map_or_else(|| *blake3::hash(self.wall.get().as_bytes()).as_bytes(), Key::fingerprint)
    }

    /// Fetches the scene file of a scene to `place` in the cache, and goes on where an earlier attempt was cut off. Waits for
    /// its end: for a thread that has nothing else to do, on a rayon pool that hashes.
    pub(crate) fn fetch(
        &self,
        scene: SceneId,
        cache: &Cache,
        place: &Path,
        watch: &Watch<'_>,
    ) -> Result<(), FetchError> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let runtime = runtime.map_err(|error| FetchError::Connect(format!("cannot start the network: {error}")))?;
        let mut n_failures = 0;
        loop {
            let mut has_moved = false;
            let mut transfer = Arrival { scene, cache, place, watch, limit: self.limit, has_moved: &mut has_moved };
            let attempt = async {
                tokio::select! {
                    ended = self.attempt(&mut transfer) => ended,
                    () = unwanted(watch) => Err(FetchError::Unwanted),
                }
            };
            match runtime.block_on(attempt) {
                Err(error) if error.is_transient() => {
                    n_failures = if has_moved { 1 } else { n_failures + 1 };
                    if n_failures >= MOST_FAILURES {
                        return Err(error);
                    }
                    tracing::debug!("the transfer of {scene} goes on after: {error}");
                    std::thread::sleep(PAUSE);
                    if !(watch.is_wanted)() {
                        return Err(FetchError::Unwanted);
                    }
                }
                ended => return ended,
            }
        }
    }

    /// One connection.
    async fn attempt(&self, arrival: &mut Arrival<'_>) -> Result<(), FetchError> {
        let connected = connect(&self.wall.get(), self.only_this_machine).await;
        let connected = connected.map_err(|error| FetchError::Connect(error.to_string()))?;
        let mut stream = connected.map_err(WireError::from)?;
        let (input, output) = stream.split();
        match &self.key {
            None => arrival.converse(input, output).await,
            Some(key) => {
                let connecting = timeout(HANDSHAKE_TIMEOUT, secure::connect(input, output, key)).await;
                let (input, output) = connecting.map_err(|_| FetchError::NoAnswer)??;
                arrival.converse(input, output).await
            }
        }
    }
}

/// A scene file on its way.
struct Arrival<'a> {
    scene: SceneId,
    cache: &'a Cache,
    place: &'a Path,
    watch: &'a Watch<'a>,
    limit: Option<MemoryBudget>,
    /// Whether this connection has brought any of it.
    has_moved: &'a mut bool,
}

impl Arrival<'_> {
    async fn converse(
        &mut self,
        input: impl AsyncRead + Unpin,
        output: impl AsyncWrite + Unpin,
    ) -> Result<(), FetchError> {
        let mut reader: MessageReader<_, ToServer> = MessageReader::new(input, HANDSHAKE_TIMEOUT);
        let mut writer = MessageWriter::new(output);
        writer.send(&ToWall::FetchScene { scene: self.scene }).await?;
        reader.read_preamble().await?;
        reader.raise_limits(FETCH_SILENCE_LIMIT);
        let (n_bytes, hash) = loop {
            match reader.read().await?.ok_or_else(closed)? {
                Incoming::Control(ToServer::SceneFileAwaited { progress }) => {
                    (self.watch.report)(Progress::Awaited(progress));
                }
                Incoming::Control(ToServer::SceneFile { n_bytes, hash }) => break (n_bytes, hash),
                Incoming::Control(ToServer::Refused { reason }) => return Err(FetchError::Refused(printable(&reason))),
                _ => return Err(FetchError::OutOfTurn),
            }
        };
        let path = Cache::part_of(self.place);
        self.make_room(n_bytes, &path)?;
        let mut part = Part::resume(&path, n_bytes, hash).map_err(|error| self.disk_error(error))?;
        let mut meter = Meter::new(part.n_done());
        let (mut n_asked, mut piece) = (0, Vec::new());
        while let Some(needed) = part.needed(0) {
            while n_asked < MOST_ASKED
                && let Some(range) = part.needed(n_asked)
            {
                let n_bytes = (range.end - range.start) as u32;
                writer.push(&ToWall::FetchPart { first: range.start, n_bytes }).map_err(WireError::from)?;
                n_asked += 1;
            }
            // Where the connection has ended, pieces that came before are still to be read, and reading finds its end.
            let _ = writer.flush().await;
            let n_needed = (needed.end - needed.start) as usize;
            piece.clear();
            while piece.len() < n_needed {
                match reader.read().await?.ok_or_else(closed)? {
                    // A message is short, so no wall makes a piece much longer than it should be.
                    Incoming::FilePart(bytes) if !bytes.is_empty() => piece.extend_from_slice(bytes),
                    Incoming::Control(ToServer::Refused { reason }) => {
                        return Err(FetchError::Refused(printable(&reason)));
                    }
                    _ => return Err(FetchError::OutOfTurn),
                }
            }
            part.put(&piece).map_err(|fault| match fault {
                Fault::Io(error) => {
                    // Others need the rest of a full disk.
                    let _ = std::fs::remove_file(&path);
                    self.disk_error(error)
                }
                fault => FetchError::Damaged(fault),
            })?;
            n_asked -= 1;
            *self.has_moved = true;
            if let Some(bytes_per_second) = meter.rate(part.n_done(), Instant::now()) {
                let transfer = Transfer { n_done: part.n_done(), n_bytes, bytes_per_second };
                (self.watch.report)(Progress::Arriving(transfer));
            }
        }
        part.finish(self.place).map_err(|error| self.disk_error(error))
    }

    /// Checks the limits, and drops scenes that were not used for the longest time.
    fn make_room(&self, n_bytes: u64, part: &Path) -> Result<(), FetchError> {
        let too_large = |limit| Err(FetchError::TooLarge { n_bytes, limit });
        if let Some(limit) = self.limit.filter(|limit| limit.is_exceeded_by(n_bytes)) {
            return too_large(format!("--fetch-limit {limit}: raise it, or give this server --model FILE"));
        }
        let n_there = part.metadata().map_or(0, |part| part.len());
        let (portion, part_of_free, cure) = match self.limit {
            Some(_) => ("what", 1, ""),
            None => ("half of what", PART_OF_FREE_DISK, ", or set --fetch-limit"),
        };
        if free_disk(self.cache.folder()).is_some_and(|free| n_bytes > free.saturating_add(n_there) / part_of_free) {
            return too_large(format!(
                "{portion} is free on the disk of {}: free some, name a folder on another with {FOLDER_VARIABLE}{cure}",
                self.cache.folder().display()
            ));
        }
        // Only now: a file that does not come should displace none.
        if !self.cache.make_room(n_bytes, self.place) {
            return too_large("the cache may have: give this server --model FILE".to_owned());
        }
        Ok(())
    }

    fn disk_error(&self, error: io::Error) -> FetchError {
        FetchError::Disk { folder: self.cache.folder().display().to_string(), error }
    }
}

/// Waits until nobody wants the scene any more.
async fn unwanted(watch: &Watch<'_>) {
    while (watch.is_wanted)() {
        sleep(WANTED_INTERVAL).await;
    }
}

fn closed() -> WireError {
    io::Error::new(io::ErrorKind::UnexpectedEof, "the wall closed the connection").into()
}

/// Measures the rate of a transfer.
struct Meter {
    /// When the last rate was measured, and the bytes until then.
    last: (Instant, u64),
    bytes_per_second: f64,
}

impl Meter {
    fn new(n_done: u64) -> Self {
        Self { last: (Instant::now(), n_done), bytes_per_second: 0.0 }
    }

    /// The rate in bytes a second, smoothed, if it is time to tell it.
    fn rate(&mut self, n_done: u64, now: Instant) -> Option<u64> {
        let (at, n_before) = self.last;
        let elapsed = now.saturating_duration_since(at);
        if elapsed < REPORT_INTERVAL {
            return None;
        }
        let rate = n_done.saturating_sub(n_before) as f64 / elapsed.as_secs_f64();
        self.bytes_per_second =
            if self.bytes_per_second == 0.0 { rate } else { 0.7 * self.bytes_per_second + 0.3 * rate };
        self.last = (now, n_done);
        Some(self.bytes_per_second as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_follows_the_bytes_that_arrive() {
        let mut meter = Meter::new(1000);
        let at = |seconds| meter.last.0 + Duration::from_secs(seconds);
        let times = [at(1), at(2), at(4)];
        assert_eq!(meter.rate(1500, meter.last.0 + Duration::from_millis(100)), None);
        assert_eq!(meter.rate(2000, times[0]), Some(1000));
        assert_eq!(meter.rate(3000, times[1]), Some(1000));
        assert_eq!(meter.rate(3000, times[2]), Some(700));
    }
}
