//! A wall in the virtual room: its file, where its projectors truly stand, and how well both agree.

use std::sync::Arc;

use compositor::{
    calibration::{Codebook, Photograph, Plan, Reading},
    wall::{PixelRect, Wall, mesh::Mesh},
};
use glam::{DVec2, DVec3};

use super::{
    camera::{Camera, Obstacle, Pinhole, Random, decoded},
    geometry,
    projector::{TrueLight, TrueProjector},
    surface::Surface,
};

/// A wall file, and the projectors that it is to describe.
#[derive(Clone, Debug)]
pub(crate) struct Rig {
    pub(crate) surface: Surface,
    pub(crate) wall: Wall,
    pub(crate) projectors: Vec<TrueProjector>,
}

/// How well a wall agrees with the room, in pixels of its projectors.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Agreement {
    /// Distances between the places where two projectors show the same point: median and 99 of 100.
    pub(crate) apart_px: [f64; 2],
    /// The farthest that a straight line of the picture departs from a line on the wall.
    pub(crate) bent_px: f64,
}

impl Rig {
    /// A grid of projectors two metres from the wall, which overlap a little more than the file says; each stands and aims
    /// up to `askew` of a width from where it should. `turned` adds tables to the wall file.
    pub(crate) fn new([columns, rows]: [u32; 2], [width, height]: [u32; 2], askew: f64, turned: &str) -> Self {
        let canvas_m = [f64::from(columns), 0.75 * f64::from(rows)];
        let text = format!(
            "# Ours.\ncanvas_m = {canvas_m:?}\n[grid]\ncolumns = {columns}\nrows = {rows}\npixels = [{width}, {height}]\n\
             overlap = [0.1, 0.1]\n{turned}"
        );
        let wall = Wall::from_toml("rig.toml", &text).expect("a wall");
        let mut random = Random::new(7);
        let stand = |projector: &compositor::wall::Projector| {
            let canvas_m = DVec2::from(canvas_m);
            let rect = projector.canvas;
            let size_m = DVec2::new(rect.width, rect.height) * canvas_m;
            let centre = DVec2::new(rect.left, rect.bottom) * canvas_m + size_m / 2.0;
            let mut astray = || DVec2::new(random.around(1.0), random.around(1.0)) * askew * size_m.x;
            let (stands, aims) = (centre + 6.0 * astray(), centre + astray());
            let position = stands.extend(2.0 + astray().x);
            let size_px = DVec2::new(width.into(), height.into());
            // It lights a little more than its part of the canvas.
            let focal_px = size_px.x * position.z / size_m.x * 0.96;
            let roll = f64::from(projector.rotation.degrees()).to_radians() + astray().x;
            TrueProjector {
                pinhole: Pinhole::new(Surface::Flat, position, aims, roll, focal_px, size_px / 2.0),
                size: [width as usize, height as usize],
                is_mirrored: projector.flip != compositor::wall::Flip::None,
                light: Arc::new(TrueLight::usual()),
                shown: Vec::new(),
            }
        };
        let projectors = wall.projectors().iter().map(stand).collect();
        Self { surface: Surface::Flat, wall, projectors }
    }

