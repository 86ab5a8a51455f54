//! Days of shows, with an invented clock and wall.

use std::path::PathBuf;

use proptest::prelude::*;

use super::{
    super::file::{Ending, Place},
    *,
};

const MS: Duration = Duration::from_millis(1);

fn scene(number: usize, seconds: Option<f64>) -> ShowScene {
    ShowScene {
        model: Some(PathBuf::from(format!("{}.ply", number % 3))),
        place: Place::Whole,
        up: None,
        light: None,
        clip: None,
        rays: None,
        path_light: None,
        caption: format!("scene {number}"),
        ending: Ending {
            after: seconds.map(Duration::from_secs_f64),
            by_touch: seconds.is_none(),
            waits: seconds.is_none(),
        },
    }
}

fn show(n_scenes: usize, seconds: f64) -> Show {
    let scenes = (0..n_scenes).map(|number| scene(number, Some(seconds))).collect();
    Show { fade: Duration::from_secs(1), repeats: true, scenes }
}

/// A wall that takes its time: it reads models and shows frames when its clock says so.
struct Wall {
    player: Player,
    now: Instant,
    /// The scene that is read, and when that is done.
    reading: Option<(usize, Instant)>,
    /// The scene whose first frame is on its way, and when it comes.
    rendering: Option<(usize, Instant)>,
    /// The scene of the picture on the wall.
    picture: Option<usize>,
    /// Scenes in the order of their pictures, and when each came.
    shown: Vec<(usize, Instant)>,
    read_time: Duration,
    frame_time: Duration,
    missing: Vec<usize>,
    n_lines: usize,
}

impl Wall {
    fn new(show: Show) -> Self {
        let now = Instant::now();
        Self {
            player: Player::new(show, now),
            now,
            reading: None,
            rendering: None,
            picture: None,
            shown: Vec::new(),
            read_time: 300 * MS,
            frame_time: 40 * MS,
            missing: Vec::new(),
            n_lines: 0,
        }
    }

    /// Does what is due now, and checks that the caption is that of the picture.
    fn settle(&mut self) {
        loop {
            if let Some((index, _)) = self.reading.take_if(|(_, at)| *at <= self.now) {
                let read = if self.missing.contains(&index) { Err(format!("{index} is missing")) } else { Ok(()) };
                self.n_lines += usize::from(self.player.on_read(index, read, self.now));
            }
            if let Some((index, _)) = self.rendering.take_if(|(_, at)| *at <= self.now) {
                self.picture = Some(index);
                self.shown.push((index, self.now));
                self.player.on_shown(index, None, self.now);
            }
            match self.player.advance(self.now) {
                Some(Step::Prepare(index)) => self.reading = Some((index, self.now + self.read_time)),
                Some(Step::Enter(index)) => {
                    assert!(!self.missing.contains(&index), "a scene that is missing was entered");
                    self.rendering = Some((index, self.now + self.frame_time));
                }
                None => break,
            }
        }
        let caption = self.player.shown().map(|(_, scene)| scene.caption.clone());
        assert_eq!(caption, self.picture.map(|index| format!("scene {index}")), "a wrong caption");
    }

    /// Lets time pass, from one thing to do to the next.
    fn pass(&mut self, time: Duration) {
        let end = self.now + time;
        self.settle();
        loop {
            let moments = [self.reading.map(|it| it.1), self.rendering.map(|it| it.1), self.player.wakes_at()];
            let Some(next) = moments.into_iter().flatten().min().filter(|next| *next <= end) else { break };
            self.now = self.now.max(next);
            self.settle();
        }
        self.now = end;
        self.settle();
    }

    fn order(&self) -> Vec<usize> {
        self.shown.iter().map(|(index, _)| *index).collect()
    }
}

#[test]
fn a_day_of_fifty_scenes_shows_each_for_its_time() {
    let mut wall = Wall::new(show(50, 7.0));
    wall.pass(Duration::from_secs(86_400));
    assert!(wall.shown.len() > 12_200, "{}", wall.shown.len());
    assert!(wall.order().iter().enumerate().all(|(nth, index)| *index == nth % 50));
    for pair in wall.shown.windows(2) {
        assert_eq!(pair[1].1 - pair[0].1, Duration::from_secs(7) + wall.frame_time);
    }
}

