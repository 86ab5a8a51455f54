//! Adjusts lens, cameras and projectors together on a wall of a known shape: bundle adjustment (Triggs et al. 1999).
//!
//! A camera's ray through a crossing meets the wall at a point in space, which the projector's matrix takes to its pixels.
//! A curved wall shows the cameras' places and focal length, so nothing has to be calibrated before.

use glam::{DMat2, DQuat, DVec2, DVec3, DVec4};

use super::{
    fitting::{median, solve_symmetric},
    lens::Lens,
};
use crate::wall::Surface;

/// A crossing in a photograph.
#[derive(Clone, Copy, Debug)]
pub(super) struct Seen {
    pub shot: usize,
    pub projector: usize,
    /// Normalised, in the photograph.
    pub at: DVec2,
    /// In the projector's pixels, in units of their number: from about -1 to 1.
    pub px: DVec2,
    /// Pixels to such a unit.
    pub px_per_unit: f64,
    /// Where it is known to lie; `None` if its projector may stand anywhere.
    pub held: Option<Held>,
}

/// The place of a crossing of a projector that has not moved.
#[derive(Clone, Copy, Debug)]
pub(super) struct Held {
    /// On the unrolled wall, in metres.
    pub place: DVec2,
    /// How pixels, as in [`Seen::px`], change with the place.
    pub px_by_place: DMat2,
}

/// Where a camera stands, and how it is turned: x right, y down, z ahead.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pose {
    pub position: DVec3,
    pub rotation: DQuat,
}

/// From points in space to a projector's pixels: the rows of a homogeneous matrix.
pub(super) type Projection = [DVec4; 3];

/// All that is adjusted.
#[derive(Clone, Debug)]
pub(super) struct Bundle {
    pub lens: Lens,
    /// In halves of the photograph's diagonal.
    pub focal: f64,
    pub poses: Vec<Option<Pose>>,
    pub projections: Vec<Option<Projection>>,
}

const N_LENS: usize = Lens::N + 1;
const N_POSE: usize = 6;
const N_PROJECTION: usize = 12;
/// Rounds of adjusting; most walls take less than a hundred.
const MOST_ROUNDS: usize = 400;
/// The step by which slopes are found.
const STEP: f64 = 1e-7;
/// A ray that misses the wall counts as so many units off.
const MISSED: f64 = 1.0;

/// The image of a point in space.
pub(super) fn projected(rows: &Projection, point: DVec3) -> Option<DVec2> {
    let [x, y, depth] = rows.map(|row| row.dot(point.extend(1.0)));
    (depth > 1e-9).then(|| DVec2::new(x, y) / depth)
}

impl Pose {
    fn moved(&self, by: &[f64]) -> Self {
        let turn = DQuat::from_scaled_axis(DVec3::new(by[3], by[4], by[5]));
        Self { position: self.position + DVec3::new(by[0], by[1], by[2]), rotation: (self.rotation * turn).normalize() }
    }
}

impl Bundle {
    /// The place on the wall that a shot shows at a normalised place.
    pub(super) fn place(&self, surface: &Surface, pose: &Pose, at: DVec2) -> Option<DVec2> {
        let slope = self.lens.undistorted(at).at / self.focal;
        surface.met(pose.position, pose.rotation * slope.extend(1.0))
    }

    /// From where a crossing should be to where it was seen, in pixels of its projector.
    pub(super) fn miss_px(&self, surface: &Surface, seen: &Seen) -> DVec2 {
        -self.away(surface, seen).unwrap_or(MISSED * DVec2::X) * seen.px_per_unit
    }

    fn away(&self, surface: &Surface, seen: &Seen) -> Option<DVec2> {
        let place = self.place(surface, self.poses[seen.shot].as_ref()?, seen.at)?;
        if let Some(Held { place: known, px_by_place }) = seen.held {
            return Some(px_by_place * (known - place));
        }
        Some(seen.px - projected(self.projections[seen.projector].as_ref()?, surface.in_space(place))?)
    }

