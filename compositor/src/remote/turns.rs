//! Turns of visitors: one steers, for a minute while others wait. Nobody gets more turns by more connections: those of one
//! address take turns with those of others. Pure: time is an argument.

use std::{
    collections::VecDeque,
    net::IpAddr,
    time::{Duration, Instant},
};

/// A visitor steers for this long while others wait.
const TURN: Duration = Duration::from_secs(60);
/// A turn goes on for at least this long after the first other visitor has come.
const NOTICE: Duration = Duration::from_secs(10);
/// A visitor who has not moved for this long while others wait has left the wall to them.
const IDLE: Duration = Duration::from_secs(15);

/// A connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Client {
    /// None is used twice.
    pub(super) number: u64,
    /// The peer's, or its network's: see [`network`].
    pub(super) network: IpAddr,
}

/// The address that tells peers apart: the half of an IPv6 address that a peer cannot choose.
pub(super) fn network(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => IpAddr::V6((address.to_bits() >> 64 << 64).into()),
        address => address,
    }
}

#[derive(Debug, Default)]
pub(super) struct Turns {
    present: Option<Present>,
    waiting: VecDeque<Client>,
}

/// The visitor who steers.
#[derive(Debug)]
struct Present {
    client: Client,
    since: Instant,
    moved_at: Instant,
    /// When another began to wait; `None` while nobody does.
    awaited_since: Option<Instant>,
}

/// A visitor's place.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub(super) struct Place {
    /// Whether the visitor steers, or may begin to: nobody else does.
    may_steer: bool,
    /// Visitors who steer earlier, the present one included; 0 for others than those who wait.
    before: usize,
    /// Visitors who wait, whoever asks.
    waiting: usize,
    /// The longest time until the next turn begins, in seconds: each touch of the present visitor delays an early end, but
    /// none this one; `None` while nobody waits.
    seconds: Option<u64>,
}

impl Turns {
    /// A visitor wants to steer: whether that is its turn. If not, it waits from now on.
    pub(super) fn steers(&mut self, client: Client, now: Instant) -> bool {
        self.advance(now);
        match &mut self.present {
            None => self.present = Some(Present { client, since: now, moved_at: now, awaited_since: None }),
            Some(present) if present.client == client => present.moved_at = now,
            Some(present) => {
                if !self.waiting.contains(&client) {
                    present.awaited_since.get_or_insert(now);
                    self.wait(client);
                }
                return false;
            }
        }
        true
    }

    /// A visitor goes away, or gives up its turn.
    pub(super) fn leaves(&mut self, client: Client, now: Instant) {
        self.waiting.retain(|&waiting| waiting != client);
        if self.waiting.is_empty() {
            self.present.iter_mut().for_each(|present| present.awaited_since = None);
        }
        if self.present.take_if(|present| present.client == client).is_some() {
            self.begin_next(now);
        }
    }

    /// Ends the present turn if its time is over.
    pub(super) fn advance(&mut self, now: Instant) {
        if self.ends_at().is_some_and(|ends_at| now >= ends_at) {
            self.begin_next(now);
        }
    }

    /// When the present turn ends; `None` while nobody waits.
    pub(super) fn ends_at(&self) -> Option<Instant> {
        let present = self.present.as_ref()?;
        let at_least = present.awaited_since? + NOTICE;
        Some((present.since + TURN).min(present.moved_at + IDLE).max(at_least))
    }

    /// When the present turn ends if its visitor goes on to move; `None` while nobody waits.
    fn ends_at_the_latest(&self) -> Option<Instant> {
        let present = self.present.as_ref()?;
        let at_least = present.awaited_since? + NOTICE;
        Some((present.since + TURN).max(at_least))
    }

    pub(super) fn place(&self, client: Client, now: Instant) -> Place {
        let position = self.waiting.iter().position(|&waiting| waiting == client);
        let is_present = self.present.as_ref().is_none_or(|present| present.client == client);
        let left = self.ends_at_the_latest().map(|ends_at| ends_at.saturating_duration_since(now));
        let seconds = left.map(|left| left.as_secs_f64().ceil() as u64);
        let before = position.map_or(0, |position| position + 1);
        Place { may_steer: is_present, before, waiting: self.waiting.len(), seconds }
    }

    /// The present visitor, whether its turn will end, and those who wait: all that others can see.
    pub(super) fn order(&self) -> (Option<(Client, bool)>, VecDeque<Client>) {
        let present = self.present.as_ref().map(|present| (present.client, present.awaited_since.is_some()));
        (present, self.waiting.clone())
    }

