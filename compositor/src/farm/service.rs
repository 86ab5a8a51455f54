//! The farm's edge: accepts connections, passes events to the scheduler, and executes its actions.

use std::{
    collections::{BTreeMap, HashMap, VecDeque},
    net::{IpAddr, SocketAddr},
    sync::Arc,
    time::{Duration, Instant},
};

use channel::key::Key;
use renderer::cli::path_bytes;
use shared::{
    codec,
    printable::printable,
    protocol::{FrameId, FrameSpec, HEARTBEAT_TIMEOUT, SceneState, ToServer},
    structure::Structure,
};
use tokio::{
    net::{TcpListener, TcpStream},
    sync::{mpsc, watch},
    task::{AbortHandle, JoinSet},
    time::{MissedTickBehavior, interval},
};

use super::{
    FinishedFrame, Frame, Probe, RenderGoal,
    connection::{self, ConnectionError, ConnectionEvent, EventSender, PendingTask, PendingTasks},
    frame_buffer::{BufferPool, FrameBuffer},
    scheduler::{Action, Event, Scheduler},
    stats::{FarmStatus, FrameStats, NodeId, NodeStatus, Probed},
};

/// Most render servers at a time: more than a wall has, and fewer than the files that a process may open.
const MOST_NODES: usize = 512;

/// Most connections before their handshake is over; the next one displaces the oldest. A render server needs only a few
/// round trips, so a flood of connections cannot keep it out.
const MOST_STRANGERS: usize = 64;

/// Most events that wait for the farm; when the queue is full, connections wait.
const LONGEST_EVENT_QUEUE: usize = 1024;

/// How often the scheduler looks for late tasks while a frame is in flight.
const TICK: Duration = Duration::from_millis(10);

/// A connected render server.
#[derive(Debug)]
struct NodeConnection {
    outgoing: mpsc::Sender<Vec<u8>>,
    pending: Arc<PendingTasks>,
}

/// A frame in flight, as the connections need it.
#[derive(Debug)]
struct OpenFrame {
    spec: FrameSpec,
    buffer: Arc<FrameBuffer>,
    moved_at: Instant,
    bytes_out: HashMap<NodeId, u64>,
}

/// A running farm, on a task of its own.
pub(super) struct Service {
    started_at: Instant,
    key: Option<Key>,
    goal: watch::Receiver<RenderGoal>,
    status: watch::Sender<FarmStatus>,
    finished: Arc<FinishedFrame>,
    wake: Box<dyn Fn() + Send + Sync>,
    scheduler: Scheduler,
    /// Connections whose handshake is not over, the oldest first.
    strangers: VecDeque<(NodeId, AbortHandle)>,
    nodes: BTreeMap<NodeId, NodeConnection>,
    /// How often render servers were lost, by name and address.
    failures: HashMap<(String, IpAddr), u32>,
    frames: HashMap<FrameId, OpenFrame>,
    buffers: BufferPool,
    /// The render server that the last probe was sent to, and the probe's number.
    pending_probe: Option<(NodeId, u32)>,
    /// The structure that render servers must keep the scene in; `None`: the one that each was started with.
    structure: Option<Structure>,
}

impl Service {
    pub(super) fn new(
        key: Option<Key>,
        mut goal: watch::Receiver<RenderGoal>,
        status: watch::Sender<FarmStatus>,
        finished: Arc<FinishedFrame>,
        wake: Box<dyn Fn() + Send + Sync>,
    ) -> Self {
        let scheduler = Scheduler::new(goal.borrow_and_update().clone());
        let started_at = Instant::now();
        Self {
            started_at,
            key,
            goal,
            status,
            finished,
            wake,
            scheduler,
            strangers: VecDeque::new(),
            nodes: BTreeMap::new(),
            failures: HashMap::new(),
            frames: HashMap::new(),
            buffers: BufferPool::default(),
            pending_probe: None,
            structure: None,
        }
    }

