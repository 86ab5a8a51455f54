//! Keeps the windows of a crashed wall in the X server, until the supervisor has copied their contents.

use winit::{event_loop::ActiveEventLoop, window::Window};

/// Makes windows outlive this process, or no longer; does nothing without X11.
#[cfg(all(unix, not(target_os = "macos")))]
pub(in crate::window) fn retain_windows(event_loop: &ActiveEventLoop, retain_windows: bool) {
    use winit::raw_window_handle::{HasDisplayHandle, RawDisplayHandle};
    /// `DestroyAll` and `RetainTemporary` of the X protocol's SetCloseDownMode.
    const MODES: [i32; 2] = [0, 2];
    let handle = event_loop.display_handle().map(|handle| handle.as_raw());
    let Ok(RawDisplayHandle::Xlib(handle)) = handle else { return };
    if let (Some(display), Ok(library)) = (handle.display, x11_dl::xlib::Xlib::open()) {
        // SAFETY: the display is winit's, and open as long as its event loop.
        unsafe {
            (library.XSetCloseDownMode)(display.as_ptr().cast(), MODES[usize::from(retain_windows)]);
            (library.XFlush)(display.as_ptr().cast());
        }
    }
}

#[cfg(all(unix, not(target_os = "macos")))]
pub(in crate::window) fn x_window_id(window: &Window) -> Option<u32> {
    use winit::raw_window_handle::{HasWindowHandle, RawWindowHandle};
    match window.window_handle().ok()?.as_raw() {
        RawWindowHandle::Xlib(handle) => u32::try_from(handle.window).ok(),
        _ => None,
    }
}

/// There is no X server.
#[cfg(not(all(unix, not(target_os = "macos"))))]
pub(in crate::window) fn retain_windows(_: &ActiveEventLoop, _: bool) {}

/// There is no X server.
#[cfg(not(all(unix, not(target_os = "macos"))))]
pub(in crate::window) fn x_window_id(_: &Window) -> Option<u32> {
    None
}
