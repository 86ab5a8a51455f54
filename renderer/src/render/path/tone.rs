//! From the light of path-traced pictures to what a display can show.

use glam::Vec3;
use shared::path_light::PathLight;

/// Exposure, and the tone mapping "PBR Neutral" of the Khronos Group (2024): colours keep their hue, those of usual albedos
/// in full light also their brightness, and brighter light nears white.
#[derive(Clone, Copy, Debug)]
pub(in crate::render) struct ToneMapping {
    exposure: f32,
}

/// The largest light that is not compressed.
const START: f32 = 0.8 - FACING;
/// The part of light that dielectrics reflect when seen from the front; it is taken off.
const FACING: f32 = 0.04;
/// How fast compressed colours lose their saturation.
const DESATURATION: f32 = 0.15;

impl ToneMapping {
    pub(in crate::render) fn new(light: PathLight) -> Self {
        Self { exposure: light.exposure() as f32 }
    }

    /// The linear light to show, from 0 to 1; light that is no number is black.
    pub(in crate::render) fn shown(self, light: Vec3) -> Vec3 {
        // Without a limit, infinite light would be no number, and black.
        let light = (light * self.exposure).max(Vec3::ZERO).min(Vec3::splat(1e30));
        let least = light.min_element();
        let offset = if least < 2.0 * FACING { least - least * least * (0.25 / FACING) } else { FACING };
        let light = light - offset;
        let peak = light.max_element();
        if peak < START {
            return light;
        }
        let room = 1.0 - START;
        let shown_peak = 1.0 - room * room / (peak + room - START);
        let part_of_white = 1.0 - 1.0 / (DESATURATION * (peak - shown_peak) + 1.0);
        light * (shown_peak / peak) * (1.0 - part_of_white) + shown_peak * part_of_white
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(deci_ev: i16, light: Vec3) -> Vec3 {
        ToneMapping::new(PathLight::new(0, 0, deci_ev).unwrap()).shown(light)
    }

    #[test]
    fn usual_colours_are_kept_and_bright_ones_near_white() {
        // The light of an albedo beside the reflection of 0.04 that every dielectric adds.
        for albedo in [Vec3::new(0.6, 0.55, 0.49), Vec3::splat(0.18), Vec3::new(0.7, 0.1, 0.05)] {
            assert!((shown(0, albedo + 0.04) - albedo).abs().max_element() < 1e-6, "{albedo}");
        }
        let mut last = Vec3::ZERO;
        for step in 0..400 {
            let next = shown(0, Vec3::new(1.0, 0.7, 0.4) * 1.05f32.powi(step - 200));
            assert!(next.cmpge(last - 1e-6).all() && next.max_element() <= 1.0, "{step}: {next} after {last}");
            last = next;
        }
        assert!(last.min_element() > 0.95, "{last}");
        assert_eq!(shown(10, Vec3::splat(0.1)), shown(0, Vec3::splat(0.2)));
    }

    #[test]
    fn no_light_is_no_number() {
        for light in [Vec3::ZERO, Vec3::INFINITY, Vec3::splat(f32::MAX), Vec3::NEG_INFINITY, Vec3::X * f32::INFINITY] {
            for deci_ev in [-100, 0, 100] {
                let shown = shown(deci_ev, light);
                assert!(shown.cmpge(Vec3::ZERO).all() && shown.cmple(Vec3::ONE).all(), "{light}: {shown}");
            }
        }
    }
}
