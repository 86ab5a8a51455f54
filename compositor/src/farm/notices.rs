//! Notices for the operator: render servers that do not render, until they do.

use std::net::IpAddr;

use shared::printable::counted;

/// Most render servers with a notice: names are chosen by peers, and one that comes back under another name keeps its
/// notice until somebody dismisses it.
const MOST_NOTICES: usize = 64;

/// Most other render servers that are named beside the newest notice.
const MOST_NAMES: usize = 3;

/// Most machines that wait outside.
const MOST_OUTSIDE: usize = 16;

/// A render server across its connections: its name, and its address unless the wall itself starts it.
pub(super) type NodeKey = (String, Option<IpAddr>);

/// The notices, at most one for each render server, the newest last.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Notices {
    all: Vec<(NodeKey, String)>,
    /// Machines whose render servers the wall does not let in, the newest last.
    outside: Vec<(IpAddr, &'static str)>,
    n_put: u64,
}

impl Notices {
    /// Gives a render server a notice, in place of an older one. The same words again are no news.
    pub(crate) fn put(&mut self, node: NodeKey, text: String) {
        if self.all.iter().any(|(of, old)| (of, old) == (&node, &text)) {
            return;
        }
        self.n_put += 1;
        self.clear(&node);
        if self.all.len() == MOST_NOTICES {
            self.all.remove(0);
        }
        self.all.push((node, text));
    }

    /// Puts the notice of a lost connection.
    pub(super) fn put_lost(&mut self, node: NodeKey, reason: &str, was_last: bool) {
        let name = &node.0;
        let rest = if was_last { "No other is left" } else { "The others render its share" };
        let text = match node.1 {
            // The reporter of its process knows more.
            None if self.all.iter().any(|(of, _)| *of == node) => return,
            None => format!("{name} lost: {reason}. {rest} until it is back."),
            Some(_) => format!("{name} lost: {reason}. {rest}; if it does not come back by itself, start it again."),
        };
        self.put(node, text);
    }

    /// A machine's render server waits outside, for this reason; the text holds the cure.
    pub(super) fn put_outside(&mut self, machine: IpAddr, reason: &'static str) {
        if self.outside.contains(&(machine, reason)) {
            return;
        }
        self.n_put += 1;
        self.clear_outside(machine);
        if self.outside.len() == MOST_OUTSIDE {
            self.outside.remove(0);
        }
        self.outside.push((machine, reason));
    }

    /// A render server of this machine has joined.
    pub(super) fn clear_outside(&mut self, machine: IpAddr) {
        self.outside.retain(|(of, _)| *of != machine);
    }

    /// The wall has started a render server: words of a notice, if there is one, change, but this is no news.
    pub(super) fn reword_started(&mut self, node: &NodeKey) {
        let text = format!("{} was started again, and loads the model.", node.0);
        self.all.iter_mut().filter(|(of, _)| of == node).for_each(|(_, old)| old.clone_from(&text));
    }

    /// Takes a render server's notice away: it is ready.
    pub(crate) fn clear(&mut self, node: &NodeKey) {
        self.all.retain(|(of, _)| of != node);
    }

    /// The number of notices that were ever put: another number means that there is news.
    pub fn n_put(&self) -> u64 {
        self.n_put
    }

    /// The newest notice, with the names of others that have one, and the machines outside.
    pub fn message(&self) -> Option<String> {
        let messages: Vec<_> = self.newest().into_iter().chain(self.newest_outside()).collect();
        (!messages.is_empty()).then(|| messages.join(" "))
    }

    fn newest_outside(&self) -> Option<String> {
        let ((newest, reason), others) = self.outside.split_last()?;
        let also = match others.len() {
            0 => String::new(),
            n_others => format!(" Also outside: {}.", counted(n_others, "other machine")),
        };
        Some(format!("A render server at {newest} waits outside: {reason}.{also}"))
    }

