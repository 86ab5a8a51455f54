//! Lies between the connections of remotes and the wall: orders go in, state and pictures come out.

use std::{
    collections::HashMap,
    net::IpAddr,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{
            AtomicBool, AtomicU64, AtomicUsize,
            Ordering::{Relaxed, SeqCst},
        },
    },
    time::{Duration, Instant},
};

use axum::{body::Bytes, extract::ws::Utf8Bytes};
use renderer::cli::recent_log;
use serde_json::json;
use tokio::sync::{mpsc, watch};

use super::{
    access::Access,
    message::{Action, Message},
    picture::Thumbnail,
    state::WallState,
    tokens::Role,
    turns::{Client, Place, Turns, network},
};
use crate::farm::LogLimit;

/// States are told at most so often: a motion has many.
const STATE_INTERVAL: Duration = Duration::from_millis(50);

/// An order to the wall.
#[derive(Debug)]
pub(crate) enum Order {
    /// Act, and tell when the wall shows it.
    Act(Action, Option<Shown>),
    /// Show remotes the present picture, once.
    Picture,
}

/// Tells a remote that the wall shows its action.
#[derive(Debug)]
pub(crate) struct Shown {
    pub(super) tag: u32,
    pub(super) to: mpsc::Sender<u32>,
}

impl Shown {
    pub(crate) fn tell(self) {
        // A remote that does not listen learns nothing.
        let _ = self.to.try_send(self.tag);
    }
}

/// The state in the words of each role.
#[derive(Clone, Debug, Default)]
pub(super) struct Told {
    visitors: Utf8Bytes,
    operators: Utf8Bytes,
}

impl Told {
    pub(super) fn to(&self, role: Role) -> &Utf8Bytes {
        match role {
            Role::Visitor => &self.visitors,
            Role::Operator => &self.operators,
        }
    }

    fn new(state: &WallState) -> Self {
        let log = recent_log::lines();
        let WallState { show, controls, farm } = state;
        let visitors = json!({ "state": { "role": Role::Visitor, "show": show } });
        let operators = json!({ "state": { "role": Role::Operator, "show": show, "controls": controls, "farm": farm, "log": log } });
        Self { visitors: visitors.to_string().into(), operators: operators.to_string().into() }
    }
}

pub(super) struct Hub {
    pub(super) access: Access,
    orders: mpsc::Sender<Order>,
    wake: Box<dyn Fn() + Send + Sync>,
    /// Whether the wall was woken and has not taken its orders yet.
    is_woken: AtomicBool,
    state: watch::Sender<WallState>,
    told: watch::Sender<Told>,
    thumbnail: watch::Sender<Option<Arc<Thumbnail>>>,
    jpeg: watch::Sender<Bytes>,
    turns: Mutex<Turns>,
    /// Changes with every change of turns.
    turned: watch::Sender<()>,
    n_watching: AtomicUsize,
    /// Connected remotes by their network.
    remotes: Mutex<HashMap<IpAddr, usize>>,
    n_actions: AtomicU64,
    last_client: AtomicU64,
    strangers: Mutex<LogLimit<IpAddr>>,
    started_at: Instant,
}

impl std::fmt::Debug for Hub {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Hub").finish_non_exhaustive()
    }
}

impl Hub {
    pub(super) fn new(access: Access, orders: mpsc::Sender<Order>, wake: Box<dyn Fn() + Send + Sync>) -> Self {
        Self {
            access,
            orders,
            wake,
            is_woken: AtomicBool::new(false),
            state: watch::Sender::default(),
            told: watch::Sender::new(Told::new(&WallState::default())),
            thumbnail: watch::Sender::default(),
            jpeg: watch::Sender::default(),
            turns: Mutex::default(),
            turned: watch::Sender::default(),
            n_watching: AtomicUsize::new(0),
            remotes: Mutex::default(),
            n_actions: AtomicU64::new(0),
            last_client: AtomicU64::new(0),
            strangers: Mutex::new(LogLimit::of_strangers()),
            started_at: Instant::now(),
        }
    }

    // The wall's side.

    pub(super) fn orders_are_taken(&self) {
        self.is_woken.store(false, SeqCst);
    }

    pub(super) fn publish(&self, state: &WallState) {
        self.state.send_if_modified(|old| {
            let differs = old.differs(state);
            old.clone_from(state);
            differs
        });
    }

    pub(super) fn is_watched(&self) -> bool {
        self.n_watching.load(Relaxed) > 0
    }

    pub(super) fn show(&self, picture: Thumbnail) {
        self.thumbnail.send_replace(Some(Arc::new(picture)));
    }

    // The remotes' side.

