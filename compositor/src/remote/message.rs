//! Messages of remotes: JSON from strangers and friends, checked before anything acts on them.

use serde::{Deserialize, Deserializer, de::Error};
use shared::{
    appearance::{Background, Clip, ClipSide},
    division::Division,
    marks::Annotation,
    printable::printable_line,
    protocol::{LightingMode, ShadingMode},
};

use crate::control::show::MOST_CAPTION;

/// Longest message in bytes.
pub const LONGEST_MESSAGE: usize = 4096;
/// Longest name of a model's file in bytes.
const LONGEST_NAME: usize = 255;
/// The farthest drag in widths and heights of the canvas.
const FARTHEST_DRAG: f64 = 10.0;
/// The largest change of distance by one message, and one over the smallest.
const LARGEST_FACTOR: f64 = 20.0;

/// A remote's wish.
///
/// Invariant: all numbers are within the limits that [`decode`] checks.
#[derive(Clone, Debug, PartialEq, Deserialize, strum::VariantNames, strum::IntoStaticStr)]
#[serde(tag = "do", rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum Action {
    /// Orbits as a drag does, by fractions of the canvas's width and height; up and right are positive.
    Orbit {
        /// To the right.
        x: f64,
        /// Upwards.
        y: f64,
    },
    /// Moves the model with the hand, by the same fractions.
    Pan {
        /// To the right.
        x: f64,
        /// Upwards.
        y: f64,
    },
    /// Moves to `factor` times the distance; what is at a point of the canvas, (0, 0) lower left, stays there.
    Dolly {
        /// Below 1 is nearer.
        factor: f64,
        /// The point's fraction of the width.
        #[serde(default = "middle")]
        x: f64,
        /// The point's fraction of the height.
        #[serde(default = "middle")]
        y: f64,
    },
    /// Turns the picture to the left.
    Roll {
        /// The angle.
        degrees: f64,
    },
    /// Goes to what is at a point of the canvas, (0, 0) lower left.
    GoTo {
        /// Fraction of the width.
        x: f64,
        /// Fraction of the height.
        y: f64,
    },
    /// Shows the whole model.
    ViewAll,
    /// Goes to a kept view.
    GoToView {
        /// From 1 to 9.
        number: u8,
    },
    /// Goes to an annotation, and shows its text on the wall.
    GoToAnnotation {
        /// From the state.
        number: u32,
    },
    /// Plays the recorded camera path, or stops.
    Play,
    /// Gives up one's turn, or one's place among those who wait.
    Leave,
    /// Asks for live pictures, or for none.
    Watch {
        /// Whether to send them.
        pictures: bool,
    },
    /// Keeps this view beside the model.
    KeepView {
        /// From 1 to 9.
        number: u8,
    },
    /// Goes on with the show.
    PlayShow,
    /// Holds the show.
    PauseShow,
    /// Goes on to the next scene of the show.
    NextScene,
    /// Goes back to the scene before.
    PreviousScene,
    /// Keeps this view as the last scene of the show.
    KeepScene {
        /// Its caption.
        #[serde(default)]
        caption: String,
        /// Its time; 15 s unless given.
        seconds: Option<f64>,
    },
    /// Gives a scene of the show another caption, another time, or both.
    EditScene {
        /// Its number, from 1.
        scene: usize,
        /// Empty for none.
        caption: Option<String>,
        /// Its time.
        seconds: Option<f64>,
    },
    /// Puts a scene of the show in the place of another.
    MoveScene {
        /// Its number, from 1.
        scene: usize,
        /// That of the other; a number beyond the last is the last.
        to: usize,
    },
    /// Deletes a scene of the show.
    DeleteScene {
        /// Its number, from 1.
        scene: usize,
    },
    /// Annotates what is at a point of the canvas, (0, 0) lower left.
    Annotate {
        /// The point's fraction of the width.
        #[serde(default = "middle")]
        x: f64,
        /// The point's fraction of the height.
        #[serde(default = "middle")]
        y: f64,
        /// The text beside the point.
        label: String,
        /// The text that is shown to those who go there.
        #[serde(default)]
        text: String,
    },
    /// Deletes an annotation.
    DeleteAnnotation {
        /// From the state.
        number: u32,
    },
    /// Lists the models in the folder of the present one.
    ListModels,
    /// Opens one of them.
    Open {
        /// Its file name.
        model: String,
    },
    /// Sets the key light, in degrees to the right of the eye and above it.
    Light {
        /// −180 to 180.
        azimuth_deg: i16,
        /// −90 to 90.
        elevation_deg: i16,
    },
    /// Sets the diameter of the sun of path-traced pictures.
    Sun {
        /// 0 to 90, rounded to tenths.
        degrees: f64,
    },
    /// Shows the shadow on a ground in path-traced pictures, or none.
    Ground {
        /// Whether it is shown.
        on: bool,
    },
    /// Sets the exposure of path-traced pictures.
    Exposure {
        /// −10 to 10, rounded to tenths: each doubles the light.
        stops: f64,
    },
    /// Sets the background.
    Background {
        /// One colour RRGGBB, or two, bottom and top, with a comma.
        #[serde(deserialize_with = "parsed")]
        colors: Background,
    },
    /// Cuts the model open from a side, or nowhere.
    Cut {
        /// x, y, z, -x, -y, -z or eye; none makes the model whole.
        #[serde(default, deserialize_with = "parsed_option")]
        side: Option<ClipSide>,
        /// The part that is cut away.
        #[serde(default = "half")]
        permille: u16,
    },
    /// Sets the division of frames.
    Division {
        /// Its name.
        division: Division,
    },
    /// Sets the rays that light the picture; without any, the wall chooses.
    Rays {
        /// Their name.
        rays: Option<LightingMode>,
    },
    /// Sets what samples show.
    Shading {
        /// Its name.
        shading: ShadingMode,
    },
    /// Takes messages off the wall.
    Dismiss,
}

