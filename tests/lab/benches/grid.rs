//! Times building and traversing the grid, on generated models: `make bench`.
//!
//! It prints elapsed times and items a second. Everything but building runs on one thread.

use std::{hint::black_box, sync::LazyLock};

use divan::{Bencher, counter::ItemsCount};
use glam::Vec3;
use lab::{chart::view_all, random::Random};
use renderer::{
    grid::GridOptions,
    intersect::{
        ray::{Hit, Ray},
        triangle,
    },
    model::{
        mesh::{Aabb, Mesh},
        statue,
    },
    render::scene::Scene,
};
use shared::{
    camera::CameraRays,
    division::{Division, FrameSize, Share},
};

fn main() {
    divan::main();
}

/// The models: a surface like a scan's; scattered triangles of one size; and both at once, of very different sizes.
#[derive(Clone, Copy, Debug)]
enum Model {
    Statue,
    Soup,
    StatueInSoup,
}

const MODELS: [Model; 3] = [Model::Statue, Model::Soup, Model::StatueInSoup];

/// Triangles of each model.
const N_TRIANGLES: u32 = 200_000;

const FRAME: (u32, u32) = (512, 256);

impl Model {
    fn mesh(self) -> Mesh {
        match self {
            Self::Statue => statue::generate(N_TRIANGLES, &|_| ()),
            Self::Soup => soup(N_TRIANGLES, 1.0, 0.01),
            Self::StatueInSoup => {
                let mut mesh = statue::generate(N_TRIANGLES / 2, &|_| ());
                let soup = soup(N_TRIANGLES / 2, 1000.0, 5.0);
                let first = mesh.vertices.len() as u32;
                mesh.vertices.extend(soup.vertices);
                mesh.triangles.extend(soup.triangles.iter().map(|corners| corners.map(|corner| corner + first)));
                mesh
            }
        }
    }

    fn fixture(self) -> &'static Fixture {
        static FIXTURES: [LazyLock<Fixture>; 3] = [
            LazyLock::new(|| Fixture::new(Model::Statue)),
            LazyLock::new(|| Fixture::new(Model::Soup)),
            LazyLock::new(|| Fixture::new(Model::StatueInSoup)),
        ];
        &FIXTURES[self as usize]
    }
}

/// Triangles at random positions in a cube around the origin.
fn soup(n_triangles: u32, extent: f32, edge: f32) -> Mesh {
    let mut random = Random::new(1);
    let mut point = |size: f32| random.point() * size;
    let mut mesh = Mesh::default();
    for triangle in 0..n_triangles {
        let centre = point(extent);
        mesh.vertices.extend([(); 3].map(|()| (centre + point(edge)).to_array()));
        mesh.triangles.push([0, 1, 2].map(|corner| 3 * triangle + corner));
    }
    mesh
}

/// A model ready to be traced, seen by one camera.
struct Fixture {
    scene: Scene,
    rays: CameraRays,
    size: FrameSize,
}

impl Fixture {
    fn new(model: Model) -> Self {
        let mesh = model.mesh();
        // The camera always looks at the statue.
        let seen = match model {
            Model::StatueInSoup => Model::Statue.fixture().scene.mesh().bounds(),
            Model::Statue | Model::Soup => mesh.bounds(),
        };
        let scene = Scene::build(mesh, &GridOptions::default(), &|_| ());
        let size = FrameSize::new(FRAME.0, FRAME.1).expect("a frame of samples");
        let rays = view_all(seen, 16.0 / 9.0).rays(size);
        Self { scene, rays, size }
    }

    /// The directions of all samples, tile by tile.
    fn directions(&self) -> Vec<Vec3> {
        let mut directions = Vec::new();
        with_tiles(self.size, |share| {
            let samples = (0..share.count()).flat_map(|tile| share.samples(tile).iter());
            directions.extend(samples.map(|(i, j)| self.rays.direction(i, j)));
        });
        directions
    }
}