    /// Passes an order on, unless the wall has too many.
    pub(super) fn order(&self, order: Order) -> Result<(), &'static str> {
        self.orders.try_send(order).map_err(|_| "the wall is busy")?;
        // One call is enough for all orders until the wall takes them.
        if !self.is_woken.swap(true, SeqCst) {
            (self.wake)();
        }
        Ok(())
    }

    /// Acts for a remote, if its role and its turn allow that.
    pub(super) fn act(
        &self,
        role: Role,
        client: Client,
        message: Message,
        to: Option<&mpsc::Sender<u32>>,
    ) -> Result<(), &'static str> {
        let Message { tag, action } = message;
        if role == Role::Visitor && !action.is_for_visitors() {
            return Err("this is for operators");
        }
        if role == Role::Visitor && action.is_steering() && !self.has_turn(client) {
            return Err("others steer now");
        }
        self.n_actions.fetch_add(1, Relaxed);
        self.order(Order::Act(action, tag.zip(to).map(|(tag, to)| Shown { tag, to: to.clone() })))
    }

    fn has_turn(&self, client: Client) -> bool {
        let now = Instant::now();
        self.change_turns(|turns| turns.steers(client, now))
    }

    pub(super) fn leave(&self, client: Client) {
        let now = Instant::now();
        self.change_turns(|turns| turns.leaves(client, now));
    }

    pub(super) fn place(&self, client: Client) -> Place {
        self.turns().place(client, Instant::now())
    }

    /// Changes the turns, and tells that if others may see it.
    fn change_turns<T>(&self, change: impl FnOnce(&mut Turns) -> T) -> T {
        let mut turns = self.turns();
        let before = turns.order();
        let result = change(&mut turns);
        let has_changed = before != turns.order();
        drop(turns);
        if has_changed {
            self.turned.send_replace(());
        }
        result
    }

    fn turns(&self) -> MutexGuard<'_, Turns> {
        self.turns.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn new_client(&self, network: IpAddr) -> Client {
        Client { number: self.last_client.fetch_add(1, Relaxed), network }
    }

    /// Tells the log of somebody without a token, now and then.
    pub(super) fn on_stranger(&self, address: IpAddr) {
        let mut limit = self.strangers.lock().unwrap_or_else(PoisonError::into_inner);
        let pass = limit.admit(self.started_at.elapsed(), network(address));
        if let Some(more) = pass {
            tracing::warn!("somebody at {address} asks for the remote without a token that the wall knows{more}");
        }
    }

    pub(super) fn told(&self) -> watch::Receiver<Told> {
        self.told.subscribe()
    }

    pub(super) fn turned(&self) -> watch::Receiver<()> {
        self.turned.subscribe()
    }

    pub(super) fn pictures(&self) -> watch::Receiver<Bytes> {
        self.jpeg.subscribe()
    }

    pub(super) fn watching(self: &Arc<Self>) -> Watching {
        self.n_watching.fetch_add(1, Relaxed);
        Watching(Arc::clone(self))
    }

    /// Counts one more remote of a network, if `may_come` allows that to so many remotes: all, and those of the network.
    pub(super) fn remote(
        self: &Arc<Self>,
        network: IpAddr,
        may_come: impl FnOnce(usize, usize) -> bool,
    ) -> Option<Connected> {
        let mut remotes = self.remotes();
        let of_network = remotes.get(&network).copied().unwrap_or_default();
        if !may_come(remotes.values().sum(), of_network) {
            return None;
        }
        remotes.insert(network, of_network + 1);
        Some(Connected { hub: Arc::clone(self), network })
    }

    fn n_remotes(&self) -> usize {
        self.remotes().values().sum()
    }

    fn remotes(&self) -> MutexGuard<'_, HashMap<IpAddr, usize>> {
        self.remotes.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn metrics(&self) -> String {
        super::metrics::text(&self.state.borrow(), self.n_remotes(), self.n_actions.load(Relaxed))
    }

    /// Puts each new state into words.
    pub(super) async fn tell_states(&self) {
        let (mut states, mut log) = (self.state.subscribe(), recent_log::news());
        loop {
            let changed = tokio::select! {
                changed = states.changed() => changed,
                changed = log.changed() => changed,
            };
            if changed.is_err() {
                return;
            }
            let told = Told::new(&states.borrow_and_update());
            log.mark_unchanged();
            self.told.send_replace(told);
            tokio::time::sleep(STATE_INTERVAL).await;
        }
    }

    /// Encodes each new picture, on another thread.
    pub(super) async fn encode_pictures(&self) {
        let mut thumbnails = self.thumbnail.subscribe();
        while thumbnails.changed().await.is_ok() {
            let Some(thumbnail) = thumbnails.borrow_and_update().clone() else { continue };
            match tokio::task::spawn_blocking(move || thumbnail.to_jpeg()).await {
                Ok(Ok(jpeg)) => drop(self.jpeg.send_replace(jpeg.into())),
                Ok(Err(error)) => tracing::warn!("no live picture: {error}"),
                Err(_) => return,
            }
        }
    }

    /// Ends turns in time; sleeps while nobody waits.
    pub(super) async fn end_turns(&self) {
        let mut turned = self.turned();
        loop {
            let ends_at = self.turns().ends_at();
            let in_time = async {
                match ends_at {
                    Some(ends_at) => tokio::time::sleep_until(ends_at.into()).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                () = in_time => self.change_turns(|turns| turns.advance(Instant::now())),
                changed = turned.changed() => if changed.is_err() { return },
            }
        }
    }
}

/// One more looks at live pictures, until this is dropped.
pub(super) struct Watching(Arc<Hub>);

impl Drop for Watching {
    fn drop(&mut self) {
        self.0.n_watching.fetch_sub(1, Relaxed);
    }
}

/// A remote is connected, until this is dropped.
pub(super) struct Connected {
    hub: Arc<Hub>,
    pub(super) network: IpAddr,
}

impl Drop for Connected {
    fn drop(&mut self) {
        let mut remotes = self.hub.remotes();
        let left = remotes.get(&self.network).map_or(0, |n| n.saturating_sub(1));
        match left {
            0 => remotes.remove(&self.network),
            _ => remotes.insert(self.network, left),
        };
    }
}