#[test]
fn an_edited_show_goes_on_with_the_scene_on_the_wall() {
    let now = Instant::now();
    let mut player = Player::new(show(4, 5.0), now);
    let enter = |player: &mut Player, index: usize| {
        assert_eq!(player.advance(now), Some(Step::Prepare(index)));
        player.on_read(index, Ok(()), now);
        assert_eq!(player.advance(now), Some(Step::Enter(index)));
        player.on_shown(index, None, now);
    };
    let edit = |player: &mut Player, map: SceneMap| {
        let mut show = player.show().clone();
        match map {
            SceneMap::Moved { from, to } => {
                let scene = show.scenes.remove(from);
                show.scenes.insert(to, scene);
            }
            SceneMap::Deleted(index) => drop(show.scenes.remove(index)),
            SceneMap::Same => {}
        }
        player.set_show(show, map);
    };
    let shown = |player: &Player| player.shown().map(|(index, scene)| (index, scene.caption.clone()));
    enter(&mut player, 0);
    edit(&mut player, SceneMap::Moved { from: 0, to: 2 });
    assert_eq!(shown(&player), Some((2, "scene 0".to_owned())));
    assert_eq!(player.advance(now), Some(Step::Prepare(3)), "the scene after its new place");
    player.on_read(3, Err("scene 3 is missing".to_owned()), now);
    edit(&mut player, SceneMap::Deleted(0));
    assert_eq!(
        (shown(&player), player.problems()),
        (Some((1, "scene 0".to_owned())), vec!["Scene 3 is left out: scene 3 is missing".to_owned()])
    );
    // Without it, the scene behind it takes its place on the wall; behind the last, the first does.
    edit(&mut player, SceneMap::Deleted(1));
    assert_eq!(shown(&player), None);
    enter(&mut player, 1);
    assert_eq!(shown(&player), Some((1, "scene 3".to_owned())));
    edit(&mut player, SceneMap::Deleted(1));
    enter(&mut player, 0);
    assert_eq!(shown(&player), Some((0, "scene 2".to_owned())));
    edit(&mut player, SceneMap::Deleted(0));
    assert_eq!((player.advance(now), player.is_stuck()), (None, true), "nothing is left");
}

#[test]
fn a_missing_scene_is_left_out_and_comes_back_when_it_can() {
    let mut wall = Wall::new(show(4, 1.0));
    wall.missing = vec![1, 2];
    wall.pass(Duration::from_secs(20));
    assert!(wall.order().chunks(2).all(|pair| [0, 3].starts_with(pair)), "{:?}", wall.order());
    assert_eq!(wall.player.problems(), ["Scene 2 is left out: 1 is missing", "Scene 3 is left out: 2 is missing"]);
    assert_eq!(wall.n_lines, 2, "each is told once");
    wall.missing.clear();
    wall.pass(Duration::from_secs(10));
    assert!(wall.order().ends_with(&[0, 1, 2, 3]) || wall.order().windows(4).any(|four| four == [0, 1, 2, 3]));
    assert_eq!(wall.player.problems(), Vec::<String>::new());
}

#[test]
fn a_show_without_any_scene_that_can_be_shown_waits_and_tries_again() {
    for (n_scenes, repeats) in [(1, true), (3, true), (1, false), (3, false)] {
        let mut wall = Wall::new(Show { repeats, ..show(n_scenes, 1.0) });
        wall.missing = (0..n_scenes).collect();
        wall.pass(Duration::from_secs(60));
        assert_eq!((wall.order(), wall.n_lines, wall.player.is_stuck()), (vec![], n_scenes, true));
        wall.missing.pop();
        wall.pass(RETRY * 2);
        assert_eq!(wall.order().first(), Some(&(n_scenes - 1)));
        assert!(wall.order().iter().all(|index| *index == n_scenes - 1));
    }
    let mut empty = Wall::new(show(0, 1.0));
    empty.player.go_on();
    empty.player.play(empty.now);
    empty.pass(Duration::from_secs(60));
    assert_eq!((empty.order(), empty.player.wakes_at()), (vec![], None));
}

#[test]
fn orders_go_on_and_back_and_hold() {
    let mut wall = Wall::new(show(5, 10.0));
    wall.pass(Duration::from_secs(5));
    wall.player.go_on();
    wall.pass(Duration::from_secs(1));
    wall.player.go_back();
    wall.pass(Duration::from_secs(1));
    wall.player.go_back();
    wall.pass(Duration::from_secs(1));
    assert_eq!(wall.order(), [0, 1, 0, 4]);
    wall.player.pause(wall.now);
    wall.pass(Duration::from_secs(3600));
    assert_eq!(wall.order(), [0, 1, 0, 4]);
    assert_eq!(wall.player.wakes_at(), None, "a held show needs no time");
    wall.player.play(wall.now);
    wall.pass(Duration::from_secs(8));
    assert_eq!(wall.order().len(), 4, "the time of the pause does not count, that before it does");
    wall.pass(Duration::from_secs(3));
    assert_eq!(wall.order(), [0, 1, 0, 4, 0]);
    for _ in 0..3 {
        wall.player.go_on();
    }
    wall.pass(Duration::from_secs(1));
    assert_eq!(wall.order().last(), Some(&3), "three orders at once go three scenes on");
}

