//! One conversation with a wall, from the handshake to its end.

use std::{
    panic,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
};

use channel::{
    key::Key,
    secure::{self, SecureError},
    wire::{Incoming, MessageReader, MessageWriter, WireError},
};
use glam::DVec3;
use shared::{
    codec,
    printable::printable,
    protocol::{FrameId, HANDSHAKE_TIMEOUT, HEARTBEAT_INTERVAL, SILENCE_LIMIT, SkyFile, ToServer, ToWall},
    scene::SceneId,
    structure::Structure,
};
use tokio::{
    io::{AsyncRead, AsyncWrite},
    sync::{Semaphore, mpsc},
    task::JoinError,
    time::{Instant, MissedTickBehavior, interval, timeout_at},
};

use crate::server::{
    load_request::{LoadRequest, path_from_bytes},
    scene_loader::{RenderSource, SceneLoader},
    task::{self, Job, JobQueue, Outgoing, TooManyTasks},
};

/// Encoded messages that may wait for the network; when the queue is full, tracing threads wait.
const LONGEST_QUEUE: usize = 64;

/// Replies that may wait for the network; when the queue is full, no messages are read.
const MOST_REPLIES: usize = 64;

/// Messages that are written between two looks at the heartbeat.
const LONGEST_BATCH: usize = 16;

/// How a conversation ended.
#[derive(Debug)]
pub(crate) struct SessionEnd {
    /// Whether the wall had accepted this server.
    pub(crate) was_accepted: bool,
    /// `Ok` if the wall closed the connection.
    pub(crate) reason: Result<(), SessionError>,
}

