//! A ground that catches the model's shadow: the background darkens where the model keeps light from a white plane below it.
//!
//! Paths follow the light that is lost rather than the light that arrives: rays that hit nothing change nothing. So the ground
//! has no edge and no noise where there is no shadow, and it takes no light from the model and gives none to it.

use glam::{DVec3, Vec3};
use shared::camera::UpAxis;

use crate::{
    grid::traced::TracedMesh,
    render::{lift::LiftedPoint, surface::Surface},
};

/// Shadows fall so far, in radii of the model around it: from there it hides less than a hundredth of a low sun's sky, and
/// single precision still has a millionth of the model.
const REACH: f64 = 20.0;

/// A plane on which the model stands.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ground {
    /// Unit length; away from the ground.
    up: DVec3,
    /// Of the plane along `up`, in model space.
    height: f64,
    /// The middle of the model, and its radius.
    centre: DVec3,
    radius: f64,
    /// How far rays start above the plane.
    offset: f64,
    /// One over the light that it scatters where nothing is in the way; 0 where that is none.
    part_of_light: Vec3,
}

impl Ground {
    /// The plane below a model whose axis `up` points up, and that scatters the light `open` where nothing is in the way.
    /// `None` for a model without a size.
    pub(super) fn below(mesh: &TracedMesh, up: UpAxis, open: Vec3) -> Option<Self> {
        let [low, high] = mesh.bulk_bounds().corners();
        let (up, centre, radius) = (up.direction(), (low + high) * 0.5, (high - low).length() * 0.5);
        let height = up.dot(centre) - up.abs().dot(high - low) * 0.5;
        // As Lift has it, for the farthest point from which rays start.
        let farthest = centre.abs().max_element() + REACH * radius;
        let offset = farthest * (8.0 * f64::from(f32::EPSILON));
        let part_of_light = Vec3::select(open.cmpgt(Vec3::ZERO), open.recip(), Vec3::ZERO);
        let is_plane = radius > 0.0 && height.is_finite() && offset.is_finite() && part_of_light.is_finite();
        is_plane.then_some(Self { up, height, centre, radius, offset, part_of_light })
    }

    /// Where a ray that hits no surface meets the ground from above, near the model.
    pub(super) fn point(&self, origin: DVec3, direction: Vec3) -> Option<LiftedPoint> {
        let direction = direction.as_dvec3();
        let (above, falls) = (self.up.dot(origin) - self.height, -self.up.dot(direction));
        if above <= 0.0 || falls <= 0.0 {
            return None;
        }
        let point = origin + direction * (above / falls);
        let is_near = (point - self.centre).length_squared() <= REACH * REACH * self.radius * self.radius;
        is_near.then(|| LiftedPoint { point: point + self.up * self.offset, normal: self.up })
    }

    /// The ground at a point, seen along a ray.
    pub(super) fn surface(&self, direction: Vec3) -> Surface {
        let up = self.up.as_vec3();
        Surface { to_eye: -direction.normalize(), geometric: up, shading: up, color: Vec3::ONE }
    }

