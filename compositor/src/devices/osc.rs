//! Open Sound Control 1.0 (Wright 2002), as show controllers speak it: each message becomes an action of the remote, within
//! the same limits. Pure: no socket.
//!
//! An address is `/raywall/` and the action's name in the remote's API. Arguments follow in the order of [`ADDRESSES`]; the
//! first may also be parts of the address, as in `/raywall/go-to-view/3`, because buttons send nothing but 1 and 0.

use rosc::{OscMessage, OscPacket, OscType};
use serde_json::{Map, Value};
use shared::printable::printable_line;

use crate::remote::message::{self, Action};

/// Longest packet in bytes: controllers keep below the 1,500 of an Ethernet frame.
pub const LONGEST_PACKET: usize = 4096;
/// Bundles within bundles: controllers send one.
const DEEPEST_BUNDLE: usize = 4;
/// All addresses begin with this.
const PREFIX: &str = "/raywall/";
/// As much of a peer's text as a line shows.
const LONGEST_SHOWN: usize = 60;

/// A value that follows an address.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Argument {
    /// A number.
    Number(&'static str),
    /// A number, rounded to a whole one.
    Whole(&'static str),
    /// A text.
    Text(&'static str),
    /// A text, or `auto` or `none` in place of one.
    Choice(&'static str),
    /// Whether a button is pressed, or `on` or `off`.
    Switch(&'static str),
}

use Argument::{Choice, Number, Switch, Text, Whole};

/// The actions that have an address, with their arguments; the names are those of the remote's API.
pub const ADDRESSES: [(&str, &[Argument]); 27] = [
    ("orbit", &[Number("x"), Number("y")]),
    ("pan", &[Number("x"), Number("y")]),
    ("dolly", &[Number("factor"), Number("x"), Number("y")]),
    ("roll", &[Number("degrees")]),
    ("go-to", &[Number("x"), Number("y")]),
    ("view-all", &[]),
    ("go-to-view", &[Whole("number")]),
    ("go-to-annotation", &[Whole("number")]),
    ("play", &[]),
    ("keep-view", &[Whole("number")]),
    ("play-show", &[]),
    ("pause-show", &[]),
    ("next-scene", &[]),
    ("previous-scene", &[]),
    ("move-scene", &[Whole("scene"), Whole("to")]),
    ("delete-scene", &[Whole("scene")]),
    ("open", &[Text("model")]),
    ("light", &[Whole("azimuth_deg"), Whole("elevation_deg")]),
    ("sun", &[Number("degrees")]),
    ("exposure", &[Number("stops")]),
    ("ground", &[Switch("on")]),
    ("background", &[Text("colors")]),
    ("cut", &[Choice("side"), Whole("permille")]),
    ("division", &[Text("division")]),
    ("rays", &[Choice("rays")]),
    ("shading", &[Text("shading")]),
    ("dismiss", &[]),
];

/// Actions of the API without an address: they are of conversations, or write texts beside the model.
pub const WITHOUT_ADDRESS: [&str; 7] =
    ["leave", "watch", "keep-scene", "edit-scene", "annotate", "delete-annotation", "list-models"];

/// Decodes a packet, and passes on each action in it, or the reason why a message is none, in one line. Bundles act at once,
/// whatever their time.
pub fn decode(packet: &[u8], each: &mut impl FnMut(Result<Action, String>)) {
    if packet.len() > LONGEST_PACKET {
        return each(Err(format!("a packet has at most {LONGEST_PACKET} bytes")));
    }
    match rosc::decoder::decode_udp(packet) {
        Ok((_, packet)) => walk(&packet, 0, each),
        Err(_) => each(Err("no OSC packet".to_owned())),
    }
}

fn walk(packet: &OscPacket, depth: usize, each: &mut impl FnMut(Result<Action, String>)) {
    match packet {
        OscPacket::Message(message) => {
            if let Some(outcome) = action(message).transpose() {
                let named = |fault| format!("{}: {fault}", shown(&message.addr));
                each(outcome.map_err(named));
            }
        }
        OscPacket::Bundle(_) if depth == DEEPEST_BUNDLE => {
            each(Err(format!("bundles lie at most {DEEPEST_BUNDLE} deep in each other")));
        }
        OscPacket::Bundle(bundle) => bundle.content.iter().for_each(|packet| walk(packet, depth + 1, each)),
    }
}

/// The action of a message; `None` if a button was released.
fn action(message: &OscMessage) -> Result<Option<Action>, String> {
    let mut parts = message.addr.strip_prefix(PREFIX).ok_or("addresses begin with /raywall/")?.split('/');
    let name = parts.next().unwrap_or_default();
    let (name, mut arguments) = ADDRESSES
        .into_iter()
        .find(|(known, _)| *known == name)
        .ok_or("there is no such address: the operators' manual lists them")?;
    let mut values = Map::from_iter([("do".to_owned(), name.into())]);
    for part in parts {
        let (first, rest) = arguments.split_first().ok_or("the address has too many parts")?;
        let (field, value) = first.of_text(part)?;
        values.insert(field.to_owned(), value);
        arguments = rest;
    }
    let mut given = message.args.as_slice();
    if let [button] = given
        && let Some(is_pressed) = pressed(button)
        && !arguments.first().is_some_and(|first| matches!(first, Number(_) | Whole(_) | Switch(_)))
    {
        if !is_pressed {
            return Ok(None);
        }
        given = &[];
    }
    for value in given {
        let (first, rest) = arguments.split_first().ok_or("too many arguments")?;
        let (field, value) = first.of(value)?;
        values.insert(field.to_owned(), value);
        arguments = rest;
    }
    message::action(Value::Object(values)).map(Some)
}

/// Whether a button is pressed, if the value is one that buttons send.
fn pressed(value: &OscType) -> Option<bool> {
    match value {
        OscType::Bool(is_pressed) => Some(*is_pressed),
        // "Impulse" in the words of OSC, and nothing.
        OscType::Inf | OscType::Nil => Some(true),
        value => number(value).map(|value| value != 0.0),
    }
}

fn number(value: &OscType) -> Option<f64> {
    match *value {
        OscType::Int(value) => Some(value.into()),
        OscType::Long(value) => Some(value as f64),
        OscType::Float(value) => Some(value.into()),
        OscType::Double(value) => Some(value),
        _ => None,
    }
}

impl Argument {
    /// Its name and its value, of an argument of a message.
    fn of(self, value: &OscType) -> Result<(&'static str, Value), String> {
        match (value, number(value)) {
            (OscType::String(text), _) => self.of_text(text),
            (OscType::Bool(is_on), _) if matches!(self, Switch(_)) => Ok((self.name(), (*is_on).into())),
            (_, Some(number)) => self.of_number(number),
            _ => Err(format!("{} is a {}", self.name(), self.kind())),
        }
    }

    /// Its name and its value, of a text.
    fn of_text(self, text: &str) -> Result<(&'static str, Value), String> {
        match self {
            Number(_) | Whole(_) => match text.parse() {
                Ok(number) => self.of_number(number),
                Err(_) => Err(format!("{} is a number, not {}", self.name(), shown(text))),
            },
            Choice(name) if matches!(text, "auto" | "none") => Ok((name, Value::Null)),
            Switch(name) => match text {
                "on" | "1" => Ok((name, true.into())),
                "off" | "0" => Ok((name, false.into())),
                _ => Err(format!("{name} is on or off")),
            },
            Text(name) | Choice(name) => Ok((name, text.into())),
        }
    }

    fn of_number(self, number: f64) -> Result<(&'static str, Value), String> {
        let (name, value) = match self {
            Number(name) => (name, number.into()),
            // Beyond the numbers of any action it saturates, and is refused.
            Whole(name) if number.is_finite() => (name, (number.round() as i32).into()),
            Whole(name) => (name, Value::Null),
            Switch(name) => (name, (number != 0.0).into()),
            // A name or a colour may have digits only.
            Text(name) | Choice(name) => (name, number.to_string().into()),
        };
        if value.is_null() { Err(format!("{name} is no number")) } else { Ok((name, value)) }
    }

    fn name(self) -> &'static str {
        let (Number(name) | Whole(name) | Text(name) | Choice(name) | Switch(name)) = self;
        name
    }

    fn kind(self) -> &'static str {
        match self {
            Number(_) | Whole(_) => "number",
            Text(_) | Choice(_) => "text",
            Switch(_) => "switch, on or off",
        }
    }
}

/// The beginning of a peer's text, fit for a line of the log.
fn shown(text: &str) -> String {
    let beginning: String = text.chars().take(LONGEST_SHOWN).collect();
    printable_line(&beginning)
}

#[cfg(test)]
mod tests {
    use rosc::{OscBundle, OscTime, encoder};
    use shared::{appearance::ClipSide, protocol::LightingMode};
    use strum::VariantNames;

    use super::*;

    fn packet(address: &str, arguments: &[OscType]) -> OscPacket {
        OscPacket::Message(OscMessage { addr: address.to_owned(), args: arguments.to_vec() })
    }

    fn bundle(content: Vec<OscPacket>) -> OscPacket {
        OscPacket::Bundle(OscBundle { timetag: OscTime { seconds: u32::MAX, fractional: 0 }, content })
    }

    fn decoded(packet: &OscPacket) -> Vec<Result<Action, String>> {
        let mut all = Vec::new();
        decode(&encoder::encode(packet).unwrap(), &mut |outcome| all.push(outcome));
        all
    }

    fn one(address: &str, arguments: &[OscType]) -> Result<Action, String> {
        let mut all = decoded(&packet(address, arguments));
        assert_eq!(all.len(), 1, "{address}");
        all.remove(0)
    }

    #[test]
    fn every_action_of_the_api_has_an_address_or_is_left_out_on_purpose() {
        let mut names: Vec<_> = ADDRESSES.iter().map(|(name, _)| *name).chain(WITHOUT_ADDRESS).collect();
        let mut of_api = Action::VARIANTS.to_vec();
        names.sort_unstable();
        of_api.sort_unstable();
        assert_eq!(names, of_api);
    }

    #[test]
    fn messages_become_actions() {
        use OscType::{Double, Float, Int, Long, String as Text};
        assert_eq!(one("/raywall/orbit", &[Float(0.5), Double(-0.25)]), Ok(Action::Orbit { x: 0.5, y: -0.25 }));
        assert_eq!(one("/raywall/dolly", &[Float(0.5)]), Ok(Action::Dolly { factor: 0.5, x: 0.5, y: 0.5 }));
        let view = Ok(Action::GoToView { number: 3 });
        assert_eq!(
            [one("/raywall/go-to-view", &[Int(3)]), one("/raywall/go-to-view", &[Float(3.2)])],
            [view.clone(), view.clone()]
        );
        assert_eq!(one("/raywall/go-to-view/3", &[]), view);
        assert_eq!(
            one("/raywall/light", &[Float(-30.4), Long(60)]),
            Ok(Action::Light { azimuth_deg: -30, elevation_deg: 60 })
        );
        let path = Ok(Action::Rays { rays: Some(LightingMode::Path) });
        assert_eq!(
            [one("/raywall/rays", &[Text("path".into())]), one("/raywall/rays/path", &[Float(1.0)])],
            [path.clone(), path]
        );
        assert_eq!(one("/raywall/rays/auto", &[]), Ok(Action::Rays { rays: None }));
        assert_eq!(
            one("/raywall/cut/-x", &[Float(250.0)]),
            Ok(Action::Cut { side: Some(ClipSide::MinusX), permille: 250 })
        );
        assert_eq!(one("/raywall/cut/none", &[]), Ok(Action::Cut { side: None, permille: 500 }));
        let model = Text("bunny.ply".into());
        assert_eq!(one("/raywall/open", &[model]), Ok(Action::Open { model: "bunny.ply".into() }));
    }

    #[test]
    fn a_button_acts_when_it_is_pressed_and_not_when_it_is_released() {
        for value in [OscType::Float(1.0), OscType::Int(127), OscType::Bool(true), OscType::Inf, OscType::Nil] {
            assert_eq!(one("/raywall/next-scene", &[value]), Ok(Action::NextScene));
        }
        for value in [OscType::Float(0.0), OscType::Int(0), OscType::Bool(false)] {
            for address in ["/raywall/next-scene", "/raywall/go-to-view/3", "/raywall/rays/path"] {
                assert_eq!(decoded(&packet(address, std::slice::from_ref(&value))), [], "{address}");
            }
        }
        // A fader at 0 is no button.
        let ground = |on| Ok(Action::Ground { on });
        assert_eq!(one("/raywall/ground", &[OscType::Float(0.0)]), ground(false));
        assert_eq!(one("/raywall/ground", &[OscType::Bool(true)]), ground(true));
        assert_eq!(one("/raywall/ground/off", &[OscType::Int(1)]), ground(false));
        assert!(one("/raywall/ground/maybe", &[]).unwrap_err().contains("on or off"));
        assert_eq!(one("/raywall/exposure", &[OscType::Float(0.0)]), Ok(Action::Exposure { stops: 0.0 }));
    }

    #[test]
    fn bundles_act_in_order_whatever_their_time_and_not_without_end() {
        let light = packet("/raywall/view-all", &[]);
        let both = bundle(vec![light.clone(), bundle(vec![packet("/raywall/next-scene", &[])])]);
        assert_eq!(decoded(&both), [Ok(Action::ViewAll), Ok(Action::NextScene)]);
        let deep = (0..100).fold(light, |inner, _| bundle(vec![inner]));
        assert_eq!(decoded(&deep), [Err("bundles lie at most 4 deep in each other".to_owned())]);
    }

    #[test]
    fn what_is_beyond_limits_is_refused_in_one_line() {
        use OscType::{Blob, Float, Int, String as Text};
        let cases: [(&str, &[OscType]); 16] = [
            ("/raywall", &[]),
            ("/raywall/", &[]),
            ("/raywall/quit", &[]),
            ("/other/view-all", &[]),
            ("/raywall/view-all", &[Int(1), Int(2)]),
            ("/raywall/view-all", &[Text("now".into())]),
            ("/raywall/view-all/now", &[]),
            ("/raywall/go-to-view", &[Int(0)]),
            ("/raywall/go-to-view", &[Float(f32::NAN)]),
            ("/raywall/go-to-view/three", &[]),
            ("/raywall/orbit", &[Float(11.0), Float(0.0)]),
            ("/raywall/orbit", &[Float(f32::INFINITY), Float(0.0)]),
            ("/raywall/orbit", &[Float(1.0)]),
            ("/raywall/open", &[Text("../secret.ply".into())]),
            ("/raywall/open", &[Blob(vec![1, 2, 3, 4])]),
            ("/raywall/a\nb", &[]),
        ];
        for (address, arguments) in cases {
            let fault = one(address, arguments).unwrap_err();
            assert!(!fault.is_empty() && !fault.contains('\n') && fault.len() < 300, "{address}: {fault}");
        }
        let mut faults = Vec::new();
        for bytes in [&b""[..], b"/", &[b'/'; LONGEST_PACKET + 1], b"#bundle\0"] {
            decode(bytes, &mut |outcome| faults.push(outcome.unwrap_err()));
        }
        assert_eq!(faults, ["no OSC packet", "no OSC packet", "a packet has at most 4096 bytes", "no OSC packet"]);
    }
}
