//! Devices: their orders become commands and motions, as keys and mouse do.

use std::time::Instant;

use winit::event_loop::ActiveEventLoop;

use super::App;
use crate::{
    control::drive::Drive,
    devices::{Devices, Order},
};

/// The wall's end of its devices.
pub(super) struct DeviceControl {
    devices: Devices,
    /// Whether a device was held out when the drive was taken last.
    is_held: bool,
    /// Whether it has ended a scene, and moves nothing until it is let go.
    has_touched: bool,
}

impl DeviceControl {
    pub(super) fn new(devices: Devices) -> Self {
        Self { devices, is_held: false, has_touched: false }
    }
}

impl App<'_> {
    /// Carries out what devices have ordered; several motions make one picture.
    pub(super) fn take_device_orders(&mut self, event_loop: &ActiveEventLoop) {
        let mut has_moved = false;
        while let Some(order) = self.devices.devices.take() {
            match order {
                Order::Act(action) => has_moved |= self.act(event_loop, action),
                Order::Press(command) => self.execute(event_loop, command),
            }
        }
        if let Some(drive) = self.devices.devices.take_drive() {
            self.drive(drive);
        }
        if has_moved {
            self.want_picture();
        }
    }

    /// Drives the camera from now on, as devices are held out.
    fn drive(&mut self, drive: Drive) {
        let now = Instant::now();
        let was_held = std::mem::replace(&mut self.devices.is_held, !drive.is_rest());
        if drive.is_rest() {
            self.devices.has_touched = false;
        } else {
            self.kiosk.touch(now);
            if !was_held && self.touch_show() {
                self.devices.has_touched = true;
                self.redraw();
            }
        }
        let drive = if self.devices.has_touched { Drive::default() } else { drive };
        self.camera.drive(drive, now);
    }
}
