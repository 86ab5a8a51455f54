//! Devices that steer the wall beside keys, mouse and remotes.
//!
//! [`osc`] is what controllers of shows say, and [`osc_socket`] hears it; [`spacemouse`] and [`gamepad`] are held in a hand.
//!
//! All of it runs on threads of its own, which sleep while no device says anything. A bounded queue of orders leads to the
//! wall, and so does the latest drive of each device, so a device never waits for the wall, and one that is let go is at rest
//! however busy the wall is.

mod gamepad;
pub mod osc;
mod osc_socket;
#[cfg(unix)]
mod spacemouse;

use std::{
    collections::BTreeMap,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering::SeqCst},
    },
    thread,
};

use anyhow::Context;
use tokio::sync::{mpsc, oneshot};

use crate::{
    control::{drive::Drive, input::Command},
    remote::message::Action,
};

/// Orders that wait for the wall; more are dropped.
const MOST_ORDERS: usize = 1024;

/// Which devices the wall listens to.
#[derive(Clone, Debug, Default)]
pub(crate) struct DeviceOptions {
    /// HOST:PORT on which OSC is heard.
    pub(crate) osc: Option<String>,
    /// Whether machines in the network may send it.
    pub(crate) osc_is_open: bool,
    /// Whether a SpaceMouse and gamepads at this machine steer.
    pub(crate) has_controllers: bool,
}

/// What a device asks for.
#[derive(Debug)]
pub(crate) enum Order {
    /// Act as an operator's remote does.
    Act(Action),
    /// Do as a key of the wall does, which a locked wall may refuse.
    Press(Command),
}

/// A device that drives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Source {
    SpaceMouse,
    Gamepad(usize),
}

/// The wall's end of its devices. Dropping it ends their threads.
#[derive(Debug)]
pub(crate) struct Devices {
    orders: mpsc::Receiver<Order>,
    link: Link,
    /// The drive that was taken last.
    taken: Drive,
    /// Its end ends the thread.
    _running: oneshot::Sender<()>,
}

/// A device's end.
#[derive(Clone, Debug)]
struct Link(Arc<Shared>);

struct Shared {
    orders: mpsc::Sender<Order>,
    /// Of the devices that are not at rest.
    drives: Mutex<BTreeMap<Source, Drive>>,
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
    fn order(&self, order: Order) -> bool {
        let has_room = self.0.orders.try_send(order).is_ok();
        self.wake();
        has_room
    }

    /// Sets how a device drives from now on.
    fn drive(&self, source: Source, drive: Drive) {
        let before = match drive.is_rest() {
            true => self.drives().remove(&source),
            false => self.drives().insert(source, drive),
        };
        if before.unwrap_or_default() != drive {
            self.wake();
        }
    }

    fn drives(&self) -> MutexGuard<'_, BTreeMap<Source, Drive>> {
        self.0.drives.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// One call is enough until the wall takes its orders.
    fn wake(&self) {
        if !self.0.is_woken.swap(true, SeqCst) {
            (self.0.wake)();
        }
    }
}

impl Devices {
    /// Listens to devices; `wake` is called when there are orders or another drive to take.
    ///
    /// # Errors
    /// The address for OSC is none, is taken, or is open to the network without leave; or the system starts no threads.
    pub(crate) fn start(options: &DeviceOptions, wake: impl Fn() + Send + Sync + 'static) -> anyhow::Result<Self> {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .context("cannot start the thread of devices")?;
        let osc = match &options.osc {
            Some(address) => Some(runtime.block_on(osc_socket::listen(address, options.osc_is_open))?),
            None => None,
        };
        if let Some(socket) = &osc {
            renderer::cli::say(format_args!("OSC at {}", socket.local_addr()?))?;
        }
        let (link, devices, ended) = Self::linked(wake);
        let has_controllers = options.has_controllers;
        if has_controllers {
            gamepad::start(link.clone()).context("cannot start the thread of gamepads")?;
        }
        let listen = move || {
            let hear = async {
                match osc {
                    Some(socket) => osc_socket::hear(socket, link.clone()).await,
                    None => std::future::pending().await,
                }
            };
            let follow = async {
                #[cfg(unix)]
                if has_controllers {
                    spacemouse::listen(link.clone()).await;
                }
                std::future::pending::<()>().await;
            };
            runtime.block_on(async {
                tokio::select! {
                    () = hear => {}
                    () = follow => {}
                    _ = ended => {}
                }
            });
        };
        thread::Builder::new()
            .name("devices".to_owned())
            .spawn(listen)
            .context("cannot start the thread of devices")?;
        Ok(devices)
    }

    /// Both ends, and what tells of the wall's end.
    fn linked(wake: impl Fn() + Send + Sync + 'static) -> (Link, Self, oneshot::Receiver<()>) {
        let (sender, orders) = mpsc::channel(MOST_ORDERS);
        let shared =
            Shared { orders: sender, drives: Mutex::default(), wake: Box::new(wake), is_woken: AtomicBool::new(false) };
        let link = Link(Arc::new(shared));
        let (running, ended) = oneshot::channel();
        let devices = Self { orders, link: link.clone(), taken: Drive::default(), _running: running };
        (link, devices, ended)
    }

    /// The next order, if there is one.
    pub(crate) fn take(&mut self) -> Option<Order> {
        self.link.0.is_woken.store(false, SeqCst);
        self.orders.try_recv().ok()
    }

    /// How all devices drive together, if that has changed; call it after [`Devices::take`].
    pub(crate) fn take_drive(&mut self) -> Option<Drive> {
        let drive = self.link.drives().values().fold(Drive::default(), |all, one| all.with(*one));
        (std::mem::replace(&mut self.taken, drive) != drive).then_some(drive)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicUsize;

    use glam::DVec2;

    use super::*;

    #[test]
    fn a_device_that_is_let_go_is_at_rest_however_many_orders_wait() {
        let n_woken = Arc::new(AtomicUsize::new(0));
        let count = Arc::clone(&n_woken);
        let (link, mut devices, _ended) = Devices::linked(move || _ = count.fetch_add(1, SeqCst));
        let drive = Drive { orbit: DVec2::X, ..Drive::default() };
        link.drive(Source::Gamepad(0), drive);
        let n_taken = (0..2 * MOST_ORDERS).filter(|_| link.order(Order::Act(Action::ViewAll))).count();
        assert_eq!((n_taken, n_woken.load(SeqCst)), (MOST_ORDERS, 1), "the wall is woken once");
        assert!(devices.take().is_some());
        assert_eq!([devices.take_drive(), devices.take_drive()], [Some(drive), None]);
        link.drive(Source::SpaceMouse, drive);
        assert_eq!(devices.take_drive(), None, "no faster than one");
        // Pulled out.
        link.drive(Source::Gamepad(0), Drive::default());
        link.drive(Source::SpaceMouse, Drive::default());
        assert_eq!(devices.take_drive(), Some(Drive::default()));
        while devices.take().is_some() {}
        let before = n_woken.load(SeqCst);
        link.drive(Source::SpaceMouse, Drive::default());
        assert_eq!(n_woken.load(SeqCst), before, "a device at rest wakes nobody");
    }
}