    /// Projectors side by side on a wall of any shape, which overlap by more than a tenth; each stands straight before its
    /// part of the wall, up to `askew` of its width beside. `keys` and `turned` are added to the wall file.
    pub(crate) fn on(
        surface: Surface,
        canvas_m: [f64; 2],
        n_projectors: u32,
        pixels: [u32; 2],
        askew: f64,
        [keys, turned]: [&str; 2],
    ) -> Self {
        let text = format!(
            "# Ours.\ncanvas_m = {canvas_m:?}\n{keys}[grid]\ncolumns = {n_projectors}\nrows = 1\npixels = {pixels:?}\n\
             overlap = [0.1, 0.0]\n{turned}"
        );
        let wall = Wall::from_toml("rig.toml", &text).expect("a wall");
        let mut random = Random::new(11);
        let stand = |projector: &compositor::wall::Projector| {
            let rect = projector.canvas;
            let size_m = DVec2::new(rect.width, rect.height) * DVec2::from(canvas_m);
            let centre = DVec2::new(rect.left, rect.bottom) * DVec2::from(canvas_m) + size_m / 2.0;
            let mut astray = || DVec2::new(random.around(1.0), random.around(1.0)) * askew * size_m.x;
            let away_m = 1.2 * size_m.x;
            let position =
                surface.in_space(centre) + away_m * surface.normal(centre) + (3.0 * astray()).extend(astray().x);
            let size_px = projector.output.size();
            // Its light is wide enough where the wall comes towards it.
            let focal_px = size_px.x * away_m / size_m.x * 0.72;
            let roll = f64::from(projector.rotation.degrees()).to_radians() + astray().x;
            TrueProjector {
                pinhole: Pinhole::new(surface, position, centre + astray(), roll, focal_px, size_px / 2.0),
                size: pixels.map(|side| side as usize),
                is_mirrored: projector.flip != compositor::wall::Flip::None,
                light: Arc::new(TrueLight::usual()),
                shown: Vec::new(),
            }
        };
        let projectors = wall.projectors().iter().map(stand).collect();
        Self { surface, wall, projectors }
    }

    /// The wall with the meshes that are true in the room, of so many control points.
    pub(crate) fn true_wall(&self, n_points: [usize; 2]) -> Wall {
        let with_mesh = |(projector, stands): (&compositor::wall::Projector, &TrueProjector)| {
            let place = |n: usize| {
                let [x, y] = [(n % n_points[0], n_points[0]), (n / n_points[0], n_points[1])]
                    .map(|(index, n)| index as f64 / (n - 1) as f64);
                let [columns, rows] = projector.upright_size().map(f64::from);
                let px = geometry::stored_px(projector, [x * columns, y * rows]);
                stands.point(px.into()) / DVec2::from(self.wall.canvas_m())
            };
            let points: Vec<DVec2> = (0..n_points[0] * n_points[1]).map(place).collect();
            let mesh = Mesh::new(format!("{}.pfm", projector.name), n_points, &points).expect("a mesh");
            projector.clone().with_mesh(Arc::new(mesh))
        };
        let projectors = self.wall.projectors().iter().zip(&self.projectors).map(with_mesh).collect();
        Wall::new(self.wall.canvas_m(), self.wall.frame_size(), projectors).expect("a wall")
    }

    /// A camera on a tripod or in a hand, `away` metres from the wall, that looks at a part of the canvas.
    pub(crate) fn camera(&self, size: [usize; 2], at: DVec3, target: DVec2, focal: f64) -> Camera {
        let size_px = DVec2::new(size[0] as f64, size[1] as f64);
        let centre_px = size_px / 2.0 + DVec2::new(0.004, -0.003) * size_px.x;
        Camera {
            pinhole: Pinhole::new(self.surface, at, target, 0.015, focal * size_px.x, centre_px),
            size,
            radial: [-0.09, 0.03, -0.004],
            tangential: [0.0005, -0.0003],
            exposure: 0.85,
            ambient: 0.06,
            noise: 0.03,
            blur_px: 0.7,
            jpeg: None,
            colours: None,
        }
    }

    /// Projects a pattern; projectors that are `off` stay dark.
    pub(crate) fn show(&mut self, plan: &Plan, pattern: u32, off: &[usize]) {
        for (index, projector) in self.projectors.iter_mut().enumerate() {
            let part: PixelRect = self.wall.projectors()[index].output;
            let is_off = off.contains(&index);
            projector.shown = if is_off { Vec::new() } else { plan.draw(pattern, &self.wall, part) };
        }
    }

