//! Edge cases: no nodes, hundreds, a very slow one, task ids that wrap.

use strum::VariantArray;

use super::*;

fn nodes(n: u32) -> Vec<NodeId> {
    (1..=n).map(NodeId).collect()
}

/// Finishes tasks in the order of assignment until `n_frames` more are shown.
fn show(farm: &mut Farm, n_frames: usize) {
    let before = farm.shown.len();
    while farm.shown.len() < before + n_frames {
        let node = farm.at_work.front().expect("a node has a task").node;
        farm.answer(node);
        farm.on(Event::FrameTaken);
        farm.pass(1);
    }
}

#[test]
fn a_farm_of_256_renders_complete_frames_and_so_does_its_last_node() {
    for &division in Division::VARIANTS {
        // More nodes than tiles: some have nothing to do.
        let all = nodes(256);
        let mut farm = Farm::with_nodes(RenderGoal { repeat: true, ..goal(division) }, &all);
        show(&mut farm, 3);
        all[..255].iter().for_each(|&node| farm.lose(node));
        assert!(farm.at_work.iter().all(|sent| sent.node == all[255]));
        show(&mut farm, 3);
    }
}

#[test]
fn an_empty_farm_starts_when_a_node_joins() {
    for &division in Division::VARIANTS {
        let mut farm = Farm::new(RenderGoal { repeat: true, ..goal(division) });
        (0..1000).for_each(|_| farm.pass(1000));
        assert!(farm.at_work.is_empty() && farm.shown.is_empty());
        farm.join(A);
        show(&mut farm, 2);
        farm.lose(A);
        farm.pass(1_000_000);
        farm.join(B);
        show(&mut farm, 2);
    }
}

#[test]
fn one_node_a_thousand_times_slower_holds_nothing_up() {
    for &division in Division::VARIANTS {
        let mut farm = Farm::with_nodes(RenderGoal { repeat: true, ..goal(division) }, &[A, B, C]);
        let mut since = farm.now;
        while farm.shown.len() < 5 {
            // The others answer every 10 ms, C every 10 s.
            farm.pass(10);
            for node in [A, B] {
                if farm.at_work.iter().any(|sent| sent.node == node) {
                    farm.answer(node);
                }
            }
            if (farm.now - since).as_secs() >= 10 {
                since = farm.now;
                farm.answer(C);
            }
            farm.on(Event::FrameTaken);
            assert!(farm.now.as_secs() < 2, "{division:?}: {} frames in 2 s", farm.shown.len());
        }
    }
}

#[test]
fn task_ids_wrap() {
    for &division in Division::VARIANTS {
        let mut farm = Farm::new(RenderGoal { repeat: true, in_flight: 3, ..goal(division) });
        farm.scheduler.last_task = TaskId(u32::MAX - 2);
        [A, B].into_iter().for_each(|node| farm.join(node));
        farm.lose(A);
        show(&mut farm, 8);
        assert!(farm.scheduler.last_task < TaskId(100), "{division:?}: {:?}", farm.scheduler.last_task);
    }
}
