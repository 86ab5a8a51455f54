//! Checks the display and the libraries that a window needs, before it opens: winit would panic or report unclearly.

/// The reason why no window can be opened.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DisplayError {
    /// There is no graphical session.
    #[error(
        "there is no display: neither WAYLAND_DISPLAY nor DISPLAY is set; run this in a graphical session, or use \
         --headless"
    )]
    NoDisplay,
    /// Libraries that winit loads at run time are not installed.
    #[error(
        "the window needs {libraries}, which cannot be opened here; install: apt install {debian} (Debian, Ubuntu), \
         dnf install {fedora} (Fedora), or pacman -S {arch} (Arch); or use --headless"
    )]
    MissingLibraries {
        /// Their names.
        libraries: String,
        /// Their packages in Debian, separated by spaces.
        debian: String,
        /// Their packages in Fedora.
        fedora: String,
        /// Their packages in Arch.
        arch: String,
    },
}

/// Checks that a window can be opened, as far as possible without opening one.
pub fn check() -> Result<(), DisplayError> {
    #[cfg(all(unix, not(target_os = "macos")))]
    {
        let is_set = |name: &str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
        check_session(is_set, libraries::can_be_opened)
    }
    #[cfg(not(all(unix, not(target_os = "macos"))))]
    Ok(())
}

#[cfg(all(unix, not(target_os = "macos")))]
fn check_session(is_set: impl Fn(&str) -> bool, can_be_opened: impl Fn(&str) -> bool) -> Result<(), DisplayError> {
    use libraries::{Library, WAYLAND, X11};

    // The order in which winit chooses.
    let needed = if is_set("WAYLAND_DISPLAY") || is_set("WAYLAND_SOCKET") {
        WAYLAND
    } else if is_set("DISPLAY") {
        X11
    } else {
        return Err(DisplayError::NoDisplay);
    };
    let missing: Vec<&Library> = needed.iter().filter(|library| !can_be_opened(library.name)).collect();
    if missing.is_empty() {
        return Ok(());
    }
    let list = |field: fn(&Library) -> &'static str| {
        let mut names: Vec<_> = missing.iter().copied().map(field).collect();
        names.dedup();
        names
    };
    Err(DisplayError::MissingLibraries {
        libraries: list(|library| library.name).join(", "),
        debian: list(|library| library.debian).join(" "),
        fedora: list(|library| library.fedora).join(" "),
        arch: list(|library| library.arch).join(" "),
    })
}

#[cfg(all(unix, not(target_os = "macos")))]
mod libraries {
    /// A library that winit loads at run time, and its package in three distributions.
    pub(super) struct Library {
        pub(super) name: &'static str,
        pub(super) debian: &'static str,
        pub(super) fedora: &'static str,
        pub(super) arch: &'static str,
    }

    const XKBCOMMON: Library =
        Library { name: "libxkbcommon", debian: "libxkbcommon0", fedora: "libxkbcommon", arch: "libxkbcommon" };

    pub(super) const WAYLAND: &[Library] = &[XKBCOMMON];

    pub(super) const X11: &[Library] = &[
        Library { name: "libX11", debian: "libx11-6", fedora: "libX11", arch: "libx11" },
        Library { name: "libX11-xcb", debian: "libx11-xcb1", fedora: "libX11-xcb", arch: "libx11" },
        Library { name: "libXcursor", debian: "libxcursor1", fedora: "libXcursor", arch: "libxcursor" },
        Library { name: "libXi", debian: "libxi6", fedora: "libXi", arch: "libxi" },
        XKBCOMMON,
        Library {
            name: "libxkbcommon-x11",
            debian: "libxkbcommon-x11-0",
            fedora: "libxkbcommon-x11",
            arch: "libxkbcommon-x11",
        },
    ];

    /// Loads a library with the same code as winit.
    pub(super) fn can_be_opened(name: &str) -> bool {
        match name {
            "libX11" => x11_dl::xlib::Xlib::open().is_ok(),
            "libX11-xcb" => x11_dl::xlib_xcb::Xlib_xcb::open().is_ok(),
            "libXcursor" => x11_dl::xcursor::Xcursor::open().is_ok(),
            "libXi" => x11_dl::xinput2::XInput2::open().is_ok(),
            "libxkbcommon" => xkbcommon_dl::xkbcommon_option().is_some(),
            "libxkbcommon-x11" => xkbcommon_dl::x11::xkbcommon_x11_option().is_some(),
            _ => false,
        }
    }
}

#[cfg(all(test, unix, not(target_os = "macos")))]
mod tests {
    use super::*;

    #[test]
    fn without_a_display_the_cure_is_named() {
        for is_set in [|_: &str| false, |name: &str| name == "HOME"] {
            let error = check_session(is_set, |_| true).unwrap_err();
            assert_eq!(error, DisplayError::NoDisplay);
            assert!(error.to_string().contains("--headless") && !error.to_string().contains('\n'));
        }
    }

    #[test]
    fn missing_libraries_name_their_packages() {
        let error = check_session(|name| name == "DISPLAY", |name| !name.contains("xkb")).unwrap_err().to_string();
        assert!(error.contains("needs libxkbcommon, libxkbcommon-x11,"), "{error}");
        assert!(error.contains("apt install libxkbcommon0 libxkbcommon-x11-0 (Debian"), "{error}");
        let error = check_session(|name| name == "DISPLAY", |name| !name.contains("X11")).unwrap_err().to_string();
        assert!(error.contains("pacman -S libx11 (Arch)"), "{error}");
    }

    #[test]
    fn wayland_needs_no_library_of_x() {
        assert_eq!(check_session(|name| name != "DISPLAY", |name| name == "libxkbcommon"), Ok(()));
    }

    #[test]
    fn every_library_can_be_asked_for() {
        // A misspelt name would make every system seem broken: on a desktop all must open, elsewhere none.
        let opened = libraries::X11.iter().filter(|library| libraries::can_be_opened(library.name)).count();
        let all = libraries::X11.len();
        assert!(opened == all || opened == 0, "{opened} of {all} libraries open: install what `make test` installs");
    }
}
