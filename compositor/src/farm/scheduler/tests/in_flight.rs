//! Several frames in flight, on simulated nodes and links.

use strum::VariantArray;

use super::*;

fn repeating(in_flight: u32) -> RenderGoal {
    RenderGoal { repeat: true, in_flight, ..goal(Division::Tiled) }
}

fn moved_to(eye_x: f64, in_flight: u32) -> Event {
    Event::GoalChanged(RenderGoal { spec: Some(spec(eye_x, 1000)), in_flight, ..goal(Division::Tiled) })
}

/// The frames that a node has unfinished tasks of, in order.
fn frames_of(farm: &Farm, node: NodeId) -> Vec<u64> {
    farm.at_work.iter().filter(|sent| sent.node == node).map(|sent| sent.frame.0).collect()
}

#[test]
fn a_node_that_is_done_with_one_frame_has_the_next() {
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
fn a_frame_that_is_complete_early_waits_for_its_turn() {
    let mut farm = Farm::with_nodes(repeating(2), &[A, B]);
    farm.lose(B);
    // A also has B's half of both frames, and finishes the second frame first.
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
fn a_frame_that_takes_long_tells_how_much_of_it_has_arrived() {
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A, B]);
    let percent = |farm: &Farm| farm.scheduler.percent(farm.now);
    farm.answer(A);
    assert_eq!(percent(&farm), None, "it may be complete at any moment");
    farm.pass(600);
    assert!(matches!(percent(&farm), Some(45..=55)), "{:?}", percent(&farm));
    // A renders B's half too by now.
    farm.answer(B);
    farm.answer(A);
    assert_eq!(percent(&farm), None, "nothing is in flight");
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
fn a_newer_camera_supersedes_frames_that_no_node_has_begun() {
    let mut farm = Farm::with_nodes(RenderGoal { in_flight: 3, ..goal(Division::Tiled) }, &[A]);
    farm.on(moved_to(1.0, 3));
    farm.on(moved_to(2.0, 3));
    let specs: Vec<_> = farm.scheduler.frames.iter().map(|frame| frame.spec).collect();
    assert_eq!(specs, [spec(0.0, 1000), spec(2.0, 1000)], "the first is shown, the second never seen");
    assert_eq!(farm.cancelled, [A]);
    let begun = farm.at_work[1].clone();
    farm.place(&begun, 0, 1);
    farm.on(moved_to(3.0, 3));
    assert_eq!(farm.scheduler.frames.len(), 3, "a frame that was begun is finished");
    (0..3).for_each(|_| farm.answer(A));
    assert_eq!(farm.shown.iter().map(|stats| stats.frame).collect::<Vec<_>>(), [1, 3, 4]);
    assert!(farm.at_work.is_empty());
}

#[test]
fn a_refinement_is_cancelled_for_any_other_frame_even_if_samples_have_arrived() {
    for &division in Division::VARIANTS {
        let mut farm = Farm::with_nodes(goal(division), &[A, B]);
        farm.answer(A);
        farm.answer(B);
        let finer = FrameSpec { samples: SampleRange::all(0, 4), ..spec(0.0, 1000) };
        let refinement = RenderGoal { spec: Some(finer), is_refinement: true, ..goal(division) };
        farm.on(Event::GoalChanged(refinement.clone()));
        farm.answer(A);
        farm.on(Event::GoalChanged(refinement));
        assert!(farm.cancelled.is_empty(), "an equal spec changes nothing");
        farm.on(moved_to(1.0, 1));
        assert_eq!(farm.cancelled, [B]);
        farm.answer(A);
        farm.answer(B);
        assert_eq!(farm.shown.iter().map(|stats| stats.frame).collect::<Vec<_>>(), [1, 3]);
    }
}

#[test]
fn a_frame_s_interval_begins_with_it_or_when_the_frame_before_it_is_complete() {
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
    assert_eq!(farm.shown.last().map(|stats| stats.interval_ms), Some(3.0), "rest does not count");
}

#[test]
fn a_camera_that_moves_all_the_time_is_seen() {
    for in_flight in 1..=3 {
        let mut farm = Farm::with_nodes(RenderGoal { in_flight, ..goal(Division::Tiled) }, &[A, B]);
        for step in 0..30 {
            // Ten motions for each finished task.
            (0..10).for_each(|motion| farm.on(moved_to(f64::from(10 * step + motion), in_flight)));
            farm.answer([A, B][step as usize % 2]);
            farm.on(Event::FrameTaken);
        }
        assert!(farm.shown.len() >= 10, "{} frames", farm.shown.len());
    }
}

#[test]
fn a_task_of_a_later_frame_is_not_late_before_it_is_begun() {
    let mut farm = Farm::with_nodes(repeating(2), &[A, B]);
    farm.pass(10);
    farm.answer(A);
    farm.answer(A);
    // A is idle; B has both tasks, and is slow with the first.
    farm.pass(20);
    assert_eq!(frames_of(&farm, A), [] as [u64; 0]);
    farm.pass(1);
    assert_eq!(frames_of(&farm, A), [1], "the first is late");
    farm.answer(A);
    assert_eq!(frames_of(&farm, A), [3], "the first is complete; B began the second when its first was cancelled");
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

/// Mean milliseconds a frame, on nodes that would each need `node_ms` for a whole frame alone. `latency_ms` is one way.
fn frame_ms(in_flight: u32, node_ms: &[f64], latency_ms: f64) -> f64 {
    let nodes: Vec<_> = (1..).take(node_ms.len()).map(NodeId).collect();
    let mut farm = Farm::with_nodes(repeating(in_flight), &nodes);
    let mut free_ms = vec![0.0; nodes.len()];
    // The unfinished tasks, and when their last samples will arrive.
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
    // Each node renders for 10 ms; the link adds 5 ms each way.
    let frame_ms = |in_flight| frame_ms(in_flight, &[40.0; 4], 5.0);
    assert!(frame_ms(1) > 19.9, "each frame waits for the link");
    assert!(frame_ms(2) < 10.6 && frame_ms(3) < 10.6, "{:?}", [frame_ms(2), frame_ms(3)]);
}
