//! Command-line options of a picture's appearance, shared by all programs that render.

use std::path::PathBuf;

use shared::{
    appearance::{Appearance, Background, Clip, Light},
    path_light::PathLight,
};

use crate::{formats::sky::SkyError, render::sky::SkyMap};

/// Each option names it: a heading of the struct would also head the options after it.
const HEADING: &str = "Appearance";

/// Appearance of a picture: light, background and clip plane.
#[derive(Clone, Debug, clap::Args)]
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

    /// With --rays path: diameter of the sun, which stands in the direction of the key light; shadows of a large one are soft
    #[arg(long, help_heading = HEADING, value_name = "DEGREES", default_value = "4",
        value_parser = PathLight::parse_sun, allow_hyphen_values = true)]
    sun: u16,

    /// With --rays path: how often light bounces between surfaces, from 0 (light of sun and sky only) to 64
    #[arg(long, help_heading = HEADING, value_name = "N", default_value = "4",
        value_parser = PathLight::parse_bounces, allow_hyphen_values = true)]
    bounces: u8,

    /// With --rays path: exposure in stops; 1 doubles the light, -1 halves it
    #[arg(long, help_heading = HEADING, value_name = "STOPS", default_value = "0",
        value_parser = PathLight::parse_exposure, allow_hyphen_values = true)]
    exposure: i16,

    /// With --rays path: show on the background the shadow that the model casts on a ground below it
    #[arg(long, help_heading = HEADING)]
    ground: bool,

    /// With --rays path: an image of the sky (equirectangular, in Radiance HDR or OpenEXR) that lights the model in place of
    /// sun and sky; the azimuth of --key-light turns it
    #[arg(long, help_heading = HEADING, value_name = "FILE")]
    pub sky: Option<PathBuf>,
}

impl AppearanceArgs {
    /// The appearance that the options describe, without the sky image and the up axis: who reads image and model knows them.
    pub fn appearance(&self) -> Appearance {
        let Self { key_light: light, background, clip, sun, bounces, exposure, ground, sky: _ } = *self;
        let path = PathLight::new(sun, bounces, exposure).expect("each number was checked as it was read");
        Appearance { light, background, clip, path: path.with_ground(ground), ..Appearance::default() }
    }

    /// The options that were given and light only pictures of paths.
    pub fn of_paths(&self) -> Vec<&'static str> {
        let default = PathLight::default();
        let path = self.appearance().path;
        let given = [
            ("--sun", path.sun_degrees() != default.sun_degrees()),
            ("--bounces", path.bounces() != default.bounces()),
            ("--exposure", path.exposure_ev() != default.exposure_ev()),
            ("--ground", path.has_ground()),
            ("--sky", self.sky.is_some()),
        ];
        given.into_iter().filter(|(_, is_given)| *is_given).map(|(name, _)| name).collect()
    }

    /// Reads the sky image, if one is given.
    ///
    /// # Errors
    /// As for [`SkyImage::read`](crate::formats::sky::SkyImage::read).
    pub fn read_sky(&self) -> Result<Option<SkyMap>, SkyError> {
        self.sky.as_deref().map(SkyMap::read).transpose()
    }
}
