//! Walls that are found without an address: multicast DNS (RFC 6762) and its services (RFC 6763).
//!
//! A wall announces its port, its protocol and a badge of its key. The badge tells holders of the key that it is theirs, and
//! others nothing; the handshake alone proves anything, so an announcement that lies costs a connection.

use std::{
    collections::BTreeMap,
    io,
    net::{IpAddr, Ipv6Addr, SocketAddr, SocketAddrV6},
};

use mdns_sd::{IfKind, Receiver, ResolvedService, ScopedIp, ServiceDaemon, ServiceEvent, ServiceInfo};
use shared::{printable::printable, protocol::PROTOCOL_VERSION};

use crate::key::Key;

/// The service's type, as DNS has it.
const SERVICE: &str = "_raywall._tcp.local.";
/// Walls that are remembered: strangers may announce any number.
const MOST_WALLS: usize = 64;
/// Addresses of a wall that are tried.
const MOST_ADDRESSES: usize = 8;
/// Longest name of a wall in bytes: a label of DNS has 63, and the library may add a number.
const LONGEST_NAME: usize = 48;
/// The addresses of this machine are looked at again after so many seconds, as when a cable is plugged in.
const ADDRESS_CHECK_SECONDS: u32 = 60;

/// The value of `key` of a wall without one.
const NO_KEY: &str = "none";

/// A wall's announcement, until it is dropped.
pub struct Announcement(ServiceDaemon);

impl std::fmt::Debug for Announcement {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Announcement").finish_non_exhaustive()
    }
}

impl Announcement {
    /// Announces a wall that listens on `address`, as `name`, which people read.
    ///
    /// # Errors
    /// The system has no network, or gives no random numbers.
    pub fn new(name: &str, address: SocketAddr, key: Option<&Key>) -> io::Result<Self> {
        let nonce = getrandom::u64().map_err(io::Error::other)?;
        let (version, key) = (PROTOCOL_VERSION.to_string(), announced_text(key, nonce));
        let properties = [("version", version.as_str()), ("key", key.as_str())];
        // A name of its own: that of the machine may be announced by the system.
        let host = format!("raywall-{nonce:016x}.local.");
        let service = |ip: &str| ServiceInfo::new(SERVICE, &label(name), &host, ip, address.port(), &properties[..]);
        let daemon = ServiceDaemon::new().map_err(io::Error::other)?;
        let started = (|| {
            daemon.set_ip_check_interval(ADDRESS_CHECK_SECONDS)?;
            // Others cannot use them, and this machine hears itself on the network too.
            daemon.disable_interface(vec![IfKind::LoopbackV4, IfKind::LoopbackV6])?;
            let ip = address.ip().to_canonical();
            let service = if ip.is_unspecified() {
                service("")?.enable_addr_auto()
            } else {
                daemon.disable_interface(IfKind::All)?;
                daemon.enable_interface(IfKind::Addr(ip))?;
                service(&ip.to_string())?
            };
            if matches!(address, SocketAddr::V4(_)) {
                daemon.disable_interface(IfKind::IPv6)?;
            }
            daemon.register(service)
        })();
        let announcement = Self(daemon);
        started.map(|()| announcement).map_err(io::Error::other)
    }
}

impl Drop for Announcement {
    fn drop(&mut self) {
        // Says good-bye on its thread; who does not hear it learns the end when a connection fails.
        let _ = self.0.shutdown();
    }
}

/// What a wall's announcement says of its key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum AnnouncedKey {
    None,
    Badge { nonce: u64, badge: u64 },
}

/// A wall that was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FoundWall {
    /// Its name, fit for people.
    pub name: String,
    /// Where it listens, the likeliest first; not empty.
    pub addresses: Vec<SocketAddr>,
    /// Its protocol.
    pub version: u8,
    key: AnnouncedKey,
}

/// How a wall's announcement fits a render server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fit {
    /// Both have the same key, or neither has one.
    Fits,
    /// The wall speaks another protocol.
    OtherVersion,
    /// Both have a key, and not the same.
    OtherKey,
    /// Only the wall has a key.
    NeedsKey,
    /// Only the render server has a key.
    HasNoKey,
}

