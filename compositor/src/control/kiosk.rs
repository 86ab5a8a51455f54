//! When a wall in a kiosk goes back to its beginning: knows no clock, and is told what time it is.

use std::time::{Duration, Instant};

/// Waits for everybody to have gone.
#[derive(Clone, Debug)]
pub struct Kiosk {
    idle_timeout: Duration,
    /// `None` once it has gone back, until somebody comes.
    touched_at: Option<Instant>,
}

impl Kiosk {
    /// Goes back when nobody has touched anything for so long.
    pub fn new(idle_timeout: Duration, now: Instant) -> Self {
        Self { idle_timeout, touched_at: Some(now) }
    }

    /// Somebody is there.
    pub fn touch(&mut self, now: Instant) {
        self.touched_at = Some(now);
    }

    /// When to go back, if nobody comes before.
    pub fn returns_at(&self) -> Option<Instant> {
        self.touched_at.map(|touched_at| touched_at + self.idle_timeout)
    }

    /// Whether to go back now; once for each time that somebody was there.
    pub fn returns(&mut self, now: Instant) -> bool {
        let returns = self.returns_at().is_some_and(|returns_at| now >= returns_at);
        self.touched_at.take_if(|_| returns).is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_kiosk_returns_once_when_everybody_has_gone() {
        let start = Instant::now();
        let at = |seconds| start + Duration::from_secs(seconds);
        let mut kiosk = Kiosk::new(Duration::from_secs(60), start);
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
}
