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

/// The metallic for which a base colour exists that scatters and reflects so much.
fn metallic(diffuse: f32, specular: f32, scattered: f32) -> f32 {
    if specular < DIELECTRIC {
        return 0.0;
    }
    let b = diffuse * scattered / (1.0 - DIELECTRIC) + specular - 2.0 * DIELECTRIC;
    let root = (b * b - 4.0 * DIELECTRIC * (DIELECTRIC - specular)).max(0.0).sqrt();
    ((root - b) / (2.0 * DIELECTRIC)).clamp(0.0, 1.0)
}

fn brightness(color: Vec3) -> f32 {
    (color * color).dot(Vec3::new(0.299, 0.587, 0.114)).sqrt()
}

/// The texel of the base colour, and that of roughness and metallic (in green and blue), of a diffuse texel and one of specular
/// colour and glossiness.
pub(super) fn texels(diffuse: [u8; 4], specular: [u8; 4]) -> [[u8; 4]; 2] {
    let linear = |[red, green, blue, _]: [u8; 4]| Vec3::new(srgb::decode(red), srgb::decode(green), srgb::decode(blue));
    let (color, metallic) = convert(linear(diffuse), linear(specular));
    let [red, green, blue] = color.to_array().map(srgb::encode);
    let metallic = (metallic * 255.0 + 0.5) as u8;
    [[red, green, blue, diffuse[3]], [0, u8::MAX - specular[3], metallic, u8::MAX]]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stone_keeps_its_colour_and_metal_has_that_of_its_reflections() {
        // sRGB 56 is 4 % of light.
        assert_eq!(texels([200, 100, 50, 9], [56, 56, 56, 155]), [[200, 100, 50, 9], [0, 100, 0, 255]]);
        assert_eq!(texels([0, 0, 0, 255], [255, 200, 90, 0]), [[255, 200, 90, 255], [0, 255, 255, 255]]);
        assert_eq!(texels([0, 0, 0, 255], [0, 0, 0, 255]), [[0, 0, 0, 255], [0, 0, 0, 255]]);
    }
}
