//! The pages on the wall while it is calibrated: patterns, photographs so far, findings. Pure: no window, no folder.

use std::ops::ControlFlow;

use shared::printable::counted;

use super::photos::Photo;
use crate::{
    calibration::{Plan, Verdict},
    control::alignment::findings::CanvasPicture,
    wall::Wall,
    window::{Page, Wish},
};

/// How photographs become a verdict.
pub(super) type Judge<'a> = Box<dyn Fn(&[Photo]) -> anyhow::Result<Verdict> + 'a>;

/// How a session works.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rules {
    /// The number of patterns to show.
    pub n_patterns: u32,
    /// Whether photographs come in while patterns are shown.
    pub watches: bool,
    /// Whether what was found is written without asking, once nothing speaks against it.
    pub accepts: bool,
    /// Whether faults may be accepted.
    pub forces: bool,
    /// Whether each photograph may be the last: few projectors have moved.
    pub is_again: bool,
}

/// One calibration.
pub(super) struct Session<'a> {
    wall: &'a Wall,
    plan: &'a Plan,
    rules: Rules,
    judge: Judge<'a>,
    pub photos: Vec<Photo>,
    /// The pattern that is shown, or was before the page.
    pattern: u32,
    shown: Shown,
    /// Of all photographs; `None` before they were judged.
    verdict: Option<Verdict>,
    /// Whether the verdict is new.
    is_new: bool,
    is_accepted: bool,
    /// Lines for the log.
    pub log: Vec<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Shown {
    Pattern,
    Progress,
    Findings,
}

impl<'a> Session<'a> {
    pub(super) fn new(wall: &'a Wall, plan: &'a Plan, rules: Rules, judge: Judge<'a>) -> Self {
        let photos = Vec::new();
        let (shown, log) = (Shown::Pattern, Vec::new());
        Self {
            wall,
            plan,
            rules,
            judge,
            photos,
            pattern: 0,
            shown,
            verdict: None,
            is_new: false,
            is_accepted: false,
            log,
        }
    }

    /// A session that begins with what photographs tell, on a wall that may show patterns for more.
    pub(super) fn with_verdict(mut self, photos: Vec<Photo>, verdict: Verdict) -> Self {
        (self.photos, self.verdict, self.shown) = (photos, Some(verdict), Shown::Findings);
        self
    }

    /// The findings since the last call.
    pub(super) fn take_news(&mut self) -> Option<&Verdict> {
        let is_new = std::mem::take(&mut self.is_new);
        self.verdict.as_ref().filter(|_| is_new)
    }

    /// Whether findings are on the wall that may be accepted.
    pub(super) fn asks(&self) -> bool {
        self.shown == Shown::Findings && self.verdict.as_ref().is_some_and(|it| self.may_be_accepted(it))
    }

    /// The findings, if they were accepted.
    pub(super) fn into_verdict(self) -> Option<Verdict> {
        self.verdict.filter(|_| self.is_accepted)
    }

    /// Does what a person wishes; returns the page that changes, or breaks to end.
    pub(super) fn on_wish(&mut self, wish: Wish) -> ControlFlow<(), Option<Page>> {
        match (wish, self.shown) {
            (Wish::Discard, _) => return ControlFlow::Break(()),
            (Wish::Accept, Shown::Findings) => return self.accept(),
            (Wish::Accept, _) if self.photos.is_empty() => return ControlFlow::Break(()),
            (Wish::Accept, _) => self.judge(),
            (Wish::Progress, Shown::Progress) => self.shown = Shown::Pattern,
            (Wish::Progress, _) => self.shown = Shown::Progress,
            (Wish::Next, Shown::Pattern) => self.pattern = (self.pattern + 1) % self.rules.n_patterns,
            (Wish::Previous, Shown::Pattern) => {
                self.pattern = (self.pattern + self.rules.n_patterns - 1) % self.rules.n_patterns;
            }
            // More photographs, of the pattern that is due.
            (Wish::Next | Wish::Previous, _) => self.shown = Shown::Pattern,
            (Wish::News, _) => return ControlFlow::Continue(None),
        }
        ControlFlow::Continue(Some(self.page()))
    }

    /// Takes a photograph, which may call for another pattern, or for a verdict; breaks if that is accepted without asking.
    pub(super) fn on_photo(&mut self, photo: Photo) -> ControlFlow<(), Option<Page>> {
        let shows_pattern = photo.reading.patterns().contains(&self.pattern);
        self.photos.push(photo);
        if self.shown != Shown::Pattern {
            if self.shown == Shown::Findings {
                self.judge();
            }
            return ControlFlow::Continue(Some(self.page()));
        }
        if !shows_pattern {
            return ControlFlow::Continue(None);
        }
        let is_last = self.pattern + 1 == self.rules.n_patterns;
        self.pattern = (self.pattern + 1) % self.rules.n_patterns;
        if is_last || self.rules.is_again {
            self.judge();
            let is_clean = self.verdict.as_ref().is_some_and(|verdict| verdict.faults.is_empty());
            if self.rules.accepts {
                self.shown = Shown::Pattern;
            }
            if self.rules.accepts && is_clean {
                return self.accept();
            }
            if !is_clean && self.rules.is_again {
                self.pattern = self.wanted().unwrap_or(self.pattern);
                // Only the pattern is missing that shows all of what has moved.
                if !is_last {
                    self.shown = Shown::Pattern;
                }
            }
        }
        ControlFlow::Continue(Some(self.page()))
    }

