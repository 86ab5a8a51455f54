//! The farm's thin edge: accepts connections, feeds the scheduler, and carries out what it says.

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
    protocol::{FrameId, FrameSpec, HEARTBEAT_TIMEOUT, SceneState, TaskId, ToServer},
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
    connection::{self, ConnectionEvent, EventSender, PendingTask, PendingTasks},
    frame_buffer::{BufferPool, FrameBuffer},
    scheduler::{self, Action, Event, Scheduler},
    stats::{FarmStatus, FrameStats, NodeId, NodeStatus, Probed},
};

/// Render servers at a time: more than a wall has, few enough for the files that a process may open.
const MOST_NODES: usize = 512;

/// Connections at a time that have not shaken hands. The next one displaces the oldest: a render server needs a few round
/// trips, so a flood of strangers neither takes its place nor keeps it out.
const MOST_STRANGERS: usize = 64;

/// Reports that wait for the farm; when it is full, receiving threads wait.
const LONGEST_REPORT_QUEUE: usize = 1024;

/// How often the scheduler looks for late work while a frame is in flight.
const TICK: Duration = Duration::from_millis(10);

/// A connected render server.
#[derive(Debug)]
struct NodeConnection {
    outgoing: mpsc::Sender<Vec<u8>>,
    pending: Arc<PendingTasks>,
}

/// A frame whose samples are coming in.
#[derive(Debug)]
struct OpenFrame {
    spec: FrameSpec,
    buffer: Arc<FrameBuffer>,
    moved_at: Instant,
    bytes_out: HashMap<NodeId, u64>,
}

