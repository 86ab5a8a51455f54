//! The farm's edge: accepts connections, passes events to the scheduler, and executes its actions.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap, VecDeque},
    io,
    net::{IpAddr, SocketAddr},
    path::PathBuf,
    sync::Arc,
    time::{Duration, Instant},
};

use channel::{key::Key, wire::is_same_machine};
use shared::{
    printable::{counted, printable},
    protocol::{FrameId, HEARTBEAT_TIMEOUT, SceneState, SkyFile, ToServer},
    sky::SkyId,
    structure::Structure,
};
use tokio::{
    net::{TcpListener, TcpStream},
    sync::{mpsc, watch},
    task::{AbortHandle, JoinSet},
    time::{MissedTickBehavior, interval, sleep_until},
};

use super::{
    FinishedFrame, Look, Probe, RenderGoal, Stretch,
    connection::{self, ConnectionError, ConnectionEvent, EventSender, PendingTask, PendingTasks},
    frame_buffer::BufferPool,
    local_news::LocalNews,
    log_limit::LogLimit,
    losses::Losses,
    notices::NodeKey,
    open_frame::OpenFrame,
    outbox::Outbox,
    questions::Questions,
    rate_limit::RateLimit,
    scheduler::{Action, Event, Scheduler},
    stats::{FarmStatus, FoundWay, NodeId, NodeStatus, Probed, Seen},
    supply::SceneSupply,
};

/// Most render servers at a time: more than a wall has, and fewer than the files that a process may open.
pub(super) const MOST_NODES: usize = 512;

/// Most connections before their handshake is over; the next one displaces the oldest. A render server needs only a few
/// round trips, so a flood of connections cannot keep it out.
const MOST_STRANGERS: usize = 64;

/// Most events that wait for the farm; when the queue is full, connections wait.
const LONGEST_EVENT_QUEUE: usize = 1024;

/// The pause after a connection that could not be accepted.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Connections that are accepted at once: four times those of a whole farm, which may come from one address.
const MOST_ACCEPTED_AT_ONCE: u32 = 4 * MOST_NODES as u32;

/// The pause between further ones: each costs the wall about 0.1 ms. A render server waits for the few that the system
/// queues, which takes less than a handshake may take.
const ACCEPT_INTERVAL: Duration = Duration::from_micros(500);

/// News of render servers wake the wall at most this often: each may redraw its windows.
const NEWS_INTERVAL: Duration = Duration::from_millis(50);

/// The questions that the wall asks about the model.
type Asked = (watch::Receiver<Probe>, watch::Receiver<Look>, watch::Receiver<Stretch>);

/// How often the scheduler looks for late tasks while a frame is in flight.
const TICK: Duration = Duration::from_millis(10);

/// A connected render server.
#[derive(Debug)]
struct NodeConnection {
    /// Whether it runs on the wall's machine, and can read the wall's files.
    is_local: bool,
    outbox: Arc<Outbox>,
    pending: Arc<PendingTasks>,
}