/// An action, and the number by which the remote learns when the wall shows it.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct Message {
    /// The remote's own number for it.
    pub tag: Option<u32>,
    /// The action.
    #[serde(flatten)]
    pub action: Action,
}

impl Action {
    /// Whether visitors may ask for it.
    pub fn is_for_visitors(&self) -> bool {
        self.is_steering() || matches!(self, Self::Leave | Self::Watch { .. })
    }

    /// Whether it moves the camera.
    pub fn is_steering(&self) -> bool {
        use Action::*;
        matches!(
            self,
            Orbit { .. }
                | Pan { .. }
                | Dolly { .. }
                | Roll { .. }
                | GoTo { .. }
                | ViewAll
                | GoToView { .. }
                | GoToAnnotation { .. }
                | Play
        )
    }

    /// The clip plane of [`Action::Cut`].
    pub fn clip(side: Option<ClipSide>, permille: u16) -> Option<Clip> {
        side.and_then(|side| Clip::new(side, permille).ok())
    }

    /// The fault of its numbers, if there is one.
    fn fault(&self) -> Option<&'static str> {
        use Action::*;
        let is_drag = |x: f64, y: f64| x.abs() <= FARTHEST_DRAG && y.abs() <= FARTHEST_DRAG;
        let is_point = |x: f64, y: f64| (0.0..=1.0).contains(&x) && (0.0..=1.0).contains(&y);
        let is_factor = |factor: f64| (1.0 / LARGEST_FACTOR..=LARGEST_FACTOR).contains(&factor);
        match *self {
            Orbit { x, y } | Pan { x, y } if !is_drag(x, y) => Some("x and y are at most 10, either way"),
            GoTo { x, y } | Dolly { x, y, .. } | Annotate { x, y, .. } if !is_point(x, y) => {
                Some("x and y are from 0 to 1")
            }
            Dolly { factor, .. } if !is_factor(factor) => Some("factor is from 0.05 to 20"),
            Roll { degrees } if !(-360.0..=360.0).contains(&degrees) => Some("degrees are from -360 to 360"),
            GoToView { number } | KeepView { number } if !(1..=9).contains(&number) => Some("number is from 1 to 9"),
            EditScene { scene: 0, .. }
            | DeleteScene { scene: 0 }
            | MoveScene { scene: 0, .. }
            | MoveScene { to: 0, .. } => Some("scenes have numbers from 1"),
            EditScene { caption: None, seconds: None, .. } => Some("caption or seconds are needed"),
            EditScene { caption: Some(ref caption), .. } | KeepScene { ref caption, .. }
                if caption.chars().count() > MOST_CAPTION =>
            {
                Some("caption has at most 200 characters")
            }
            EditScene { seconds: Some(seconds), .. } | KeepScene { seconds: Some(seconds), .. }
                if !(0.1..=86_400.0).contains(&seconds) =>
            {
                Some("seconds are from 0.1 to 86400")
            }
            Annotate { ref label, ref text, .. }
                if !(1..=Annotation::LONGEST_LABEL).contains(&label.trim().chars().count())
                    || text.chars().count() > Annotation::LONGEST_TEXT =>
            {
                Some("label has 1 to 60 characters, and text at most 600")
            }
            Open { ref model } if !is_file_name(model) => Some("model is the name of a file, without folders"),
            Light { azimuth_deg, elevation_deg }
                if shared::appearance::Light::new(azimuth_deg, elevation_deg).is_err() =>
            {
                Some("azimuth_deg is from -180 to 180, elevation_deg from -90 to 90")
            }
            Sun { degrees } if !(0.0..=90.0).contains(&degrees) => Some("degrees are from 0 to 90"),
            Exposure { stops } if !(-10.0..=10.0).contains(&stops) => Some("stops are from -10 to 10"),
            Cut { permille, .. } if permille > 1000 => Some("permille is from 0 to 1000"),
            _ => None,
        }
    }
}