/// The farm while it runs.
pub(super) struct Service {
    started_at: Instant,
    key: Option<Key>,
    goal: watch::Receiver<RenderGoal>,
    status: watch::Sender<FarmStatus>,
    finished: Arc<FinishedFrame>,
    wake: Box<dyn Fn() + Send + Sync>,
    scheduler: Scheduler,
    /// Connections that have not shaken hands, the oldest first.
    strangers: VecDeque<(NodeId, AbortHandle)>,
    nodes: BTreeMap<NodeId, NodeConnection>,
    /// How often render servers were lost, by name and machine.
    failures: HashMap<(String, IpAddr), u32>,
    frames: HashMap<FrameId, OpenFrame>,
    spare_buffers: BufferPool,
    /// When the camera of the last frame was set.
    last_moved_at: Option<Instant>,
    /// Whom the last question about the model was put to, and its number.
    pending_probe: Option<(NodeId, u32)>,
    /// How render servers are to keep the scene, if not as they were started.
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
        let scheduler = Scheduler::new(scheduler_goal(&goal.borrow_and_update()));
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
            spare_buffers: BufferPool::default(),
            last_moved_at: None,
            pending_probe: None,
            structure: None,
        }
    }

    /// Runs until the task is aborted or the wall is gone.
    pub(super) async fn run(
        mut self,
        listener: TcpListener,
        mut probes: watch::Receiver<Probe>,
        mut structures: watch::Receiver<Option<Structure>>,
    ) {
        let (reports_in, mut reports) = mpsc::channel(LONGEST_REPORT_QUEUE);
        let mut connections = JoinSet::new();
        let mut last_node = NodeId(0);
        let mut tick = interval(TICK);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let finished = Arc::clone(&self.finished);
        loop {
            tokio::select! {
                (stream, address) = accept(&listener) => {
                    last_node.0 += 1;
                    let events = EventSender { node: last_node, address, farm: reports_in.clone() };
                    let connection = run_connection(stream, self.key.clone(), events, self.started_at);
                    self.strangers.push_back((last_node, connections.spawn(connection)));
                    if self.strangers.len() > MOST_STRANGERS && let Some((_, oldest)) = self.strangers.pop_front() {
                        oldest.abort();
                    }
                }
                Some(_) = connections.join_next(), if !connections.is_empty() => {}
                Some((node, address, report)) = reports.recv() => self.on_connection_event(node, address, report),
                changed = self.goal.changed() => match changed {
                    Ok(()) => self.on_goal(),
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

    fn on_goal(&mut self) {
        let goal = self.goal.borrow_and_update().clone();
        let scene = goal.spec.map(|spec| spec.scene);
        let is_new_scene = scene != self.scheduler.scene();
        self.dispatch(Event::GoalChanged(scheduler_goal(&goal)));
        if is_new_scene {
            self.status.send_modify(|status| status.nodes.iter_mut().for_each(|node| node.scene = None));
            let nodes: Vec<_> = self.nodes.keys().copied().collect();
            nodes.into_iter().for_each(|node| self.request_scene(node));
        }
    }

    /// Has everybody build the scene anew. Nobody is given work until he has done so.
    fn on_structure(&mut self, structure: Option<Structure>) {
        if self.structure == structure {
            return;
        }
        self.structure = structure;
        self.status.send_modify(|status| status.nodes.iter_mut().for_each(|node| node.scene = None));
        for node in self.nodes.keys().copied().collect::<Vec<_>>() {
            self.dispatch(Event::SceneReady { node, ready: false });
            self.request_scene(node);
        }
        (self.wake)();
    }

    /// Hands a question to the first who can answer it. Nobody waits for the answer: if its render server dies, the person
    /// who asked sees none, and asks again.
    fn on_probe(&mut self, Probe { number, view, at, clip }: Probe) {
        let Some((scene, camera)) = view.filter(|&(scene, _)| self.scheduler.scene() == Some(scene)) else { return };
        let ready = self.status.borrow().nodes.iter().find(|node| node.is_ready()).map(|node| node.id);
        self.pending_probe = ready.map(|id| (id, number));
        if let Some(id) = ready {
            self.send(id, &ToServer::Probe { number, scene, camera, at, clip });
        }
    }

    fn on_connection_event(&mut self, id: NodeId, address: SocketAddr, report: ConnectionEvent) {
        match report {
            ConnectionEvent::Joined { name, threads, outgoing, pending } => {
                // One that was displaced a moment before is gone.
                if !self.remove_stranger(id) {
                    return;
                }
                if self.nodes.len() >= MOST_NODES {
                    tracing::warn!("render server {name} at {address} refused: {MOST_NODES} are the most");
                    // Without its queue the connection ends.
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
                self.request_scene(id);
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
                self.dispatch(Event::UnitsPlaced { node: id, frame, task_id, units })
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
                // A resting wall stays at rest: this alone wakes nobody.
                self.change_node(id, |node| node.round_trip_ms = Some(round_trip.as_secs_f64() * 1e3));
            }
            // Once, and by whom it was asked.
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

    /// Whether the connection was one of those that have not shaken hands.
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
                tracing::warn!("render server {name} is silent for {milliseconds} ms: the others render its share");
            } else {
                tracing::info!("render server {name} is heard again");
            }
        });
    }

    fn on_ended(&mut self, id: NodeId, address: SocketAddr, reason: Result<(), connection::ConnectionError>) {
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
            // Who takes a new name each time is not remembered for ever.
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

    /// Tells a render server which scene to get ready.
    fn request_scene(&mut self, id: NodeId) {
        let Some(scene) = self.scheduler.scene() else { return };
        let is_local = self.status.borrow().nodes.iter().any(|node| node.id == id && node.address.ip().is_loopback());
        let path = self.goal.borrow().scene_path.as_ref().filter(|_| is_local).map(|path| path_bytes::to_bytes(path));
        let structure = self.structure;
        self.send(id, &ToServer::LoadScene { scene, path, structure });
    }

    fn dispatch(&mut self, event: Event) {
        let actions = self.scheduler.on_event(self.started_at.elapsed(), event);
        actions.into_iter().for_each(|action| self.execute(action));
    }

    fn execute(&mut self, action: Action) {
        match action {
            Action::Open { frame, spec } => {
                let buffer = Arc::new(self.spare_buffers.take(spec.size));
                let moved_at = self.goal.borrow().moved_at;
                // A frame that no motion asked for is as old as its beginning; so is the first, before which models load.
                let is_first_since = self.last_moved_at.replace(moved_at).is_some_and(|last| last != moved_at);
                let moved_at = if is_first_since { moved_at } else { Instant::now() };
                self.frames.insert(frame, OpenFrame { spec, buffer, moved_at, bytes_out: HashMap::new() });
            }
            Action::Render { node, frame, task_id, spec, task, encoding } => {
                self.add_pending_task(node, frame, task_id, &task);
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
                    let frame = open.finish(stats, &self.status.borrow(), self.spare_buffers.clone());
                    self.finished.put(frame);
                    (self.wake)();
                }
            }
            Action::Discard { frame } => {
                self.frames.remove(&frame);
            }
        }
    }

    fn add_pending_task(&self, node: NodeId, frame: FrameId, task_id: TaskId, task: &shared::division::Task) {
        if let (Some(node), Some(open)) = (self.nodes.get(&node), self.frames.get(&frame)) {
            let buffer = Arc::clone(&open.buffer);
            node.pending.put(task_id, PendingTask::new(frame, task.clone(), buffer));
        }
    }

    /// Queues a message, and says how many bytes it has. A render server that leaves its queue unread loses it, and by
    /// that its connection.
    fn send(&mut self, id: NodeId, message: &ToServer) -> u64 {
        let mut bytes = Vec::new();
        codec::encode(message, &mut bytes).expect("the wall's requests are short");
        let n_bytes = bytes.len() as u64;
        if let Some(node) = self.nodes.get_mut(&id)
            && let Err(mpsc::error::TrySendError::Full(_)) = node.outgoing.try_send(bytes)
        {
            // Closing the queue ends the connection's task, which reports the end.
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
            // One that died meanwhile is no longer known.
            if let Some(known) = farm.nodes.iter().find(|known| known.id == node.id) {
                node.address = Some(known.address);
                (node.n_failures, node.round_trip_ms) = (known.n_failures, known.round_trip_ms);
            }
        }
        stats.bytes_out = self.bytes_out.values().sum();
        Frame { spec: self.spec, rgba: self.buffer.into_samples(spare), stats, moved_at: self.moved_at }
    }
}

fn scheduler_goal(goal: &RenderGoal) -> scheduler::RenderGoal {
    let RenderGoal { spec, is_refinement, division, min_renderers, repeat, in_flight, encoding, .. } = *goal;
    scheduler::RenderGoal { spec, is_refinement, division, min_renderers, repeat, in_flight, encoding }
}

async fn accept(listener: &TcpListener) -> (TcpStream, SocketAddr) {
    loop {
        match listener.accept().await {
            Ok(accepted) => return accepted,
            Err(error) => {
                // Out of file descriptors, or the peer is gone already: neither ends the wall.
                tracing::warn!("cannot accept a connection: {error}");
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        }
    }
}

async fn run_connection(mut stream: TcpStream, key: Option<Key>, events: EventSender, started_at: Instant) {
    // Requests are small and wanted at once.
    let _ = stream.set_nodelay(true);
    let (input, output) = stream.split();
    connection::serve(input, output, key.as_ref(), events, started_at).await;
}