#[test]
fn a_scene_that_is_overtaken_still_has_its_own_caption() {
    let mut wall = Wall::new(show(5, 10.0));
    wall.pass(Duration::from_secs(1));
    wall.frame_time = Duration::from_secs(2);
    wall.player.go_on();
    wall.pass(MS);
    assert!(wall.rendering.is_some());
    wall.player.go_on();
    // Its model is read while the frame of the one before is on its way; `pass` checks each caption.
    wall.read_time = Duration::from_secs(5);
    wall.pass(Duration::from_secs(9));
    assert_eq!(wall.order(), [0, 1, 2]);
}

#[test]
fn a_touch_ends_a_scene_that_waits_for_it_and_otherwise_steers() {
    let mut two = show(2, 5.0);
    two.scenes[0] = scene(0, None);
    let mut wall = Wall::new(two);
    wall.pass(Duration::from_secs(600));
    assert!(wall.player.touch() && wall.player.touch(), "both fingers of a hand");
    wall.pass(Duration::from_secs(1));
    assert_eq!(wall.order(), [0, 1]);
    assert!(!wall.player.touch());
    wall.player.steer(wall.now);
    wall.pass(Duration::from_secs(60));
    assert_eq!(wall.order(), [0, 1], "the visitor has the wall");
    wall.player.play(wall.now);
    wall.pass(Duration::from_secs(1));
    assert_eq!(wall.order(), [0, 1, 1], "the scene begins again");
}

#[test]
fn a_show_that_does_not_repeat_ends_with_its_last_scene() {
    let mut wall = Wall::new(Show { repeats: false, ..show(3, 1.0) });
    wall.pass(Duration::from_secs(60));
    assert_eq!((wall.order(), wall.player.is_playing()), (vec![0, 1, 2], false));
    wall.player.go_on();
    wall.pass(Duration::from_secs(1));
    assert_eq!(wall.order(), [0, 1, 2]);
    wall.player.play(wall.now);
    wall.pass(Duration::from_secs(60));
    assert_eq!(wall.order(), [0, 1, 2, 0, 1, 2]);
}

#[test]
fn a_clock_that_jumps_ends_one_scene() {
    let mut wall = Wall::new(show(9, 10.0));
    wall.pass(Duration::from_secs(1));
    // The machine slept for a week.
    wall.now += Duration::from_secs(600_000);
    wall.settle();
    wall.pass(Duration::from_secs(1));
    assert_eq!(wall.order(), [0, 1]);
    wall.player.advance(wall.now - Duration::from_secs(5));
    wall.pass(Duration::from_secs(8));
    assert_eq!(wall.order(), [0, 1], "a clock that goes back counts nothing twice");
}

#[test]
fn an_opened_model_has_no_caption_and_the_show_comes_back_to_its_scene() {
    let mut wall = Wall::new(show(4, 10.0));
    wall.pass(Duration::from_secs(12));
    wall.player.leave(wall.now);
    wall.picture = None;
    wall.pass(Duration::from_secs(100));
    assert_eq!((wall.order(), wall.player.shown().is_none()), (vec![0, 1], true));
    wall.player.play(wall.now);
    wall.pass(Duration::from_secs(1));
    assert_eq!(wall.order(), [0, 1, 1]);
}

proptest! {
    #[test]
    fn no_sequence_of_orders_gives_a_wrong_caption_or_an_endless_loop(
        orders in proptest::collection::vec((0..8u8, 0..4000u64), 1..60),
        missing in proptest::collection::vec(0..6usize, 0..6),
        [read, frame] in [0..3000u32, 0..3000u32],
        repeats: bool,
    ) {
        let mut wall = Wall::new(Show { repeats, ..show(6, 1.5) });
        (wall.missing, wall.read_time, wall.frame_time) = (missing, MS * read, MS * frame);
        for (order, milliseconds) in orders {
            match order {
                0 => wall.player.go_on(),
                1 => wall.player.go_back(),
                2 => wall.player.play(wall.now),
                3 => wall.player.pause(wall.now),
                4 => wall.player.steer(wall.now),
                5 => drop(wall.player.touch()),
                6 => wall.missing.clear(),
                _ => {}
            }
            // `settle` checks captions, and ends.
            wall.pass(MS * milliseconds as u32);
        }
    }
}
