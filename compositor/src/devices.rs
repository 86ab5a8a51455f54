//! Devices that steer the wall beside keys, mouse and remotes.
//!
//! [`osc`] is what controllers of shows say, and [`osc_socket`] hears it.
//!
//! All of it runs on threads of its own, which sleep while no device says anything. A bounded queue of orders leads to the
//! wall, so a device never waits for it.

pub mod osc;
mod osc_socket;

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::SeqCst},
    },
    thread,
};

use anyhow::Context;
use tokio::sync::{mpsc, oneshot};

use crate::remote::message::Action;

/// Orders that wait for the wall; more are dropped.
const MOST_ORDERS: usize = 1024;

/// Which devices the wall listens to.
#[derive(Clone, Debug, Default)]
pub(crate) struct DeviceOptions {
    /// HOST:PORT on which OSC is heard.
    pub(crate) osc: Option<String>,
    /// Whether machines in the network may send it.
    pub(crate) osc_is_open: bool,
}

/// The wall's end of its devices. Dropping it ends their threads.
#[derive(Debug)]
pub(crate) struct Devices {
    orders: mpsc::Receiver<Action>,
    link: Link,
    /// Its end ends the thread.
    _running: oneshot::Sender<()>,
}

/// A device's end.
#[derive(Clone, Debug)]
struct Link(Arc<Shared>);

struct Shared {
    orders: mpsc::Sender<Action>,
    wake: Box<dyn Fn() + Send + Sync>,
    /// Whether the wall was woken and has not taken its orders yet.
    is_woken: AtomicBool,
}

impl std::fmt::Debug for Shared {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shared").finish_non_exhaustive()
    }
}

impl Link {
    /// Passes an order on. Returns whether the wall had room for it.
    fn order(&self, action: Action) -> bool {
        let has_room = self.0.orders.try_send(action).is_ok();
        self.wake();
        has_room
    }

    /// One call is enough until the wall takes its orders.
    fn wake(&self) {
        if !self.0.is_woken.swap(true, SeqCst) {
            (self.0.wake)();
        }
    }
}

impl Devices {
    /// Listens to devices; `wake` is called when there are orders to take. `None` if there is nothing to listen to.
    ///
    /// # Errors
    /// The address for OSC is none, is taken, or is open to the network without leave.
    pub(crate) fn start(
        options: &DeviceOptions,
        wake: impl Fn() + Send + Sync + 'static,
    ) -> anyhow::Result<Option<Self>> {
        let Some(address) = &options.osc else { return Ok(None) };
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .context("cannot start the thread of devices")?;
        let socket = runtime.block_on(osc_socket::listen(address, options.osc_is_open))?;
        renderer::cli::say(format_args!("OSC at {}", socket.local_addr()?))?;
        let (sender, orders) = mpsc::channel(MOST_ORDERS);
        let shared = Shared { orders: sender, wake: Box::new(wake), is_woken: AtomicBool::new(false) };
        let link = Link(Arc::new(shared));
        let (running, ended) = oneshot::channel();
        let heard = link.clone();
        let listen = move || {
            runtime.block_on(async {
                tokio::select! {
                    () = osc_socket::hear(socket, heard) => {}
                    _ = ended => {}
                }
            });
        };
        thread::Builder::new()
            .name("devices".to_owned())
            .spawn(listen)
            .context("cannot start the thread of devices")?;
        Ok(Some(Self { orders, link, _running: running }))
    }

    /// The next order, if there is one.
    pub(crate) fn take(&mut self) -> Option<Action> {
        self.link.0.is_woken.store(false, SeqCst);
        self.orders.try_recv().ok()
    }
}
