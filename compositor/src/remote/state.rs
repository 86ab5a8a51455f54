//! The wall's state as remotes see it: plain values, without anything that changes while the wall rests.

use serde::Serialize;

/// The state of a wall.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct WallState {
    /// Shown to visitors.
    pub show: Show,
    /// Controls for operators.
    pub controls: Controls,
    /// Figures for operators.
    pub farm: FarmState,
}

/// The show on the wall.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Show {
    /// The model's name; empty before the first.
    pub model: String,
    /// Its triangles.
    pub n_triangles: usize,
    /// The model that is being read, and the progress from 0 to 1.
    pub loading: Option<(String, f32)>,
    /// The canvas's width over its height.
    pub aspect: f64,
    /// The numbers of the model's views.
    pub views: Vec<u8>,
    /// The model's annotations, in the order of their file.
    pub annotations: Vec<AnnotationLabel>,
    /// The annotation whose text the wall shows.
    pub annotation: Option<ShownAnnotation>,
    /// Whether the model has a camera path.
    pub has_path: bool,
    /// Whether the camera follows it.
    pub is_playing: bool,
    /// The scenes of the wall's show; none without a show.
    pub n_scenes: Option<usize>,
    /// The number of the scene on the wall, from 1.
    pub scene: Option<usize>,
    /// Its caption.
    pub caption: Option<String>,
    /// Its time; none if it has no end of its own.
    pub scene_seconds: Option<f64>,
    /// Whether time goes on in the show.
    pub is_show_playing: bool,
    /// The SHA-256 of the certificate by which the remote is encrypted, if a wall made it: nobody else vouches for it.
    pub own_certificate: Option<String>,
    /// The effect of the last command on the wall, shown for a moment.
    pub note: Option<String>,
}

/// An annotation in a list.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct AnnotationLabel {
    /// Its number while the model is on the wall.
    pub number: u32,
    /// The text beside its point.
    pub label: String,
}

/// An annotation that the wall shows.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ShownAnnotation {
    /// Its number.
    pub number: u32,
    /// The text beside its point.
    pub label: String,
    /// Its long text; may be empty.
    pub text: String,
}

/// The choices of an operator.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Controls {
    /// The models in the folder of the present one; empty until they are listed.
    pub models: Vec<String>,
    /// The key light: degrees to the right of the eye, and above it.
    pub light_deg: [i16; 2],
    /// The diameter of the sun that lights paths.
    pub sun_deg: f64,
    /// Stops by which path-traced pictures are brighter.
    pub exposure_stops: f64,
    /// Whether path-traced pictures show the shadow on a ground.
    pub has_ground: bool,
    /// The background, bottom and top: RRGGBB, or two with a comma.
    pub background: String,
    /// The side from which the model is cut, and the thousandths that are cut away.
    pub cut: Option<(String, u16)>,
    /// The division of frames.
    pub division: String,
    /// The rays that light the picture; none if the wall chooses.
    pub rays: Option<String>,
    /// The shading of the samples.
    pub shading: String,
    /// Whether visitors at the wall can only steer.
    pub is_locked: bool,
}

/// The farm, and the wall's own times.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct FarmState {
    /// Frames shown since the wall started.
    pub frames_shown: u64,
    /// Frames a second; none at rest.
    pub frames_per_second: Option<f64>,
    /// The resolution of the newest frame.
    pub resolution: String,
    /// Samples a pixel of the newest frame.
    pub samples: u32,
    /// From the first request to the last placed sample.
    pub render_ms: f64,
    /// Placing samples.
    pub place_ms: f64,
    /// Uploading samples.
    pub upload_ms: f64,
    /// Drawing the wall.
    pub draw_ms: f64,
    /// From the camera's motion to the picture that shows it.
    pub latency_ms: f64,
    /// The busiest render server's busy time over the mean.
    pub imbalance: f64,
    /// Render servers lost since the wall started.
    pub nodes_lost: u32,
    /// Frames completed although one was lost.
    pub frames_healed: u32,
    /// Every connected render server.
    pub nodes: Vec<Node>,
    /// Warnings, each with its cure.
    pub alerts: Vec<String>,
}

/// A render server.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Node {
    /// The name that it gave.
    pub name: String,
    /// Where it connected from.
    pub address: String,
    /// Its tracing threads.
    pub threads: u32,
    /// ready, loading, missing, silent or joining.
    pub state: &'static str,
    /// The progress of loading, from 0 to 1, or the reason why the model is missing.
    pub detail: String,
    /// Its busy time in the newest frame.
    pub busy_ms: f64,
    /// Its part of the newest frame, from 0 to 1.
    pub share: f64,
    /// How often one of its name was lost.
    pub losses: u32,
    /// The last round trip of a ping, when something else changed.
    pub round_trip_ms: Option<f64>,
}

impl WallState {
    /// Whether a change is worth telling: a round trip alone is not.
    pub(crate) fn differs(&self, other: &Self) -> bool {
        let plain = |state: &Self| {
            let mut state = state.clone();
            state.farm.nodes.iter_mut().for_each(|node| node.round_trip_ms = None);
            state
        };
        plain(self) != plain(other)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_round_trip_is_no_news() {
        let with =
            |node| WallState { farm: FarmState { nodes: vec![node], ..Default::default() }, ..Default::default() };
        let node = Node { state: "ready", ..Node::default() };
        let pinged = Node { round_trip_ms: Some(0.3), ..node.clone() };
        assert!(!with(node.clone()).differs(&with(pinged)));
        assert!(with(node).differs(&with(Node { state: "silent", ..Node::default() })));
    }
}
