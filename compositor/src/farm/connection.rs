//! The connection to one render server: handshake, heartbeats, and samples placed as they arrive.

use std::{
    collections::HashMap,
    net::SocketAddr,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use channel::{
    key::Key,
    secure::{self, SecureError},
    wire::{Incoming, MessageReader, MessageWriter, WireError},
};
use fixedbitset::FixedBitSet;
use shared::{
    division::{Share, Task},
    marks::SurfaceWay,
    printable::printable,
    protocol::{
        Chunk, FETCH_SILENCE_LIMIT, FrameId, HANDSHAKE_TIMEOUT, HEARTBEAT_INTERVAL, HEARTBEAT_TIMEOUT, LONGEST_NAME,
        ProbeHit, RunCosts, SILENCE_LIMIT, SceneState, TaskId, TaskTimings, ToServer, ToWall,
    },
    scene::SceneId,
};
use tokio::{
    io::{AsyncRead, AsyncWrite},
    net::TcpStream,
    sync::mpsc,
    time::{MissedTickBehavior, interval, sleep, timeout, timeout_at},
};

use super::{
    frame_buffer::{FrameBuffer, PlaceError},
    losses::Losses,
    outbox::Outbox,
    scheduler::PlacedUnits,
    silence::{self, LastHeard},
    stats::NodeId,
    supply::SceneSupply,
    transfer,
};

/// A report of a connection to the farm.
#[derive(Debug)]
pub(super) enum ConnectionEvent {
    /// The handshake is over.
    Joined { name: String, threads: u32, is_local: bool, outbox: Arc<Outbox>, pending: Arc<PendingTasks> },
    /// It will not render, but fetch the scene.
    Fetching,
    /// The render server's progress with a scene.
    Scene { scene: SceneId, state: SceneState },
    /// Samples are in the frame buffer.
    UnitsPlaced { frame: FrameId, task_id: TaskId, units: PlacedUnits },
    /// A task is done.
    TaskDone { frame: FrameId, task_id: TaskId, timings: TaskTimings, costs: RunCosts },
    /// The render server has become silent, or is heard again.
    Silent(bool),
    /// The round trip of a ping.
    RoundTrip(Duration),
    /// The answer to a probe.
    Probed { number: u32, hit: Option<ProbeHit> },
    /// The answer to a look.
    Seen { number: u32, seen: Vec<bool> },
    /// The answer about a way along the surface.
    Measured { number: u32, way: Option<SurfaceWay> },
    /// The connection has ended: the peer closed it, or an error did.
    Ended(Result<(), ConnectionError>),
}

/// Why the wall drops a render server.
#[derive(Debug, thiserror::Error)]
pub(super) enum ConnectionError {
    #[error("{0}")]
    Wire(#[from] WireError),
    #[error("{0}")]
    Secure(#[from] SecureError),
    #[error("no handshake within {} s", HANDSHAKE_TIMEOUT.as_secs())]
    NoHandshake,
    #[error("it spoke out of turn")]
    OutOfTurn,
    #[error("its name is longer than {LONGEST_NAME} bytes")]
    LongName,
    #[error("it sent samples that do not fit their task: {0}")]
    Misplaced(#[from] PlaceError),
    #[error("it reported a task as done after {sent} of {n_units} units")]
    Incomplete { sent: u32, n_units: u32 },
    #[error("it reported the costs of {n_runs} runs of {run_units} units for a task of {n_units} units")]
    MisfitCosts { n_runs: usize, run_units: u32, n_units: u32 },
    #[error("it did not read its messages for too long")]
    Clogged,
    #[error("refused: no more render servers can join")]
    Refused,
}

impl ConnectionError {
    /// Why a render server is not let in, with the cure, if it is one: not for strangers that are none.
    pub(super) fn keeps_outside(&self) -> Option<&'static str> {
        match self {
            Self::Secure(SecureError::NoKey) => Some("it has no key; start it with a copy of this wall's, --key FILE"),
            Self::Secure(SecureError::OtherKey | SecureError::Refused) => {
                Some("it has another key; start it with a copy of this wall's, --key FILE")
            }
            Self::Wire(WireError::Encrypted) => {
                Some("it has a key, and this wall has none; start both with copies of one, --key FILE")
            }
            Self::Wire(WireError::OtherVersion(_)) | Self::Secure(SecureError::OtherVersion(_)) => {
                Some("it is of another version; build both programs from one commit")
            }
            _ => None,
        }
    }
}

/// The tasks that a render server has been given and has not finished.
#[derive(Debug, Default)]
pub(super) struct PendingTasks(Mutex<HashMap<TaskId, PendingTask>>);

/// A task, and the frame buffer for its samples.
#[derive(Debug)]
pub(super) struct PendingTask {
    frame: FrameId,
    task: Task,
    buffer: Arc<FrameBuffer>,
    received: FixedBitSet,
}

impl PendingTask {
    /// A task without samples yet.
    pub(super) fn new(frame: FrameId, task: Task, buffer: Arc<FrameBuffer>) -> Self {
        let mut pending = Self { frame, task, buffer, received: FixedBitSet::new() };
        pending.received.grow(pending.share().count() as usize);
        pending
    }

    fn share(&self) -> Share {
        self.task.share(self.buffer.size()).expect("the wall's tasks fit their frames")
    }
}

impl PendingTasks {
    fn lock(&self) -> MutexGuard<'_, HashMap<TaskId, PendingTask>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn put(&self, task_id: TaskId, pending_task: PendingTask) {
        self.lock().insert(task_id, pending_task);
    }

    /// Forgets the tasks of a frame: samples that arrive late are dropped.
    pub(super) fn clear(&self, frame: FrameId) {
        self.lock().retain(|_, pending_task| pending_task.frame != frame);
    }

    /// Places a chunk. `None` if its task is not, or no longer, pending, and if all its units had arrived before.
    fn place(&self, chunk: Chunk<'_>, n_bytes: usize) -> Result<Option<PlacedUnits>, ConnectionError> {
        let started_at = Instant::now();
        let mut pending_tasks = self.lock();
        let Some(pending_task) = pending_tasks.get_mut(&chunk.task_id).filter(|given| given.frame == chunk.frame)
        else {
            return Ok(None);
        };
        let Chunk { first_unit: first, n_units: count, rgb, .. } = chunk;
        pending_task.buffer.place(&pending_task.share(), first, count, rgb)?;
        let units = first as usize..(first + count) as usize;
        if pending_task.received.contains_all_in_range(units.clone()) {
            return Ok(None);
        }
        pending_task.received.insert_range(units);
        Ok(Some(PlacedUnits { first, count, n_bytes: n_bytes as u64, place_time: started_at.elapsed() }))
    }

    /// Removes a finished task; whether it was pending.
    fn finish(&self, frame: FrameId, task_id: TaskId, costs: &RunCosts) -> Result<bool, ConnectionError> {
        let mut pending_tasks = self.lock();
        if pending_tasks.get(&task_id).is_none_or(|pending_task| pending_task.frame != frame) {
            return Ok(false);
        }
        let Some(pending_task) = pending_tasks.remove(&task_id) else { return Ok(false) };
        let n_units = pending_task.share().count();
        let sent = pending_task.received.count_ones(..) as u32;
        if sent < n_units {
            return Err(ConnectionError::Incomplete { sent, n_units });
        }
        if !costs.fits(n_units) {
            let (n_runs, run_units) = (costs.cpu_ns.len(), costs.run_units);
            return Err(ConnectionError::MisfitCosts { n_runs, run_units, n_units });
        }
        Ok(true)
    }
}

/// Sends a connection's events to the farm.
#[derive(Clone, Debug)]
pub(super) struct EventSender {
    pub(super) node: NodeId,
    pub(super) address: SocketAddr,
    /// Whether it runs on the wall's machine.
    pub(super) is_local: bool,
    pub(super) farm: mpsc::Sender<(NodeId, SocketAddr, ConnectionEvent)>,
}

impl EventSender {
    async fn send(&self, event: ConnectionEvent) {
        // The farm ends only with the wall, and then this connection ends too.
        let _ = self.farm.send((self.node, self.address, event)).await;
    }
}

/// Runs a connection from its first byte to its end, encrypted if there is a key.
pub(super) async fn run(
    mut stream: TcpStream,
    key: Option<Key>,
    events: EventSender,
    losses: Arc<Losses>,
    supply: Arc<SceneSupply>,
    started_at: Instant,
) {
    // Requests are small and must not wait for more.
    let _ = stream.set_nodelay(true);
    let (input, output) = stream.split();
    serve(input, output, key.as_ref(), events, (&losses, &supply), started_at).await;
}

async fn serve(
    input: impl AsyncRead + Unpin,
    output: impl AsyncWrite + Unpin,
    key: Option<&Key>,
    events: EventSender,
    shared: (&Losses, &Arc<SceneSupply>),
    started_at: Instant,
) {
    let heard = LastHeard::now();
    let input = heard.observe(input);
    // One time limit for both handshakes: a peer that sends slowly gets no more.
    let deadline = tokio::time::Instant::now() + HANDSHAKE_TIMEOUT;
    let ended = match key {
        None => converse(input, output, &events, shared, &heard, started_at, deadline).await,
        Some(key) => match timeout_at(deadline, secure::accept(input, output, key)).await {
            Err(_) => Err(ConnectionError::NoHandshake),
            Ok(Err(error)) => Err(error.into()),
            Ok(Ok((input, output))) => converse(input, output, &events, shared, &heard, started_at, deadline).await,
        },
    };
    events.send(ConnectionEvent::Ended(ended)).await;
}

async fn converse(
    input: impl AsyncRead + Unpin,
    output: impl AsyncWrite + Unpin,
    events: &EventSender,
    (losses, supply): (&Losses, &Arc<SceneSupply>),
    heard: &LastHeard,
    started_at: Instant,
    deadline: tokio::time::Instant,
) -> Result<(), ConnectionError> {
    // The deadline bounds the handshake: silence within it needs no limit of its own.
    let mut reader = MessageReader::new(input, 2 * HANDSHAKE_TIMEOUT);
    let mut writer = MessageWriter::new(output);
    let admission_wait = |name: &str| losses.wait(Instant::now(), name, events.address.ip());
    let shaking_hands = shake_hands(&mut reader, &mut writer, admission_wait);
    let opening = timeout_at(deadline, shaking_hands).await.map_err(|_| ConnectionError::NoHandshake)??;
    let (name, threads) = match opening {
        Opening::Render { name, threads } => (name, threads),
        Opening::Fetch(scene) => {
            events.send(ConnectionEvent::Fetching).await;
            reader.raise_limits(FETCH_SILENCE_LIMIT);
            return transfer::serve(&mut reader, &mut writer, supply, scene).await;
        }
    };
    // One that was made to wait had nothing to say.
    heard.note();
    let outbox = Arc::new(Outbox::default());
    let pending = Arc::new(PendingTasks::default());
    reader.raise_limits(SILENCE_LIMIT);
    let (farms_outbox, farms_pending, is_local) = (Arc::clone(&outbox), Arc::clone(&pending), events.is_local);
    let joined = ConnectionEvent::Joined { name, threads, is_local, outbox: farms_outbox, pending: farms_pending };
    events.send(joined).await;
    tokio::select! {
        ended = receive(&mut reader, &pending, events, started_at) => ended,
        ended = transmit(&mut writer, &outbox, started_at) => ended,
        () = silence::watch(heard, HEARTBEAT_TIMEOUT, |is_silent| events.send(ConnectionEvent::Silent(is_silent))) => Ok(()),
    }
}

/// The purpose of a connection.
enum Opening {
    /// To render, under this name and with so many threads.
    Render { name: String, threads: u32 },
    /// To fetch this scene.
    Fetch(SceneId),
}

async fn shake_hands(
    reader: &mut MessageReader<impl AsyncRead + Unpin, ToWall>,
    writer: &mut MessageWriter<impl AsyncWrite + Unpin>,
    admission_wait: impl Fn(&str) -> Duration,
) -> Result<Opening, ConnectionError> {
    // The wall's preamble always goes out: a render server of another version then reports the mismatch.
    writer.flush().await.map_err(WireError::from)?;
    reader.read_preamble().await?;
    let (name, threads) = match reader.read().await? {
        Some(Incoming::Control(ToWall::Hello { name, threads })) => (name, threads),
        Some(Incoming::Control(ToWall::FetchScene { scene })) => return Ok(Opening::Fetch(scene)),
        _ => return Err(ConnectionError::OutOfTurn),
    };
    if name.len() > LONGEST_NAME {
        return Err(ConnectionError::LongName);
    }
    // Logs and the overlay show names: control characters must not disturb them.
    let name = printable(&name);
    let name = if name.is_empty() { "nameless".to_owned() } else { name };
    sleep(admission_wait(&name)).await;
    writer.send(&ToServer::Welcome).await?;
    Ok(Opening::Render { name, threads })
}

async fn receive(
    reader: &mut MessageReader<impl AsyncRead + Unpin, ToWall>,
    pending: &PendingTasks,
    events: &EventSender,
    started_at: Instant,
) -> Result<(), ConnectionError> {
    let mut placed = PlacedRun::default();
    let received = receive_until_end(reader, pending, events, started_at, &mut placed).await;
    // Placed samples need not be rendered again, even if the connection ends here.
    placed.report(events).await;
    received
}

/// Consecutive units that were placed and not yet reported: one event reports all chunks that arrive together.
#[derive(Debug, Default)]
struct PlacedRun(Option<(FrameId, TaskId, PlacedUnits)>);

impl PlacedRun {
    async fn add(&mut self, frame: FrameId, task_id: TaskId, units: PlacedUnits, events: &EventSender) {
        match &mut self.0 {
            Some((run_frame, run_task, run))
                if (*run_frame, *run_task, run.first + run.count) == (frame, task_id, units.first) =>
            {
                run.count += units.count;
                run.n_bytes += units.n_bytes;
                run.place_time += units.place_time;
            }
            _ => {
                self.report(events).await;
                self.0 = Some((frame, task_id, units));
            }
        }
    }

    async fn report(&mut self, events: &EventSender) {
        if let Some((frame, task_id, units)) = self.0.take() {
            events.send(ConnectionEvent::UnitsPlaced { frame, task_id, units }).await;
        }
    }
}

async fn receive_until_end(
    reader: &mut MessageReader<impl AsyncRead + Unpin, ToWall>,
    pending: &PendingTasks,
    events: &EventSender,
    started_at: Instant,
    placed: &mut PlacedRun,
) -> Result<(), ConnectionError> {
    loop {
        if !reader.has_more() {
            placed.report(events).await;
        }
        let Some(incoming) = reader.read().await? else { return Ok(()) };
        match incoming {
            Incoming::Samples { chunk, n_bytes } => {
                let (frame, task_id) = (chunk.frame, chunk.task_id);
                if let Some(units) = pending.place(chunk, n_bytes)? {
                    placed.add(frame, task_id, units, events).await;
                }
            }
            Incoming::Control(ToWall::TaskDone { frame, task_id, timings, costs }) => {
                if pending.finish(frame, task_id, &costs)? {
                    placed.report(events).await;
                    events.send(ConnectionEvent::TaskDone { frame, task_id, timings, costs }).await;
                }
            }
            Incoming::Control(ToWall::SceneState { scene, state }) => {
                events.send(ConnectionEvent::Scene { scene, state }).await;
            }
            Incoming::Control(ToWall::Pong { sent_us }) => {
                let sent_at = Duration::from_micros(sent_us);
                events.send(ConnectionEvent::RoundTrip(started_at.elapsed().saturating_sub(sent_at))).await;
            }
            Incoming::Control(ToWall::Probed { number, hit }) => {
                events.send(ConnectionEvent::Probed { number, hit }).await;
            }
            Incoming::Control(ToWall::Seen { number, seen }) => {
                events.send(ConnectionEvent::Seen { number, seen }).await;
            }
            Incoming::Control(ToWall::Measured { number, way }) => {
                events.send(ConnectionEvent::Measured { number, way }).await;
            }
            Incoming::Control(ToWall::Heartbeat) => {}
            Incoming::FilePart(_)
            | Incoming::Control(ToWall::Hello { .. } | ToWall::FetchScene { .. } | ToWall::FetchPart { .. }) => {
                return Err(ConnectionError::OutOfTurn);
            }
        }
    }
}

async fn transmit(
    writer: &mut MessageWriter<impl AsyncWrite + Unpin>,
    outbox: &Outbox,
    started_at: Instant,
) -> Result<(), ConnectionError> {
    let mut heartbeat = interval(HEARTBEAT_INTERVAL);
    heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            messages = outbox.take() => match messages {
                Some(messages) => writer.push_encoded(&messages),
                None => return Err(ConnectionError::Refused),
            },
            _ = heartbeat.tick() => {
                let sent_us = started_at.elapsed().as_micros() as u64;
                writer.push(&ToServer::Ping { sent_us }).map_err(WireError::from)?;
            }
        }
        // The system buffers more than a wall says in this time.
        let flushed = timeout(SILENCE_LIMIT, writer.flush()).await.map_err(|_| ConnectionError::Clogged)?;
        flushed.map_err(WireError::from)?;
    }
}

