//! Questions on their way to render servers: one of a kind at a time, so that a camera in constant motion gets answers, however
//! slow the link. Pure.

use shared::scene::SceneId;

use super::{Look, Stretch, stats::NodeId};

/// A question about a model.
pub(super) trait Question: Clone {
    /// Its number, which the answer repeats.
    fn number(&self) -> u32;

    /// The model; `None` asks nothing.
    fn scene(&self) -> Option<SceneId>;
}

impl Question for Look {
    fn number(&self) -> u32 {
        self.number
    }

    fn scene(&self) -> Option<SceneId> {
        self.view.map(|(scene, _)| scene)
    }
}

impl Question for Stretch {
    fn number(&self) -> u32 {
        self.number
    }

    fn scene(&self) -> Option<SceneId> {
        self.scene
    }
}

/// The question that waits, and the one that a render server answers.
#[derive(Debug)]
pub(super) struct Questions<Q> {
    waiting: Option<Q>,
    asked: Option<(NodeId, Q)>,
}

impl<Q> Default for Questions<Q> {
    fn default() -> Self {
        Self { waiting: None, asked: None }
    }
}

impl<Q: Question> Questions<Q> {
    /// Puts a question in place of the one that waits.
    pub(super) fn ask(&mut self, question: Q) {
        self.waiting = question.scene().is_some().then_some(question);
    }

    /// Takes the question that waits, to send it to a node that has this scene; `None` while another is being answered.
    pub(super) fn begin(&mut self, node: NodeId, scene: SceneId) -> Option<Q> {
        let is_of_scene = |question: &Q| question.scene() == Some(scene);
        // Nobody answers a question about another scene.
        self.asked.take_if(|(_, question)| !is_of_scene(question));
        if self.asked.is_some() {
            return None;
        }
        let question = self.waiting.take_if(|question| is_of_scene(question))?;
        self.asked = Some((node, question.clone()));
        Some(question)
    }

    /// A node answers. Returns whether it was asked that, and had not answered yet.
    pub(super) fn answer(&mut self, node: NodeId, number: u32) -> bool {
        self.asked.take_if(|(asked, question)| (*asked, question.number()) == (node, number)).is_some()
    }

    /// A node will not answer: its question waits again, unless there is a later one.
    pub(super) fn lose(&mut self, node: NodeId) {
        if let Some((_, question)) = self.asked.take_if(|(asked, _)| *asked == node) {
            self.waiting.get_or_insert(question);
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use shared::{camera::Camera, scene::Treatment};

    use super::*;

    const STATUE: SceneId = scene(8);

    const fn scene(triangles: u32) -> SceneId {
        SceneId::Statue { triangles, treatment: Treatment::FLAT }
    }

    fn look(number: u32, scene: SceneId) -> Look {
        let camera = Camera::new(DVec3::Z, DVec3::ZERO, DVec3::X, DVec3::Y).unwrap();
        Look { number, view: Some((scene, camera)), ..Look::default() }
    }

    fn begin(looks: &mut Questions<Look>, node: u32) -> Option<u32> {
        looks.begin(NodeId(node), STATUE).map(|look| look.number)
    }

    #[test]
    fn one_is_answered_while_the_last_of_the_others_waits() {
        let mut looks = Questions::default();
        assert_eq!(begin(&mut looks, 1), None);
        (1..=3).for_each(|number| looks.ask(look(number, STATUE)));
        assert_eq!(begin(&mut looks, 1), Some(3));
        (4..=5).for_each(|number| looks.ask(look(number, STATUE)));
        assert_eq!(begin(&mut looks, 2), None);
        assert!(!looks.answer(NodeId(2), 3) && !looks.answer(NodeId(1), 5), "nobody asked that");
        assert!(looks.answer(NodeId(1), 3) && !looks.answer(NodeId(1), 3));
        assert_eq!(begin(&mut looks, 2), Some(5));
    }

    #[test]
    fn another_node_answers_in_place_of_a_lost_one() {
        let mut looks = Questions::default();
        looks.ask(look(1, STATUE));
        assert_eq!(begin(&mut looks, 1), Some(1));
        looks.lose(NodeId(2));
        assert_eq!(begin(&mut looks, 2), None);
        looks.lose(NodeId(1));
        assert_eq!(begin(&mut looks, 2), Some(1));
        looks.ask(look(2, STATUE));
        looks.lose(NodeId(2));
        assert_eq!(begin(&mut looks, 3), Some(2), "the later one");
    }

    #[test]
    fn a_look_waits_for_its_scene_and_is_dropped_with_it() {
        let mut looks = Questions::default();
        looks.ask(look(1, scene(9)));
        assert_eq!(begin(&mut looks, 1), None);
        looks.ask(look(2, STATUE));
        assert_eq!(begin(&mut looks, 1), Some(2));
        looks.ask(look(3, scene(9)));
        assert!(looks.begin(NodeId(1), scene(9)).is_some());
        looks.ask(Look::default());
        looks.lose(NodeId(1));
        assert!(looks.begin(NodeId(1), scene(9)).is_some());
    }
}