    /// Photographs what is shown, and reads the photograph.
    pub(crate) fn read(
        &self,
        camera: &Camera,
        codebook: &Codebook<'_>,
        name: &str,
        obstacle: Option<Obstacle>,
        seed: u64,
    ) -> Reading {
        let (values, colours) = decoded(&camera.photograph(&self.projectors, obstacle, seed));
        let colour_at =
            |x: usize, y: usize| colours.get_pixel(x as u32, y as u32).0.map(|value| f32::from(value) / 255.0);
        Reading::with_colours(name.to_owned(), &Photograph { size: camera.size, values }, &colour_at, codebook)
    }

    /// Gives each projector a light of its own: lamps of different age, and lenses that are not quite straight.
    pub(crate) fn with_lights(mut self, seed: u64) -> Self {
        let mut random = Random::new(seed);
        for projector in &mut self.projectors {
            let mut around = |middle: f64, most: f64| middle + random.around(most);
            let lamp = around(0.9, 0.1);
            let white = [0, 1, 2].map(|_| lamp * around(0.96, 0.04));
            let black = around(0.004, 0.002);
            let brightest = DVec2::new(around(0.5, 0.1), around(0.5, 0.1));
            let light = TrueLight::new(around(2.2, 0.25), white, [black; 3], brightest, around(0.3, 0.1));
            projector.light = Arc::new(light);
        }
        self
    }

    /// How well the wall's file and the room agree if it has the corners of `wall`.
    pub(crate) fn agreement(&self, wall: &Wall) -> Agreement {
        let canvas_m = wall.canvas_m();
        let maps: Vec<_> = wall.projectors().iter().map(|it| geometry::px_from_m(it, canvas_m)).collect();
        // Each projector that shows a point of the canvas, and the place on the wall where it does.
        let places = |part: DVec2| -> Vec<(usize, DVec2)> {
            let place = |index: usize| {
                let projector = &wall.projectors()[index];
                let rect_point = projector.canvas.rect_from_canvas(part);
                let px = DVec2::from(geometry::image(&maps[index], (part * DVec2::from(canvas_m)).to_array())?);
                let is_shown = rect_point.cmpge(DVec2::ZERO).all()
                    && rect_point.cmple(DVec2::ONE).all()
                    && px.cmpge(DVec2::ZERO).all()
                    && px.cmple(projector.output.size()).all();
                is_shown.then(|| (index, self.projectors[index].point(px)))
            };
            (0..maps.len()).filter_map(place).collect()
        };
        let mut apart = Vec::new();
        let side = |n: u32, of: u32| (f64::from(n) + 0.5) / f64::from(of);
        for (x, y) in (0..240).flat_map(|y| (0..240).map(move |x| (x, y))) {
            let shown = places(DVec2::new(side(x, 240), side(y, 240)));
            for (n, (a, at_a)) in shown.iter().enumerate() {
                let projector = &self.projectors[*a];
                apart.extend(shown[..n].iter().map(|(_, at_b)| projector.px(*at_a).distance(projector.px(*at_b))));
            }
        }
        apart.sort_by(f64::total_cmp);
        let quantile = |part: f64| apart[((apart.len() - 1) as f64 * part) as usize];
        Agreement { apart_px: [quantile(0.5), quantile(0.99)], bent_px: self.bent_px(&places) }
    }