/// A running farm, on a task of its own.
pub(super) struct Service {
    started_at: Instant,
    key: Option<Key>,
    goal: watch::Receiver<RenderGoal>,
    status: watch::Sender<FarmStatus>,
    finished: Arc<FinishedFrame>,
    wake: Box<dyn Fn() + Send + Sync>,
    supply: Arc<SceneSupply>,
    scheduler: Scheduler,
    /// Connections whose handshake is not over, the oldest first.
    strangers: VecDeque<(NodeId, AbortHandle)>,
    nodes: BTreeMap<NodeId, NodeConnection>,
    /// The names of the wall's own render servers.
    local: BTreeSet<String>,
    losses: Arc<Losses>,
    /// Lines about strangers, by reason.
    stranger_lines: LogLimit<(Option<IpAddr>, String)>,
    /// Lines about render servers, by event and name.
    node_lines: LogLimit<(&'static str, String)>,
    accepts: RateLimit,
    next_accept_at: tokio::time::Instant,
    /// When the wall is woken for news of render servers, if there are any.
    news_at: Option<tokio::time::Instant>,
    /// When it may be woken for more.
    next_news_at: tokio::time::Instant,
    frames: HashMap<FrameId, OpenFrame>,
    buffers: BufferPool,
    /// The render server that the last probe was sent to, and the probe's number.
    pending_probe: Option<(NodeId, u32)>,
    looks: Questions<Look>,
    stretches: Questions<Stretch>,
    /// The structure that render servers must keep the scene in; `None`: the one that each was started with.
    structure: Option<Structure>,
}

impl Service {
    pub(super) fn new(
        key: Option<Key>,
        mut goal: watch::Receiver<RenderGoal>,
        status: watch::Sender<FarmStatus>,
        finished: Arc<FinishedFrame>,
        supply: Arc<SceneSupply>,
        wake: Box<dyn Fn() + Send + Sync>,
    ) -> Self {
        let scheduler = Scheduler::new(goal.borrow_and_update().clone());
        supply_goal(&supply, &goal.borrow());
        let started_at = Instant::now();
        Self {
            started_at,
            key,
            goal,
            status,
            finished,
            wake,
            supply,
            scheduler,
            strangers: VecDeque::new(),
            nodes: BTreeMap::new(),
            local: BTreeSet::new(),
            losses: Arc::default(),
            stranger_lines: LogLimit::of_strangers(),
            node_lines: LogLimit::of_nodes(),
            accepts: RateLimit::new(MOST_ACCEPTED_AT_ONCE, ACCEPT_INTERVAL),
            next_accept_at: tokio::time::Instant::now(),
            news_at: None,
            next_news_at: tokio::time::Instant::now(),
            frames: HashMap::new(),
            buffers: BufferPool::default(),
            pending_probe: None,
            looks: Questions::default(),
            stretches: Questions::default(),
            structure: None,
        }
    }

    /// Runs until it is aborted or the [`super::Farm`] is dropped.
    pub(super) async fn run(
        mut self,
        listener: TcpListener,
        (mut probes, mut looks, mut stretches): Asked,
        mut structures: watch::Receiver<Option<Structure>>,
        mut local_news: mpsc::UnboundedReceiver<LocalNews>,
    ) {
        let (event_sender, mut events) = mpsc::channel(LONGEST_EVENT_QUEUE);
        let mut connections = JoinSet::new();
        let mut last_node = NodeId(0);
        let mut tick = interval(TICK);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let finished = Arc::clone(&self.finished);
        loop {
            tokio::select! {
                accepted = accept_after(self.next_accept_at, &listener) => {
                    let Some((stream, address)) = self.on_accepted(accepted) else { continue };
                    last_node.0 += 1;
                    let is_local = stream.local_addr().is_ok_and(|here| is_same_machine(here, address));
                    let sender = EventSender { node: last_node, address, is_local, farm: event_sender.clone() };
                    let connection = connection::run(stream, self.key.clone(), sender, Arc::clone(&self.losses), Arc::clone(&self.supply), self.started_at);
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
                        supply_goal(&self.supply, &goal);
                        self.dispatch(Event::GoalChanged(goal));
                    }
                    Err(_) => return,
                },
                Ok(()) = structures.changed() => {
                    let structure = *structures.borrow_and_update();
                    self.on_structure(structure);
                }
                Some(news) = local_news.recv() => self.on_local_news(news),
                Ok(()) = probes.changed() => {
                    let probe = *probes.borrow_and_update();
                    self.on_probe(probe);
                }
                Ok(()) = looks.changed() => {
                    self.looks.ask(looks.borrow_and_update().clone());
                    self.send_questions();
                }
                Ok(()) = stretches.changed() => {
                    self.stretches.ask(*stretches.borrow_and_update());
                    self.send_questions();
                }
                () = finished.taken.notified() => self.dispatch(Event::FrameTaken),
                () = sleep_until(self.news_at.unwrap_or(self.next_news_at)), if self.news_at.is_some() => self.on_news(),
                _ = tick.tick(), if self.scheduler.has_frame_in_flight() => self.dispatch(Event::Tick),
            }
        }
    }

