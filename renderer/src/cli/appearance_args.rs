//! How a picture looks, as it is said on the command lines of all programs that make some.

use shared::appearance::{Appearance, Background, Clip, Light};

/// How a picture looks beside what it shows.
#[derive(Clone, Copy, Debug, clap::Args)]
#[command(next_help_heading = "The look")]
pub struct AppearanceArgs {
    /// From where the light comes, in degrees to the right of the eye and above it
    #[arg(long, value_name = "AZIMUTH,ELEVATION", default_value_t = Light::default(), allow_hyphen_values = true)]
    key_light: Light,

    /// What is behind the model, as red, green and blue: one colour, or two, at the bottom and at the top
    #[arg(long, value_name = "RRGGBB[,RRGGBB]", default_value_t = Background::default())]
    background: Background,

    /// Cut the model open: how much of its extent is taken away, from x, y, z, -x, -y, -z or the eye, as in y:30
    #[arg(long, value_name = "SIDE:PERCENT", allow_hyphen_values = true)]
    clip: Option<Clip>,
}

impl AppearanceArgs {
    /// What they ask for.
    pub fn appearance(&self) -> Appearance {
        let Self { key_light: light, background, clip } = *self;
        Appearance { light, background, clip }
    }
}
