//! The light of sky images beside closed forms.

use std::{f64::consts::PI, sync::Arc};

use shared::appearance::{Appearance, Light};

use super::{
    tests::{ball, build, check, colored, lights, spec},
    *,
};
use crate::{formats::sky::SkyImage, render::sky::SkyMap};

/// A ball of this colour under a sky image, and the frame that shows it.
fn ball_under(image: SkyImage, color: u8, bounces: u8) -> (Scene, FrameSpec) {
    let sky = SkyMap::new(image);
    let id = sky.id();
    let scene = build(colored(ball(), [color; 3])).with_sky(Some(Arc::new(sky)));
    let spec = spec(DVec3::new(1.0, 2.5, 4.0), DVec3::ZERO, bounces);
    let light = Light::new(0, 36).unwrap();
    let appearance = Appearance { sky: Some(id), light, ..spec.appearance };
    (scene, FrameSpec { appearance, ..spec })
}

#[test]
fn a_sky_image_of_one_colour_is_an_even_sky() {
    let color = Vec3::new(0.7, 0.5, 0.3);
    for (width, bounces) in [(2, 0), (64, 4)] {
        let image = SkyImage::new(width, width / 2, vec![color.to_array(); (width * width / 2) as usize]).unwrap();
        let (scene, spec) = ball_under(image, 255, bounces);
        let all = lights(&scene, &spec, 256, |_| ());
        // The coarser the rows, the less their sines are those of the directions in them.
        let noise = if width == 2 { 0.05 } else { 0.01 };
        check(all.into_iter().map(|(_, _, light)| (light, color.as_dvec3())), noise);
    }
}

#[test]
fn a_single_texel_lights_a_ball_by_the_cosine() {
    let (width, height, row, column) = (64u32, 32u32, 6u32, 40u32);
    let given = 300.0;
    let texels = (0..width * height).map(|index| if index == row * width + column { [given; 3] } else { [0.0; 3] });
    let (scene, spec) = ball_under(SkyImage::new(width, height, texels.collect()).unwrap(), 255, 0);
    // The light that comes from the texel, as a vector, by numbers: the middle column is ahead, that is +z, and the columns
    // after it are to the right of who looks there, that is −x.
    let n = 20;
    let mut from_texel = DVec3::ZERO;
    for (down, across) in (0..n * n).map(|at| (at / n, at % n)) {
        let theta = PI * (f64::from(row) + (f64::from(down) + 0.5) / f64::from(n)) / f64::from(height);
        let phi = 2.0 * PI * ((f64::from(column) + (f64::from(across) + 0.5) / f64::from(n)) / f64::from(width) - 0.5);
        let direction = DVec3::new(-theta.sin() * phi.sin(), theta.cos(), theta.sin() * phi.cos());
        let area = PI / f64::from(height) * 2.0 * PI / f64::from(width) * theta.sin() / f64::from(n * n);
        from_texel += direction * (f64::from(given) * area);
    }
    let all = lights(&scene, &spec, 64, |_| ());
    let mut n_lit = 0;
    let pixels: Vec<_> = all
        .into_iter()
        .filter_map(|(hit, _, light)| {
            let [a, ..] = scene.mesh().corners(hit.triangle);
            let normal = scene.mesh().normal(hit.triangle).normalize();
            let normal = normal * normal.dot(Vec3::from_array(a).as_dvec3()).signum();
            let truth = normal.dot(from_texel) / PI;
            assert!(truth > -0.05 * from_texel.length() || light == DVec3::ZERO, "{light} behind");
            // The texel's edges set where it touches the horizon.
            let is_clear = truth > 0.1 * from_texel.length();
            n_lit += usize::from(is_clear);
            is_clear.then_some((light, DVec3::splat(truth)))
        })
        .collect();
    assert!(n_lit > 100, "{n_lit}");
    check(pixels.into_iter(), 0.02);
}

#[test]
fn a_frame_that_names_no_sky_image_is_lit_by_sun_and_sky() {
    let image = SkyImage::new(2, 1, vec![[9.0; 3]; 2]).unwrap();
    let (scene, named) = ball_under(image, 255, 1);
    let unnamed = FrameSpec { appearance: Appearance { sky: None, ..named.appearance }, ..named };
    let without = build(colored(ball(), [255; 3]));
    assert_eq!(scene.render_frame(&unnamed).0, without.render_frame(&unnamed).0);
    assert_ne!(scene.render_frame(&named).0, without.render_frame(&unnamed).0);
}