#[cfg(test)]
mod tests {
    use shared::division::{Division, FrameSize};

    use super::*;
    use crate::farm::frame_buffer::BufferPool;

    #[test]
    fn a_task_is_finished_by_all_its_samples_and_costs_that_fit_it() {
        let (frame, task_id, size) = (FrameId(1), TaskId(2), FrameSize::new(32, 8).unwrap());
        let finish_with = |chunks: &[(u32, u32)], costs: &RunCosts| {
            let (task, buffer) = (Division::Dynamic.task(0, 1), Arc::new(BufferPool::default().take(size)));
            let pending = PendingTasks::default();
            pending.put(task_id, PendingTask::new(frame, task, buffer));
            for &(first_unit, n_units) in chunks {
                let rgb = vec![7; 3 * 64 * n_units as usize];
                pending.place(Chunk { frame, task_id, first_unit, n_units, rgb: &rgb }, rgb.len()).unwrap();
            }
            pending.finish(frame, task_id, costs)
        };
        let finish = |n_units, costs: &RunCosts| finish_with(&[(0, n_units)], costs);
        let costs = |run_units, n_runs| RunCosts { run_units, cpu_ns: vec![1; n_runs] };
        assert!(finish(4, &costs(3, 2)).unwrap());
        assert!(finish(4, &RunCosts::default()).unwrap());
        assert!(matches!(finish(3, &costs(3, 2)), Err(ConnectionError::Incomplete { sent: 3, n_units: 4 })));
        let repeated = finish_with(&[(0, 2), (0, 2), (1, 1)], &RunCosts::default());
        assert!(matches!(repeated, Err(ConnectionError::Incomplete { sent: 2, n_units: 4 })), "twice is not more");
        assert!(finish_with(&[(2, 2), (0, 3)], &RunCosts::default()).unwrap());
        for misfit in [costs(3, 1), costs(3, 3), costs(0, 4), costs(u32::MAX, 2)] {
            assert!(matches!(finish(4, &misfit), Err(ConnectionError::MisfitCosts { n_units: 4, .. })));
        }
    }
}