    fn with_lens(&self, by: &[f64]) -> Self {
        let mut coefficients = self.lens.coefficients;
        coefficients.iter_mut().zip(by).for_each(|(it, by)| *it += by);
        let focal = self.focal * by[Lens::N].clamp(-1.0, 1.0).exp();
        Self { lens: Lens { coefficients }, focal, poses: Vec::new(), projections: Vec::new() }
    }

    fn moved(&self, by: &[f64]) -> Self {
        let mut moved = self.with_lens(&by[..N_LENS]);
        let mut rest = &by[N_LENS..];
        let mut next = |n: usize| {
            let (now, later) = rest.split_at(n);
            rest = later;
            now
        };
        moved.poses = self
            .poses
            .iter()
            .map(|pose| {
                let by = next(N_POSE);
                pose.map(|pose| pose.moved(by))
            })
            .collect();
        moved.projections = self
            .projections
            .iter()
            .map(|rows| {
                let by = next(N_PROJECTION);
                rows.map(|rows| {
                    let rows: Projection = std::array::from_fn(|n| rows[n] + DVec4::from_slice(&by[4 * n..]));
                    // Their scale is free.
                    let scale = rows.iter().map(|row| row.length_squared()).sum::<f64>().sqrt();
                    rows.map(|row| row / scale)
                })
            })
            .collect();
        moved
    }

    /// The sum of Cauchy's losses, and of the lens's distance from none.
    fn cost(&self, surface: &Surface, seen: &[Seen], scale: f64) -> f64 {
        let loss = |away: f64| scale * scale * (away / scale).powi(2).ln_1p();
        let prior: f64 =
            self.lens.coefficients.iter().zip(Lens::SPREAD).map(|(it, spread)| (it / spread).powi(2)).sum();
        seen.iter().map(|it| loss(self.away(surface, it).map_or(MISSED, DVec2::length))).sum::<f64>() + 1e-6 * prior
    }

    fn scale(&self, surface: &Surface, seen: &[Seen]) -> f64 {
        3.0 * median(seen.iter().map(|it| self.away(surface, it).map_or(MISSED, DVec2::length)).collect()).max(1e-6)
    }

    /// The bundle that fits best, by the method of Levenberg and Marquardt with Cauchy's weights.
    pub(super) fn adjusted(mut self, surface: &Surface, seen: &[Seen]) -> Self {
        let (mut scale, mut damping) = (self.scale(surface, seen), 1e-3);
        for _ in 0..MOST_ROUNDS {
            let before = self.cost(surface, seen, scale);
            let (matrix, right) = self.normal_equations(surface, seen, scale);
            let (next, now) = loop {
                let next = step(&matrix, &right, damping).map(|step| self.moved(&step));
                let next = next.map(|next| (next.cost(surface, seen, scale), next));
                match next {
                    Some((now, next)) if now <= before => break (next, now),
                    _ if damping > 1e9 => return self,
                    _ => damping *= 10.0,
                }
            };
            self = next;
            damping = (damping * 0.2).max(1e-12);
            let next_scale = self.scale(surface, seen).min(scale);
            if before - now <= 1e-8 * before && next_scale > 0.999 * scale {
                break;
            }
            scale = next_scale;
        }
        self
    }

    /// The matrix of the normal equations, row by row, and their right side.
    fn normal_equations(&self, surface: &Surface, seen: &[Seen], scale: f64) -> (Vec<f64>, Vec<f64>) {
        let n = N_LENS + N_POSE * self.poses.len() + N_PROJECTION * self.projections.len();
        let (mut matrix, mut right) = (vec![0.0; n * n], vec![0.0; n]);
        for (at, (value, spread)) in self.lens.coefficients.iter().zip(Lens::SPREAD).enumerate() {
            matrix[at * n + at] += 1e-6 / (spread * spread);
            right[at] -= 1e-6 * value / (spread * spread);
        }
        for it in seen {
            let Some(pose) = &self.poses[it.shot] else { continue };
            let rows = self.projections[it.projector].as_ref();
            let slopes = match (it.held, rows) {
                (Some(held), _) => self.slopes_of_held(surface, it, pose, held),
                (None, Some(rows)) => self.slopes(surface, it, pose, rows),
                (None, None) => None,
            };
            let Some(slopes) = slopes else { continue };
            let away = slopes.away;
            let weight = 1.0 / (1.0 + away.length_squared() / (scale * scale));
            let places = |n: usize| match n {
                n if n < N_LENS => n,
                n if n < N_LENS + N_POSE => N_LENS + N_POSE * it.shot + n - N_LENS,
                n => N_LENS + N_POSE * self.poses.len() + N_PROJECTION * it.projector + n - N_LENS - N_POSE,
            };
            for (a, slope) in slopes.by.iter().enumerate() {
                let row = places(a);
                for (b, other) in slopes.by.iter().enumerate() {
                    matrix[row * n + places(b)] += weight * slope.dot(*other);
                }
                right[row] += weight * slope.dot(away);
            }
        }
        (matrix, right)
    }

