//! Several frames at a time, on invented computers at the ends of invented links.

use super::*;

fn repeating(in_flight: u32) -> RenderGoal {
    RenderGoal { repeat: true, in_flight, ..goal(Division::Tiled) }
}

fn moved_to(eye_x: f64, in_flight: u32) -> Event {
    Event::GoalChanged(RenderGoal { spec: Some(spec(eye_x, 1000)), in_flight, ..goal(Division::Tiled) })
}

/// The frames that a node has been given work for and not answered, in order.
fn frames_of(farm: &Farm, node: NodeId) -> Vec<u64> {
    farm.at_work.iter().filter(|sent| sent.node == node).map(|sent| sent.frame.0).collect()
}

#[test]
fn who_is_done_with_one_frame_has_the_next() {
    let mut farm = Farm::with_nodes(repeating(3), &[A, B]);
    assert_eq!(frames_of(&farm, A), [1, 2, 3]);
    farm.answer(A);
    farm.answer(A);
    assert_eq!((frames_of(&farm, A), frames_of(&farm, B)), (vec![3], vec![1, 2, 3]));
    assert!(farm.shown.is_empty());
    farm.answer(B);
    assert_eq!((farm.shown.len(), frames_of(&farm, A)), (1, vec![3, 4]));
}

#[test]
fn a_frame_that_is_whole_early_waits_for_its_turn() {
    let mut farm = Farm::with_nodes(repeating(2), &[A, B]);
    farm.lose(B);
    // Half of the first frame is B's, and now A's: the second is whole before it is.
    farm.pass(1);
    let second: Vec<_> = farm.at_work.iter().filter(|sent| sent.frame.0 == 2).cloned().collect();
    for sent in second {
        farm.at_work.retain(|other| other.task_id != sent.task_id);
        farm.at_work.push_front(sent);
        farm.answer(A);
    }
    assert!(farm.shown.is_empty());
    farm.pass(7);
    farm.answer(A);
    farm.answer(A);
    farm.on(Event::FrameTaken);
    let shown: Vec<_> = farm.shown.iter().map(|stats| (stats.frame, stats.render_ms)).collect();
    assert_eq!(shown, [(1, 8.0), (2, 1.0)], "in order, and waiting is not rendering");
}

#[test]
fn the_death_of_a_node_is_healed_in_every_frame() {
    let mut farm = Farm::with_nodes(repeating(3), &[A, B, C]);
    farm.lose(B);
    for _ in 0..3 {
        while farm.at_work.iter().any(|sent| sent.frame.0 <= 3) {
            let node = farm.at_work[0].node;
            farm.answer(node);
            farm.on(Event::FrameTaken);
        }
    }
    assert!(farm.shown.len() >= 3 && farm.shown[..3].iter().all(|stats| stats.attempts == 2));
}

#[test]
fn a_newer_camera_supersedes_what_nobody_has_begun() {
    let mut farm = Farm::with_nodes(RenderGoal { in_flight: 3, ..goal(Division::Tiled) }, &[A]);
    farm.on(moved_to(1.0, 3));
    farm.on(moved_to(2.0, 3));
    let pictures: Vec<_> = farm.scheduler.frames.iter().map(|frame| frame.spec).collect();
    assert_eq!(pictures, [spec(0.0, 1000), spec(2.0, 1000)], "the first is shown, the second never seen");
    assert_eq!(farm.cancelled, [A]);
    let begun = farm.at_work[1].clone();
    farm.place(&begun, 0, 1);
    farm.on(moved_to(3.0, 3));
    assert_eq!(farm.scheduler.frames.len(), 3, "what is begun is finished");
    (0..3).for_each(|_| farm.answer(A));
    assert_eq!(farm.shown.iter().map(|stats| stats.frame).collect::<Vec<_>>(), [1, 3, 4]);
    assert!(farm.at_work.is_empty());
}

#[test]
fn a_refinement_is_given_up_for_any_other_picture_however_much_of_it_has_come() {
    for division in Division::ALL {
        let mut farm = Farm::with_nodes(goal(division), &[A, B]);
        farm.answer(A);
        farm.answer(B);
        let finer = FrameSpec { samples: SampleRange { first: 0, count: 4 }, ..spec(0.0, 1000) };
        let refinement = RenderGoal { spec: Some(finer), is_refinement: true, ..goal(division) };
        farm.on(Event::GoalChanged(refinement.clone()));
        farm.answer(A);
        farm.on(Event::GoalChanged(refinement));
        assert!(farm.cancelled.is_empty(), "the same picture is no other");
        farm.on(moved_to(1.0, 1));
        assert_eq!(farm.cancelled, [B]);
        farm.answer(A);
        farm.answer(B);
        assert_eq!(farm.shown.iter().map(|stats| stats.frame).collect::<Vec<_>>(), [1, 3]);
    }
}

