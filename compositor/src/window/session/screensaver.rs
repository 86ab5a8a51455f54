//! Holds the screensaver off while nobody touches the keyboard of a wall.
//!
//! On X11 by the MIT screen saver extension, which stops power saving of the screen as well. Elsewhere nothing is done:
//! winit 0.30 offers no way on Wayland, so switch the session's own power saving off there.

/// While this lives, the screensaver stays away.
#[derive(Debug)]
pub struct ScreensaverHold {
    #[cfg(all(unix, not(target_os = "macos")))]
    _connection: x11rb::rust_connection::RustConnection,
}

impl ScreensaverHold {
    /// Holds it off; `None` where that cannot be done, which is logged.
    pub fn new() -> Option<Self> {
        #[cfg(all(unix, not(target_os = "macos")))]
        match hold() {
            Ok(connection) => return Some(Self { _connection: connection }),
            Err(error) => {
                tracing::info!("the screensaver cannot be held off ({error}): switch off the session's power saving");
            }
        }
        None
    }
}

/// A connection of its own: the server ends the hold when the connection ends, however this program ends.
#[cfg(all(unix, not(target_os = "macos")))]
fn hold() -> anyhow::Result<x11rb::rust_connection::RustConnection> {
    use x11rb::{connection::Connection, protocol::screensaver::ConnectionExt};

    // An X server may run there too, but its screen saver is not the session's.
    anyhow::ensure!(std::env::var_os("WAYLAND_DISPLAY").is_none(), "this is Wayland");
    let (connection, _) = x11rb::connect(None)?;
    // Holding came with version 1.1.
    let version = connection.screensaver_query_version(1, 1)?.reply()?;
    anyhow::ensure!(
        (version.server_major_version, version.server_minor_version) >= (1, 1),
        "the X server's screen saver extension is older than 1.1"
    );
    connection.screensaver_suspend(1)?.check()?;
    connection.flush()?;
    Ok(connection)
}