    /// How far a crossing is off, and the changes of its image with lens, pose and projection.
    fn slopes(&self, surface: &Surface, seen: &Seen, pose: &Pose, rows: &Projection) -> Option<Slopes> {
        let point = surface.in_space(self.place(surface, pose, seen.at)?);
        let px = projected(rows, point)?;
        let depth = rows[2].dot(point.extend(1.0));
        let mut by = [DVec2::ZERO; N_LENS + N_POSE + N_PROJECTION];
        let (x, y) = ((rows[0] - rows[2] * px.x).truncate() / depth, (rows[1] - rows[2] * px.y).truncate() / depth);
        for (n, slope) in by[..N_LENS + N_POSE].iter_mut().enumerate() {
            let by_point = (surface.in_space(self.place_after(surface, seen, pose, n)?) - point) / STEP;
            *slope = DVec2::new(x.dot(by_point), y.dot(by_point));
        }
        let point = point.extend(1.0) / depth;
        for n in 0..4 {
            by[N_LENS + N_POSE + n] = DVec2::X * point[n];
            by[N_LENS + N_POSE + 4 + n] = DVec2::Y * point[n];
            by[N_LENS + N_POSE + 8 + n] = -px * point[n];
        }
        Some(Slopes { away: seen.px - px, by })
    }

    /// The same for a crossing whose place is known: projections change nothing.
    fn slopes_of_held(&self, surface: &Surface, seen: &Seen, pose: &Pose, held: Held) -> Option<Slopes> {
        let place = self.place(surface, pose, seen.at)?;
        let mut by = [DVec2::ZERO; N_LENS + N_POSE + N_PROJECTION];
        for (n, slope) in by[..N_LENS + N_POSE].iter_mut().enumerate() {
            *slope = held.px_by_place * (self.place_after(surface, seen, pose, n)? - place) / STEP;
        }
        Some(Slopes { away: held.px_by_place * (held.place - place), by })
    }

    /// The place of a crossing after a small step of lens or pose.
    fn place_after(&self, surface: &Surface, seen: &Seen, pose: &Pose, n: usize) -> Option<DVec2> {
        let mut step = [0.0; N_LENS + N_POSE];
        step[n] = STEP;
        if n < N_LENS {
            self.with_lens(&step[..N_LENS]).place(surface, pose, seen.at)
        } else {
            self.place(surface, &pose.moved(&step[N_LENS..]), seen.at)
        }
    }
}

struct Slopes {
    away: DVec2,
    by: [DVec2; N_LENS + N_POSE + N_PROJECTION],
}

/// The solution of the damped equations; `None` if there is none.
fn step(matrix: &[f64], right: &[f64], damping: f64) -> Option<Vec<f64>> {
    let (mut matrix, mut step) = (matrix.to_vec(), right.to_vec());
    let n = right.len();
    let largest = (0..n).map(|index| matrix[index * n + index]).fold(0.0, f64::max);
    for index in 0..n {
        // What nothing determines stays as it is: the wall's sliding along itself, a projector off the plane it lights.
        matrix[index * n + index] += damping * matrix[index * n + index] + 1e-12 * largest;
    }
    solve_symmetric(&mut matrix, &mut step).then_some(step)
}
