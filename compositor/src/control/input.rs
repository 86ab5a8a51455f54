//! Keys and mouse, in words: what they ask of the wall.

use shared::{
    appearance::{Background, Clip, Light},
    division::Division,
    protocol::{LightingMode, ShadingMode},
    structure::Storage,
};
use winit::keyboard::NamedKey;

use crate::overlay::Tint;

/// What a person can ask of the wall, by key or on the overlay.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// See the whole model.
    ViewAll,
    /// Go to the view of this number.
    GoToView(u8),
    /// Give this view this number.
    KeepView(u8),
    /// Begin to record the camera's path, or end it.
    ToggleRecording,
    /// Follow the camera path, or stop.
    TogglePlaying,
    /// Fly faster by so many steps, or slower.
    ChangeSpeed(i32),
    /// Say what lies under the cursor.
    Inspect,
    /// Tint the picture by the next of who rendered it, what it cost, or nothing.
    NextTint,
    /// Tint the picture by this.
    SetTint(Tint),
    /// Have render servers keep the grid in the next of the storages.
    NextStorage,
    /// Have render servers keep the grid in this storage; without one, as they were started.
    SetStorage(Option<Storage>),
    /// Have render servers build the next denser grid, and after the densest the coarsest.
    NextDensity,
    /// Have render servers build a grid of so many cells a triangle.
    SetDensity(u32),
    /// Show or hide the files that can be opened.
    ToggleFiles,
    /// Mark this entry of the files.
    Choose(usize),
    /// Open this entry of the files.
    OpenEntry(usize),
    /// Show the files of the folder above.
    OpenParent,
    /// Go near to what lies under the cursor, and orbit around it.
    GoToCursor,
    /// Take the next axis as up, and see the whole model.
    NextUpAxis,
    /// Divide frames by the next heuristic.
    NextDivision,
    /// Divide frames by this heuristic.
    SetDivision(Division),
    /// Show the next of the views.
    NextView,
    /// Show this view.
    SetView(ShadingMode),
    /// Light the picture by more rays, or by fewest again.
    NextRays,
    /// Light the picture by these rays.
    SetRays(LightingMode),
    /// Light the picture from the next place.
    NextLight,
    /// Light the picture from here.
    SetLight(Light),
    /// Have the next background behind the model.
    NextBackground,
    /// Have this background behind the model.
    SetBackground(Background),
    /// Cut the model open from the next side, or no more.
    NextClip,
    /// Cut the model open here, or nowhere.
    SetClip(Option<Clip>),
    /// Cut away so many thousandths of the model more, or less.
    MoveClip(i16),
    /// Have the resolution follow the motion, or not.
    ToggleRefinement,
    /// Show or hide the overlay.
    ToggleOverlay,
    /// Show or hide keys and mouse.
    ToggleHelp,
    /// Fill the screen, or stop filling it.
    ToggleFullscreen,
    /// Stop filling the screen.
    LeaveFullscreen,
    /// Write the wall to a file.
    Screenshot,
    /// Show the next test pattern instead of frames, and after the last frames again.
    NextPattern,
    /// Write the corners of all projectors into the wall's file.
    SaveCorners,
    /// Let visitors steer and nothing else, or let everybody do everything again.
    ToggleLock,
    /// Forget the message on screen.
    DismissMessage,
    /// End the wall.
    Quit,
}

impl Command {
    /// Whether it is asked for again and again while its key is held.
    pub fn repeats(self) -> bool {
        matches!(self, Self::MoveClip(_))
    }

    /// Whether visitors of a locked wall may ask for it.
    pub fn is_for_visitors(self) -> bool {
        use Command::*;
        matches!(self, ViewAll | GoToView(_) | TogglePlaying | ChangeSpeed(_) | GoToCursor | ToggleLock)
    }
}

/// Where to fly while a key is held.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// Into the picture.
    Forward,
    /// Out of it.
    Backward,
    /// To the left.
    Left,
    /// To the right.
    Right,
    /// Up in the picture.
    Up,
    /// Down in the picture.
    Down,
}

/// What a key does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum KeyAction {
    /// Moves the camera while it is held.
    Fly(Direction),
    /// Asks for something when it is pressed.
    Trigger(Command),
}

/// A key as its cap says it, so that the table holds for every keyboard layout.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Key {
    /// A lower-case letter.
    Letter(char),
    /// A lower-case letter together with Ctrl.
    Ctrl(char),
    /// A digit from 1 to 9: what its row asks for, it asks for with its number.
    AnyDigit,
    /// The same together with Ctrl.
    CtrlAnyDigit,
    /// A key that makes no letter.
    Named(NamedKey),
}