    /// Runs until it is aborted or the [`super::Farm`] is dropped.
    pub(super) async fn run(
        mut self,
        listener: TcpListener,
        mut probes: watch::Receiver<Probe>,
        mut structures: watch::Receiver<Option<Structure>>,
    ) {
        let (event_sender, mut events) = mpsc::channel(LONGEST_EVENT_QUEUE);
        let mut connections = JoinSet::new();
        let mut last_node = NodeId(0);
        let mut tick = interval(TICK);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let finished = Arc::clone(&self.finished);
        loop {
            tokio::select! {
                (stream, address) = accept(&listener) => {
                    last_node.0 += 1;
                    let sender = EventSender { node: last_node, address, farm: event_sender.clone() };
                    let connection = run_connection(stream, self.key.clone(), sender, self.started_at);
                    self.strangers.push_back((last_node, connections.spawn(connection)));
                    if self.strangers.len() > MOST_STRANGERS && let Some((_, oldest)) = self.strangers.pop_front() {
                        oldest.abort();
                    }
                }
                Some(_) = connections.join_next(), if !connections.is_empty() => {}
                Some((node, address, event)) = events.recv() => self.on_connection_event(node, address, event),
                changed = self.goal.changed() => match changed {
                    Ok(()) => {
                        let goal = self.goal.borrow_and_update().clone();
                        self.dispatch(Event::GoalChanged(goal));
                    }
                    Err(_) => return,
                },
                Ok(()) = structures.changed() => {
                    let structure = *structures.borrow_and_update();
                    self.on_structure(structure);
                }
                Ok(()) = probes.changed() => {
                    let probe = *probes.borrow_and_update();
                    self.on_probe(probe);
                }
                () = finished.taken.notified() => self.dispatch(Event::FrameTaken),
                _ = tick.tick(), if self.scheduler.has_frame_in_flight() => self.dispatch(Event::Tick),
            }
        }
    }

    fn on_structure(&mut self, structure: Option<Structure>) {
        if std::mem::replace(&mut self.structure, structure) != structure {
            self.dispatch(Event::StructureChanged);
            (self.wake)();
        }
    }

    /// Sends a probe to the first render server that is ready. If it dies before it answers, there is no answer.
    fn on_probe(&mut self, Probe { number, view, at, clip }: Probe) {
        let Some((scene, camera)) = view.filter(|&(scene, _)| self.scheduler.scene() == Some(scene)) else { return };
        let ready = self.status.borrow().nodes.iter().find(|node| node.is_ready()).map(|node| node.id);
        self.pending_probe = ready.map(|id| (id, number));
        if let Some(id) = ready {
            self.send(id, &ToServer::Probe { number, scene, camera, at, clip });
        }
    }

    fn on_connection_event(&mut self, id: NodeId, address: SocketAddr, event: ConnectionEvent) {
        match event {
            ConnectionEvent::Joined { name, threads, outgoing, pending } => {
                // A newer connection has displaced it.
                if !self.remove_stranger(id) {
                    return;
                }
                if self.nodes.len() >= MOST_NODES {
                    tracing::warn!("render server {name} at {address} refused: {MOST_NODES} have joined already");
                    // Dropping its queue ends the connection.
                    return;
                }
                tracing::info!("render server {name} joined from {address} with {threads} threads");
                self.nodes.insert(id, NodeConnection { outgoing, pending });
                let n_failures = self.failures.get(&(name.clone(), address.ip())).copied().unwrap_or(0);
                let joined = NodeStatus {
                    id,
                    name: name.clone(),
                    address,
                    threads,
                    scene: None,
                    is_silent: false,
                    n_failures,
                    round_trip_ms: None,
                };
                self.status.send_modify(|status| status.nodes.push(joined));
                self.dispatch(Event::Joined { node: id, name, threads });
                (self.wake)();
            }
            ConnectionEvent::Scene { scene, state } => {
                if self.scheduler.scene() != Some(scene) {
                    return;
                }
                let ready = matches!(state, SceneState::Ready { .. });
                self.on_scene_state(id, state);
                self.dispatch(Event::SceneReady { node: id, ready });
                (self.wake)();
            }
            ConnectionEvent::UnitsPlaced { frame, task_id, units } => {
                self.dispatch(Event::UnitsPlaced { node: id, frame, task_id, units });
            }
            ConnectionEvent::TaskDone { frame, task_id, timings, costs } => {
                self.dispatch(Event::TaskDone { node: id, frame, task_id, timings, costs });
            }
            ConnectionEvent::Silent(is_silent) => {
                self.on_silent(id, is_silent);
                self.dispatch(Event::Silent { node: id, is_silent });
                (self.wake)();
            }
            ConnectionEvent::RoundTrip(round_trip) => {
                // No wake: a round trip alone must not disturb a resting wall.
                self.change_node(id, |node| node.round_trip_ms = Some(round_trip.as_secs_f64() * 1e3));
            }
            // Only the first answer, and only from the render server that was asked.
            ConnectionEvent::Probed { number, hit }
                if self.pending_probe.take_if(|pending_probe| *pending_probe == (id, number)).is_some() =>
            {
                self.status.send_modify(|status| status.probed = Some(Probed { number, hit }));
                (self.wake)();
            }
            ConnectionEvent::Probed { .. } => {}
            ConnectionEvent::Ended(reason) => self.on_ended(id, address, reason),
        }
    }