    fn accept(&mut self) -> ControlFlow<(), Option<Page>> {
        if self.verdict.as_ref().is_some_and(|it| self.may_be_accepted(it)) {
            self.is_accepted = true;
            return ControlFlow::Break(());
        }
        ControlFlow::Continue(None)
    }

    fn may_be_accepted(&self, verdict: &Verdict) -> bool {
        verdict.wall.is_some() && (verdict.faults.is_empty() || self.rules.forces)
    }

    fn judge(&mut self) {
        self.is_new = true;
        self.verdict = match (self.judge)(&self.photos) {
            Ok(verdict) => Some(verdict),
            Err(error) => {
                self.log.push(format!("{error:#}"));
                None
            }
        };
        self.shown = if self.verdict.is_some() { Shown::Findings } else { Shown::Progress };
    }

    /// The pattern that shows all of the first projector that moved and was seen too little.
    fn wanted(&self) -> Option<u32> {
        let projectors = &self.verdict.as_ref()?.projectors;
        let lacking = projectors.iter().position(|it| it.has_fault && it.moved_px != Some(0.0))?;
        let pattern = self.plan.whole_in(lacking);
        let was_shown = self.photos.iter().any(|photo| photo.reading.patterns().contains(&pattern));
        (!was_shown).then_some(pattern)
    }

    /// The page that is shown now.
    pub(super) fn page(&self) -> Page {
        match (self.shown, &self.verdict) {
            (Shown::Findings, Some(verdict)) => {
                let wall = verdict.wall.as_ref().unwrap_or(self.wall);
                Page::Picture(Box::new(wall.clone()), self.findings(verdict))
            }
            (Shown::Progress | Shown::Findings, _) => Page::Picture(Box::new(self.wall.clone()), self.progress()),
            (Shown::Pattern, _) => Page::Pattern(self.pattern),
        }
    }

    fn findings(&self, verdict: &Verdict) -> CanvasPicture {
        let mut notes: Vec<String> = verdict.faults.iter().take(MOST_FAULTS).cloned().collect();
        if verdict.faults.len() > MOST_FAULTS {
            notes.push(format!("and {}", counted(verdict.faults.len() - MOST_FAULTS, "other fault")));
        }
        let more = if self.rules.watches { "; Space: more photographs" } else { "" };
        notes.push(if self.may_be_accepted(verdict) {
            format!("Enter writes this into the file; Escape leaves the file as it was{more}")
        } else {
            format!("Escape leaves the file as it was{more}")
        });
        CanvasPicture::of_findings(verdict.wall.as_ref().unwrap_or(self.wall), &verdict.projectors, &notes)
    }

    fn progress(&self) -> CanvasPicture {
        let mut n_photos = vec![0; self.wall.projectors().len()];
        self.photos.iter().flat_map(|photo| photo.reading.projectors()).for_each(|index| n_photos[index] += 1);
        let n_of = |pattern: u32| self.photos.iter().filter(|it| it.reading.patterns().contains(&pattern)).count();
        let patterns: Vec<String> =
            (0..self.rules.n_patterns).map(|pattern| format!("{}: {}", pattern + 1, n_of(pattern))).collect();
        let mut notes = vec![format!("photographs by pattern: {}", patterns.join(", "))];
        let useless = self.photos.iter().filter(|photo| photo.reading.patterns().is_empty());
        notes.extend(useless.take(MOST_FAULTS).map(|photo| photo.reading.line(self.wall)));
        notes.push("Tab or Space: patterns; Enter: what these photographs tell; Escape: end".to_owned());
        CanvasPicture::of_progress(self.wall, &n_photos, &notes)
    }
}

/// So many faults are shown at once; the terminal has all.
const MOST_FAULTS: usize = 4;

#[cfg(test)]
mod tests {
    use image::metadata::Orientation;

    use super::*;
    use crate::calibration::{Codebook, Finding, Photograph, Reading, judge};

    fn wall() -> Wall {
        let text = "canvas_m = [2.0, 0.75]\n[grid]\ncolumns = 2\nrows = 1\npixels = [400, 300]\noverlap = [0.1, 0.0]\n";
        Wall::from_toml("ours", text).expect("a wall")
    }

    /// What a camera would see that shows the pixels themselves, from the left up to a column.
    fn seen(wall: &Wall, plan: &Plan, pattern: u32, n_columns: usize) -> Photo {
        let part = wall.whole_output();
        let pixels = plan.draw(pattern, wall, part).into_iter().enumerate();
        let grey = |(index, [grey, ..]): (usize, [u8; 3])| {
            if index % part.width as usize >= n_columns { 0.0 } else { f32::from(grey) / 255.0 }
        };
        let photograph =
            Photograph { size: [part.width as usize, part.height as usize], values: pixels.map(grey).collect() };
        let reading = Reading::new(format!("{pattern}.png"), &photograph, &Codebook::new(plan));
        Photo { reading, orientation: Orientation::NoTransforms }
    }

