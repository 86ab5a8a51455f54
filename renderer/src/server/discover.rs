//! Which wall a render server joins that was given no address: one in the network that has its key.

use std::{collections::BTreeSet, net::SocketAddr, time::Duration};

use channel::{
    discovery::{Finder, Fit, FoundWall},
    key::Key,
};
use shared::{
    printable::counted,
    protocol::{DEFAULT_PORT, PROTOCOL_VERSION},
};
use tokio::time::{Instant, sleep, timeout_at};

/// After this time without a wall, a line says so.
const NONE_AFTER: Duration = Duration::from_secs(3);
/// After the first wall that fits, others have this time to be found.
const GATHER: Duration = Duration::from_millis(300);
/// A wall that has ended comes back at its address, as a restarted one does; after this time another may be joined.
const RETURN_WITHIN: Duration = Duration::from_secs(10);
/// The pause after the system gave no network.
const NETWORK_PAUSE: Duration = Duration::from_secs(5);
/// Walls that a line names.
const MOST_NAMED: usize = 3;

/// Finds walls while this server has none; asks and hears nothing while it has one.
pub(super) struct Search {
    /// Whether walls without a key may be joined.
    is_insecure: bool,
    finder: Option<Finder>,
    /// Addresses that were tried in vain since all were.
    failed: BTreeSet<SocketAddr>,
    /// The wall of the last session, and until when it is awaited after its end.
    joined: Option<(SocketAddr, Option<Instant>)>,
    /// The last line.
    told: String,
}

impl Search {
    pub(super) fn new(is_insecure: bool) -> Self {
        Self { is_insecure, finder: None, failed: BTreeSet::new(), joined: None, told: String::new() }
    }

    /// The address to try next; waits until there is one.
    pub(super) async fn next(&mut self, key: Option<&Key>) -> SocketAddr {
        if let Some((address, until)) = &mut self.joined {
            if Instant::now() < *until.get_or_insert_with(|| Instant::now() + RETURN_WITHIN) {
                return *address;
            }
            self.joined = None;
        }
        let started_at = Instant::now();
        let mut found_at = None;
        loop {
            let finder = match &mut self.finder {
                Some(finder) => finder,
                None => match Finder::start() {
                    Ok(finder) => self.finder.insert(finder),
                    Err(error) => {
                        tell(
                            &mut self.told,
                            format!(
                                "no walls can be looked for: {error}; name one, as in renderer connect wall.example"
                            ),
                        );
                        sleep(NETWORK_PAUSE).await;
                        continue;
                    }
                },
            };
            let walls: Vec<_> = finder.walls().collect();
            let choice = choose(&walls, key, self.is_insecure, &mut self.failed);
            let wait_until = match choice {
                Ok((address, line)) => {
                    let gathered_at = *found_at.get_or_insert_with(Instant::now) + GATHER;
                    if Instant::now() >= gathered_at {
                        line.into_iter().for_each(|line| tell(&mut self.told, line));
                        return address;
                    }
                    gathered_at
                }
                Err(line) => {
                    let none_at = started_at + NONE_AFTER;
                    if Instant::now() >= none_at {
                        tell(&mut self.told, line);
                    }
                    // Later nothing but news changes the line.
                    if Instant::now() < none_at { none_at } else { none_at + Duration::from_secs(86_400 * 365) }
                }
            };
            // Late or not, look again.
            let _ = timeout_at(wait_until, finder.changed()).await;
        }
    }

    /// A wall has accepted this server: nothing is looked for until it has ended.
    pub(super) fn joined(&mut self, address: SocketAddr) {
        *self = Self { joined: Some((address, None)), ..Self::new(self.is_insecure) };
    }

    /// An attempt has failed: others have their turn.
    pub(super) fn failed(&mut self, address: SocketAddr) {
        self.failed.insert(address);
    }
}

/// Says a line, unless it is the last one again.
fn tell(told: &mut String, line: String) {
    if *told != line {
        tracing::info!("{line}");
        *told = line;
    }
}

/// The address to try, with a line if others fit too; or a line why none fits. Addresses that have failed come last; once all
/// have, they are forgotten.
fn choose(
    walls: &[&FoundWall],
    key: Option<&Key>,
    is_insecure: bool,
    failed: &mut BTreeSet<SocketAddr>,
) -> Result<(SocketAddr, Option<String>), String> {
    let may_join = |wall: &FoundWall| wall.fit(key) == Fit::Fits && (key.is_some() || is_insecure);
    let fitting: Vec<_> = walls.iter().filter(|wall| may_join(wall)).collect();
    if fitting.is_empty() {
        return Err(why_none(walls, key));
    }
    let addresses = || fitting.iter().flat_map(|wall| wall.addresses.iter().map(move |address| (wall, *address)));
    if addresses().all(|(_, address)| failed.contains(&address)) {
        failed.clear();
    }
    let (wall, address) = addresses().find(|(_, address)| !failed.contains(address)).expect("one that has not failed");
    let line = (fitting.len() > 1).then(|| {
        let others = fitting.iter().filter(|other| other.name != wall.name).map(|other| named(other));
        format!(
            "{} in this network fit: joining {}; to join another, name it: {}",
            counted(fitting.len(), "wall"),
            named(wall),
            listed(others)
        )
    });
    Ok((address, line))
}