    fn newest(&self) -> Option<String> {
        let ((_, newest), others) = self.all.split_last()?;
        let names: Vec<_> = others.iter().rev().take(MOST_NAMES).map(|((name, _), _)| name.as_str()).collect();
        let more = match others.len() - names.len() {
            0 => String::new(),
            n_more => format!(" and {n_more} more"),
        };
        let also = if names.is_empty() { String::new() } else { format!(" Also missing: {}{more}.", names.join(", ")) };
        Some(format!("{newest}{also}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node(name: &str) -> NodeKey {
        (name.to_owned(), Some([10, 0, 0, 1].into()))
    }

    #[test]
    fn a_notice_goes_when_its_render_server_is_back_and_the_others_stay() {
        let mut notices = Notices::default();
        notices.put(node("left"), "left lost.".to_owned());
        notices.put(node("right"), "right lost.".to_owned());
        assert_eq!(notices.message().as_deref(), Some("right lost. Also missing: left."));
        notices.clear(&("right".to_owned(), None));
        assert_eq!(notices.message().as_deref(), Some("right lost. Also missing: left."), "another of that name");
        notices.clear(&node("right"));
        assert_eq!(notices.message().as_deref(), Some("left lost."));
        let n_put = notices.n_put();
        notices.put(node("left"), "left lost.".to_owned());
        assert_eq!(notices.n_put(), n_put, "the same again is no news");
        notices.clear(&node("left"));
        assert_eq!(notices.message(), None);
    }

    #[test]
    fn the_walls_own_render_servers_are_not_to_be_started_by_hand() {
        let ours: NodeKey = ("local-1".to_owned(), None);
        let mut notices = Notices::default();
        notices.reword_started(&ours);
        assert_eq!(notices.message(), None, "the first start is no news");
        notices.put_lost(ours.clone(), "it closed the connection", true);
        assert_eq!(
            notices.message().as_deref(),
            Some("local-1 lost: it closed the connection. No other is left until it is back.")
        );
        // Its process and its connection end at once: news of either may come first.
        notices.put(ours.clone(), "local-1 was killed. It starts again in 1 s.".to_owned());
        notices.put_lost(ours.clone(), "it closed the connection", false);
        assert_eq!(notices.message().as_deref(), Some("local-1 was killed. It starts again in 1 s."));
        let n_put = notices.n_put();
        notices.reword_started(&ours);
        assert_eq!(notices.message().as_deref(), Some("local-1 was started again, and loads the model."));
        assert_eq!(notices.n_put(), n_put, "dismissed stays dismissed");
        notices.put_lost(node("left"), "silent for 2000 ms", false);
        assert!(
            notices.message().unwrap().contains("others render its share; if it does not come back by itself, start")
        );
    }

    #[test]
    fn names_without_end_take_no_memory_without_end() {
        let mut notices = Notices::default();
        (0..1000).for_each(|number| notices.put(node(&number.to_string()), format!("{number} lost.")));
        assert_eq!(notices.all.len(), MOST_NOTICES);
        assert_eq!(notices.message().unwrap(), "999 lost. Also missing: 998, 997, 996 and 60 more.");
    }

    #[test]
    fn machines_outside_are_told_until_they_have_joined() {
        let mut notices = Notices::default();
        let machine = |number| IpAddr::from([10, 0, 0, number]);
        notices.put_outside(machine(1), "it has no key");
        notices.put_outside(machine(1), "it has no key");
        assert_eq!(notices.n_put(), 1, "the same again is no news");
        assert_eq!(notices.message().unwrap(), "A render server at 10.0.0.1 waits outside: it has no key.");
        notices.put_outside(machine(2), "it has another key");
        let said = notices.message().unwrap();
        assert!(said.contains("10.0.0.2") && said.ends_with("Also outside: 1 other machine."), "{said}");
        for number in 0..=255 {
            notices.put_outside(machine(number), "it has no key");
        }
        assert_eq!(notices.outside.len(), MOST_OUTSIDE);
        for number in 0..=255 {
            notices.clear_outside(machine(number));
        }
        assert_eq!(notices.message(), None);
    }
}