fn with_tiles(size: FrameSize, mut visit: impl FnMut(&Share)) {
    let task = Division::Tiled.task(0, 1);
    visit(&task.share(size).expect("a whole frame"));
}

/// Building, on all cores.
#[divan::bench(args = MODELS, sample_count = 10, sample_size = 1)]
fn build(bencher: Bencher, model: Model) {
    bencher
        .counter(ItemsCount::new(N_TRIANGLES))
        .with_inputs(|| model.mesh())
        .bench_values(|mesh| Scene::build(mesh, &GridOptions::default(), &|_| ()));
}

/// Camera rays in packets, with this machine's best instructions.
#[divan::bench(args = MODELS, sample_count = 20, sample_size = 1)]
fn packets(bencher: Bencher, model: Model) {
    let fixture = model.fixture();
    let mut hits: Vec<Hit> = Vec::with_capacity(fixture.size.n_samples() as usize);
    bencher.counter(ItemsCount::new(fixture.size.n_samples())).bench_local(|| {
        hits.clear();
        with_tiles(fixture.size, |share| {
            fixture
                .scene
                .trace(&fixture.rays, None, share, 0..share.count(), |_, tile_hits| hits.extend_from_slice(tile_hits));
        });
        hits.len()
    });
}

/// The same rays one by one.
#[divan::bench(args = MODELS, sample_count = 10, sample_size = 1)]
fn single_rays(bencher: Bencher, model: Model) {
    let fixture = model.fixture();
    let directions = fixture.directions();
    bencher.counter(ItemsCount::new(directions.len())).bench_local(|| {
        for &direction in &directions {
            black_box(fixture.scene.grid().intersect(&Ray::new(fixture.rays.eye, direction)));
        }
    });
}

/// Shadow rays from the hits to a light above them.
#[divan::bench(args = MODELS, sample_count = 10, sample_size = 1)]
fn occlusion(bencher: Bencher, model: Model) {
    let fixture = model.fixture();
    let Aabb { min, max } = fixture.scene.mesh().bounds();
    let [min, max] = [min, max].map(Vec3::from_array);
    let light = max + (max - min);
    let shadow_ray = |direction| {
        let hit = fixture.scene.grid().intersect(&Ray::new(fixture.rays.eye, direction));
        let origin = fixture.rays.eye + direction * hit.t;
        (!hit.is_miss()).then(|| Ray { origin, direction: light - origin, t_min: 1e-4, t_max: 1.0 })
    };
    let shadow_rays: Vec<_> = fixture.directions().into_iter().filter_map(shadow_ray).collect();
    bencher
        .counter(ItemsCount::new(shadow_rays.len()))
        .bench_local(|| shadow_rays.iter().filter(|ray| fixture.scene.grid().occluded(ray)).count());
}

/// Pairs of ray and triangle: through its centre, beside it, and through a corner, which needs the exact test.
#[divan::bench(args = ["hit", "miss", "edge"], sample_count = 100)]
fn intersection(bencher: Bencher, outcome: &str) {
    const N_PAIRS: u32 = 1024;
    let mesh = soup(N_PAIRS, 1.0, 0.1);
    let origin = Vec3::new(0.0, 0.0, 4.0);
    let pairs: Vec<_> = (0..N_PAIRS as usize)
        .filter_map(|triangle| mesh.corners(triangle))
        .map(|corners| {
            let [a, b, c] = corners.map(Vec3::from_array);
            let target = match outcome {
                "hit" => (a + b + c) / 3.0,
                "miss" => a + (a - b) + (a - c),
                _ => a,
            };
            (Ray::new(origin, target - origin), corners)
        })
        .collect();
    bencher.counter(ItemsCount::new(N_PAIRS)).bench_local(|| {
        pairs.iter().filter(|(ray, corners)| triangle::intersect(black_box(ray), corners).is_some()).count()
    });
}