/// Why a conversation with a wall fails.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SessionError {
    #[error("{0}")]
    Wire(#[from] WireError),
    #[error("{0}")]
    Secure(#[from] SecureError),
    #[error("the wall refuses: {0}")]
    Refused(String),
    #[error(transparent)]
    TooManyTasks(#[from] TooManyTasks),
    #[error("no handshake within {} s", HANDSHAKE_TIMEOUT.as_secs())]
    NoHandshake,
    #[error("the wall sent an unexpected message")]
    OutOfTurn,
}

impl SessionError {
    /// Whether the wall's end may be the cause: with samples under way, it resets the connection.
    pub(crate) fn is_end(&self) -> bool {
        use std::io::ErrorKind::{BrokenPipe, ConnectionReset, UnexpectedEof};
        matches!(self, Self::Wire(WireError::Io(error))
            if matches!(error.kind(), BrokenPipe | ConnectionReset | UnexpectedEof))
    }
}

/// Runs a conversation over any stream; encrypted if a key is given. Files that the wall names are read only if it
/// `is_local`: runs on this machine. Calls `on_welcome` once the wall has accepted this server.
pub(crate) async fn run(
    input: impl AsyncRead + Unpin,
    output: impl AsyncWrite + Unpin,
    key: Option<&Key>,
    name: &str,
    loader: &SceneLoader,
    is_local: bool,
    on_welcome: impl FnOnce(),
) -> SessionEnd {
    // One time limit for both handshakes: a wall that sends slowly gets no more.
    let deadline = Instant::now() + HANDSHAKE_TIMEOUT;
    let Some(key) = key else { return run_session(input, output, name, loader, deadline, is_local, on_welcome).await };
    match timeout_at(deadline, secure::connect(input, output, key)).await {
        Ok(Ok((input, output))) => run_session(input, output, name, loader, deadline, is_local, on_welcome).await,
        Ok(Err(error)) => SessionEnd { was_accepted: false, reason: Err(error.into()) },
        Err(_) => SessionEnd { was_accepted: false, reason: Err(SessionError::NoHandshake) },
    }
}

async fn run_session(
    input: impl AsyncRead + Unpin,
    output: impl AsyncWrite + Unpin,
    name: &str,
    loader: &SceneLoader,
    deadline: Instant,
    is_local: bool,
    on_welcome: impl FnOnce(),
) -> SessionEnd {
    // The deadline bounds the handshake: silence within it needs no limit of its own.
    let mut reader = MessageReader::new(input, 2 * HANDSHAKE_TIMEOUT);
    let mut writer = MessageWriter::new(output);
    let shaking_hands = shake_hands(&mut reader, &mut writer, name, loader.pool().current_num_threads());
    if let Err(error) = timeout_at(deadline, shaking_hands).await.unwrap_or(Err(SessionError::NoHandshake)) {
        return SessionEnd { was_accepted: false, reason: Err(error) };
    }
    on_welcome();
    reader.raise_limits(SILENCE_LIMIT);
    let (outbox, outgoing) = mpsc::channel(LONGEST_QUEUE);
    let (replies, reply_queue) = mpsc::channel(MOST_REPLIES);
    let jobs = Arc::new(JobQueue::new());
    let mut session = Session {
        loader,
        is_local,
        replies,
        jobs: Arc::clone(&jobs),
        unfinished: Vec::new(),
        measuring: Arc::new(Semaphore::new(1)),
    };
    let mut worker = tokio::task::spawn_blocking({
        let (pool, jobs) = (Arc::clone(loader.pool()), Arc::clone(&jobs));
        move || task::run(&jobs, &pool, &outbox)
    });
    let reason = tokio::select! {
        reason = session.listen(&mut reader) => reason,
        reason = write_messages(&mut writer, outgoing, reply_queue, loader) => reason,
        ended = &mut worker => {
            end_of_worker(ended);
            return SessionEnd { was_accepted: true, reason: Ok(()) };
        }
    };
    drop(session);
    // The worker ends with its queue and outbox.
    end_of_worker(worker.await);
    SessionEnd { was_accepted: true, reason }
}

/// Ends the program if the worker panicked: a node that renders nothing would only delay the others.
fn end_of_worker(result: Result<(), JoinError>) {
    if let Err(error) = result {
        tracing::error!(
            "tracing failed: a scene file was changed in place while it was in use, or this is a bug; start the program \
            again, which checks the file, and put new files in the place of old ones by `mv`"
        );
        panic::resume_unwind(error.into_panic());
    }
}

async fn shake_hands(
    reader: &mut MessageReader<impl AsyncRead + Unpin, ToServer>,
    writer: &mut MessageWriter<impl AsyncWrite + Unpin>,
    name: &str,
    n_threads: usize,
) -> Result<(), SessionError> {
    writer.send(&ToWall::Hello { name: name.to_owned(), threads: n_threads as u32 }).await?;
    reader.read_preamble().await?;
    match reader.read().await? {
        Some(Incoming::Control(ToServer::Welcome)) => Ok(()),
        Some(Incoming::Control(ToServer::Refused { reason })) => Err(SessionError::Refused(printable(&reason))),
        _ => Err(SessionError::OutOfTurn),
    }
}

struct Session<'a> {
    loader: &'a SceneLoader,
    /// Whether the wall runs on this machine.
    is_local: bool,
    /// Encoded messages that overtake samples: on a slow network, a session that waited to send a reply could not read that
    /// the samples before it are cancelled.
    replies: mpsc::Sender<Vec<u8>>,
    jobs: Arc<JobQueue>,
    /// Tasks whose samples may not all be sent, with their cancel flags.
    unfinished: Vec<(FrameId, Arc<AtomicBool>)>,
    /// One way along the surface is found at a time.
    measuring: Arc<Semaphore>,
}

impl Drop for Session<'_> {
    /// Ends the worker, whether the conversation has ended or the program is told to stop: nobody wants its tasks any more.
    fn drop(&mut self) {
        self.unfinished.iter().for_each(|(_, cancelled)| cancelled.store(true, Relaxed));
        self.jobs.close();
    }
}

