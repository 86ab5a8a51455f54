//! Commands, and the keys and mouse gestures that give them.

use shared::{
    appearance::{Background, Clip, Light},
    division::Division,
    protocol::{LightingMode, ShadingMode},
    structure::Storage,
};
use winit::keyboard::NamedKey;

use super::marks::MarkCommand;

/// The quantity that colours over the picture show, in the order in which a key steps through them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, strum::IntoStaticStr, strum::VariantArray)]
pub(crate) enum Tint {
    #[default]
    #[strum(serialize = "none")]
    None,
    /// The render server of each tile: one colour each.
    #[strum(serialize = "who")]
    Nodes,
    /// CPU time, from dark to bright.
    #[strum(serialize = "time")]
    Cost,
}

/// A command to the wall, given by a key or on the overlay; [`KEYS`] has the help on most of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Command {
    ViewAll,
    GoToView(u8),
    KeepView(u8),
    ToggleRecording,
    TogglePlaying,
    /// Make flying this many steps faster; slower if negative.
    ChangeSpeed(i32),
    Inspect,
    NextTint,
    SetTint(Tint),
    NextStorage,
    /// Have render servers store the grid this way; `None`: as they were started.
    SetStorage(Option<Storage>),
    NextDensity,
    /// Have render servers build a grid with this many cells per triangle.
    SetDensity(u32),
    ToggleFiles,
    Choose(usize),
    OpenEntry(usize),
    OpenParent,
    /// Take the last typed letter away.
    Untype,
    GoToCursor,
    /// Go to what is in the middle of the picture.
    GoToMiddle,
    NextUpAxis,
    NextDivision,
    SetDivision(Division),
    NextShading,
    SetShading(ShadingMode),
    NextLighting,
    SetLighting(Option<LightingMode>),
    NextLight,
    SetLight(Light),
    /// The sun's diameter, in tenths of a degree.
    SetSun(u16),
    /// Of paths of light, in tenths of a stop.
    SetExposure(i16),
    /// Brighten pictures of paths by this many tenths of a stop.
    ChangeExposure(i16),
    /// Whether the background shows the shadow on a ground.
    SetGround(bool),
    ToggleGround,
    NextBackground,
    SetBackground(Background),
    NextClip,
    /// Cut the model open here, or nowhere.
    SetClip(Option<Clip>),
    /// Cut this many thousandths of the model deeper; less deep if negative.
    MoveClip(i16),
    ToggleRefinement,
    ToggleOverlay,
    ToggleHelp,
    ToggleFullscreen,
    LeaveFullscreen,
    Screenshot,
    NextPattern,
    SaveCorners,
    /// Take the last move of corners back.
    Undo,
    Redo,
    ToggleLock,
    /// Show or hide the code that opens the remote.
    ToggleRemote,
    /// Play the show, or hold it.
    TogglePlayingShow,
    NextScene,
    PreviousScene,
    /// Keep this view as the last scene of the show.
    KeepScene,
    /// Move the scene on the wall one place in the show.
    MoveScene {
        is_later: bool,
    },
    /// Delete the scene on the wall from the show.
    DeleteScene,
    Mark(MarkCommand),
    DismissMessage,
    Quit,
}

impl Command {
    pub(crate) fn repeats(self) -> bool {
        matches!(
            self,
            Self::MoveClip(_) | Self::ChangeExposure(_) | Self::Undo | Self::Redo | Self::Choose(_) | Self::Untype
        )
    }

    /// Whether it moves the camera, as a hand does.
    pub(crate) fn is_steering(self) -> bool {
        use Command::*;
        matches!(
            self,
            ViewAll | GoToView(_) | TogglePlaying | GoToCursor | GoToMiddle | NextUpAxis | Mark(MarkCommand::GoTo(_))
        )
    }

    /// Whether visitors of a locked wall may give it.
    pub(crate) fn is_for_visitors(self) -> bool {
        use Command::*;
        matches!(
            self,
            ViewAll
                | GoToView(_)
                | TogglePlaying
                | ChangeSpeed(_)
                | GoToCursor
                | GoToMiddle
                | ToggleLock
                | ToggleRemote
                | Mark(MarkCommand::GoTo(_))
        )
    }
}

/// A direction to fly in, relative to the picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Direction {
    Forward,
    Backward,
    Left,
    Right,
    Up,
    Down,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum KeyAction {
    /// Moves the camera while the key is held.
    Fly(Direction),
    /// Gives a command when the key is pressed.
    Trigger(Command),
}