    /// The connection, unless it could not be accepted; the next is accepted after a pause then.
    fn on_accepted(&mut self, accepted: io::Result<(TcpStream, SocketAddr)>) -> Option<(TcpStream, SocketAddr)> {
        let now = self.started_at.elapsed();
        match accepted {
            Ok(accepted) => {
                self.accepts.count(now);
                self.next_accept_at = tokio::time::Instant::now() + self.accepts.wait(now);
                Some(accepted)
            }
            Err(error) => {
                // Out of file descriptors, or the peer is gone already: the wall goes on.
                if let Some(more) = self.stranger_lines.admit(now, (None, "cannot accept".to_owned())) {
                    tracing::warn!("cannot accept a connection: {error}{more}");
                }
                self.next_accept_at = tokio::time::Instant::now() + ACCEPT_PAUSE;
                None
            }
        }
    }

    fn on_structure(&mut self, structure: Option<Structure>) {
        if std::mem::replace(&mut self.structure, structure) != structure {
            self.dispatch(Event::StructureChanged);
            (self.wake)();
        }
    }

    /// Wakes the wall soon, and not often: nodes that come and go must not keep it drawing.
    fn wake_for_news(&mut self) {
        self.news_at.get_or_insert(self.next_news_at);
    }

    fn on_news(&mut self) {
        self.news_at = None;
        self.next_news_at = tokio::time::Instant::now() + NEWS_INTERVAL;
        (self.wake)();
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

    /// Sends the questions that wait to the first render server that is ready, unless another of the kind is being answered.
    fn send_questions(&mut self) {
        let ready = self.status.borrow().nodes.iter().find(|node| node.is_ready()).map(|node| node.id);
        let (Some(id), Some(scene)) = (ready, self.scheduler.scene()) else { return };
        if let Some(Look { number, view: Some((scene, camera)), clip, points }) = self.looks.begin(id, scene) {
            self.send(id, &ToServer::Look { number, scene, camera, clip, points: points.to_vec() });
        }
        if let Some(Stretch { number, scene: Some(scene), ends, across }) = self.stretches.begin(id, scene) {
            self.send(id, &ToServer::Measure { number, scene, ends, across });
        }
    }

    /// A render server will not answer.
    fn lose_questions(&mut self, id: NodeId) {
        self.looks.lose(id);
        self.stretches.lose(id);
    }

    fn on_connection_event(&mut self, id: NodeId, address: SocketAddr, event: ConnectionEvent) {
        match event {
            ConnectionEvent::Joined { name, threads, is_local, outbox, pending } => {
                // A newer connection has displaced it.
                if !self.remove_stranger(id) {
                    return;
                }
                if self.nodes.len() >= MOST_NODES {
                    let reason = format!("{MOST_NODES} render servers have joined already");
                    outbox.push(&ToServer::Refused { reason });
                    outbox.close();
                    return;
                }
                if let Some(more) = self.admit_line("joined", &name) {
                    let threads = counted(threads, "thread");
                    tracing::info!("render server {name} joined from {address} with {threads}{more}");
                }
                self.nodes.insert(id, NodeConnection { is_local, outbox, pending });
                let n_failures = self.losses.n_lost(&name, address.ip());
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
                self.status.send_modify(|status| {
                    status.notices.clear_outside(address.ip());
                    status.nodes.push(joined);
                });
                self.dispatch(Event::Joined { node: id, name, threads });
                self.wake_for_news();
            }
            ConnectionEvent::Fetching => drop(self.remove_stranger(id)),
            ConnectionEvent::Scene { scene, state } => {
                if self.scheduler.scene() != Some(scene) {
                    return;
                }
                let ready = matches!(state, SceneState::Ready { .. });
                self.on_scene_state(id, state);
                self.dispatch(Event::SceneReady { node: id, ready });
                if !ready {
                    self.lose_questions(id);
                }
                self.send_questions();
                self.wake_for_news();
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
                self.send_questions();
                self.wake_for_news();
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
            ConnectionEvent::Seen { number, seen } => {
                if self.looks.answer(id, number) {
                    self.status.send_modify(|status| status.seen = Some(Seen { number, seen: seen.into() }));
                    (self.wake)();
                    self.send_questions();
                }
            }
            ConnectionEvent::Measured { number, way } => {
                if self.stretches.answer(id, number) {
                    self.status.send_modify(|status| status.way = Some(FoundWay { number, way }));
                    (self.wake)();
                    self.send_questions();
                }
            }
            ConnectionEvent::Ended(reason) => self.on_ended(id, address, reason),
        }
    }

    /// Whether the connection was still a stranger.
    fn remove_stranger(&mut self, id: NodeId) -> bool {
        let index = self.strangers.iter().position(|&(stranger, _)| stranger == id);
        index.and_then(|index| self.strangers.remove(index)).is_some()
    }

    /// Whether a line about a render server may be written now; if so, what to add to it.
    fn admit_line(&mut self, line: &'static str, name: &str) -> Option<String> {
        self.node_lines.admit(self.started_at.elapsed(), (line, name.to_owned()))
    }

    fn name(&self, id: NodeId) -> String {
        let status = self.status.borrow();
        status.nodes.iter().find(|node| node.id == id).map_or_else(String::new, |node| node.name.clone())
    }

    /// The render server across its connections.
    fn key(&self, id: NodeId) -> NodeKey {
        let status = self.status.borrow();
        let Some(node) = status.nodes.iter().find(|node| node.id == id) else { return NodeKey::default() };
        let is_ours = self.local.contains(&node.name) && self.nodes.get(&id).is_some_and(|node| node.is_local);
        (node.name.clone(), (!is_ours).then(|| node.address.ip()))
    }

    fn on_scene_state(&mut self, id: NodeId, mut state: SceneState) {
        if let SceneState::Missing { reason } = &mut state {
            *reason = printable(reason);
        }
        let name = self.name(id);
        let was_ready = self.status.borrow().nodes.iter().any(|node| node.id == id && node.is_ready());
        let was_fetching = self.status.borrow().nodes.iter().any(|node| node.id == id && node.transfer().is_some());
        match &state {
            SceneState::Missing { reason } => {
                if let Some(more) = self.admit_line("missing", &name) {
                    tracing::warn!("render server {name} cannot render yet: {reason}{more}");
                }
                let (key, text) = (self.key(id), format!("{name}: {reason}."));
                self.status.send_modify(|status| status.notices.put(key, text));
            }
            SceneState::Fetching(transfer) if !was_fetching => {
                if let Some(more) = self.admit_line("fetching", &name) {
                    tracing::info!("render server {name} fetches the model: {transfer}{more}");
                }
            }
            SceneState::Ready { .. } if !was_ready => {
                if let Some(more) = self.admit_line("ready", &name) {
                    tracing::info!("render server {name} is ready{more}");
                }
                let key = self.key(id);
                self.status.send_modify(|status| status.notices.clear(&key));
            }
            _ => {}
        }
        self.change_node(id, |node| node.scene = Some(state));
    }

    fn on_silent(&mut self, id: NodeId, is_silent: bool) {
        self.change_node(id, |node| node.is_silent = is_silent);
        let name = self.name(id);
        let Some(more) = self.admit_line(if is_silent { "silent" } else { "heard" }, &name) else { return };
        if is_silent {
            let milliseconds = HEARTBEAT_TIMEOUT.as_millis();
            tracing::warn!("render server {name} has been silent for {milliseconds} ms: others render its share{more}");
        } else {
            tracing::info!("render server {name} is heard again{more}");
        }
    }

    fn on_ended(&mut self, id: NodeId, address: SocketAddr, reason: Result<(), ConnectionError>) {
        self.remove_stranger(id);
        let key = self.key(id);
        if self.nodes.remove(&id).is_none() {
            if let Err(reason) = reason {
                // Without the numbers in it, which a stranger chooses.
                let kind = (Some(address.ip()), reason.to_string().replace(char::is_numeric, ""));
                if let Some(more) = self.stranger_lines.admit(self.started_at.elapsed(), kind) {
                    tracing::warn!("connection from {address} dropped: {reason}{more}");
                    if let Some(reason) = reason.keeps_outside() {
                        self.status.send_modify(|status| status.notices.put_outside(address.ip(), reason));
                        self.wake_for_news();
                    }
                }
            }
            return;
        }
        let name = self.name(id);
        let reason = reason.map_or_else(|error| error.to_string(), |()| "it closed the connection".to_owned());
        if let Some(more) = self.admit_line("lost", &name) {
            tracing::warn!("render server {name} at {address} lost: {reason}{more}");
        }
        self.losses.add(Instant::now(), &name, address.ip());
        self.status.send_modify(|status| {
            status.nodes.retain(|node| node.id != id);
            status.n_lost += 1;
            status.notices.put_lost(key, &reason, status.nodes.is_empty());
        });
        self.dispatch(Event::Lost { node: id });
        self.lose_questions(id);
        self.send_questions();
        self.wake_for_news();
    }

    fn on_local_news(&mut self, news: LocalNews) {
        match news {
            LocalNews::Started { name } => {
                self.local.insert(name.clone());
                self.status.send_modify(|status| status.notices.reword_started(&(name, None)));
            }
            LocalNews::Ended { name, text } => self.status.send_modify(|status| status.notices.put((name, None), text)),
        }
        self.wake_for_news();
    }

    fn change_node(&self, id: NodeId, change: impl FnOnce(&mut NodeStatus)) {
        self.status.send_modify(|status| {
            if let Some(node) = status.nodes.iter_mut().find(|node| node.id == id) {
                change(node);
            }
        });
    }

    fn dispatch(&mut self, event: Event) {
        let now = self.started_at.elapsed();
        let actions = self.scheduler.on_event(now, event);
        actions.into_iter().for_each(|action| self.execute(action));
        let percent = self.scheduler.percent(now);
        if self.status.borrow().percent != percent {
            self.status.send_modify(|status| status.percent = percent);
            self.wake_for_news();
        }
    }

    fn execute(&mut self, action: Action) {
        match action {
            Action::LoadScene { node, scene, path, sky } => {
                self.change_node(node, |node| node.scene = None);
                if let Some(scene) = scene {
                    let (path, sky, structure) = (self.path_on(node, path), self.sky_on(node, sky), self.structure);
                    self.send(node, &ToServer::LoadScene { scene, path, structure, sky });
                }
            }
            Action::PrepareScene { node, scene, path, sky } => {
                let (path, sky, structure) = (self.path_on(node, path), self.sky_on(node, sky), self.structure);
                self.send(node, &ToServer::PrepareScene { scene, path, structure, sky });
            }
            Action::Open { frame, spec, moved_at, change } => {
                let buffer = Arc::new(self.buffers.take(spec.size));
                let moved_at = moved_at.unwrap_or_else(Instant::now);
                self.frames.insert(frame, OpenFrame { spec, buffer, moved_at, change, bytes_out: HashMap::new() });
            }
            Action::Render { node, frame, task_id, spec, task, encoding } => {
                self.supply.note_frame();
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
                self.forget(frame);
                if stats.is_healed {
                    self.status.send_modify(|status| status.n_healed += 1);
                }
                if let Some(open) = self.frames.remove(&frame) {
                    let frame = open.finish(stats, &self.status.borrow(), self.buffers.clone());
                    self.finished.put(frame);
                    (self.wake)();
                }
            }
            Action::Discard { frame } => {
                self.forget(frame);
                self.frames.remove(&frame);
            }
        }
    }

    /// The path of a file as a render server needs it, which can read it on this machine only.
    fn path_on(&self, node: NodeId, path: Option<PathBuf>) -> Option<Vec<u8>> {
        let is_local = self.nodes.get(&node).is_some_and(|node| node.is_local);
        path.filter(|_| is_local).map(|path| path.into_os_string().into_encoded_bytes())
    }

    fn sky_on(&self, node: NodeId, sky: Option<(SkyId, Option<PathBuf>)>) -> Option<SkyFile> {
        sky.map(|(id, path)| SkyFile { id, path: self.path_on(node, path) })
    }

    /// Queues a message and returns its size in bytes.
    fn send(&self, id: NodeId, message: &ToServer) -> u64 {
        self.nodes.get(&id).map_or(0, |node| node.outbox.push(message))
    }

    fn forget(&self, frame: FrameId) {
        for node in self.nodes.values() {
            node.outbox.forget(frame);
        }
    }
}

fn supply_goal(supply: &SceneSupply, goal: &RenderGoal) {
    let on_show = goal.spec.map(|spec| (spec.scene, goal.scene_path.clone()));
    supply.set_scenes(on_show.into_iter().chain(goal.next_scene.clone()));
}

async fn accept_after(when: tokio::time::Instant, listener: &TcpListener) -> io::Result<(TcpStream, SocketAddr)> {
    sleep_until(when).await;
    listener.accept().await
}
