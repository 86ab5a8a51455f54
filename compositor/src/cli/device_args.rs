//! The options of devices that steer the wall.

use crate::devices::DeviceOptions;

/// Which devices steer the wall.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct DeviceArgs {
    /// Listen to Open Sound Control, which controllers of shows speak, on this UDP address, as in 127.0.0.1:7190. OSC has no
    /// passwords, so other addresses than this machine's own need --osc-open
    #[arg(long, help_heading = "Devices", value_name = "HOST:PORT", conflicts_with = "headless")]
    pub osc: Option<String>,
    /// Let everybody in the network steer the wall by OSC
    #[arg(long, help_heading = "Devices", requires = "osc")]
    pub osc_open: bool,
    /// Listen to no SpaceMouse and no gamepad
    #[arg(long, help_heading = "Devices", conflicts_with = "headless")]
    pub no_controllers: bool,
}

impl DeviceArgs {
    pub(crate) fn options(&self) -> DeviceOptions {
        DeviceOptions { osc: self.osc.clone(), osc_is_open: self.osc_open, has_controllers: !self.no_controllers }
    }
}
