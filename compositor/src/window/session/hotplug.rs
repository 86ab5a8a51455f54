//! Lets winit notice monitors that come and go under X11.
//!
//! winit 0.30 asks for RandR events and updates its list of monitors on one. But Xlib drops an extension's events until
//! the extension's own library is in use.

use winit::event_loop::ActiveEventLoop;

/// Starts to use RandR's library under X11. Logs a warning if it is missing; the wall then does not notice monitors.
#[cfg(all(unix, not(target_os = "macos")))]
pub(in crate::window) fn listen(event_loop: &ActiveEventLoop) {
    use winit::raw_window_handle::{HasDisplayHandle, RawDisplayHandle};
    let handle = event_loop.display_handle().map(|handle| handle.as_raw());
    let Ok(RawDisplayHandle::Xlib(handle)) = handle else { return };
    let Some(display) = handle.display else { return };
    match x11_dl::xrandr::Xrandr::open() {
        Ok(library) => {
            let [mut first_event, mut first_error] = [0; 2];
            // Xlib calls the library for each event from now on; it is never closed.
            // SAFETY: the display is winit's, and open as long as its event loop; both numbers outlive the call.
            unsafe { (library.XRRQueryExtension)(display.as_ptr().cast(), &mut first_event, &mut first_error) };
        }
        Err(error) => tracing::warn!(
            "monitors that come back are not noticed without libXrandr ({error}): apt install libxrandr2 (Debian, \
             Ubuntu), dnf install libXrandr (Fedora), or pacman -S libxrandr (Arch)"
        ),
    }
}

/// Not needed on other systems.
#[cfg(not(all(unix, not(target_os = "macos"))))]
pub(in crate::window) fn listen(_: &ActiveEventLoop) {}