/// A key by the letter on its cap, so that bindings hold for every keyboard layout.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Key {
    /// A lower-case letter.
    Letter(char),
    /// A lower-case letter together with Ctrl.
    Ctrl(char),
    /// A lower-case letter together with Ctrl and Shift.
    CtrlShift(char),
    /// A digit from 1 to 9, which becomes the number of its command.
    AnyDigit,
    /// The same together with Ctrl.
    CtrlAnyDigit,
    /// A key without a letter.
    Named(NamedKey),
}

impl Key {
    /// A key that was pressed or released; `None` for keys that no binding can name.
    pub(crate) fn from_winit(key: &winit::keyboard::Key, ctrl: bool, shift: bool) -> Option<Self> {
        match key {
            winit::keyboard::Key::Named(named) => Some(Self::Named(*named)),
            winit::keyboard::Key::Character(text) => {
                let letter = text.chars().next()?.to_ascii_lowercase();
                Some(match (ctrl, shift) {
                    (false, _) => Self::Letter(letter),
                    // Some keyboards need Shift for digits.
                    (true, true) if letter.is_alphabetic() => Self::CtrlShift(letter),
                    (true, _) => Self::Ctrl(letter),
                })
            }
            _ => None,
        }
    }
}

impl std::fmt::Display for Key {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Letter(letter) => write!(f, "{}", letter.to_ascii_uppercase()),
            Self::Ctrl(letter) => write!(f, "Ctrl+{}", letter.to_ascii_uppercase()),
            Self::CtrlShift(letter) => write!(f, "Ctrl+Shift+{}", letter.to_ascii_uppercase()),
            Self::AnyDigit => f.write_str("1 to 9"),
            Self::CtrlAnyDigit => f.write_str("Ctrl+1 to 9"),
            Self::Named(NamedKey::ArrowUp) => f.write_str("Up"),
            Self::Named(NamedKey::ArrowDown) => f.write_str("Down"),
            Self::Named(NamedKey::ArrowLeft) => f.write_str("Left"),
            Self::Named(NamedKey::ArrowRight) => f.write_str("Right"),
            Self::Named(NamedKey::Escape) => f.write_str("Esc"),
            Self::Named(NamedKey::PageUp) => f.write_str("Page Up"),
            Self::Named(NamedKey::PageDown) => f.write_str("Page Down"),
            Self::Named(named) => write!(f, "{named:?}"),
        }
    }
}

/// A row of [`KEYS`].
#[derive(Clone, Copy, Debug)]
pub struct KeyBinding {
    /// The keys.
    pub keys: &'static [Key],
    /// Their effect.
    pub(crate) action: KeyAction,
    /// Their effect, for the help.
    pub help: &'static str,
}

impl KeyBinding {
    /// The keys' names: `P or F12`.
    pub fn names(&self) -> String {
        self.keys.iter().map(Key::to_string).collect::<Vec<_>>().join(" or ")
    }
}

