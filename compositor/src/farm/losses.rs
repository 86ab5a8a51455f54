//! How often render servers were lost, and how long those that come and go must wait to join again.

use std::{
    collections::HashMap,
    net::IpAddr,
    sync::{Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

/// Most render servers whose losses are counted: a peer may take a new name each time.
const MOST_COUNTED: usize = 512;

/// A render server that stayed for this long since it was lost last does not flap.
const STABLE_AFTER: Duration = Duration::from_secs(10);

/// Losses within [`STABLE_AFTER`] of each other that cost no waiting.
const FREE_LOSSES: u32 = 3;

/// The first wait; it doubles with each loss…
const SHORTEST_WAIT: Duration = Duration::from_millis(50);

/// …up to this one, which fits within a handshake.
const LONGEST_WAIT: Duration = Duration::from_secs(1);

/// The losses of all render servers, by name and address.
#[derive(Debug, Default)]
pub(super) struct Losses(Mutex<HashMap<(String, IpAddr), NodeLosses>>);

#[derive(Clone, Copy, Debug)]
struct NodeLosses {
    n_lost: u32,
    /// Losses that followed each other within [`STABLE_AFTER`].
    n_recent: u32,
    last_at: Instant,
}

impl Losses {
    fn lock(&self) -> MutexGuard<'_, HashMap<(String, IpAddr), NodeLosses>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn add(&self, now: Instant, name: &str, address: IpAddr) {
        let mut losses = self.lock();
        let node = (name.to_owned(), address);
        // The one that was lost least makes room, so names that come once displace none that flap.
        if losses.len() >= MOST_COUNTED && !losses.contains_key(&node) {
            let least = losses.iter().min_by_key(|(_, losses)| (losses.n_lost, losses.last_at));
            if let Some(least) = least.map(|(least, _)| least.clone()) {
                losses.remove(&least);
            }
        }
        let losses = losses.entry(node).or_insert(NodeLosses { n_lost: 0, n_recent: 0, last_at: now });
        losses.n_lost += 1;
        let is_flapping = now - losses.last_at < STABLE_AFTER;
        losses.n_recent = if is_flapping { losses.n_recent + 1 } else { 1 };
        losses.last_at = now;
    }

    pub(super) fn n_lost(&self, name: &str, address: IpAddr) -> u32 {
        self.lock().get(&(name.to_owned(), address)).map_or(0, |losses| losses.n_lost)
    }

    /// How long a render server must wait before it joins: each join costs the wall messages, redraws and log lines.
    pub(super) fn wait(&self, now: Instant, name: &str, address: IpAddr) -> Duration {
        let losses = self.lock().get(&(name.to_owned(), address)).copied();
        let flapping = losses.filter(|losses| now - losses.last_at < STABLE_AFTER && losses.n_recent > FREE_LOSSES);
        flapping.map_or(Duration::ZERO, |NodeLosses { n_recent, .. }| {
            (SHORTEST_WAIT * 2_u32.pow((n_recent - FREE_LOSSES - 1).min(10))).min(LONGEST_WAIT)
        })
    }
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;

    #[test]
    fn a_node_that_flaps_waits_longer_each_time_until_it_stays() {
        let (losses, address) = (Losses::default(), IpAddr::V4(Ipv4Addr::LOCALHOST));
        let started_at = Instant::now();
        let mut waits_ms = Vec::new();
        for second in 0..10 {
            let now = started_at + Duration::from_secs(second);
            waits_ms.push(losses.wait(now, "a", address).as_millis());
            losses.add(now, "a", address);
        }
        assert_eq!(waits_ms, [0, 0, 0, 0, 50, 100, 200, 400, 800, 1000]);
        assert_eq!(losses.wait(started_at, "b", address), Duration::ZERO);
        assert_eq!(losses.wait(started_at + Duration::from_secs(20), "a", address), Duration::ZERO);
        assert_eq!((losses.n_lost("a", address), losses.n_lost("b", address)), (10, 0));
    }

    #[test]
    fn names_without_end_take_no_memory_without_end() {
        let (losses, address) = (Losses::default(), IpAddr::V4(Ipv4Addr::LOCALHOST));
        (0..10_000).for_each(|name| losses.add(Instant::now(), &name.to_string(), address));
        assert_eq!(losses.lock().len(), MOST_COUNTED);
        // Nor do they keep a node that flaps from being counted.
        for flood in 0..10 {
            losses.add(Instant::now(), "flapping", address);
            (0..100).for_each(|name| losses.add(Instant::now(), &format!("{flood}-{name}"), address));
        }
        assert_eq!(losses.n_lost("flapping", address), 10);
    }
}