/// Whether a text names a file, and no folder.
fn is_file_name(name: &str) -> bool {
    !name.is_empty() && name.len() <= LONGEST_NAME && !name.starts_with('.') && !name.contains(['/', '\\', '\0', ':'])
}

/// Decodes a message.
///
/// # Errors
/// One line: it is longer than [`LONGEST_MESSAGE`], no JSON, no action, or a number is beyond its limits.
pub fn decode(json: &[u8]) -> Result<Message, String> {
    if json.len() > LONGEST_MESSAGE {
        return Err(format!("a message has at most {LONGEST_MESSAGE} bytes"));
    }
    let message: Message = serde_json::from_slice(json).map_err(|error| printable_line(&error.to_string()))?;
    message.action.fault().map_or(Ok(message), |fault| Err(fault.to_owned()))
}

/// The action of a JSON value, which others than remotes have put together.
///
/// # Errors
/// One line: it is no action, or a number is beyond its limits.
pub fn action(json: serde_json::Value) -> Result<Action, String> {
    let action = Action::deserialize(json).map_err(|error| printable_line(&error.to_string()))?;
    action.fault().map_or(Ok(action), |fault| Err(fault.to_owned()))
}

fn middle() -> f64 {
    0.5
}

fn half() -> u16 {
    500
}

fn parsed<'de, D: Deserializer<'de>, T: std::str::FromStr<Err: std::fmt::Display>>(from: D) -> Result<T, D::Error> {
    String::deserialize(from)?.parse().map_err(D::Error::custom)
}