/// One line why no wall can be joined, with the cure.
fn why_none(walls: &[&FoundWall], key: Option<&Key>) -> String {
    let why = |wall: &&FoundWall| {
        let cure = match wall.fit(key) {
            Fit::OtherVersion => {
                format!("speaks protocol {}, this program {PROTOCOL_VERSION}: build both from one commit", wall.version)
            }
            Fit::OtherKey => "has another key: give --key a copy of its key file".to_owned(),
            Fit::NeedsKey => "has a key: give --key a copy of its key file".to_owned(),
            Fit::HasNoKey => {
                "has no key: give --insecure in place of --key if you trust everybody in the network".to_owned()
            }
            Fit::Fits => "has no key: add --insecure if you trust everybody in the network".to_owned(),
        };
        format!("the wall {} {cure}", named(wall))
    };
    if walls.is_empty() {
        return format!(
            "no wall is found in this network yet: one that others reach, with --listen 0.0.0.0:{DEFAULT_PORT}, is found by \
             itself; or name one, as in renderer connect wall.example, or 127.0.0.1 on its own machine"
        );
    }
    listed(walls.iter().map(why)) + "; looking for others"
}

fn named(wall: &FoundWall) -> String {
    format!("{} ({})", wall.name, wall.address())
}

/// The first few of a list.
fn listed(items: impl Iterator<Item = String>) -> String {
    let items: Vec<_> = items.collect();
    let shown = items.iter().take(MOST_NAMED).cloned().collect::<Vec<_>>().join("; ");
    match items.len().saturating_sub(MOST_NAMED) {
        0 => shown,
        more => format!("{shown}; and {more} more"),
    }
}

#[cfg(test)]
mod tests {
    use channel::discovery::announced_text;

    use super::*;

    fn wall(name: &str, last_byte: u8, key: Option<&Key>) -> FoundWall {
        let version = PROTOCOL_VERSION.to_string();
        let addresses = [1, 2].map(|net| ([10, 0, net, last_byte], 7117).into()).to_vec();
        FoundWall::announced(name, addresses, &version, &announced_text(key, 5)).unwrap()
    }

    fn address(net: u8, last_byte: u8) -> SocketAddr {
        ([10, 0, net, last_byte], 7117).into()
    }

    #[test]
    fn a_wall_with_the_same_key_is_preferred_and_others_are_named() {
        let [ours, other] = [(); 2].map(|()| Key::random().unwrap());
        let walls = [wall("attic", 1, Some(&other)), wall("hall", 2, Some(&ours)), wall("yard", 3, None)];
        let all: Vec<_> = walls.iter().collect();
        let join = |key, is_insecure| choose(&all, key, is_insecure, &mut BTreeSet::new());
        assert_eq!(join(Some(&ours), false), Ok((address(1, 2), None)));
        assert_eq!(join(None, true), Ok((address(1, 3), None)));
        let line = join(None, false).unwrap_err();
        assert!(
            line.contains("attic (10.0.1.1:7117) has a key")
                && line.contains("yard (10.0.1.3:7117) has no key: add --insecure")
        );
        let line = choose(&all[..1], Some(&ours), false, &mut BTreeSet::new()).unwrap_err();
        assert!(line.contains("attic (10.0.1.1:7117) has another key: give --key"), "{line}");
        assert!(choose(&[], Some(&ours), false, &mut BTreeSet::new()).unwrap_err().contains("no wall is found"));
    }

    #[test]
    fn of_several_that_fit_the_first_by_name_is_joined_and_all_are_told() {
        let walls = [wall("attic", 1, None), wall("hall", 2, None)];
        let (joined, line) = choose(&[&walls[0], &walls[1]], None, true, &mut BTreeSet::new()).unwrap();
        assert_eq!(joined, address(1, 1));
        let line = line.unwrap();
        assert!(
            line.starts_with("2 walls in this network fit: joining attic (10.0.1.1:7117)") && line.contains("hall"),
            "{line}"
        );
    }

    #[test]
    fn addresses_that_fail_come_last_and_then_anew() {
        let walls = [wall("attic", 1, None), wall("hall", 2, None)];
        let mut failed = BTreeSet::new();
        let mut tried = Vec::new();
        for _ in 0..6 {
            let (address, _) = choose(&[&walls[0], &walls[1]], None, true, &mut failed).unwrap();
            failed.insert(address);
            tried.push(address);
        }
        let once = [address(1, 1), address(2, 1), address(1, 2), address(2, 2)];
        assert_eq!(tried[..4], once);
        assert_eq!(tried[4..], once[..2]);
    }
}
