//! Render servers that are connected but silent.

use strum::VariantArray;

use super::*;

fn silent(node: NodeId, is_silent: bool) -> Event {
    Event::Silent { node, is_silent }
}

#[test]
fn the_share_of_a_silent_node_goes_to_the_others_and_it_is_told_to_stop() {
    for &division in Division::VARIANTS {
        let mut farm = Farm::with_nodes(RenderGoal { repeat: true, ..goal(division) }, &[A, B, C]);
        farm.answer(A);
        farm.on(silent(B, true));
        assert_eq!(farm.at_work.len(), 4, "B's own share, C's, and B's again in two parts");
        farm.answer(C);
        farm.answer(A);
        farm.answer(C);
        assert_eq!(farm.shown[0].attempts, 2);
        assert_eq!(farm.cancelled, [B]);
        assert!(farm.at_work.iter().all(|sent| sent.node != B), "it gets no part of the next frame");
        farm.on(Event::FrameTaken);
        farm.on(silent(B, false));
        farm.answer(A);
        farm.answer(C);
        assert!(farm.at_work.iter().any(|sent| sent.node == B), "a node that is heard again does");
    }
}

#[test]
fn a_late_answer_of_a_silent_node_counts() {
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A]);
    farm.on(silent(A, true));
    farm.pass(1000);
    assert!(farm.shown.is_empty() && farm.at_work.len() == 1, "there is no other");
    farm.on(silent(A, false));
    farm.answer(A);
    assert_eq!((farm.shown.len(), farm.shown[0].attempts), (1, 1));
}

#[test]
fn a_silent_node_may_be_lost_after_all() {
    let mut farm = Farm::with_nodes(goal(Division::Tiled), &[A, B]);
    farm.on(silent(A, true));
    farm.lose(A);
    farm.answer(B);
    farm.answer(B);
    assert_eq!((farm.shown.len(), farm.shown[0].attempts), (1, 2));
}

#[test]
fn tasks_do_not_multiply_as_silences_repeat() {
    // On a full link, one node after the other is silent for a moment, and no task is finished meanwhile.
    for &division in Division::VARIANTS {
        let nodes: Vec<_> = (1..=12).map(NodeId).collect();
        let native = FrameSpec { size: FrameSize::new(4096, 2304).unwrap(), ..spec(0.0, 1000) };
        let mut farm = Farm::with_nodes(RenderGoal { spec: Some(native), ..goal(division) }, &nodes);
        for n_silences in 1..=60 {
            let node = nodes[n_silences % nodes.len()];
            let n_before = farm.at_work.len();
            farm.on(silent(node, true));
            let n_lost = farm.at_work.iter().take(n_before).filter(|sent| sent.node == node).count();
            assert!(farm.at_work.len() - n_before <= n_lost + nodes.len(), "{n_lost} tasks were lost");
            farm.on(silent(node, false));
        }
        let of_one = nodes.iter().map(|&node| farm.at_work.iter().filter(|sent| sent.node == node).count()).max();
        assert!(of_one.unwrap() <= 128, "more tasks than a render server may be given: {of_one:?}");
    }
}