fn parsed_option<'de, D: Deserializer<'de>, T: std::str::FromStr<Err: std::fmt::Display>>(
    from: D,
) -> Result<Option<T>, D::Error> {
    let text = Option::<String>::deserialize(from)?;
    text.map(|text| text.parse().map_err(D::Error::custom)).transpose()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_become_actions() {
        let action = |json: &str| decode(json.as_bytes()).map(|message| message.action);
        assert_eq!(action(r#"{"do":"orbit","x":0.1,"y":-0.2}"#), Ok(Action::Orbit { x: 0.1, y: -0.2 }));
        assert_eq!(action(r#"{"do":"dolly","factor":0.5}"#), Ok(Action::Dolly { factor: 0.5, x: 0.5, y: 0.5 }));
        assert_eq!(
            action(r#"{"do":"cut","side":"-x","permille":250}"#),
            Ok(Action::Cut { side: Some(ClipSide::MinusX), permille: 250 })
        );
        assert_eq!(action(r#"{"do":"cut"}"#), Ok(Action::Cut { side: None, permille: 500 }));
        assert_eq!(action(r#"{"do":"rays","rays":null}"#), Ok(Action::Rays { rays: None }));
        let tagged = decode(br#"{"tag":7,"do":"view-all"}"#).unwrap();
        assert_eq!((tagged.tag, tagged.action), (Some(7), Action::ViewAll));
    }

    #[test]
    fn what_is_beyond_limits_is_refused_in_one_line() {
        for json in [
            "",
            "[]",
            r#"{"do":"quit"}"#,
            r#"{"do":"two\nlines"}"#,
            r#"{"do":"orbit","x":1e999,"y":0}"#,
            r#"{"do":"orbit","x":11,"y":0}"#,
            r#"{"do":"dolly","factor":0}"#,
            r#"{"do":"dolly","factor":1,"x":1.5}"#,
            r#"{"do":"go-to","x":-0.1,"y":0}"#,
            r#"{"do":"roll","degrees":1e9}"#,
            r#"{"do":"go-to-view","number":0}"#,
            r#"{"do":"keep-scene","seconds":0}"#,
            &format!(r#"{{"do":"keep-scene","caption":"{}"}}"#, "é".repeat(MOST_CAPTION + 1)),
            r#"{"do":"annotate","label":" "}"#,
            r#"{"do":"annotate","label":"a","x":2}"#,
            &format!(r#"{{"do":"annotate","label":"{}"}}"#, "é".repeat(Annotation::LONGEST_LABEL + 1)),
            &format!(r#"{{"do":"annotate","label":"a","text":"{}"}}"#, "é".repeat(Annotation::LONGEST_TEXT + 1)),
            r#"{"do":"open","model":"../secret.ply"}"#,
            r#"{"do":"open","model":".hidden.ply"}"#,
            r#"{"do":"light","azimuth_deg":181,"elevation_deg":0}"#,
            r#"{"do":"exposure","stops":10.1}"#,
            r#"{"do":"sun","degrees":-0.1}"#,
            r#"{"do":"ground"}"#,
            r#"{"do":"edit-scene","scene":1}"#,
            r#"{"do":"edit-scene","scene":1,"seconds":0}"#,
            r#"{"do":"move-scene","scene":1,"to":0}"#,
            r#"{"do":"delete-scene","scene":0}"#,
            r#"{"do":"cut","side":"w"}"#,
            r#"{"do":"cut","side":"x","permille":1001}"#,
            &format!(r#"{{"do":"open","model":"{}"}}"#, "x".repeat(LONGEST_MESSAGE)),
        ] {
            let refused = decode(json.as_bytes()).unwrap_err();
            assert!(!refused.is_empty() && !refused.contains('\n'), "{json}: {refused}");
        }
    }

    #[test]
    fn visitors_steer_and_do_nothing_else() {
        let allowed = |json: &str| decode(json.as_bytes()).unwrap().action.is_for_visitors();
        assert!(allowed(r#"{"do":"orbit","x":0,"y":0}"#) && allowed(r#"{"do":"leave"}"#));
        assert!(!allowed(r#"{"do":"open","model":"a.ply"}"#) && !allowed(r#"{"do":"keep-view","number":1}"#));
        assert!(allowed(r#"{"do":"go-to-annotation","number":1}"#));
        assert!(!allowed(r#"{"do":"annotate","label":"a"}"#) && !allowed(r#"{"do":"delete-annotation","number":1}"#));
        assert!(!allowed(r#"{"do":"next-scene"}"#) && !allowed(r#"{"do":"keep-scene"}"#));
        assert!(!allowed(r#"{"do":"division","division":"tiled"}"#) && !allowed(r#"{"do":"dismiss"}"#));
    }
}
