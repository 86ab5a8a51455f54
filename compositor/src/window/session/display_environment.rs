//! Checks the display and the libraries that a window needs, before it opens: winit would panic or report unclearly.

#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum DisplayError {
    #[error("there is no display: neither WAYLAND_DISPLAY nor DISPLAY is set; run this in a graphical session")]
    NoDisplay,
    #[error(
        "the window needs {libraries}, which cannot be opened here; install: apt install {debian} (Debian, Ubuntu), \
         dnf install {fedora} (Fedora), or pacman -S {arch} (Arch)"
    )]
    MissingLibraries { libraries: String, debian: String, fedora: String, arch: String },
}

/// Checks that a window can be opened, as far as possible without opening one.
pub(crate) fn check() -> Result<(), DisplayError> {
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
    // The order in which winit chooses.
    let needed = if is_set("WAYLAND_DISPLAY") || is_set("WAYLAND_SOCKET") {
        libraries::WAYLAND
    } else if is_set("DISPLAY") {
        libraries::X11
    } else {
        return Err(DisplayError::NoDisplay);
    };
    let missing: Vec<_> = needed.iter().filter(|[name, ..]| !can_be_opened(name)).collect();
    if missing.is_empty() {
        return Ok(());
    }
    let list = |column: usize, separator: &str| {
        let mut names: Vec<_> = missing.iter().map(|row| row[column]).collect();
        names.dedup();
        names.join(separator)
    };
    let [libraries, debian, fedora, arch] = [list(0, ", "), list(1, " "), list(2, " "), list(3, " ")];
    Err(DisplayError::MissingLibraries { libraries, debian, fedora, arch })
}

#[cfg(all(unix, not(target_os = "macos")))]
mod libraries {
    /// The libraries that winit loads at run time, and their packages in Debian, Fedora and Arch.
    pub(super) const X11: &[[&str; 4]] = &[
        ["libX11", "libx11-6", "libX11", "libx11"],
        ["libX11-xcb", "libx11-xcb1", "libX11-xcb", "libx11"],
        ["libXcursor", "libxcursor1", "libXcursor", "libxcursor"],
        ["libXi", "libxi6", "libXi", "libxi"],
        ["libxkbcommon", "libxkbcommon0", "libxkbcommon", "libxkbcommon"],
        ["libxkbcommon-x11", "libxkbcommon-x11-0", "libxkbcommon-x11", "libxkbcommon-x11"],
    ];
    /// The same for Wayland.
    pub(super) const WAYLAND: &[[&str; 4]] = &[["libxkbcommon", "libxkbcommon0", "libxkbcommon", "libxkbcommon"]];

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
            assert!(error.to_string().contains("graphical session") && !error.to_string().contains('\n'));
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
        let opened = libraries::X11.iter().filter(|[name, ..]| libraries::can_be_opened(name)).count();
        let all = libraries::X11.len();
        assert!(opened == all || opened == 0, "{opened} of {all} libraries open: install what `make test` installs");
    }
}
