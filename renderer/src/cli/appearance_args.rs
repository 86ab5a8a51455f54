//! Command-line options of a picture's appearance, shared by all programs that render.

use shared::appearance::{Appearance, Background, Clip, Light};

/// Each option names it: a heading of the struct would also head the options after it.
const HEADING: &str = "Appearance";

/// Appearance of a picture: light, background and clip plane.
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct AppearanceArgs {
    /// Direction of the key light, in degrees to the right of the eye and above it
    #[arg(long, help_heading = HEADING, value_name = "AZIMUTH,ELEVATION",
        default_value_t = Light::default(), allow_hyphen_values = true)]
    key_light: Light,

    /// Background as red, green and blue: one colour, or one at the bottom and one at the top
    #[arg(long, help_heading = HEADING, value_name = "RRGGBB[,RRGGBB]", default_value_t = Background::default())]
    background: Background,

    /// Cut the model open: remove this part of its extent from the side x, y, z, -x, -y, -z or eye, for example y:30
    #[arg(long, help_heading = HEADING, value_name = "SIDE:PERCENT", allow_hyphen_values = true)]
    clip: Option<Clip>,
}

impl AppearanceArgs {
    /// The appearance that the options describe.
    pub fn appearance(&self) -> Appearance {
        let Self { key_light: light, background, clip } = *self;
        Appearance { light, background, clip }
    }
}
