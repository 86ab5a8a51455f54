//! Hides the desktop where a crashed wall was, under X11, with a copy of its windows: see `window/session/legacy.rs`.

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

/// The connection to the X server, and the number of its screen.
pub(super) struct XDesktop {
    connection: Rc<RustConnection>,
    number: usize,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct WallWindow {
    /// Its X11 identifier.
    pub(super) id: u32,
    pub(super) rect: Option<Rectangle>,
}

/// Windows above all others; they close on drop.
pub(super) struct DesktopCover {
    connection: Rc<RustConnection>,
    windows: Vec<u32>,
}

impl XDesktop {
    /// Connects to the X server that shows the wall; logs a failure and returns `None`.
    pub(super) fn connect() -> Option<Self> {
        let is_wayland = std::env::var_os("WAYLAND_DISPLAY").is_some_and(|name| !name.is_empty());
        if is_wayland {
            tracing::info!("under Wayland the desktop is visible while a crashed wall restarts");
            return None;
        }
        let (connection, number) = x11rb::connect(None)
            .inspect_err(|error| tracing::debug!("no X server, so the desktop cannot be covered: {error}"))
            .ok()?;
        Some(Self { connection: connection.into(), number })
    }

    /// Updates the places of windows; a closed window keeps its last place.
    pub(super) fn find(&self, windows: &mut [WallWindow]) {
        windows.iter_mut().for_each(|window| window.rect = self.visible_rect(window.id).or(window.rect));
    }

    /// Covers the places of windows with their present contents or with black.
    ///
    /// Logs failures; `None` if no place is covered.
    pub(super) fn cover(&self, windows: &[WallWindow], on_loss: OnLoss) -> Option<DesktopCover> {
        let mut cover = DesktopCover { connection: Rc::clone(&self.connection), windows: Vec::new() };
        for window in windows {
            // In place of a closed window the desktop is visible already: nothing to copy.
            let now = self.visible_rect(window.id);
            let copies_screen = now.is_some() && on_loss == OnLoss::LastFrame;
            let Some(rect) = now.or(window.rect) else { continue };
            match self.cover_rect(rect, copies_screen) {
                Ok(id) => cover.windows.push(id),
                Err(error) => tracing::warn!("the desktop cannot be covered: {error:#}"),
            }
        }
        (!cover.windows.is_empty()).then_some(cover)
    }

    /// Closes the windows that a crashed child left behind, and frees its other X11 resources.
    pub(super) fn forget(&self, windows: &[WallWindow]) {
        for window in windows {
            // The first call also closes the child's other windows, so later ones may fail.
            if let Ok(request) = self.connection.kill_client(window.id) {
                let _ = request.check();
            }
        }
    }

    /// The place of a window; `None` if it is not visible.
    fn visible_rect(&self, window: u32) -> Option<Rectangle> {
        let root = self.root();
        let attributes = self.connection.get_window_attributes(window).ok()?.reply().ok()?;
        let geometry = self.connection.get_geometry(window).ok()?.reply().ok()?;
        let origin = self.connection.translate_coordinates(window, root, 0, 0).ok()?.reply().ok()?;
        let (x, y, width, height) = (origin.dst_x, origin.dst_y, geometry.width, geometry.height);
        (attributes.map_state == MapState::VIEWABLE).then_some(Rectangle { x, y, width, height })
    }

    fn cover_rect(&self, rect: Rectangle, copies_screen: bool) -> anyhow::Result<u32> {
        let (connection, root) = (&self.connection, self.root());
        let Rectangle { x, y, width, height } = rect;
        let screen = &connection.setup().roots[self.number];
        // An invisible cursor.
        let (shape, clear, cursor) = (connection.generate_id()?, connection.generate_id()?, connection.generate_id()?);
        connection.create_pixmap(1, shape, root, 1, 1)?;
        connection.create_gc(clear, shape, &CreateGCAux::new().foreground(0))?;
        connection.poly_fill_rectangle(shape, clear, &[Rectangle { x: 0, y: 0, width: 1, height: 1 }])?;
        connection.create_cursor(cursor, shape, shape, 0, 0, 0, 0, 0, 0, 0, 0)?;
        // Window managers ignore a window with override_redirect.
        let attributes = CreateWindowAux::new().override_redirect(1).cursor(cursor);
        let (picture, copying) = (connection.generate_id()?, connection.generate_id()?);
        let attributes = if copies_screen {
            connection.create_pixmap(screen.root_depth, picture, root, width, height)?;
            // The copy includes windows.
            let with_windows = CreateGCAux::new().subwindow_mode(SubwindowMode::INCLUDE_INFERIORS);
            connection.create_gc(copying, root, &with_windows)?;
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
        // The window keeps its own references.
        connection.free_cursor(cursor)?;
        connection.free_gc(clear)?;
        connection.free_pixmap(shape)?;
        if copies_screen {
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
    /// Raises the cover above windows that have opened since.
    pub(super) fn raise(&self) {
        for &window in &self.windows {
            // Without an X server there is nothing to cover.
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
