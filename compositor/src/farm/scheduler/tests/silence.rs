//! Render servers that nothing comes from, though their connections are there.

use super::*;

fn silent(node: NodeId, is_silent: bool) -> Event {
    Event::Silent { node, is_silent }
}

#[test]
fn the_share_of_a_silent_node_goes_to_the_others_and_it_is_told_to_stop() {
    for division in Division::ALL {
        let mut farm = Farm::with_nodes(Wanted { repeat: true, ..wanted(division) }, &[A, B, C]);
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
        assert!(farm.at_work.iter().any(|sent| sent.node == B), "who is heard again does");
    }
}

#[test]
fn what_a_silent_node_says_at_last_counts() {
    let mut farm = Farm::with_nodes(wanted(Division::Tiled), &[A]);
    farm.on(silent(A, true));
    farm.pass(1000);
    assert!(farm.shown.is_empty() && farm.at_work.len() == 1, "there is nobody else");
    farm.on(silent(A, false));
    farm.answer(A);
    assert_eq!((farm.shown.len(), farm.shown[0].attempts), (1, 1));
}

#[test]
fn a_silent_node_may_be_lost_after_all() {
    let mut farm = Farm::with_nodes(wanted(Division::Tiled), &[A, B]);
    farm.on(silent(A, true));
    farm.lose(A);
    farm.answer(B);
    farm.answer(B);
    assert_eq!((farm.shown.len(), farm.shown[0].attempts), (1, 2));
}
