//! Inhibits the screensaver while a wall fills its screens.
//!
//! On X11 through the MIT screen saver extension, which also stops the screen's power saving. winit 0.30 has no way to do
//! this on Wayland: switch off the session's own power saving there.

#[derive(Debug)]
pub(crate) struct ScreensaverHold {
    #[cfg(all(unix, not(target_os = "macos")))]
    _connection: x11rb::rust_connection::RustConnection,
}

impl ScreensaverHold {
    /// Inhibits the screensaver; logs a failure and returns `None`.
    pub(crate) fn new() -> Option<Self> {
        #[cfg(all(unix, not(target_os = "macos")))]
        match hold() {
            Ok(connection) => return Some(Self { _connection: connection }),
            Err(error) => {
                tracing::info!("the screensaver cannot be inhibited ({error}): switch off the session's power saving");
            }
        }
        None
    }
}

/// Uses a connection of its own: the server ends the inhibition with the connection, however this program ends.
#[cfg(all(unix, not(target_os = "macos")))]
fn hold() -> anyhow::Result<x11rb::rust_connection::RustConnection> {
    use x11rb::{connection::Connection, protocol::screensaver::ConnectionExt};

    // An X server may run under Wayland too, but its screensaver is not the session's.
    anyhow::ensure!(std::env::var_os("WAYLAND_DISPLAY").is_none(), "this is Wayland");
    let (connection, _) = x11rb::connect(None)?;
    // Version 1.1 added suspension.
    let version = connection.screensaver_query_version(1, 1)?.reply()?;
    anyhow::ensure!(
        (version.server_major_version, version.server_minor_version) >= (1, 1),
        "the X server's screen saver extension is older than 1.1"
    );
    connection.screensaver_suspend(1)?.check()?;
    connection.flush()?;
    Ok(connection)
}
