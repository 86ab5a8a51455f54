//! The lock against visitors, and a kiosk's return to its beginning. Pure: time is an argument.

use std::time::{Duration, Instant};

use super::input::Command;

/// The lock against visitors, and the time since the last of them.
#[derive(Clone, Debug)]
pub(crate) struct Kiosk {
    /// Whether only visitors' commands are allowed.
    pub is_locked: bool,
    /// `None` for a wall that is no kiosk, and never returns.
    idle_timeout: Option<Duration>,
    /// Whether locking has hidden the overlay's panels.
    hides_panel: bool,
    /// The last input; `None` once the kiosk has returned, until the next input.
    touched_at: Option<Instant>,
}

impl Kiosk {
    /// A kiosk is locked, and returns after this time without input.
    pub(crate) fn new(idle_timeout: Option<Duration>, now: Instant) -> Self {
        Self { is_locked: idle_timeout.is_some(), idle_timeout, hides_panel: false, touched_at: Some(now) }
    }

    /// Locks the wall and hides the overlay's `panel`, or unlocks it and shows the panel that it hid. Returns whether the wall
    /// is locked now.
    pub(crate) fn toggle_lock(&mut self, panel: &mut bool) -> bool {
        self.is_locked = !self.is_locked;
        if self.is_locked {
            self.hides_panel = std::mem::take(panel);
        } else {
            *panel = std::mem::take(&mut self.hides_panel);
        }
        self.is_locked
    }

    pub(crate) fn allows(&self, command: Command) -> bool {
        !self.is_locked || command.is_for_visitors()
    }

    pub(crate) fn repeats_paths(&self) -> bool {
        self.idle_timeout.is_some()
    }

    pub(crate) fn touch(&mut self, now: Instant) {
        self.touched_at = Some(now);
    }

    /// When a locked kiosk returns, unless there is input before.
    pub(crate) fn returns_at(&self) -> Option<Instant> {
        let touched_at = self.touched_at.filter(|_| self.is_locked)?;
        Some(touched_at + self.idle_timeout?)
    }

    /// Whether to return now: true once after each input.
    pub(crate) fn returns(&mut self, now: Instant) -> bool {
        let returns = self.returns_at().is_some_and(|returns_at| now >= returns_at);
        self.touched_at.take_if(|_| returns).is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_kiosk_returns_once_after_the_last_input() {
        let start = Instant::now();
        let at = |seconds| start + Duration::from_secs(seconds);
        let mut kiosk = Kiosk::new(Some(Duration::from_secs(60)), start);
        assert_eq!(kiosk.returns_at(), Some(at(60)));
        assert!(!kiosk.returns(at(59)));
        kiosk.touch(at(59));
        assert!(!kiosk.returns(at(118)) && kiosk.returns_at() == Some(at(119)));
        assert!(kiosk.returns(at(119)));
        assert!(!kiosk.returns(at(3600)) && kiosk.returns_at().is_none(), "it is there already");
        kiosk.touch(at(3600));
        kiosk.touch(at(3610));
        assert!(!kiosk.returns(at(3661)) && kiosk.returns(at(3700)), "the last touch counts");
    }

    #[test]
    fn a_locked_wall_takes_only_commands_of_visitors() {
        let now = Instant::now();
        let (mut wall, mut panel) = (Kiosk::new(None, now), true);
        assert!(wall.allows(Command::Quit) && !wall.repeats_paths() && wall.returns_at().is_none());
        assert!(wall.toggle_lock(&mut panel) && !wall.allows(Command::Quit) && wall.allows(Command::ViewAll));
        assert_eq!(wall.returns_at(), None, "only kiosks return");
        let mut kiosk = Kiosk::new(Some(Duration::ZERO), now);
        assert!(kiosk.is_locked && !kiosk.toggle_lock(&mut panel) && kiosk.returns_at().is_none());
    }

    #[test]
    fn unlocking_shows_the_panel_that_locking_hid() {
        for had_panel in [true, false] {
            let (mut wall, mut panel) = (Kiosk::new(None, Instant::now()), had_panel);
            for _ in 0..2 {
                assert!(wall.toggle_lock(&mut panel) && !panel);
                assert!(!wall.toggle_lock(&mut panel) && panel == had_panel);
            }
        }
    }
}
