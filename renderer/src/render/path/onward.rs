//! Directions to the lights from surfaces that paths have hit, and those in which the paths go on, many at once: loops over
//! arrays, which the compiler turns into vector instructions.

use glam::Vec3;

use super::{
    DIMENSIONS, PathVertex,
    lights::{LightSample, Lights},
    scattering::{ScatterSample, Scatterings},
    sobol::{PixelSample, PixelSamples},
};
use crate::{
    render::surface::{N, Vectors, get, set},
    simd::{InstructionSet, Kernel, Simd},
};

/// The number of a surface that a path has hit, and the sample that decides where it goes on.
#[derive(Clone, Copy)]
struct Departure {
    vertex: usize,
    sample: PixelSample,
}

/// A direction to a light.
#[derive(Clone, Copy)]
pub(super) struct ToLight {
    /// Unit length, world space.
    pub(super) direction: Vec3,
    /// The light from there that the surface scatters to the eye if nothing is between, weighed against the path's own chance to go
    /// there.
    pub(super) light: Vec3,
    /// A number from 0 to 1 that decides whether the ray is traced.
    pub(super) random: f32,
}

/// The direction in which a path goes on.
#[derive(Clone, Copy)]
pub(super) struct Onward {
    pub(super) sample: ScatterSample,
    /// The light of sun and sky from there if nothing is between.
    pub(super) escaped: Vec3,
    /// A number from 0 to 1 that decides whether the path ends.
    pub(super) random: f32,
}

/// Directions from up to 64 surfaces; their memory serves again.
#[derive(Default)]
pub(super) struct Outgoing {
    departures: Vec<Departure>,
    /// Of each surface.
    pub(super) to_lights: Vec<ToLight>,
    /// Of each path that goes on from the first surface, then from the second, and so on.
    pub(super) onwards: Vec<Onward>,
}

impl Outgoing {
    /// Finds a direction to a light from each surface, and that of each path that goes on from there; the paths have hit `bounce`
    /// surfaces before.
    pub(super) fn find(
        &mut self,
        (instructions, lights): (InstructionSet, &Lights<'_>),
        vertices: &[PathVertex<'_>],
        bounce: u8,
    ) {
        let Self { departures, to_lights, onwards } = self;
        departures.clear();
        to_lights.clear();
        onwards.clear();
        departures.extend(vertices.iter().enumerate().map(|(vertex, of)| Departure { vertex, sample: of.path.sample }));
        // SAFETY: a grid holds only an instruction set that `InstructionSet::available` has found.
        unsafe {
            instructions.call(Directions::<ToLightLanes> { lights, vertices, departures, bounce, found: to_lights });
        }
        departures.clear();
        for (vertex, PathVertex { path, .. }) in vertices.iter().enumerate() {
            let samples = (0..path.sharing.n_paths).map(|number| path.sample_alone(number));
            departures.extend(samples.map(|sample| Departure { vertex, sample }));
        }
        // SAFETY: as above.
        unsafe { instructions.call(Directions::<OnwardLanes> { lights, vertices, departures, bounce, found: onwards }) }
    }
}

/// Finds directions of one kind.
struct Directions<'a, L: Lanes> {
    lights: &'a Lights<'a>,
    vertices: &'a [PathVertex<'a>],
    departures: &'a [Departure],
    bounce: u8,
    found: &'a mut Vec<L::Direction>,
}

impl<L: Lanes> Kernel for Directions<'_, L> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { lights, vertices, departures, bounce, found } = self;
        for departures in departures.chunks(N) {
            // Lanes beyond the last repeat it.
            let at = |lane: usize| departures[lane.min(departures.len() - 1)];
            let from = Gathered {
                scatterings: Scatterings::of(|lane| &vertices[at(lane).vertex].scattering),
                samples: PixelSamples::of(|lane| at(lane).sample),
                bounce,
            };
            let lanes = if from.scatterings.are_matte {
                L::find::<false>(lights, &from)
            } else {
                L::find::<true>(lights, &from)
            };
            for lane in 0..departures.len() {
                found.push(lanes.get(lane));
            }
        }
    }
}

/// [`N`] surfaces, and the samples of the paths that go on from them.
struct Gathered {
    scatterings: Scatterings,
    samples: PixelSamples,
    bounce: u8,
}