impl Key {
    /// The key that was pressed or let go; `None` if it is none that a table could name.
    pub fn from_winit(key: &winit::keyboard::Key, ctrl: bool) -> Option<Self> {
        match key {
            winit::keyboard::Key::Named(named) => Some(Self::Named(*named)),
            winit::keyboard::Key::Character(text) => {
                let letter = text.chars().next()?.to_ascii_lowercase();
                Some(if ctrl { Self::Ctrl(letter) } else { Self::Letter(letter) })
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
            Self::AnyDigit => f.write_str("1 to 9"),
            Self::CtrlAnyDigit => f.write_str("Ctrl+1 to 9"),
            Self::Named(NamedKey::ArrowUp) => f.write_str("Up"),
            Self::Named(NamedKey::ArrowDown) => f.write_str("Down"),
            Self::Named(NamedKey::ArrowLeft) => f.write_str("Left"),
            Self::Named(NamedKey::ArrowRight) => f.write_str("Right"),
            Self::Named(NamedKey::Escape) => f.write_str("Esc"),
            Self::Named(named) => write!(f, "{named:?}"),
        }
    }
}

/// A row of [`KEYS`].
#[derive(Clone, Copy, Debug)]
pub struct KeyBinding {
    /// The keys that do it.
    pub keys: &'static [Key],
    /// What they do.
    pub action: KeyAction,
    /// What they do, in words.
    pub help: &'static str,
}

impl KeyBinding {
    /// The keys in words: `P or F12`.
    pub fn names(&self) -> String {
        self.keys.iter().map(Key::to_string).collect::<Vec<_>>().join(" or ")
    }
}

/// Every key of the window, the help panel and the table in `wall-config/README.md`.
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
        row(&[Letter('g')], Trigger(GoToCursor), "go to what is under the cursor, and orbit around it"),
        row(&[Letter('i')], Trigger(Inspect), "what is under the cursor: triangle, point, distance"),
        row(&[AnyDigit], Trigger(GoToView(0)), "go to a kept view"),
        row(&[CtrlAnyDigit], Trigger(KeepView(0)), "keep this view beside the model"),
        row(&[Letter('c')], Trigger(ToggleRecording), "record the camera, or end recording"),
        row(&[Named(NamedKey::Space)], Trigger(TogglePlaying), "play the recorded camera path, or stop"),
        row(&[Letter('u')], Trigger(NextUpAxis), "next up axis: y, z, x"),
        row(&[Letter('h')], Trigger(NextDivision), "next heuristic: interleaved, tiled, dynamic"),
        row(&[Letter('v')], Trigger(NextView), "next view: shaded, normals, cost"),
        row(&[Letter('r')], Trigger(NextRays), "next rays: primary, shadows, ambient"),
        row(
            &[Letter('l')],
            Trigger(NextLight),
            "next light: left shoulder, eye, right shoulder, above, grazing, behind",
        ),
        row(&[Letter('b')], Trigger(NextBackground), "next background: dusk, black, grey, white, sky"),
        row(&[Letter('x')], Trigger(NextClip), "cut open from the next side: x, y, z, -x, -y, -z, eye, none"),
        row(&[Letter('.')], Trigger(MoveClip(10)), "cut deeper"),
        row(&[Letter(',')], Trigger(MoveClip(-10)), "cut less deep"),
        row(&[Letter('m')], Trigger(ToggleRefinement), "resolution follows the motion, or not"),
        row(&[Letter('t')], Trigger(NextTint), "next tint: none, who rendered it, CPU time"),
        row(&[Letter('k')], Trigger(NextStorage), "next storage of the grid"),
        row(&[Letter('j')], Trigger(NextDensity), "next density of the grid"),
        row(&[Ctrl('o')], Trigger(ToggleFiles), "open another model"),
        row(&[Letter('o')], Trigger(ToggleOverlay), "overlay on or off"),
        row(&[Named(NamedKey::F1)], Trigger(ToggleHelp), "this help on or off"),
        row(&[Letter('p'), Named(NamedKey::F12)], Trigger(Screenshot), "screenshot of the wall"),
        row(&[Named(NamedKey::F11)], Trigger(ToggleFullscreen), "fullscreen on or off"),
        row(&[Named(NamedKey::Escape)], Trigger(LeaveFullscreen), "leave fullscreen"),
        row(&[Letter('n')], Trigger(NextPattern), "next test pattern: align, names, pixels, overlap, gamma, focus"),
        row(&[Ctrl('s')], Trigger(SaveCorners), "save the corners that were moved on the wall"),
        row(&[Ctrl('l')], Trigger(ToggleLock), "lock for visitors, who can only steer, or unlock"),
        row(&[Ctrl('q')], Trigger(Quit), "quit"),
    ]
};

/// The mouse, in words: gesture and effect.
pub const MOUSE: &[(&str, &str)] = &[
    ("Left drag", "orbit around the model, or the point gone to"),
    ("Middle or Shift + left drag", "pan"),
    ("Right drag", "dolly: nearer or farther"),
    ("Wheel", "nearer to what is under the cursor, or farther"),
    ("Click", "what is there: triangle, point, distance"),
    ("Double click", "go there, and orbit around it"),
    ("Shift while flying", "fly four times as fast"),
    ("Drop a PLY file", "open it"),
];

/// What a key does, if anything.
pub fn action(key: Key) -> Option<KeyAction> {
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
        let pressed = |key, ctrl| Key::from_winit(&key, ctrl).and_then(action);
        assert_eq!(pressed(letter("h"), false), Some(KeyAction::Trigger(Command::NextDivision)));
        assert_eq!(pressed(letter("H"), false), Some(KeyAction::Trigger(Command::NextDivision)));
        assert_eq!(pressed(letter("h"), true), None);
        assert_eq!(pressed(letter("q"), false), Some(KeyAction::Fly(Direction::Down)));
        assert_eq!(pressed(letter("q"), true), Some(KeyAction::Trigger(Command::Quit)));
        let f11 = winit::keyboard::Key::Named(NamedKey::F11);
        assert_eq!(pressed(f11, false), Some(KeyAction::Trigger(Command::ToggleFullscreen)));
        assert_eq!(pressed(letter("ж"), false), None);
        assert_eq!(pressed(letter("7"), false), Some(KeyAction::Trigger(Command::GoToView(7))));
        assert_eq!(pressed(letter("1"), true), Some(KeyAction::Trigger(Command::KeepView(1))));
        assert_eq!(pressed(letter("0"), true), None);
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
            [ChangeSpeed(1), ChangeSpeed(-1), ViewAll, GoToCursor, GoToView(0), TogglePlaying, ToggleLock]
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