#[test]
fn a_frame_s_interval_begins_with_it_or_when_the_frame_before_it_is_whole() {
    let mut farm = Farm::with_nodes(repeating(2), &[A]);
    for milliseconds in [10, 7, 8] {
        farm.pass(milliseconds);
        farm.answer(A);
        farm.on(Event::FrameTaken);
    }
    let times: Vec<_> = farm.shown.iter().map(|stats| (stats.render_ms, stats.interval_ms)).collect();
    assert_eq!(times, [(10.0, 10.0), (17.0, 7.0), (15.0, 8.0)]);
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A]);
    farm.pass(5);
    farm.answer(A);
    farm.on(Event::FrameTaken);
    farm.pass(50);
    farm.on(moved_to(2.0, 1));
    farm.pass(3);
    farm.answer(A);
    assert_eq!(farm.shown.last().map(|stats| stats.interval_ms), Some(3.0), "rest is not counted");
}

#[test]
fn a_camera_that_moves_all_the_time_is_seen() {
    for in_flight in 1..=3 {
        let mut farm = Farm::with_nodes(RenderGoal { in_flight, ..goal(Division::Tiled) }, &[A, B]);
        for step in 0..30 {
            // Ten motions for each answer.
            (0..10).for_each(|motion| farm.on(moved_to(f64::from(10 * step + motion), in_flight)));
            farm.answer([A, B][step as usize % 2]);
            farm.on(Event::FrameTaken);
        }
        assert!(farm.shown.len() >= 10, "{} frames", farm.shown.len());
    }
}

#[test]
fn work_for_a_later_frame_is_not_late_before_it_is_begun() {
    let mut farm = Farm::with_nodes(repeating(2), &[A, B]);
    farm.pass(10);
    farm.answer(A);
    farm.answer(A);
    // A is idle; B has both works before it, and is slow with the first.
    farm.pass(20);
    assert_eq!(frames_of(&farm, A), [] as [u64; 0]);
    farm.pass(1);
    assert_eq!(frames_of(&farm, A), [1], "the first is late");
    farm.answer(A);
    assert_eq!(frames_of(&farm, A), [3], "the first is whole; the second was begun when B was told to stop the first");
    farm.answer(A);
    farm.pass(30);
    assert_eq!(frames_of(&farm, A), [] as [u64; 0]);
    farm.pass(1);
    assert_eq!(frames_of(&farm, A), [2]);
}

#[test]
fn a_moving_cameras_frame_is_divided_by_what_the_last_one_cost() {
    let dynamic = |eye_x| {
        let spec = Some(spec(eye_x, 1000));
        Event::GoalChanged(RenderGoal { spec, in_flight: 3, ..goal(Division::Dynamic) })
    };
    let mut farm = Farm::with_nodes(RenderGoal { in_flight: 3, ..goal(Division::Dynamic) }, &[A, B]);
    farm.on(dynamic(1.0));
    assert_eq!(frames_of(&farm, A), [1], "the second waits for the first");
    farm.answer(A);
    farm.answer(B);
    assert_eq!(frames_of(&farm, A), [2]);
    farm.on(Event::GoalChanged(RenderGoal { spec: Some(spec(1.0, 1000)), ..repeating(3) }));
    assert_eq!(frames_of(&farm, A), [2, 3, 4], "without a motion none waits");
}

/// Milliseconds for each frame on nodes that need so long for one on their own, all at the end of a link of so much
/// latency.
fn frame_ms(in_flight: u32, node_ms: &[f64], latency_ms: f64) -> f64 {
    let nodes: Vec<_> = (1..).take(node_ms.len()).map(NodeId).collect();
    let mut farm = Farm::with_nodes(repeating(in_flight), &nodes);
    let mut free_ms = vec![0.0; nodes.len()];
    // What is on its way or being done: when it is done, and what.
    let mut under_way: Vec<(f64, Sent)> = Vec::new();
    let n_frames = 40;
    while farm.shown.len() < n_frames {
        let now_ms = farm.now.as_secs_f64() * 1e3;
        for sent in std::mem::take(&mut farm.at_work) {
            let node = sent.node.0 as usize - 1;
            let begun_ms = f64::max(free_ms[node], now_ms + latency_ms);
            free_ms[node] = begun_ms + node_ms[node] / nodes.len() as f64;
            under_way.push((free_ms[node] + latency_ms, sent));
        }
        let next = (0..under_way.len()).min_by(|&a, &b| under_way[a].0.total_cmp(&under_way[b].0)).unwrap();
        let (done_ms, sent) = under_way.swap_remove(next);
        farm.now = farm.now.max(Duration::from_secs_f64(done_ms / 1e3));
        let node = sent.node;
        farm.at_work.push_front(sent);
        farm.answer(node);
        farm.on(Event::FrameTaken);
    }
    farm.now.as_secs_f64() * 1e3 / n_frames as f64
}

#[test]
fn latency_costs_no_frame_rate_once_frames_overlap() {
    // Ten milliseconds of work for each node, and five on the way there and back.
    let frame_ms = |in_flight| frame_ms(in_flight, &[40.0; 4], 5.0);
    assert!(frame_ms(1) > 19.9, "each frame waits for the link");
    assert!(frame_ms(2) < 10.6 && frame_ms(3) < 10.6, "{:?}", [frame_ms(2), frame_ms(3)]);
}