impl Session<'_> {
    async fn listen(
        &mut self,
        reader: &mut MessageReader<impl AsyncRead + Unpin, ToServer>,
    ) -> Result<(), SessionError> {
        while let Some(incoming) = reader.read().await? {
            let Incoming::Control(message) = incoming else { return Err(SessionError::OutOfTurn) };
            match message {
                ToServer::LoadScene { scene, path, structure, sky } => {
                    self.loader.order(self.load_request(scene, path, structure, sky));
                }
                ToServer::PrepareScene { scene, path, structure, sky } => {
                    self.loader.prepare(self.load_request(scene, path, structure, sky));
                }
                ToServer::RenderFrame { frame, task_id, spec, task, encoding } => {
                    let sky = spec.appearance.sky;
                    let source = self.loader.source_for(spec.scene).filter(|source| source.has_sky(sky));
                    // The wall went to another scene and back, and took the first order's answer for the last's, which follows
                    // when this scene is loaded: then the wall sends the task again.
                    let Some(source) = source else { continue };
                    let cancelled = Arc::new(AtomicBool::new(false));
                    self.unfinished.retain(|(_, cancelled)| Arc::strong_count(cancelled) > 1);
                    self.unfinished.push((frame, Arc::clone(&cancelled)));
                    let received_at = std::time::Instant::now();
                    let job = Job { frame, task_id, spec, task, encoding, source, cancelled, received_at };
                    self.jobs.push(job)?;
                }
                ToServer::Cancel { frame } => {
                    let of_frame = self.unfinished.iter().filter(|(of, _)| *of == frame);
                    of_frame.for_each(|(_, cancelled)| cancelled.store(true, Relaxed));
                    self.jobs.drop_cancelled();
                }
                ToServer::Ping { sent_us } => self.reply(&ToWall::Pong { sent_us }).await,
                ToServer::Probe { number, scene, camera, at, clip } => {
                    // Tracing one ray is faster than handing it to another thread.
                    if let Some(RenderSource::Scene(scene)) = self.loader.source_for(scene) {
                        self.reply(&ToWall::Probed { number, hit: scene.probe(&camera, at, clip) }).await;
                    }
                }
                ToServer::Look { number, scene, camera, clip, points } => {
                    // A few hundred rays take less than a millisecond.
                    if let Some(RenderSource::Scene(scene)) = self.loader.source_for(scene) {
                        self.reply(&ToWall::Seen { number, seen: scene.sees(&camera, &points, clip) }).await;
                    }
                }
                ToServer::Measure { number, scene, ends, across } => self.measure(number, scene, ends, across),
                ToServer::Refused { reason } => return Err(SessionError::Refused(printable(&reason))),
                ToServer::Welcome | ToServer::SceneFileAwaited { .. } | ToServer::SceneFile { .. } => {
                    return Err(SessionError::OutOfTurn);
                }
            }
        }
        Ok(())
    }

    /// Finds a way along the surface on a thread of its own, which reads every triangle, unless another is being found.
    fn measure(&self, number: u32, scene: SceneId, ends: [DVec3; 2], across: DVec3) {
        let turn = Arc::clone(&self.measuring).try_acquire_owned();
        let (Some(RenderSource::Scene(scene)), Ok(turn)) = (self.loader.source_for(scene), turn) else { return };
        let replies = self.replies.clone();
        tokio::task::spawn_blocking(move || {
            let way = scene.way(ends, across);
            drop(turn);
            // If the writer has ended, the session ends too.
            let _ = replies.blocking_send(encoded(&ToWall::Measured { number, way }));
        });
    }

    /// A request for a scene, with the paths of files that are on this machine.
    fn load_request(
        &self,
        scene: SceneId,
        path: Option<Vec<u8>>,
        structure: Option<Structure>,
        sky: Option<SkyFile>,
    ) -> LoadRequest {
        let path_here = |path: Option<Vec<u8>>| path.filter(|_| self.is_local);
        let sky = sky.map(|SkyFile { id, path }| SkyFile { id, path: path_here(path) });
        LoadRequest { scene, path: path_here(path).map(path_from_bytes), structure, sky }
    }

    async fn reply(&self, message: &ToWall) {
        // If the writer has ended, the session ends too.
        let _ = self.replies.send(encoded(message)).await;
    }
}

async fn write_messages(
    writer: &mut MessageWriter<impl AsyncWrite + Unpin>,
    mut outgoing: mpsc::Receiver<Outgoing>,
    mut replies: mpsc::Receiver<Vec<u8>>,
    loader: &SceneLoader,
) -> Result<(), SessionError> {
    let mut progressed = loader.progressed();
    progressed.mark_changed();
    let mut heartbeat = interval(HEARTBEAT_INTERVAL);
    heartbeat.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        let first = tokio::select! {
            Some(message) = outgoing.recv() => Some(message),
            Some(reply) = replies.recv() => {
                writer.push_encoded(&reply);
                None
            }
            Ok(()) = progressed.changed() => {
                let progressed = progressed.borrow_and_update().clone();
                if let Some((scene, state)) = progressed {
                    writer.push_encoded(&encoded(&ToWall::SceneState { scene, state }));
                }
                None
            }
            _ = heartbeat.tick() => {
                writer.push_encoded(&encoded(&ToWall::Heartbeat));
                None
            }
        };
        let more = std::iter::from_fn(|| outgoing.try_recv().ok()).take(LONGEST_BATCH);
        for Outgoing { bytes, cancelled } in first.into_iter().chain(more) {
            while let Ok(reply) = replies.try_recv() {
                writer.push_encoded(&reply);
            }
            // Cancelled samples would only delay others on a slow link.
            if !cancelled.load(Relaxed) {
                writer.write_encoded(&bytes).await.map_err(WireError::from)?;
            }
        }
        writer.flush().await.map_err(WireError::from)?;
    }
}

fn encoded(message: &ToWall) -> Vec<u8> {
    let mut bytes = Vec::new();
    codec::encode(message, &mut bytes).expect("a render server's messages are short");
    bytes
}
