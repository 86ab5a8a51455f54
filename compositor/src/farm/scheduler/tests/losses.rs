//! Most of a large farm dies, stalls, lies or flaps, at random and all at once.

use strum::VariantArray;

use super::*;

/// A node of the simulated farm.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Behavior {
    /// Answers its oldest task in every round.
    Honest,
    /// Sends heartbeats, and no answer.
    Mute,
    /// Reports its tasks as done without all their samples.
    Liar,
    /// Says in turn that it has the scene and that it has not.
    Flapping,
    /// Is silent in every other round, and answers in the others.
    Stuttering,
}

/// A farm whose nodes behave as they are told to, in rounds of 10 ms.
struct Crowd {
    farm: Farm,
    nodes: BTreeMap<NodeId, Behavior>,
    round: u64,
    /// Units that nodes lost, kept to themselves or lied about.
    n_spoilt: u64,
    /// The most tasks that one node held.
    most_held: usize,
}

impl Crowd {
    fn new(goal: RenderGoal, nodes: impl IntoIterator<Item = (u32, Behavior)>) -> Self {
        let nodes: BTreeMap<_, _> = nodes.into_iter().map(|(node, behavior)| (NodeId(node), behavior)).collect();
        let ids: Vec<_> = nodes.keys().copied().collect();
        Self { farm: Farm::with_nodes(goal, &ids), nodes, round: 0, n_spoilt: 0, most_held: 0 }
    }

    fn n_units(sent: &Sent) -> u64 {
        sent.task.share(sent.size).unwrap().count().into()
    }

    fn count_held(&mut self) {
        let mut held: BTreeMap<NodeId, usize> = BTreeMap::new();
        for sent in &self.farm.at_work {
            *held.entry(sent.node).or_default() += 1;
        }
        self.most_held = self.most_held.max(held.into_values().max().unwrap_or(0));
    }

    fn spoil(&mut self, node: NodeId) {
        let spoilt = self.farm.at_work.iter().filter(|sent| sent.node == node).map(Self::n_units);
        self.n_spoilt += spoilt.sum::<u64>();
    }

    fn lose(&mut self, node: NodeId) {
        if self.nodes.remove(&node).is_some() {
            self.spoil(node);
            self.farm.lose(node);
            self.count_held();
        }
    }

    /// Every node does what it does.
    fn pass_round(&mut self) {
        self.round += 1;
        let nodes: Vec<_> = self.nodes.iter().map(|(&node, &behavior)| (node, behavior)).collect();
        for (node, behavior) in nodes {
            let is_even = self.round.is_multiple_of(2);
            let has_task = self.farm.at_work.iter().any(|sent| sent.node == node);
            match behavior {
                Behavior::Mute => {}
                Behavior::Liar => {
                    let first = self.farm.at_work.iter().position(|sent| sent.node == node);
                    if let Some(sent) = first.and_then(|first| self.farm.at_work.remove(first)) {
                        self.n_spoilt += Self::n_units(&sent);
                        let Sent { frame, task_id, .. } = sent;
                        let (timings, costs) = Default::default();
                        self.farm.on(Event::TaskDone { node, frame, task_id, timings, costs });
                    }
                }
                Behavior::Flapping => {
                    self.spoil(node);
                    self.farm.on(Event::SceneReady { node, ready: is_even });
                }
                Behavior::Stuttering => {
                    self.farm.on(Event::Silent { node, is_silent: is_even });
                    if is_even {
                        self.spoil(node);
                    } else if has_task {
                        self.farm.answer(node);
                    }
                }
                Behavior::Honest => {
                    if has_task {
                        self.farm.answer(node);
                    }
                }
            }
        }
        self.count_held();
        self.farm.on(Event::FrameTaken);
        self.farm.pass(10);
        self.count_held();
    }

    /// Rounds until another frame is shown.
    fn rounds_to_frame(&mut self, most: u64) -> u64 {
        let (n_shown, first) = (self.farm.shown.len(), self.round);
        while self.farm.shown.len() == n_shown {
            self.pass_round();
            let unfinished = || self.farm.scheduler.frames.front().map(FrameInFlight::n_unfinished);
            assert!(self.round - first < most, "no frame in {most} rounds: {:?}", unfinished());
        }
        self.round - first
    }
}

fn repeating(division: Division, in_flight: u32) -> RenderGoal {
    let native = FrameSpec { size: FrameSize::new(1024, 512).unwrap(), ..spec(0.0, 1000) };
    RenderGoal { spec: Some(native), repeat: true, in_flight, ..goal(division) }
}

fn honest(n: u32) -> impl Iterator<Item = (u32, Behavior)> {
    (1..=n).map(|node| (node, Behavior::Honest))
}