impl FoundWall {
    /// How a render server with this key fits.
    pub fn fit(&self, key: Option<&Key>) -> Fit {
        match (self.key, key) {
            _ if self.version != PROTOCOL_VERSION => Fit::OtherVersion,
            (AnnouncedKey::None, None) => Fit::Fits,
            (AnnouncedKey::None, Some(_)) => Fit::HasNoKey,
            (AnnouncedKey::Badge { .. }, None) => Fit::NeedsKey,
            (AnnouncedKey::Badge { nonce, badge }, Some(key)) if key.badge(nonce) == badge => Fit::Fits,
            (AnnouncedKey::Badge { .. }, Some(_)) => Fit::OtherKey,
        }
    }

    /// A wall by what it announces; `None` if nobody could connect to it.
    pub fn announced(name: &str, mut addresses: Vec<SocketAddr>, version: &str, key: &str) -> Option<Self> {
        let (version, key) = (version.parse().ok()?, announced_key(key)?);
        // IPv4 first, then addresses that are valid beyond the link.
        addresses.sort_by_key(|address| (rank(address.ip()), *address));
        addresses.truncate(MOST_ADDRESSES);
        let is_there = !addresses.is_empty() && addresses.iter().all(|address| address.port() != 0);
        is_there.then_some(Self { name: printable(name), addresses, version, key })
    }

    fn of_service(service: &ResolvedService) -> Option<Self> {
        let [version, key] = ["version", "key"].map(|name| service.get_property_val_str(name));
        let port = service.get_port();
        let addresses = service.get_addresses().iter().filter_map(|ip| socket_address(ip, port)).collect();
        let instance = service.get_fullname().strip_suffix(SERVICE).unwrap_or(service.get_fullname());
        Self::announced(instance.trim_end_matches('.'), addresses, version?, key?)
    }

    /// The likeliest address.
    pub fn address(&self) -> SocketAddr {
        self.addresses[0]
    }
}

/// What a wall announces of its key; with another nonce it is something else.
pub fn announced_text(key: Option<&Key>, nonce: u64) -> String {
    key.map_or_else(|| NO_KEY.to_owned(), |key| format!("{nonce:016x}-{:016x}", key.badge(nonce)))
}

fn announced_key(text: &str) -> Option<AnnouncedKey> {
    if text == NO_KEY {
        return Some(AnnouncedKey::None);
    }
    let (nonce, badge) = text.split_once('-')?;
    let number = |text| u64::from_str_radix(text, 16).ok();
    Some(AnnouncedKey::Badge { nonce: number(nonce)?, badge: number(badge)? })
}

fn socket_address(ip: &ScopedIp, port: u16) -> Option<SocketAddr> {
    match ip {
        ScopedIp::V4(ip) => Some((*ip.addr(), port).into()),
        // An address of the link needs the interface.
        ScopedIp::V6(ip) => Some(SocketAddrV6::new(*ip.addr(), port, 0, ip.scope_id().index).into()),
        _ => None,
    }
}

fn rank(ip: IpAddr) -> u8 {
    let is_of_link = |ip: Ipv6Addr| ip.segments()[0] & 0xffc0 == 0xfe80;
    match ip {
        IpAddr::V4(ip) if ip.is_loopback() => 3,
        IpAddr::V4(ip) if ip.is_link_local() => 1,
        IpAddr::V4(_) => 0,
        IpAddr::V6(ip) if ip.is_loopback() || is_of_link(ip) => 3,
        IpAddr::V6(_) => 2,
    }
}

/// A name as a label of DNS.
fn label(name: &str) -> String {
    let mut label = String::new();
    for character in printable(name).chars().map(|character| if character == '.' { '-' } else { character }) {
        if label.len() + character.len_utf8() > LONGEST_NAME {
            break;
        }
        label.push(character);
    }
    label
}

/// Looks for walls until it is dropped.
pub struct Finder {
    daemon: ServiceDaemon,
    events: Receiver<ServiceEvent>,
    walls: BTreeMap<String, FoundWall>,
}

impl std::fmt::Debug for Finder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Finder").field("walls", &self.walls).finish_non_exhaustive()
    }
}

impl Finder {
    /// Asks the network for walls.
    ///
    /// # Errors
    /// The system has no network.
    pub fn start() -> io::Result<Self> {
        let daemon = ServiceDaemon::new().map_err(io::Error::other)?;
        let events = daemon.browse(SERVICE).map_err(io::Error::other)?;
        Ok(Self { daemon, events, walls: BTreeMap::new() })
    }