impl Gathered {
    /// A pair of random numbers of a lane's sample; each bounce has [`DIMENSIONS`] of them.
    #[inline(always)]
    fn random(&self, lane: usize, number: u32) -> [f32; 2] {
        self.samples.get(lane).pair(DIMENSIONS * u32::from(self.bounce) + number)
    }
}

/// [`N`] directions of one kind.
trait Lanes {
    type Direction;
    /// Finds the directions from surfaces; `REFLECTS` unless all are matte.
    fn find<const REFLECTS: bool>(lights: &Lights<'_>, from: &Gathered) -> Self;
    fn get(&self, lane: usize) -> Self::Direction;
}

/// [`N`] directions to lights.
struct ToLightLanes {
    directions: Vectors,
    /// Those of the lights.
    radiances: Vectors,
    densities: [f32; N],
    /// The light that the surfaces scatter.
    lights: Vectors,
    randoms: [f32; N],
}

impl Lanes for ToLightLanes {
    type Direction = ToLight;

    #[inline(always)]
    fn find<const REFLECTS: bool>(lights: &Lights<'_>, from: &Gathered) -> Self {
        let [directions, radiances, of_surfaces] = [[[0.0; N]; 3]; 3];
        let mut lanes = Self { directions, radiances, lights: of_surfaces, densities: [0.0; N], randoms: [0.0; N] };
        match &lights.sky_map {
            Some(sky) => {
                for lane in 0..N {
                    lanes.set(lane, sky.sample(from.random(lane, 0)));
                }
            }
            None => {
                for lane in 0..N {
                    lanes.set(lane, lights.sun.sample(from.random(lane, 0)));
                }
            }
        }
        for lane in 0..N {
            let (part, density) = from.scatterings.get::<REFLECTS>(lane).toward(get(&lanes.directions, lane));
            let light = part * get(&lanes.radiances, lane) * (1.0 / (lanes.densities[lane] + density));
            set(&mut lanes.lights, lane, light);
            lanes.randoms[lane] = from.random(lane, 1)[1];
        }
        lanes
    }

    #[inline(always)]
    fn get(&self, lane: usize) -> ToLight {
        let (direction, light) = (get(&self.directions, lane), get(&self.lights, lane));
        ToLight { direction, light, random: self.randoms[lane] }
    }
}

impl ToLightLanes {
    #[inline(always)]
    fn set(&mut self, lane: usize, LightSample { direction, radiance, density }: LightSample) {
        set(&mut self.directions, lane, direction);
        set(&mut self.radiances, lane, radiance);
        self.densities[lane] = density;
    }
}

/// [`N`] of [`Onward`].
struct OnwardLanes {
    directions: Vectors,
    weights: Vectors,
    escaped: Vectors,
    densities: [f32; N],
    are_diffuse: [bool; N],
    randoms: [f32; N],
}

impl Lanes for OnwardLanes {
    type Direction = Onward;

    #[inline(always)]
    fn find<const REFLECTS: bool>(lights: &Lights<'_>, from: &Gathered) -> Self {
        let [directions, weights, escaped] = [[[0.0; N]; 3]; 3];
        let (densities, randoms, are_diffuse) = ([0.0; N], [0.0; N], [false; N]);
        let mut lanes = Self { directions, weights, escaped, densities, are_diffuse, randoms };
        for lane in 0..N {
            let [choice, random] = from.random(lane, 1);
            let ScatterSample { direction, weight, density, is_diffuse } =
                from.scatterings.get::<REFLECTS>(lane).sample(choice, from.random(lane, 2));
            set(&mut lanes.directions, lane, direction);
            set(&mut lanes.weights, lane, weight);
            lanes.densities[lane] = density;
            lanes.are_diffuse[lane] = is_diffuse;
            lanes.randoms[lane] = random;
        }
        match &lights.sky_map {
            Some(sky) => {
                for lane in 0..N {
                    let light = sky.toward(get(&lanes.directions, lane)).escaped(lanes.densities[lane]);
                    set(&mut lanes.escaped, lane, light);
                }
            }
            None => {
                for lane in 0..N {
                    let direction = get(&lanes.directions, lane);
                    let of_sun = lights.sun.toward(direction).escaped(lanes.densities[lane]);
                    set(&mut lanes.escaped, lane, lights.sky.radiance(direction) + of_sun);
                }
            }
        }
        lanes
    }