    /// Whether the connection was still a stranger.
    fn remove_stranger(&mut self, id: NodeId) -> bool {
        let index = self.strangers.iter().position(|&(stranger, _)| stranger == id);
        index.and_then(|index| self.strangers.remove(index)).is_some()
    }

    fn on_scene_state(&self, id: NodeId, state: SceneState) {
        self.status.send_modify(|status| {
            let Some(node) = status.nodes.iter_mut().find(|node| node.id == id) else { return };
            if let SceneState::Missing { reason } = &state {
                let reason = printable(reason);
                tracing::warn!("render server {} does not have the model: {reason}", node.name);
                status.message = Some(format!("{}: {reason}", node.name));
            }
            if matches!(state, SceneState::Ready { .. }) && !node.is_ready() {
                tracing::info!("render server {} is ready", node.name);
            }
            node.scene = Some(state);
        });
    }

    fn on_silent(&self, id: NodeId, is_silent: bool) {
        self.change_node(id, |node| {
            node.is_silent = is_silent;
            let name = &node.name;
            if is_silent {
                let milliseconds = HEARTBEAT_TIMEOUT.as_millis();
                tracing::warn!("render server {name} has been silent for {milliseconds} ms: others render its share");
            } else {
                tracing::info!("render server {name} is heard again");
            }
        });
    }

    fn on_ended(&mut self, id: NodeId, address: SocketAddr, reason: Result<(), ConnectionError>) {
        self.remove_stranger(id);
        if self.nodes.remove(&id).is_none() {
            if let Err(reason) = reason {
                tracing::warn!("connection from {address} dropped: {reason}");
            }
            return;
        }
        self.status.send_modify(|status| {
            let name = status.nodes.iter().find(|node| node.id == id).map_or("", |node| &node.name).to_owned();
            let reason = reason.map_or_else(|error| error.to_string(), |()| "it closed the connection".to_owned());
            tracing::warn!("render server {name} at {address} lost: {reason}");
            let failed = (name.clone(), address.ip());
            // Bounded: a peer may take a new name each time.
            if self.failures.len() < MOST_NODES || self.failures.contains_key(&failed) {
                *self.failures.entry(failed).or_default() += 1;
            }
            status.nodes.retain(|node| node.id != id);
            status.n_lost += 1;
            status.message =
                Some(format!("{name} lost: {reason}. The others render its share; start it again to have it back."));
        });
        self.dispatch(Event::Lost { node: id });
        (self.wake)();
    }

    fn change_node(&self, id: NodeId, change: impl FnOnce(&mut NodeStatus)) {
        self.status.send_modify(|status| {
            if let Some(node) = status.nodes.iter_mut().find(|node| node.id == id) {
                change(node);
            }
        });
    }

    fn dispatch(&mut self, event: Event) {
        let actions = self.scheduler.on_event(self.started_at.elapsed(), event);
        actions.into_iter().for_each(|action| self.execute(action));
    }