#[test]
fn the_survivors_of_512_take_the_lost_tasks_as_they_finish() {
    for (&division, n_lost) in Division::VARIANTS.iter().flat_map(|division| [1, 256, 511].map(|n| (division, n))) {
        for n_answers in [0, 300] {
            let mut crowd = Crowd::new(repeating(division, 2), honest(512));
            (1..=n_answers).for_each(|node| crowd.farm.answer(NodeId(node)));
            // The first to answer die first, so that early and late tasks are lost.
            (1..=n_lost).for_each(|node| crowd.lose(NodeId(node)));
            let n_left = 512 - u64::from(n_lost);
            // Two frames are in flight, each with a task for each node. Some were in parts when their nodes died: a round's
            // task may be small.
            let most = 4 * 512_u64.div_ceil(n_left) + 4;
            let rounds = crowd.rounds_to_frame(2 * most);
            assert!(rounds <= most, "{division:?}: {rounds} rounds for {n_left} left");
            assert!(crowd.most_held <= 2 * MOST_HELD as usize, "one node holds {} tasks", crowd.most_held);
            assert!(crowd.rounds_to_frame(2 * most) <= most, "the next frame takes no longer");
        }
    }
}

#[test]
fn newcomers_help_nodes_that_are_stuck() {
    for (&division, in_flight) in Division::VARIANTS.iter().flat_map(|division| [1, 2, 3].map(|n| (division, n))) {
        let mut crowd = Crowd::new(repeating(division, in_flight), [(1, Behavior::Mute)]);
        (0..10).for_each(|_| crowd.pass_round());
        for node in 2..=4 {
            crowd.nodes.insert(NodeId(node), Behavior::Honest);
            crowd.farm.join(NodeId(node));
        }
        for frame in 0..3 {
            let rounds = crowd.rounds_to_frame(2000);
            assert!(rounds <= 40, "{division:?}, {in_flight} in flight: frame {frame} takes {rounds} rounds");
        }
    }
}

#[test]
fn newcomers_share_the_work_of_one_slow_node() {
    let mut crowd = Crowd::new(repeating(Division::Tiled, 1), [(1, Behavior::Mute)]);
    for node in 2..=4 {
        (0..60).for_each(|_| crowd.pass_round());
        crowd.nodes.insert(NodeId(node), Behavior::Mute);
        crowd.farm.join(NodeId(node));
    }
    crowd.farm.pass(1);
    let parts: Vec<_> =
        (2..=4).map(|node| crowd.farm.at_work.iter().filter(|sent| sent.node == NodeId(node)).count()).collect();
    assert_eq!(parts, [1, 1, 1], "each has a part");
    assert!(crowd.farm.n_units_sent <= 2 * 8192, "and none has the work of another: {}", crowd.farm.n_units_sent);
}

#[test]
fn what_a_node_without_the_scene_held_leaves_its_desk() {
    for &division in Division::VARIANTS {
        let mut farm = Farm::with_nodes(RenderGoal { repeat: true, ..goal(division) }, &[A, B]);
        farm.on(Event::SceneReady { node: A, ready: false });
        assert_eq!(farm.cancelled, [A], "it is told");
        assert!(farm.at_work.iter().all(|sent| sent.node == B));
        farm.on(Event::SceneReady { node: A, ready: false });
        assert_eq!(farm.cancelled, [A], "once");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    /// However the nodes behave, as long as some are honest every frame is whole in bounded time, no node holds more than a
    /// few tasks, and no more than three times the needed work is handed out.
    #[test]
    fn any_of_512_may_die_stall_lie_or_flap(
        n_nodes in 2..=512_u32, behaviors in proptest::collection::vec(0..10_u8, 512), n_honest in 1..4_u32,
        deaths in proptest::collection::vec((1..=512_u32, 0..4_u64), 0..512), division in 0..3_usize, in_flight in 1..4_u32,
    ) {
        let behavior = |node: u32| match behaviors[node as usize - 1] {
            _ if node <= n_honest => Behavior::Honest,
            0 => Behavior::Mute,
            1 => Behavior::Liar,
            2 => Behavior::Flapping,
            3 => Behavior::Stuttering,
            _ => Behavior::Honest,
        };
        let nodes = (1..=n_nodes.max(n_honest)).map(|node| (node, behavior(node)));
        let mut crowd = Crowd::new(repeating(Division::VARIANTS[division], in_flight), nodes);
        for round in 0..4 {
            for &(node, _) in deaths.iter().filter(|&&(node, at)| at == round && node > n_honest) {
                crowd.lose(NodeId(node));
            }
            crowd.pass_round();
        }
        let n_shown = crowd.farm.shown.len() as u64;
        (0..3).for_each(|_| { crowd.rounds_to_frame(4000); });
        let n_frames = crowd.farm.shown.len() as u64 + u64::from(in_flight);
        let n_units = u64::from(Division::VARIANTS[division].units(FrameSize::new(1024, 512).unwrap()).count());
        prop_assert!(crowd.most_held <= (MOST_HELD * in_flight) as usize, "{} tasks", crowd.most_held);
        let most = 3 * (n_frames * n_units + crowd.n_spoilt);
        prop_assert!(crowd.farm.n_units_sent <= most, "{} units, {most} at most; {n_shown} frames", crowd.farm.n_units_sent);
        prop_assert!(crowd.farm.scheduler.frames.len() <= in_flight as usize);
    }
}