    #[inline(always)]
    fn get(&self, lane: usize) -> Onward {
        let (direction, weight) = (get(&self.directions, lane), get(&self.weights, lane));
        let (density, is_diffuse) = (self.densities[lane], self.are_diffuse[lane]);
        let sample = ScatterSample { direction, weight, density, is_diffuse };
        Onward { sample, escaped: get(&self.escaped, lane), random: self.randoms[lane] }
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::{super::scattering::Scattering, *};
    use crate::{
        intersect::ray::Hit,
        render::{
            path::{
                Path,
                lights::{Sky, Sun},
                pixel::Sharing,
            },
            surface::Surface,
        },
    };

    fn path(number: u32) -> Path {
        Path {
            sharing: Sharing { first: 0, n_paths: 1 + number % 4, is_direct: true },
            sample: PixelSample::new((number, 7), 5),
            sample_number: 20,
            origin: DVec3::ZERO,
            direction: Vec3::NEG_Z,
            sides: [Vec3::ZERO; 2],
            hit: Hit::MISS,
            weight: Vec3::ONE,
            density: f32::INFINITY,
        }
    }

    #[test]
    fn many_paths_go_on_as_single_ones() {
        let lights = Lights {
            sun: Sun::new(DVec3::new(0.6, 0.0, 0.8), 30.0, Vec3::new(0.8, 0.7, 0.6)),
            sky: Sky { up: Vec3::Y, zenith: Vec3::ONE, ground: Vec3::splat(0.1) },
            sky_map: None,
        };
        let surface = |number: u32| {
            let tilt = (number % 9) as f32 * 0.2 - 0.8;
            let shading = Vec3::new(tilt, 0.3, 1.0).normalize();
            Surface { to_eye: Vec3::Z, geometric: Vec3::Z, shading, color: Vec3::new(0.9, 0.5, 0.1) }
        };
        let matte = |number| Scattering::matte(&surface(number));
        let mixed =
            |number| if number % 3 == 0 { Scattering::glossy(&surface(number), 0.4, 0.5, 0.0) } else { matte(number) };
        let paths: Vec<_> = (0..39).map(path).collect();
        let vertices = |scattering: &dyn Fn(u32) -> Scattering| -> Vec<_> {
            let scatterings = (0..).map(scattering);
            paths
                .iter()
                .zip(scatterings)
                .map(|(path, scattering)| PathVertex { path, point: DVec3::ZERO, scattering })
                .collect()
        };
        let mut n_lit = 0;
        for (vertices, bounce) in [(vertices(&matte), 0), (vertices(&mixed), 2), (vertices(&matte)[..1].to_vec(), 1)] {
            let random = |sample: PixelSample, number: u32| sample.pair(3 * u32::from(bounce) + number);
            for instructions in InstructionSet::available() {
                let mut outgoing = Outgoing::default();
                (0..2).for_each(|_| outgoing.find((instructions, &lights), &vertices, bounce));
                assert_eq!(outgoing.to_lights.len(), vertices.len());
                let mut onwards = outgoing.onwards.iter();
                for (PathVertex { path, scattering, .. }, to_light) in vertices.iter().zip(&outgoing.to_lights) {
                    let of_sun = lights.sun.sample(random(path.sample, 0));
                    let (part, density) = scattering.toward(of_sun.direction);
                    let light = part * of_sun.radiance * (1.0 / (of_sun.density + density));
                    let expected = (of_sun.direction, light, random(path.sample, 1)[1]);
                    assert_eq!((to_light.direction, to_light.light, to_light.random), expected, "{instructions:?}");
                    for number in 0..path.sharing.n_paths {
                        let sample = path.alone(number).sample;
                        let [choice, end] = random(sample, 1);
                        let expected = scattering.sample(choice, random(sample, 2));
                        let onward = onwards.next().unwrap();
                        let numbers = |sample: &ScatterSample| (sample.direction, sample.density, sample.is_diffuse);
                        assert_eq!(
                            (numbers(&onward.sample), onward.random),
                            (numbers(&expected), end),
                            "{instructions:?}"
                        );
                        if expected.density > 0.0 {
                            let escaped = lights.sun.toward(expected.direction).escaped(expected.density);
                            let escaped = lights.sky.radiance(expected.direction) + escaped;
                            assert_eq!((onward.sample.weight, onward.escaped), (expected.weight, escaped));
                            n_lit += 1;
                        }
                    }
                }
                assert!(onwards.next().is_none());
            }
        }
        assert!(n_lit > 100, "{n_lit} directions bring light");
    }
}
