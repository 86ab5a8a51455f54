//! From diffuse and specular colours to base colour and metal, after the appendix of glTF's `KHR_materials_pbrSpecularGlossiness`.
//!
//! Only + − × ÷ √ are used, so that every machine computes the same bytes.

use glam::Vec3;
use shared::srgb;

/// The part of light that all surfaces but metals reflect.
const DIELECTRIC: f32 = 0.04;

/// Base colour and metallic, from 0 to 1, of a surface whose scattered and reflected light have these linear colours.
fn convert(diffuse: Vec3, specular: Vec3) -> (Vec3, f32) {
    let scattered = 1.0 - specular.max_element();
    let metallic = metallic(brightness(diffuse), brightness(specular), scattered);
    let of_diffuse = diffuse * (scattered / (1.0 - DIELECTRIC) / (1.0 - metallic).max(1e-6));
    let of_specular = (specular - DIELECTRIC * (1.0 - metallic)) / metallic.max(1e-6);
    let color = of_diffuse + (of_specular - of_diffuse) * (metallic * metallic);
    (color.clamp(Vec3::ZERO, Vec3::ONE), metallic)
}

/// Linear factors, in steps of 1 / 65535: images that factors change are told apart by them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Factors {
    diffuse: [u16; 3],
    specular: [u16; 3],
    glossiness: u16,
}

impl Factors {
    pub(super) fn new(diffuse: [f32; 3], specular: [f32; 3], glossiness: f32) -> Self {
        let steps = |factor: f32| (factor.clamp(0.0, 1.0) * f32::from(u16::MAX) + 0.5) as u16;
        Self { diffuse: diffuse.map(steps), specular: specular.map(steps), glossiness: steps(glossiness) }
    }

    /// Those of a surface that reflects as stone and plastic do.
    pub(super) fn of_dielectric(self) -> Self {
        Self { specular: Self::new([0.0; 3], [DIELECTRIC; 3], 0.0).specular, ..self }
    }

    /// Whether a surface of any diffuse colour is no metal.
    pub(super) fn is_dielectric(self) -> bool {
        is_dielectric(brightness(linear(self.specular)))
    }

    /// Base colour and metallic of a surface without textures.
    pub(super) fn convert(self) -> ([f32; 3], f32) {
        let (color, metallic) = convert(linear(self.diffuse), linear(self.specular));
        (color.to_array(), metallic)
    }

    /// The texel of the base colour, and that of roughness and metallic (in green and blue), of a diffuse texel and one of
    /// specular colour and glossiness.
    pub(super) fn texels(self, diffuse: [u8; 4], specular: [u8; 4]) -> [[u8; 4]; 2] {
        let decoded = |[red, green, blue, _]: [u8; 4]| Vec3::from([red, green, blue].map(srgb::decode));
        let (color, metallic) =
            convert(decoded(diffuse) * linear(self.diffuse), decoded(specular) * linear(self.specular));
        let [red, green, blue] = color.to_array().map(srgb::encode);
        let glossiness = f32::from(specular[3]) * fraction(self.glossiness);
        let [glossiness, metallic] = [glossiness, metallic * 255.0].map(|part| (part + 0.5) as u8);
        [[red, green, blue, diffuse[3]], [0, u8::MAX - glossiness, metallic, u8::MAX]]
    }
}

fn linear(steps: [u16; 3]) -> Vec3 {
    Vec3::from(steps.map(fraction))
}

fn fraction(steps: u16) -> f32 {
    f32::from(steps) / f32::from(u16::MAX)
}

/// The metallic for which a base colour exists that scatters and reflects so much.
fn metallic(diffuse: f32, specular: f32, scattered: f32) -> f32 {
    if is_dielectric(specular) {
        return 0.0;
    }
    let b = diffuse * scattered / (1.0 - DIELECTRIC) + specular - 2.0 * DIELECTRIC;
    let root = (b * b - 4.0 * DIELECTRIC * (DIELECTRIC - specular)).max(0.0).sqrt();
    ((root - b) / (2.0 * DIELECTRIC)).clamp(0.0, 1.0)
}

/// Also a brightness that is [`DIELECTRIC`] but for rounding: dark surfaces would be metals.
fn is_dielectric(specular: f32) -> bool {
    specular < 1.001 * DIELECTRIC
}

fn brightness(color: Vec3) -> f32 {
    (color * color).dot(Vec3::new(0.299, 0.587, 0.114)).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    const NO_CHANGE: Factors = Factors { diffuse: [u16::MAX; 3], specular: [u16::MAX; 3], glossiness: u16::MAX };

    #[test]
    fn stone_keeps_its_colour_and_metal_has_that_of_its_reflections() {
        // sRGB 56 is 4 % of light.
        assert_eq!(NO_CHANGE.texels([200, 100, 50, 9], [56, 56, 56, 155]), [[200, 100, 50, 9], [0, 100, 0, 255]]);
        assert_eq!(NO_CHANGE.texels([0, 0, 0, 255], [255, 200, 90, 0]), [[255, 200, 90, 255], [0, 255, 255, 255]]);
        assert_eq!(NO_CHANGE.texels([0, 0, 0, 255], [0, 0, 0, 255]), [[0, 0, 0, 255], [0, 0, 0, 255]]);
    }

    #[test]
    fn factors_change_surfaces_as_texels_of_their_colours_do() {
        let white = [u8::MAX; 4];
        let factors = |diffuse: [u8; 4], [red, green, blue, glossy]: [u8; 4]| {
            let [r, g, b, _] = diffuse;
            Factors::new([r, g, b].map(srgb::decode), [red, green, blue].map(srgb::decode), f32::from(glossy) / 255.0)
        };
        for (diffuse, specular) in [
            ([200, 100, 50, 255], [56, 56, 56, 155]),
            ([0, 0, 0, 255], [255, 200, 90, 0]),
            ([90, 120, 30, 255], [120, 110, 130, 200]),
        ] {
            let (both, one) = (factors(diffuse, specular), NO_CHANGE.texels(diffuse, specular));
            assert_eq!(both.texels(white, white), one);
            assert_eq!(factors(white, specular).texels(diffuse, white), one);
            assert_eq!(factors(diffuse, white).texels(white, specular), one);
            let ([red, green, blue], metallic) = both.convert();
            assert_eq!([red, green, blue].map(srgb::encode), one[0][..3]);
            assert!((metallic * 255.0 - f32::from(one[1][2])).abs() < 0.51, "{metallic}");
        }
        let stone = factors([9, 9, 9, 255], white).of_dielectric();
        assert!(stone.is_dielectric() && stone.convert().1 == 0.0 && !NO_CHANGE.is_dielectric());
    }
}
