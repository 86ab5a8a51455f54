//! Lays the canvas onto a wall that is not flat, and makes projectors' meshes.
//!
//! A cylinder's canvas may slide around it and up, and a dome's turn about its centre. Photographs do not tell the size of a
//! fold, so its canvas may slide up and be scaled about the edge.

use std::sync::Arc;

use glam::{DMat3, DQuat, DVec2, DVec3};

use super::{bent::BentSolution, fitting::median};
use crate::wall::{Projector, Surface, Wall, homography::apply, mesh::Mesh};

/// Where the canvas lies on the wall that was solved.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Unrolled {
    /// The place that stays when the scale changes: on the fold's edge.
    centre: DVec2,
    scale: f64,
    by_m: DVec2,
    /// The turn of a dome about its centre.
    turn: Option<(Surface, DQuat)>,
}

/// Points of the canvas, each way, that must be lit.
const N_LIT: [u32; 2] = [49, 17];

impl Unrolled {
    /// The place on the solved wall of a point of the canvas, both in metres.
    fn solved(&self, canvas_m: DVec2) -> DVec2 {
        self.turned(self.centre + self.scale * (canvas_m - self.centre) + self.by_m, |turn| turn)
    }

    /// The point of the canvas at a place on the solved wall.
    fn canvas(&self, solved: DVec2) -> DVec2 {
        self.centre + (self.turned(solved, DQuat::inverse) - self.by_m - self.centre) / self.scale
    }

    fn turned(&self, place: DVec2, of: impl Fn(DQuat) -> DQuat) -> DVec2 {
        let Some((surface, turn)) = self.turn else { return place };
        let centre = surface.middle(0.0);
        // From the centre, every ray meets the sphere.
        surface.met(centre, of(turn) * (surface.in_space(place) - centre)).unwrap_or(place)
    }

    /// Where the solved wall has it, because projectors were held there.
    pub(super) fn as_solved() -> Self {
        Self { centre: DVec2::ZERO, scale: 1.0, by_m: DVec2::ZERO, turn: None }
    }

    /// Where the wall file has the canvas, on average.
    pub(super) fn kept(wall: &Wall, surface: Surface, solution: &BentSolution) -> Self {
        let of_projector = |(index, projector)| {
            solution.crossings(index).map(move |[px, place]| [place_in_file(wall, projector, px), place])
        };
        let pairs: Vec<[DVec2; 2]> = wall.projectors().iter().enumerate().flat_map(of_projector).collect();
        let mut unrolled = Self::as_solved();
        let median_of =
            |it: &Self, axis: usize| median(pairs.iter().map(|pair| (pair[1] - it.solved(pair[0]))[axis]).collect());
        match surface {
            Surface::Cylinder { .. } => unrolled.by_m = DVec2::new(median_of(&unrolled, 0), median_of(&unrolled, 1)),
            Surface::Fold { at_m, .. } => {
                unrolled.centre.x = at_m;
                // Near the edge the ratio says nothing.
                let far = pairs.iter().filter(|pair| (pair[0].x - at_m).abs() > 0.1 * wall.canvas_m()[0]);
                unrolled.scale = median(far.map(|[in_file, solved]| (solved.x - at_m) / (in_file.x - at_m)).collect());
                unrolled.by_m = DVec2::new(0.0, median_of(&unrolled, 1));
            }
            Surface::Dome { .. } => {
                let centre = surface.middle(0.0);
                let rays = pairs.iter().map(|pair| pair.map(|place| (surface.in_space(place) - centre).normalize()));
                unrolled.turn = Some((surface, turn_between(&rays.collect::<Vec<_>>())));
            }
        }
        unrolled
    }

    /// The same with the canvas moved along the wall.
    fn moved(&self, by_m: DVec2) -> Self {
        let turn = self.turn.map(|(surface, turn)| {
            let angles = by_m / surface.middle(0.0).z;
            // To the right is clockwise from above.
            let about = DQuat::from_rotation_y(-angles.x) * DQuat::from_rotation_x(angles.y);
            (surface, turn * about)
        });
        Self { by_m: if turn.is_some() { self.by_m } else { self.by_m + by_m }, turn, ..*self }
    }

    /// As large as possible with all of the canvas lit, near where it is; if that is impossible, with as much of it lit as
    /// can be.
    pub(super) fn largest(self, wall: &Wall, surface: Surface, solution: &BentSolution) -> Self {
        let canvas_m = DVec2::from(wall.canvas_m());
        let steps = |n: i32| (-n..=n).map(|step| 0.01 * f64::from(step));
        let (scales, asides): (Vec<f64>, Vec<f64>) = match surface {
            Surface::Cylinder { .. } | Surface::Dome { .. } => (vec![1.0], steps(12).collect()),
            Surface::Fold { .. } => ((0..=80).map(|step| 1.4 - 0.01 * f64::from(step)).collect(), vec![0.0]),
        };
        let mut best = (0, f64::NEG_INFINITY, self);
        for scale in scales {
            // Scaled about the middle of its height.
            let up = DVec2::new(0.0, self.scale * (1.0 - scale) * canvas_m.y / 2.0);
            let scaled = Self { scale: self.scale * scale, ..self };
            for (x, y) in asides.iter().flat_map(|x| steps(20).map(move |y| (*x, y))) {
                let moved = scaled.moved(up + DVec2::new(x, y) * canvas_m);
                let (n_lit, nearness) = (moved.n_lit(wall, solution, best.0), -x.hypot(y));
                if (n_lit, nearness) > (best.0, best.1) {
                    best = (n_lit, nearness, moved);
                }
            }
            if best.0 == N_LIT[0] * N_LIT[1] {
                break;
            }
        }
        best.2
    }