/// Every key of the window, of the help panel, and of the table in `wall-config/README.md`.
pub const KEYS: &[KeyBinding] = {
    use {Command::*, Direction::*, Key::*, KeyAction::*};
    const fn row(keys: &'static [Key], action: KeyAction, help: &'static str) -> KeyBinding {
        KeyBinding { keys, action, help }
    }
    &[
        row(&[Letter('w'), Named(NamedKey::ArrowUp)], Fly(Forward), "fly forward"),
        row(&[Letter('s'), Named(NamedKey::ArrowDown)], Fly(Backward), "fly backward"),
        row(&[Letter('a'), Named(NamedKey::ArrowLeft)], Fly(Left), "fly left"),
        row(&[Letter('d'), Named(NamedKey::ArrowRight)], Fly(Right), "fly right"),
        row(&[Letter('e')], Fly(Up), "fly up"),
        row(&[Letter('q')], Fly(Down), "fly down"),
        row(&[Letter('+')], Trigger(ChangeSpeed(1)), "fly faster from now on"),
        row(&[Letter('-')], Trigger(ChangeSpeed(-1)), "fly slower from now on"),
        row(&[Letter('f')], Trigger(ViewAll), "view all of the model"),
        row(&[Letter('g')], Trigger(GoToCursor), "go to the point under the cursor, and orbit around it"),
        row(&[Letter('i')], Trigger(Inspect), "show triangle, point and distance under the cursor"),
        row(&[AnyDigit], Trigger(GoToView(0)), "go to a kept view"),
        row(&[CtrlAnyDigit], Trigger(KeepView(0)), "keep this view beside the model"),
        row(&[Letter('c')], Trigger(ToggleRecording), "record the camera, or end the recording"),
        row(&[Named(NamedKey::Space)], Trigger(TogglePlaying), "play the recorded camera path, or stop"),
        row(&[Named(NamedKey::F5)], Trigger(TogglePlayingShow), "play the show, or hold it"),
        row(&[Named(NamedKey::PageDown)], Trigger(NextScene), "next scene of the show"),
        row(&[Named(NamedKey::PageUp)], Trigger(PreviousScene), "previous scene of the show"),
        row(&[Ctrl('k')], Trigger(KeepScene), "keep this view as a scene of the show"),
        row(&[Ctrl('a')], Trigger(Mark(MarkCommand::Annotate)), "annotate the point under the cursor"),
        row(&[Letter('y')], Trigger(Mark(MarkCommand::NextRuler)), "next ruler: distance, surface, angle, area, none"),
        row(&[Ctrl('h')], Trigger(Mark(MarkCommand::Toggle)), "annotations and measurements on or off"),
        row(&[Letter('u')], Trigger(NextUpAxis), "next up axis: y, z, x, -y, -z, -x"),
        row(&[Letter('h')], Trigger(NextDivision), "next division: interleaved, tiled, dynamic"),
        row(&[Letter('v')], Trigger(NextShading), "next view: shaded, normals, cost"),
        row(&[Letter('r')], Trigger(NextLighting), "next rays: auto, primary, shadows, ambient, path"),
        row(
            &[Letter('l')],
            Trigger(NextLight),
            "next light: left shoulder, eye, right shoulder, above, grazing, behind",
        ),
        row(&[Letter(']')], Trigger(ChangeExposure(1)), "brighter light, at rest"),
        row(&[Letter('[')], Trigger(ChangeExposure(-1)), "darker light, at rest"),
        row(&[Letter('z')], Trigger(ToggleGround), "shadow on a ground, at rest, or none"),
        row(&[Letter('b')], Trigger(NextBackground), "next background: dusk, black, grey, white, sky"),
        row(&[Letter('x')], Trigger(NextClip), "cut open from the next side: x, y, z, -x, -y, -z, eye, none"),
        row(&[Letter('.')], Trigger(MoveClip(10)), "cut deeper"),
        row(&[Letter(',')], Trigger(MoveClip(-10)), "cut less deep"),
        row(&[Letter('m')], Trigger(ToggleRefinement), "resolution follows the motion, or not"),
        row(&[Letter('t')], Trigger(NextTint), "next tint: none, render server, CPU time"),
        row(&[Letter('k')], Trigger(NextStorage), "next storage of the grid"),
        row(&[Letter('j')], Trigger(NextDensity), "next density of the grid"),
        row(&[Ctrl('o')], Trigger(ToggleFiles), "open another model"),
        row(&[Letter('o')], Trigger(ToggleOverlay), "overlay on or off"),
        row(&[Named(NamedKey::F1)], Trigger(ToggleHelp), "this help on or off"),
        row(&[Letter('p'), Named(NamedKey::F12)], Trigger(Screenshot), "screenshot of the wall"),
        row(&[Named(NamedKey::F11)], Trigger(ToggleFullscreen), "fullscreen on or off"),
        row(&[Named(NamedKey::Escape)], Trigger(LeaveFullscreen), "leave fullscreen"),
        row(&[Letter('n')], Trigger(NextPattern), "next test pattern: align, names, pixels, overlap, gamma, focus"),
        row(&[Ctrl('s')], Trigger(SaveCorners), "save the moved corners"),
        row(&[Ctrl('z')], Trigger(Undo), "take the last move of corners back"),
        row(&[CtrlShift('z')], Trigger(Redo), "move the corners again"),
        row(&[Ctrl('l')], Trigger(ToggleLock), "lock for visitors, who can only steer, or unlock"),
        row(&[Ctrl('r')], Trigger(ToggleRemote), "the code that opens the remote on a phone, or hide it"),
        row(&[Ctrl('q')], Trigger(Quit), "quit"),
    ]
};

