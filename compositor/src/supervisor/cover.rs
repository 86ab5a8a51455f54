//! Hides the desktop where a wall was, under X11.
//!
//! The X server keeps the windows of a wall that has died (see `window/session/legacy.rs`), so the last frame is still on screen
//! when its guard hears of the death: the server copies it, whole and in no time, and showing frames costs nothing more.

use std::rc::Rc;

use x11rb::{
    connection::Connection,
    protocol::xproto::{
        ConfigureWindowAux, ConnectionExt as _, CreateGCAux, CreateWindowAux, MapState, Rectangle, StackMode,
        SubwindowMode, WindowClass,
    },
    rust_connection::RustConnection,
    wrapper::ConnectionExt as _,
};

use crate::wall::OnLoss;

/// The X server's screen.
pub(super) struct XDesktop {
    connection: Rc<RustConnection>,
    number: usize,
}

/// A window of the wall.
#[derive(Clone, Copy, Debug)]
pub(super) struct WallWindow {
    /// The X server's number for it.
    pub(super) id: u32,
    /// Where on the desktop it was seen last.
    pub(super) rect: Option<Rectangle>,
}

/// Windows above all others; dropped, they close.
pub(super) struct DesktopCover {
    connection: Rc<RustConnection>,
    windows: Vec<u32>,
}

impl XDesktop {
    /// `None` without an X server that shows the wall, which is logged.
    pub(super) fn connect() -> Option<Self> {
        let is_wayland = std::env::var_os("WAYLAND_DISPLAY").is_some_and(|name| !name.is_empty());
        if is_wayland {
            tracing::info!("under Wayland the desktop is seen from the death of the wall to its return");
            return None;
        }
        let (connection, number) = x11rb::connect(None)
            .inspect_err(|error| tracing::debug!("no X server to cover a desktop of: {error}"))
            .ok()?;
        Some(Self { connection: connection.into(), number })
    }

    /// Finds out where windows are; those that are no longer there stay where they were.
    pub(super) fn find(&self, windows: &mut [WallWindow]) {
        windows.iter_mut().for_each(|window| window.rect = self.visible_rect(window.id).or(window.rect));
    }

    /// Hides the desktop where these windows are or were, by what is seen there now or by black.
    ///
    /// `None` if that fails, which is logged, or if there is nothing to hide.
    pub(super) fn cover(&self, windows: &[WallWindow], on_loss: OnLoss) -> Option<DesktopCover> {
        let mut cover = DesktopCover { connection: Rc::clone(&self.connection), windows: Vec::new() };
        for window in windows {
            // What was closed shows the desktop already.
            let now = self.visible_rect(window.id);
            let shows_last = now.is_some() && on_loss == OnLoss::LastFrame;
            let Some(rect) = now.or(window.rect) else { continue };
            match self.cover_rect(rect, shows_last) {
                Ok(id) => cover.windows.push(id),
                Err(error) => tracing::warn!("the desktop cannot be covered: {error:#}"),
            }
        }
        (!cover.windows.is_empty()).then_some(cover)
    }

    /// Closes windows that a wall has left behind, and all else that the server keeps of it.
    pub(super) fn forget(&self, windows: &[WallWindow]) {
        for window in windows {
            // The first takes all others of its wall with it, and what is gone needs no closing.
            if let Ok(request) = self.connection.kill_client(window.id) {
                let _ = request.check();
            }
        }
    }

    /// `None` for a window that is not to be seen.
    fn visible_rect(&self, window: u32) -> Option<Rectangle> {
        let root = self.root();
        let attributes = self.connection.get_window_attributes(window).ok()?.reply().ok()?;
        let geometry = self.connection.get_geometry(window).ok()?.reply().ok()?;
        let origin = self.connection.translate_coordinates(window, root, 0, 0).ok()?.reply().ok()?;
        let (x, y, width, height) = (origin.dst_x, origin.dst_y, geometry.width, geometry.height);
        (attributes.map_state == MapState::VIEWABLE).then_some(Rectangle { x, y, width, height })
    }

    fn cover_rect(&self, rect: Rectangle, shows_last: bool) -> anyhow::Result<u32> {
        let (connection, root) = (&self.connection, self.root());
        let Rectangle { x, y, width, height } = rect;
        let screen = &connection.setup().roots[self.number];
        // A cursor without a pixel.
        let (shape, clear, cursor) = (connection.generate_id()?, connection.generate_id()?, connection.generate_id()?);
        connection.create_pixmap(1, shape, root, 1, 1)?;
        connection.create_gc(clear, shape, &CreateGCAux::new().foreground(0))?;
        connection.poly_fill_rectangle(shape, clear, &[Rectangle { x: 0, y: 0, width: 1, height: 1 }])?;
        connection.create_cursor(cursor, shape, shape, 0, 0, 0, 0, 0, 0, 0, 0)?;
        // Window managers leave it alone.
        let attributes = CreateWindowAux::new().override_redirect(1).cursor(cursor);
        let (picture, copying) = (connection.generate_id()?, connection.generate_id()?);
        let attributes = if shows_last {
            connection.create_pixmap(screen.root_depth, picture, root, width, height)?;
            // Windows are part of what is seen.
            let of_all = CreateGCAux::new().subwindow_mode(SubwindowMode::INCLUDE_INFERIORS);
            connection.create_gc(copying, root, &of_all)?;
            connection.copy_area(root, picture, copying, x, y, 0, 0, width, height)?;
            attributes.background_pixmap(picture)
        } else {
            attributes.background_pixel(screen.black_pixel)
        };
        let window = connection.generate_id()?;
        let (depth, visual) = (x11rb::COPY_DEPTH_FROM_PARENT, x11rb::COPY_FROM_PARENT);
        let class = WindowClass::INPUT_OUTPUT;
        let created =
            connection.create_window(depth, window, root, x, y, width, height, 0, class, visual, &attributes)?;
        connection.map_window(window)?;
        // The window keeps what it needs of them.
        connection.free_cursor(cursor)?;
        connection.free_gc(clear)?;
        connection.free_pixmap(shape)?;
        if shows_last {
            connection.free_gc(copying)?;
            connection.free_pixmap(picture)?;
        }
        created.check()?;
        Ok(window)
    }

    fn root(&self) -> u32 {
        self.connection.setup().roots[self.number].root
    }
}

impl DesktopCover {
    /// Puts it above windows that have opened since.
    pub(super) fn raise(&self) {
        for &window in &self.windows {
            // Where the X server is gone, there is nothing to cover.
            let _ = self.connection.configure_window(window, &ConfigureWindowAux::new().stack_mode(StackMode::ABOVE));
        }
        let _ = self.connection.flush();
    }
}

impl Drop for DesktopCover {
    fn drop(&mut self) {
        for &window in &self.windows {
            // As above.
            let _ = self.connection.destroy_window(window);
        }
        let _ = self.connection.sync();
    }
}