    /// Waits until a wall was found, has changed or is gone.
    pub async fn changed(&mut self) {
        loop {
            match self.events.recv_async().await {
                Ok(event) => {
                    if self.take(event) {
                        return;
                    }
                }
                // The library has ended, which only a dropped finder does.
                Err(_) => std::future::pending().await,
            }
        }
    }

    /// The walls that are there, by name.
    pub fn walls(&self) -> impl Iterator<Item = &FoundWall> {
        self.walls.values()
    }

    fn take(&mut self, event: ServiceEvent) -> bool {
        match event {
            ServiceEvent::ServiceResolved(service) => {
                let (name, wall) = (service.get_fullname(), FoundWall::of_service(&service));
                let is_known = self.walls.contains_key(name);
                match wall {
                    Some(wall) if is_known || self.walls.len() < MOST_WALLS => {
                        self.walls.insert(name.to_owned(), wall.clone()).is_none_or(|old| old != wall)
                    }
                    _ => false,
                }
            }
            ServiceEvent::ServiceRemoved(_, name) => self.walls.remove(&name).is_some(),
            _ => false,
        }
    }
}

impl Drop for Finder {
    fn drop(&mut self) {
        let _ = self.daemon.shutdown();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wall(key: Option<&Key>, version: u8) -> FoundWall {
        let address = ([10, 0, 0, 1], 7117).into();
        FoundWall::announced("wall", vec![address], &version.to_string(), &announced_text(key, 7)).unwrap()
    }

    #[test]
    fn holders_of_the_key_recognise_their_wall_and_others_do_not() {
        let [ours, other] = [(); 2].map(|()| Key::random().unwrap());
        let (keyed, open) = (wall(Some(&ours), PROTOCOL_VERSION), wall(None, PROTOCOL_VERSION));
        assert_eq!(
            [Some(&ours), Some(&other), None].map(|key| keyed.fit(key)),
            [Fit::Fits, Fit::OtherKey, Fit::NeedsKey]
        );
        assert_eq!([None, Some(&ours)].map(|key| open.fit(key)), [Fit::Fits, Fit::HasNoKey]);
        assert_eq!(wall(Some(&ours), PROTOCOL_VERSION - 1).fit(Some(&ours)), Fit::OtherVersion);
    }

    #[test]
    fn two_announcements_of_a_key_have_nothing_in_common() {
        let key = Key::random().unwrap();
        let [one, two] = [1, 2].map(|nonce| key.badge(nonce));
        assert_ne!(one, two);
        assert_ne!(key.badge(1).to_le_bytes(), key.fingerprint()[..8]);
    }

    #[test]
    fn announcements_that_make_no_sense_are_none() {
        for text in ["", "-", "none-", "0011", "xyz-0011", "0-", "1234567890123456789-1", "nonE"] {
            assert_eq!(announced_key(text), None, "{text}");
        }
        assert_eq!(FoundWall::announced("wall", Vec::new(), "16", "none"), None);
        assert_eq!(FoundWall::announced("wall", vec![([10, 0, 0, 1], 0).into()], "16", "none"), None);
        assert_eq!(FoundWall::announced("wall", vec![([10, 0, 0, 1], 1).into()], "256", "none"), None);
        assert_eq!(label(&"hall of mirrors.example ".repeat(9)).len(), LONGEST_NAME);
        assert_eq!(label("wall.example\u{1b}[31m").matches(['.', '\u{1b}']).count(), 0);
        assert!(label(&"é".repeat(99)).len() <= LONGEST_NAME);
    }

    #[test]
    fn addresses_of_the_network_come_before_those_of_the_link() {
        let mut addresses =
            ["fe80::1", "127.0.0.1", "2001:db8::1", "169.254.1.1", "10.0.0.1"].map(|ip| ip.parse().unwrap());
        addresses.sort_by_key(|ip| (rank(*ip), *ip));
        assert_eq!(
            addresses.map(|ip: IpAddr| ip.to_string()),
            ["10.0.0.1", "169.254.1.1", "2001:db8::1", "127.0.0.1", "fe80::1"]
        );
    }
}