/// Gestures of mouse and fingers, and their effects, for the help.
pub const MOUSE: &[(&str, &str)] = &[
    ("Left drag", "orbit around the model, or the point gone to"),
    ("Middle or Shift + left drag", "pan"),
    ("Right drag", "dolly: nearer or farther"),
    ("Wheel", "nearer to the point under the cursor, or farther"),
    ("Click", "show triangle, point and distance there, or pick it for the ruler"),
    ("Click on a label", "go to its annotation, and show its text"),
    ("Double click", "go there, and orbit around it"),
    ("One finger", "orbit; a tap clicks, and two taps go there"),
    ("Two fingers", "pan, pinch nearer or farther, twist"),
    ("Shift while flying", "fly four times as fast"),
    ("Drop a model's file", "open it"),
];

pub(crate) fn action(key: Key) -> Option<KeyAction> {
    let (key, number) = match key {
        Key::Letter(digit @ '1'..='9') => (Key::AnyDigit, digit as u8 - b'0'),
        Key::Ctrl(digit @ '1'..='9') => (Key::CtrlAnyDigit, digit as u8 - b'0'),
        other => (other, 0),
    };
    let binding = KEYS.iter().find(|binding| binding.keys.contains(&key))?;
    Some(match binding.action {
        KeyAction::Trigger(Command::GoToView(_)) => KeyAction::Trigger(Command::GoToView(number)),
        KeyAction::Trigger(Command::KeepView(_)) => KeyAction::Trigger(Command::KeepView(number)),
        other => other,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_key_does_two_things() {
        let keys: Vec<Key> = KEYS.iter().flat_map(|binding| binding.keys).copied().collect();
        for (index, key) in keys.iter().enumerate() {
            assert!(!keys[..index].contains(key), "{key} is bound twice");
        }
    }

    #[test]
    fn keys_are_known_by_their_caps() {
        let letter = |text: &str| winit::keyboard::Key::Character(text.into());
        let pressed = |key, ctrl| Key::from_winit(&key, ctrl, false).and_then(action);
        assert_eq!(pressed(letter("h"), false), Some(KeyAction::Trigger(Command::NextDivision)));
        assert_eq!(pressed(letter("H"), false), Some(KeyAction::Trigger(Command::NextDivision)));
        assert_eq!(pressed(letter("j"), true), None);
        assert_eq!(pressed(letter("q"), false), Some(KeyAction::Fly(Direction::Down)));
        assert_eq!(pressed(letter("q"), true), Some(KeyAction::Trigger(Command::Quit)));
        let f11 = winit::keyboard::Key::Named(NamedKey::F11);
        assert_eq!(pressed(f11, false), Some(KeyAction::Trigger(Command::ToggleFullscreen)));
        assert_eq!(pressed(letter("ж"), false), None);
        assert_eq!(pressed(letter("7"), false), Some(KeyAction::Trigger(Command::GoToView(7))));
        assert_eq!(pressed(letter("1"), true), Some(KeyAction::Trigger(Command::KeepView(1))));
        assert_eq!(pressed(letter("0"), true), None);
        let pressed_with_shift = |text| Key::from_winit(&letter(text), true, true).and_then(action);
        assert_eq!(pressed(letter("z"), true), Some(KeyAction::Trigger(Command::Undo)));
        assert_eq!(pressed_with_shift("Z"), Some(KeyAction::Trigger(Command::Redo)));
        assert_eq!(pressed_with_shift("1"), Some(KeyAction::Trigger(Command::KeepView(1))));
    }

    #[test]
    fn visitors_can_neither_end_nor_change_the_wall() {
        let commands = KEYS.iter().filter_map(|binding| match binding.action {
            KeyAction::Trigger(command) => Some(command),
            KeyAction::Fly(_) => None,
        });
        let allowed: Vec<_> = commands.filter(|command| command.is_for_visitors()).collect();
        use Command::*;
        assert_eq!(
            allowed,
            [
                ChangeSpeed(1),
                ChangeSpeed(-1),
                ViewAll,
                GoToCursor,
                GoToView(0),
                TogglePlaying,
                ToggleLock,
                ToggleRemote
            ]
        );
    }

    #[test]
    fn names_of_keys_are_those_on_the_caps() {
        let names: Vec<_> = KEYS.iter().map(KeyBinding::names).collect();
        for name in ["W or Up", "P or F12", "Ctrl+Q", "Esc", "F11", "1 to 9", "Space"] {
            assert!(names.iter().any(|shown| shown == name), "{name} is not among {names:?}");
        }
    }
}