    /// Adds one who waits: behind those whose networks have no more turns before them than its own has.
    fn wait(&mut self, client: Client) {
        let present = self.present.iter().map(|present| present.client);
        let all: Vec<_> = present.chain(self.waiting.iter().copied()).collect();
        let n_before = |end: usize, network| all[..end].iter().filter(|other| other.network == network).count();
        let own = n_before(all.len(), client.network);
        let n_present = all.len() - self.waiting.len();
        let is_later = |&at: &usize| n_before(n_present + at, self.waiting[at].network) > own;
        let at = (0..self.waiting.len()).find(is_later).unwrap_or(self.waiting.len());
        self.waiting.insert(at, client);
    }

    fn begin_next(&mut self, now: Instant) {
        self.present = self.waiting.pop_front().map(|client| {
            let awaited_since = (!self.waiting.is_empty()).then_some(now);
            Present { client, since: now, moved_at: now, awaited_since }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A connection from a network.
    fn of(network: u8, number: u64) -> Client {
        Client { number, network: [10, 0, 0, network].into() }
    }

    /// One that is alone in its network.
    fn alone(number: u8) -> Client {
        of(number, number.into())
    }

    #[test]
    fn a_visitor_alone_steers_as_long_as_it_likes() {
        let (mut turns, start) = (Turns::default(), Instant::now());
        assert!(turns.steers(alone(1), start) && turns.steers(alone(1), start + 100 * TURN));
        assert_eq!(turns.ends_at(), None);
        assert!(turns.place(alone(1), start).may_steer && !turns.place(alone(2), start).may_steer);
    }

    #[test]
    fn while_others_wait_each_has_a_minute() {
        let (mut turns, start) = (Turns::default(), Instant::now());
        let at = |seconds| start + Duration::from_secs(seconds);
        assert!(turns.steers(alone(1), start) && !turns.steers(alone(2), at(1)) && !turns.steers(alone(3), at(2)));
        assert_eq!([2, 3].map(|client| turns.place(alone(client), at(2)).before), [1, 2]);
        // It must move to keep its turn, and those who wait know the end from the first moment on.
        for second in 3..60 {
            assert!(turns.steers(alone(1), at(second)), "{second}");
            assert_eq!(turns.place(alone(2), at(second)).seconds, Some(60 - second));
        }
        assert!(!turns.steers(alone(1), at(60)) && turns.steers(alone(2), at(60)), "the turn is over");
        assert_eq!(turns.place(alone(1), at(60)), Place { may_steer: false, before: 2, waiting: 2, seconds: Some(60) });
        turns.leaves(alone(2), at(70));
        assert!(turns.steers(alone(3), at(70)));
        turns.leaves(alone(1), at(71));
        assert_eq!(turns.ends_at(), None, "nobody waits any more");
        turns.leaves(alone(3), at(72));
        assert!(turns.place(alone(1), at(72)).may_steer && turns.steers(alone(1), at(72)));
    }

    #[test]
    fn nobody_loses_the_wall_without_notice_and_an_idle_hand_loses_it_early() {
        let (mut turns, start) = (Turns::default(), Instant::now());
        let at = |seconds| start + Duration::from_secs(seconds);
        assert!(turns.steers(alone(1), start) && turns.steers(alone(1), at(500)) && !turns.steers(alone(2), at(500)));
        assert!(turns.steers(alone(1), at(509)) && !turns.steers(alone(2), at(509)) && turns.steers(alone(2), at(510)));
        assert!(!turns.steers(alone(1), at(511)));
        assert!(!turns.steers(alone(1), at(524)) && turns.steers(alone(1), at(525)), "2 has not moved for 15 s");
        // A clock that goes back ends nothing.
        assert!(turns.steers(alone(1), at(3)));
    }

    #[test]
    fn many_connections_of_one_network_get_no_more_turns_than_one() {
        let (mut turns, start) = (Turns::default(), Instant::now());
        for number in 0..40 {
            turns.steers(of(1, number), start);
        }
        turns.steers(of(2, 100), start);
        turns.steers(of(2, 101), start);
        turns.steers(of(3, 200), start);
        let order: Vec<_> = turns.order().1.iter().take(6).map(|client| client.number).collect();
        assert_eq!(order, [100, 200, 1, 101, 2, 3]);
        assert_eq!(turns.place(of(3, 200), start).before, 2);
    }

    #[test]
    fn peers_are_told_apart_by_what_they_cannot_choose() {
        let network = |address: &str| network(address.parse().unwrap()).to_string();
        assert_eq!(network("192.168.1.7"), "192.168.1.7");
        assert_eq!(network("::ffff:192.168.1.7"), "192.168.1.7");
        assert_eq!(network("2001:db8:1:2:3:4:5:6"), "2001:db8:1:2::");
    }
}
