//! A desktop of several virtual monitors that tests connect and disconnect: Xorg with its dummy driver.

use std::{fs, process::Command};

use x11rb::{
    CURRENT_TIME,
    connection::Connection,
    protocol::{
        randr::{self, ConnectionExt as _, ModeInfo, Rotation},
        xproto::Window,
    },
    rust_connection::RustConnection,
    wrapper::ConnectionExt as _,
};

use crate::x_session::XSession;

/// Xorg's configuration; it names the first monitor `DUMMY0`.
const CONFIG: &str = r#"
Section "Device"
    Identifier "memory"
    Driver "dummy"
    VideoRam 65536
EndSection
Section "Screen"
    Identifier "desktop"
    Device "memory"
    DefaultDepth 24
    SubSection "Display"
        Depth 24
        Virtual 4096 4096
    EndSubSection
EndSection
Section "ServerFlags"
    Option "AutoAddDevices" "false"
EndSection
"#;

/// A monitor on the desktop.
#[derive(Clone, Copy)]
pub(crate) struct Monitor {
    pub(crate) name: &'static str,
    /// Its upper-left corner on the desktop.
    pub(crate) at: [u16; 2],
    pub(crate) size: [u16; 2],
}

/// Starts a desktop with these monitors.
pub(crate) fn start(monitors: &[Monitor]) -> XSession {
    start_with(monitors, "")
}

/// Starts one with more in its configuration.
pub(crate) fn start_with(monitors: &[Monitor], more: &str) -> XSession {
    let extent = |axis: usize| monitors.iter().map(|it| it.at[axis] + it.size[axis]).max().expect("monitors");
    let size = [extent(0), extent(1)];
    let folder = tempfile::tempdir().expect("a folder");
    let config = folder.path().join("xorg.conf");
    fs::write(&config, CONFIG.to_owned() + more).expect("a file");
    let mut server = Command::new("Xorg");
    server.arg("-config").arg(config).arg("-logfile").arg(folder.path().join("log")).arg("-novtswitch");
    XSession::start_on(server, size.map(usize::from), &|display| {
        let desk = Desk::connect(display);
        let [width, height] = size;
        // The server refuses a desktop smaller than a connected monitor.
        desk.unplug(monitors[0].name);
        let [width_mm, height_mm] = [width, height].map(|side| u32::from(side) / 4);
        desk.connection.randr_set_screen_size(desk.root, width, height, width_mm, height_mm).expect("sent");
        monitors.iter().for_each(|&monitor| desk.plug(monitor));
    })
}

/// A connection to the desktop.
pub(crate) struct Desk {
    connection: RustConnection,
    root: Window,
}

impl Desk {
    pub(crate) fn connect(display: &str) -> Self {
        let (connection, screen) = x11rb::connect(Some(display)).expect("the X server runs");
        let root = connection.setup().roots[screen].root;
        connection.randr_query_version(1, 5).expect("sent").reply().expect("RandR");
        Self { connection, root }
    }

    /// Connects a monitor and switches it on.
    pub(crate) fn plug(&self, monitor: Monitor) {
        let Monitor { name, at, size: [width, height] } = monitor;
        let (output, mode) = (self.output(name), self.mode(width, height));
        self.connection.randr_add_output_mode(output, mode).expect("sent");
        self.set_crtc(output, at.map(|side| side as i16), mode, &[output]);
    }

    /// Switches a monitor off and disconnects it.
    pub(crate) fn unplug(&self, name: &str) {
        self.set_crtc(self.output(name), [0, 0], 0, &[]);
    }

    fn set_crtc(&self, output: randr::Output, [x, y]: [i16; 2], mode: u32, outputs: &[randr::Output]) {
        let info =
            self.connection.randr_get_output_info(output, CURRENT_TIME).expect("sent").reply().expect("an output");
        let crtc = info.crtcs[0];
        let config = self.connection.randr_set_crtc_config(
            crtc,
            CURRENT_TIME,
            CURRENT_TIME,
            x,
            y,
            mode,
            Rotation::ROTATE0,
            outputs,
        );
        let reply = config.expect("sent").reply().expect("a mode that fits");
        assert_eq!(reply.status, randr::SetConfig::SUCCESS);
        self.connection.sync().expect("the X server runs");
    }

    fn output(&self, name: &str) -> randr::Output {
        let outputs = self.resources().outputs.into_iter();
        let named = |output: &randr::Output| {
            let info = self.connection.randr_get_output_info(*output, CURRENT_TIME).expect("sent").reply();
            info.expect("an output").name == name.as_bytes()
        };
        outputs.into_iter().find(named).unwrap_or_else(|| panic!("the X server has no output {name}"))
    }

    /// The mode of a size, made on first use.
    fn mode(&self, width: u16, height: u16) -> u32 {
        let resources = self.resources();
        let mut names = resources.names.as_slice();
        let wanted = format!("{width}x{height} of a test");
        for mode in &resources.modes {
            let (name, rest) = names.split_at(usize::from(mode.name_len));
            if name == wanted.as_bytes() {
                return mode.id;
            }
            names = rest;
        }
        let info = ModeInfo {
            width,
            height,
            dot_clock: u32::from(width) * u32::from(height) * 60,
            hsync_start: width,
            hsync_end: width,
            htotal: width,
            vsync_start: height,
            vsync_end: height,
            vtotal: height,
            name_len: wanted.len() as u16,
            ..ModeInfo::default()
        };
        let made = self.connection.randr_create_mode(self.root, info, wanted.as_bytes()).expect("sent");
        made.reply().expect("a mode").mode
    }

    fn resources(&self) -> randr::GetScreenResourcesCurrentReply {
        self.connection.randr_get_screen_resources_current(self.root).expect("sent").reply().expect("RandR")
    }
}