    /// The part of a background that stands for light which the ground scatters.
    pub(super) fn weight(&self, background: Vec3) -> Vec3 {
        background * self.part_of_light
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use shared::{
        appearance::{Appearance, Background},
        camera::Camera,
        protocol::{FrameSpec, SampleRange},
        srgb,
    };

    use super::{
        super::tests::{ball, build, colored, spec},
        *,
    };
    use crate::{
        formats::sky::SkyImage,
        render::{scene::Scene, sky::SkyMap},
    };

    /// A black ball of radius 1 around zero under an even sky, and a frame that shows it on a ground before white.
    fn ball_on_ground(eye: DVec3) -> (Scene, FrameSpec) {
        let sky = SkyMap::new(SkyImage::new(64, 32, vec![[0.5; 3]; 64 * 32]).unwrap());
        let spec = spec(eye, DVec3::ZERO, 1);
        let path = spec.appearance.path.with_ground(true);
        let background = Background::plain([255; 3]);
        let appearance = Appearance { path, background, sky: Some(sky.id()), ..spec.appearance };
        let scene = build(colored(ball(), [0; 3])).with_sky(Some(Arc::new(sky)));
        (scene, FrameSpec { appearance, samples: SampleRange::all(0, 256), ..spec })
    }

    /// The direction of a pixel's middle, and its colour, row by row from the bottom.
    fn pixels(scene: &Scene, spec: &FrameSpec) -> Vec<(DVec3, [u8; 3])> {
        let (columns, camera) = (spec.size.xres(), &spec.camera);
        let direction = |pixel: u32| {
            let [x, y] = [pixel % columns, pixel / columns].map(|at| f64::from(at) + 0.5);
            let way = camera.ll() - camera.eye();
            way + camera.u() * (x / f64::from(columns)) + camera.v() * (y / f64::from(spec.size.yres()))
        };
        let (rgb, _) = scene.render_frame(spec);
        (0..).map(direction).zip(rgb.as_chunks().0.iter().copied()).collect()
    }

    #[test]
    fn a_ball_hides_its_part_of_an_even_sky() {
        let eye = DVec3::new(1.0, 3.0, 6.0);
        let (scene, spec) = ball_on_ground(eye);
        let (mut errors, mut n_dark) = (Vec::new(), 0);
        for (direction, [shade, ..]) in pixels(&scene, &spec) {
            // How near the ray passes to the ball, with room for the pixel's width.
            let miss = (eye - direction * (eye.dot(direction) / direction.length_squared())).length();
            let point = eye + direction * ((-1.0 - eye.y) / direction.y);
            let distance = point.length();
            if miss < 1.15 || direction.y > -0.05 * direction.length() {
                continue;
            }
            // A sphere's view factor: Howell, Menguc, Daun and Siegel, Thermal Radiation Heat Transfer, appendix C.
            let truth = 1.0 - 1.0 / distance.powi(3);
            errors.push(f64::from(shade) - f64::from(srgb::encode(truth as f32)));
            n_dark += u32::from(truth < 0.9);
        }
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        let worst = errors.iter().fold(0.0, |worst: f64, error| worst.max(error.abs()));
        assert!(n_dark > 100 && errors.len() > 500, "{n_dark} of {}", errors.len());
        assert!(mean.abs() < 0.3 && worst < 6.0, "{mean} in the mean, {worst} at worst");
    }

    #[test]
    fn where_no_shadow_falls_the_background_stays_as_it_is() {
        // The ground is seen from above alone, and takes nothing from the ball.
        let (scene, spec) = ball_on_ground(DVec3::new(1.0, -3.0, 6.0));
        let without = |spec: &FrameSpec| {
            let path = spec.appearance.path.with_ground(false);
            FrameSpec { appearance: Appearance { path, ..spec.appearance }, ..*spec }
        };
        assert_eq!(pixels(&scene, &spec), pixels(&scene, &without(&spec)));
        let far = Camera::look_at(DVec3::new(0.0, 40.0, 90.0), DVec3::new(0.0, 0.0, 60.0), DVec3::Y, 0.1, 2.0).unwrap();
        let far = FrameSpec { camera: far, ..spec };
        assert!(pixels(&scene, &far).iter().all(|(_, color)| *color == [255; 3]));
        let (scene, spec) = ball_on_ground(DVec3::new(1.0, 3.0, 6.0));
        let (with, without) = (pixels(&scene, &spec), pixels(&scene, &without(&spec)));
        let of_ball: Vec<_> = with.iter().zip(&without).filter(|(_, (_, plain))| *plain == [0; 3]).collect();
        assert!(of_ball.len() > 100 && of_ball.iter().all(|((_, shown), _)| *shown == [0; 3]), "{}", of_ball.len());
    }

    #[test]
    fn models_without_a_size_have_no_ground() {
        let scene = build(crate::model::mesh::Mesh::default());
        assert!(Ground::below(scene.mesh(), UpAxis::Y, Vec3::ONE).is_none());
        let scene = build(ball());
        let ground = Ground::below(scene.mesh(), UpAxis::MinusZ, Vec3::new(1.0, 0.0, 0.5)).unwrap();
        assert_eq!(ground.weight(Vec3::ONE), Vec3::new(1.0, 0.0, 2.0));
        assert!((ground.height + 1.0).abs() < 1e-6 && ground.point(DVec3::Z * 3.0, Vec3::NEG_Z).is_none());
        assert!(ground.point(DVec3::Z * -3.0, Vec3::Z).is_some());
    }
}
