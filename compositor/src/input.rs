//! Keys and mouse, in words: what they ask of the wall.

use shared::{
    division::Division,
    protocol::{RayTree, View},
};
use winit::keyboard::NamedKey;

/// What a person can ask of the wall, by key or on the overlay.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// See the whole model.
    ViewAll,
    /// Take the next axis as up, and see the whole model.
    NextUpAxis,
    /// Divide frames by the next heuristic.
    NextDivision,
    /// Divide frames by this heuristic.
    SetDivision(Division),
    /// Show the next of the views.
    NextView,
    /// Show this view.
    SetView(View),
    /// Light the picture by more rays, or by fewest again.
    NextRays,
    /// Light the picture by these rays.
    SetRays(RayTree),
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
    /// Forget the message on screen.
    DismissMessage,
    /// End the wall.
    Quit,
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
pub enum Action {
    /// Moves the camera while it is held.
    Fly(Direction),
    /// Asks for something when it is pressed.
    Ask(Command),
}

/// A key as its cap says it, so that the table holds for every keyboard layout.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Key {
    /// A lower-case letter.
    Letter(char),
    /// A lower-case letter together with Ctrl.
    Ctrl(char),
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
    pub action: Action,
    /// What they do, in words.
    pub help: &'static str,
}

impl KeyBinding {
    /// The keys in words: `P or F12`.
    pub fn names(&self) -> String {
        self.keys.iter().map(Key::to_string).collect::<Vec<_>>().join(" or ")
    }
}

/// Every key: what the window obeys, what the help panel shows and what the README lists.
pub const KEYS: &[KeyBinding] = {
    use {Action::*, Command::*, Direction::*, Key::*};
    const fn row(keys: &'static [Key], action: Action, help: &'static str) -> KeyBinding {
        KeyBinding { keys, action, help }
    }
    &[
        row(&[Letter('w'), Named(NamedKey::ArrowUp)], Fly(Forward), "fly forward"),
        row(&[Letter('s'), Named(NamedKey::ArrowDown)], Fly(Backward), "fly backward"),
        row(&[Letter('a'), Named(NamedKey::ArrowLeft)], Fly(Left), "fly left"),
        row(&[Letter('d'), Named(NamedKey::ArrowRight)], Fly(Right), "fly right"),
        row(&[Letter('e')], Fly(Up), "fly up"),
        row(&[Letter('q')], Fly(Down), "fly down"),
        row(&[Letter('f')], Ask(ViewAll), "view all of the model"),
        row(&[Letter('u')], Ask(NextUpAxis), "next up axis: y, z, x"),
        row(&[Letter('h')], Ask(NextDivision), "next heuristic: interleaved, tiled, dynamic"),
        row(&[Letter('v')], Ask(NextView), "next view: shaded, normals, cost"),
        row(&[Letter('r')], Ask(NextRays), "next rays: primary, shadows, ambient"),
        row(&[Letter('o')], Ask(ToggleOverlay), "overlay on or off"),
        row(&[Named(NamedKey::F1)], Ask(ToggleHelp), "this help on or off"),
        row(&[Letter('p'), Named(NamedKey::F12)], Ask(Screenshot), "screenshot of the wall"),
        row(&[Named(NamedKey::F11)], Ask(ToggleFullscreen), "fullscreen on or off"),
        row(&[Named(NamedKey::Escape)], Ask(LeaveFullscreen), "leave fullscreen"),
        row(&[Ctrl('q')], Ask(Quit), "quit"),
    ]
};

/// The mouse, in words: gesture and effect.
pub const MOUSE: &[(&str, &str)] = &[
    ("Left drag", "orbit around the model"),
    ("Middle drag or Shift + left drag", "pan"),
    ("Right drag or wheel", "dolly: nearer or farther"),
    ("Shift while flying", "fly four times as fast"),
    ("Drop a PLY file", "open it"),
];

/// What a key does, if anything.
pub fn action(key: Key) -> Option<Action> {
    KEYS.iter().find(|binding| binding.keys.contains(&key)).map(|binding| binding.action)
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
        assert_eq!(pressed(letter("h"), false), Some(Action::Ask(Command::NextDivision)));
        assert_eq!(pressed(letter("H"), false), Some(Action::Ask(Command::NextDivision)));
        assert_eq!(pressed(letter("h"), true), None);
        assert_eq!(pressed(letter("q"), false), Some(Action::Fly(Direction::Down)));
        assert_eq!(pressed(letter("q"), true), Some(Action::Ask(Command::Quit)));
        let f11 = winit::keyboard::Key::Named(NamedKey::F11);
        assert_eq!(pressed(f11, false), Some(Action::Ask(Command::ToggleFullscreen)));
        assert_eq!(pressed(letter("ж"), false), None);
    }

    #[test]
    fn names_of_keys_are_those_on_the_caps() {
        let names: Vec<_> = KEYS.iter().map(KeyBinding::names).collect();
        for name in ["W or Up", "P or F12", "Ctrl+Q", "Esc", "F11"] {
            assert!(names.iter().any(|shown| shown == name), "{name} is not among {names:?}");
        }
    }
}