    /// The same for a wall with meshes: distances between places where two projectors show the same point, and the
    /// least and the greatest ratio of distances along the canvas to those on the wall.
    pub(crate) fn agreement_of_meshes(&self, wall: &Wall) -> ([f64; 2], [f64; 2]) {
        let mut apart = Vec::new();
        let mut lands: Vec<[DVec2; 2]> = Vec::new();
        for (index, projector) in wall.projectors().iter().enumerate() {
            let size = projector.output.size();
            for n in 0..96 * 72 {
                let px = (DVec2::new(f64::from(n % 96), f64::from(n / 96)) + 0.5) / DVec2::new(96.0, 72.0) * size;
                let canvas = wall.canvas_at(projector.output.origin() + px);
                if canvas.cmplt(DVec2::ZERO).any() || canvas.cmpgt(DVec2::ONE).any() {
                    continue;
                }
                let place = self.projectors[index].point(px);
                lands.push([canvas * DVec2::from(wall.canvas_m()), place]);
                for (other, stands) in wall.projectors().iter().zip(&self.projectors).take(index) {
                    // Where the other projector shows the same point of the canvas.
                    let image = other.image_at(other.canvas.rect_from_canvas(canvas));
                    let is_shown = image.cmpge(DVec2::ZERO).all() && image.cmple(DVec2::ONE).all();
                    let [columns, rows] = other.upright_size().map(f64::from);
                    let other_px = geometry::stored_px(other, [image.x * columns, image.y * rows]);
                    if is_shown {
                        apart.push(self.projectors[index].px(stands.point(other_px.into())).distance(px));
                    }
                }
            }
        }
        apart.sort_by(f64::total_cmp);
        let quantile = |part: f64| apart[((apart.len() - 1) as f64 * part) as usize];
        // Some of a projector's points, and those in the middle of the next one's.
        let mut stretched = [f64::INFINITY, 0.0];
        for (a, b) in lands.iter().step_by(97).zip(lands.iter().skip(lands.len() / 5).step_by(97)) {
            // Straight through the room: no layout of a dome keeps all distances.
            let [on_canvas, on_wall] =
                [0, 1].map(|side| self.surface.in_space(a[side]).distance(self.surface.in_space(b[side])));
            if on_wall > 0.2 {
                stretched = [f64::min(stretched[0], on_canvas / on_wall), f64::max(stretched[1], on_canvas / on_wall)];
            }
        }
        ([quantile(0.5), quantile(0.99)], stretched)
    }

    /// Where the corners of the canvas lie on the wall: upper left, upper right, lower right, lower left.
    pub(crate) fn canvas_corners(&self, wall: &Wall) -> [DVec2; 4] {
        [[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]].map(|corner| {
            let (corner, canvas_m) = (DVec2::from(corner), DVec2::from(wall.canvas_m()));
            let inside = |at: &DVec2| at.cmpge(DVec2::splat(-1e-6)).all() && at.cmple(DVec2::splat(1.0 + 1e-6)).all();
            let index = wall.projectors().iter().position(|it| inside(&it.canvas.rect_from_canvas(corner)));
            let index = index.expect("projectors cover the canvas");
            let map = geometry::px_from_m(&wall.projectors()[index], wall.canvas_m());
            let px = geometry::image(&map, (corner * canvas_m).to_array()).expect("before the horizon");
            self.projectors[index].point(px.into())
        })
    }

    fn bent_px(&self, places: &dyn Fn(DVec2) -> Vec<(usize, DVec2)>) -> f64 {
        let mut lines: Vec<[DVec2; 2]> = vec![[DVec2::ZERO, DVec2::ONE], [DVec2::Y, DVec2::X]];
        for n in 0..=20 {
            let part = f64::from(n) / 20.0;
            lines.push([DVec2::new(0.0, part), DVec2::new(1.0, part)]);
            lines.push([DVec2::new(part, 0.0), DVec2::new(part, 1.0)]);
        }
        let mut farthest: f64 = 0.0;
        for [from, to] in lines {
            let seen: Vec<(usize, DVec2)> =
                (0..=400).flat_map(|n| places(from.lerp(to, f64::from(n) / 400.0))).collect();
            let centre = seen.iter().map(|(_, at)| *at).sum::<DVec2>() / seen.len() as f64;
            // The direction of least squares.
            let [mut xx, mut xy, mut yy] = [0.0; 3];
            for (_, at) in &seen {
                let away = *at - centre;
                (xx, xy, yy) = (xx + away.x * away.x, xy + away.x * away.y, yy + away.y * away.y);
            }
            let direction = DVec2::from_angle(0.5 * (2.0 * xy).atan2(xx - yy));
            for (index, at) in seen {
                let on_line = centre + direction * direction.dot(at - centre);
                let projector = &self.projectors[index];
                farthest = farthest.max(projector.px(at).distance(projector.px(on_line)));
            }
        }
        farthest
    }
}