    /// The part of the canvas that is lit.
    pub(super) fn lit(&self, wall: &Wall, solution: &BentSolution) -> f64 {
        f64::from(self.n_lit(wall, solution, 0)) / f64::from(N_LIT[0] * N_LIT[1])
    }

    /// The number of points of the canvas that are lit, or less than `least`.
    fn n_lit(&self, wall: &Wall, solution: &BentSolution, least: u32) -> u32 {
        let mut n_possible = N_LIT[0] * N_LIT[1];
        for (x, y) in (0..N_LIT[1]).flat_map(|y| (0..N_LIT[0]).map(move |x| (x, y))) {
            let part = DVec2::new(f64::from(x), f64::from(y)) / DVec2::from(N_LIT.map(|n| f64::from(n - 1)));
            let place = self.solved(part * DVec2::from(wall.canvas_m()));
            let is_lit = (0..wall.projectors().len()).any(|index| solution.lights(index, place));
            n_possible -= u32::from(!is_lit);
            if n_possible < least {
                break;
            }
        }
        n_possible
    }

    /// A projector with the mesh that shows its part of the canvas; the mesh has no file yet. `None` if it was not solved,
    /// or its pixels make no mesh.
    pub(super) fn projector(
        &self,
        wall: &Wall,
        surface: Surface,
        solution: &BentSolution,
        index: usize,
    ) -> Option<Projector> {
        // Beside a fold a mesh is off by up to a fifth of the distance between its points.
        let spacing = match surface {
            Surface::Cylinder { .. } | Surface::Dome { .. } => 24,
            Surface::Fold { .. } => 4,
        };
        let plain = Projector { warp_px: [[0.0; 2]; 4], mesh: None, ..wall.projectors()[index].clone() };
        let n_points =
            plain.upright_size().map(|side| (side.div_ceil(spacing) as usize + 1).min(Mesh::MOST_POINTS_A_SIDE));
        let raster_from_upright = plain.raster_from_upright();
        let point = |n: usize| {
            let [column, row] = [n % n_points[0], n / n_points[0]].map(|it| it as f64);
            let upright = DVec2::new(column / (n_points[0] - 1) as f64, row / (n_points[1] - 1) as f64);
            let px = raster_from_upright.transform_point2(upright) * plain.output.size();
            Some(self.canvas(solution.place_at(index, px)?) / DVec2::from(wall.canvas_m()))
        };
        let points: Vec<DVec2> = (0..n_points[0] * n_points[1]).map(point).collect::<Option<_>>()?;
        let mesh = Mesh::new(String::new(), n_points, &points).ok()?;
        Some(plain.with_mesh(Arc::new(mesh)))
    }
}

/// The turn that takes the first rays of pairs to the second ones; pairs that do not fit count little.
///
/// Small turns from none, each by linear equations, with Cauchy's weights.
fn turn_between(pairs: &[[DVec3; 2]]) -> DQuat {
    let mut turn = DQuat::IDENTITY;
    for _ in 0..30 {
        let away = |pair: &[DVec3; 2]| (turn * pair[0]).distance(pair[1]);
        let scale = (3.0 * median(pairs.iter().map(away).collect())).max(1e-12);
        let (mut matrix, mut right) = (DMat3::ZERO, DVec3::ZERO);
        for pair in pairs {
            let weight = 1.0 / (1.0 + (away(pair) / scale).powi(2));
            let ray = turn * pair[0];
            let outer = DMat3::from_cols(ray * ray.x, ray * ray.y, ray * ray.z);
            matrix += weight * (DMat3::IDENTITY - outer);
            right += weight * ray.cross(pair[1]);
        }
        let step = matrix.inverse() * right;
        if !step.is_finite() {
            break;
        }
        turn = (DQuat::from_scaled_axis(step) * turn).normalize();
    }
    turn
}

/// The place, in metres of the canvas, where the wall file has a projector's pixel.
pub(super) fn place_in_file(wall: &Wall, projector: &Projector, px: DVec2) -> DVec2 {
    let image = projector.raster_from_image().and_then(|map| apply(map.inverse(), px / projector.output.size()));
    let rect_point = projector.rect_at(image.unwrap_or(DVec2::splat(0.5)));
    projector.canvas.canvas_from_rect(rect_point) * DVec2::from(wall.canvas_m())
}