    fn photo(wall: &Wall, plan: &Plan, pattern: u32) -> Photo {
        seen(wall, plan, pattern, usize::MAX)
    }

    fn check(accepts: bool, steps: impl FnOnce(&mut Session<'_>, &dyn Fn(u32) -> Photo)) {
        let wall = wall();
        let plan = Plan::of_wall(&wall).expect("patterns");
        let rules = Rules { n_patterns: plan.n_patterns(), watches: true, accepts, forces: false, is_again: false };
        let judge: Judge<'_> = Box::new(|photos| {
            let readings: Vec<Reading> = photos.iter().map(|photo| photo.reading.clone()).collect();
            Ok(judge(&wall, &plan, &readings, None))
        });
        steps(&mut Session::new(&wall, &plan, rules, judge), &|pattern| photo(&wall, &plan, pattern));
    }

    fn is_picture(shown: &ControlFlow<(), Option<Page>>) -> bool {
        matches!(shown, ControlFlow::Continue(Some(Page::Picture(..))))
    }

    #[test]
    fn photographs_lead_from_pattern_to_pattern_to_findings_which_a_person_accepts() {
        check(false, |session, photo| {
            assert_eq!(session.page(), Page::Pattern(0));
            // A photograph of another pattern changes nothing.
            assert_eq!(session.on_photo(photo(1)), ControlFlow::Continue(None));
            assert_eq!(session.on_photo(photo(0)), ControlFlow::Continue(Some(Page::Pattern(1))));
            assert!(is_picture(&session.on_photo(photo(1))) && session.asks());
            assert!(session.take_news().is_some_and(|verdict| verdict.faults.is_empty()));
            assert!(session.take_news().is_none());
            // More photographs, and back.
            assert_eq!(session.on_wish(Wish::Next), ControlFlow::Continue(Some(Page::Pattern(0))));
            assert!(!session.asks() && is_picture(&session.on_wish(Wish::Accept)));
            assert_eq!(session.on_wish(Wish::Accept), ControlFlow::Break(()));
            assert!(session.is_accepted);
        });
    }

    #[test]
    fn faults_are_shown_and_cannot_be_accepted() {
        check(false, |session, _| {
            // The right projector is off.
            let _ = session.on_photo(seen(session.wall, session.plan, 0, 400));
            let progress = session.on_wish(Wish::Progress);
            assert!(is_picture(&progress) && progress != session.on_wish(Wish::Progress));
            assert!(is_picture(&session.on_wish(Wish::Accept)));
            assert!(session.take_news().is_some_and(|verdict| !verdict.faults.is_empty()));
            assert_eq!(session.on_wish(Wish::Accept), ControlFlow::Continue(None));
            assert_eq!(session.on_wish(Wish::Discard), ControlFlow::Break(()));
            assert!(!session.is_accepted);
        });
    }

    #[test]
    fn after_a_bump_the_pattern_that_shows_all_of_what_moved_comes_next() {
        let text = "canvas_m = [2.0, 1.5]\n[grid]\ncolumns = 2\nrows = 2\npixels = [300, 300]\noverlap = [0.1, 0.1]\n";
        let wall = Wall::from_toml("ours", text).expect("a wall");
        let plan = Plan::of_wall(&wall).expect("patterns");
        let last = plan.whole_in(3);
        assert!(last > 1);
        // The fourth projector has moved, and only its own pattern tells enough.
        let judge: Judge<'_> = Box::new(|photos| {
            let is_told = photos.iter().any(|photo| photo.reading.patterns().contains(&last));
            let mut projectors = vec![Finding { moved_px: Some(0.0), ..Finding::default() }; 4];
            projectors[3] = Finding { moved_px: Some(5.0), has_fault: !is_told, ..Finding::default() };
            let faults = if is_told { Vec::new() } else { vec!["too little".to_owned()] };
            Ok(Verdict { wall: Some(wall.clone()), found: Vec::new(), faults, projectors })
        });
        let rules =
            Rules { n_patterns: plan.n_patterns(), watches: true, accepts: false, forces: false, is_again: true };
        let mut session = Session::new(&wall, &plan, rules, judge);
        assert_eq!(session.on_photo(photo(&wall, &plan, 0)), ControlFlow::Continue(Some(Page::Pattern(last))));
        assert!(is_picture(&session.on_photo(photo(&wall, &plan, last))) && session.asks());
    }

    #[test]
    fn a_wall_that_asks_nobody_ends_when_nothing_speaks_against_it() {
        check(true, |session, photo| {
            let _ = session.on_photo(photo(0));
            assert_eq!(session.on_photo(photo(1)), ControlFlow::Break(()));
            assert!(session.is_accepted);
        });
    }
}