    fn execute(&mut self, action: Action) {
        match action {
            Action::LoadScene { node, scene, path } => {
                let mut is_local = false;
                self.change_node(node, |node| {
                    node.scene = None;
                    is_local = node.address.ip().is_loopback();
                });
                if let Some(scene) = scene {
                    let path = path.filter(|_| is_local).map(|path| path_bytes::to_bytes(&path));
                    self.send(node, &ToServer::LoadScene { scene, path, structure: self.structure });
                }
            }
            Action::Open { frame, spec, moved_at } => {
                let buffer = Arc::new(self.buffers.take(spec.size));
                let moved_at = moved_at.unwrap_or_else(Instant::now);
                self.frames.insert(frame, OpenFrame { spec, buffer, moved_at, bytes_out: HashMap::new() });
            }
            Action::Render { node, frame, task_id, spec, task, encoding } => {
                if let (Some(connection), Some(open)) = (self.nodes.get(&node), self.frames.get(&frame)) {
                    let pending_task = PendingTask::new(frame, task, Arc::clone(&open.buffer));
                    connection.pending.put(task_id, pending_task);
                }
                let n_bytes = self.send(node, &ToServer::RenderFrame { frame, task_id, spec, task, encoding });
                if let Some(open) = self.frames.get_mut(&frame) {
                    *open.bytes_out.entry(node).or_default() += n_bytes;
                }
            }
            Action::Cancel { node, frame } => {
                if let Some(node) = self.nodes.get(&node) {
                    node.pending.clear(frame);
                }
                self.send(node, &ToServer::Cancel { frame });
            }
            Action::Show { frame, stats } => {
                if stats.attempts > 1 {
                    self.status.send_modify(|status| status.n_healed += 1);
                }
                if let Some(open) = self.frames.remove(&frame) {
                    let frame = open.finish(stats, &self.status.borrow(), self.buffers.clone());
                    self.finished.put(frame);
                    (self.wake)();
                }
            }
            Action::Discard { frame } => {
                self.frames.remove(&frame);
            }
        }
    }

    /// Queues a message and returns its size in bytes. A render server that does not read its messages is dropped when its
    /// queue is full.
    fn send(&mut self, id: NodeId, message: &ToServer) -> u64 {
        let mut bytes = Vec::new();
        codec::encode(message, &mut bytes).expect("the wall's requests are short");
        let n_bytes = bytes.len() as u64;
        if let Some(node) = self.nodes.get_mut(&id)
            && let Err(mpsc::error::TrySendError::Full(_)) = node.outgoing.try_send(bytes)
        {
            // Closing the queue ends the connection, which reports it.
            (node.outgoing, _) = mpsc::channel(1);
        }
        n_bytes
    }
}

impl OpenFrame {
    fn finish(self, mut stats: FrameStats, farm: &FarmStatus, spare: BufferPool) -> Frame {
        (stats.n_lost, stats.n_healed) = (farm.n_lost, farm.n_healed);
        for node in &mut stats.nodes {
            node.bytes_out = self.bytes_out.get(&node.id).copied().unwrap_or(0);
            // A render server that was lost meanwhile is not listed.
            if let Some(known) = farm.nodes.iter().find(|known| known.id == node.id) {
                node.address = Some(known.address);
                (node.n_failures, node.round_trip_ms) = (known.n_failures, known.round_trip_ms);
            }
        }
        stats.bytes_out = self.bytes_out.values().sum();
        Frame { spec: self.spec, rgba: self.buffer.into_samples(spare), stats, moved_at: self.moved_at }
    }
}

async fn accept(listener: &TcpListener) -> (TcpStream, SocketAddr) {
    loop {
        match listener.accept().await {
            Ok(accepted) => return accepted,
            Err(error) => {
                // Out of file descriptors, or the peer is gone already: the wall goes on.
                tracing::warn!("cannot accept a connection: {error}");
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        }
    }
}

async fn run_connection(mut stream: TcpStream, key: Option<Key>, events: EventSender, started_at: Instant) {
    // Requests are small and must not wait for more.
    let _ = stream.set_nodelay(true);
    let (input, output) = stream.split();
    connection::serve(input, output, key.as_ref(), events, started_at).await;
}
