//! How even the light of a wall is in the virtual room, when projectors show what the wall makes of grey fields.

use compositor::wall::Wall;
use glam::DVec2;

use super::rig::Rig;

/// Departures from even light, as parts of white, beyond the rounding to 8 bits.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Evenness {
    /// The largest departure from light that varies smoothly over the whole wall, as a polynomial of the fourth degree.
    pub(crate) seam: f64,
    /// The largest departure from one light.
    pub(crate) uneven: f64,
    /// The largest rounding.
    pub(crate) rounding: f64,
}

/// Ten levels of grey, sRGB-encoded; three at a time, as red, green and blue.
pub(crate) const LEVELS: [[u8; 3]; 4] = [[0, 16, 40], [64, 96, 128], [160, 192, 224], [255, 0, 255]];

/// A value that a projector shows: of `LEVELS` by number, a projector, a column and a row as stored.
pub(crate) type Shown<'a> = &'a dyn Fn(usize, usize, [usize; 2]) -> [u8; 3];

/// The light on so many points of each projector's part of the canvas.
pub(crate) fn evenness(rig: &Rig, wall: &Wall, shown: Shown<'_>, n_points: u32) -> Evenness {
    let points = points(rig, wall, n_points);
    let mut worst = Evenness::default();
    for channel in 0..3 {
        worst = worst.or(evenness_of(rig, wall, shown, &points, channel));
    }
    worst
}

impl Evenness {
    /// The worse of both.
    fn or(self, other: Self) -> Self {
        Self {
            seam: self.seam.max(other.seam),
            uneven: self.uneven.max(other.uneven),
            rounding: self.rounding.max(other.rounding),
        }
    }
}

/// The light of one channel.
fn evenness_of(rig: &Rig, wall: &Wall, shown: Shown<'_>, points: &[(DVec2, DVec2)], channel: usize) -> Evenness {
    let light_at = |level: usize| points.iter().map(move |(point, _)| light(rig, shown, level, channel, *point));
    let fields: Vec<(f64, Vec<[f64; 2]>)> = LEVELS
        .iter()
        .enumerate()
        .map(|(level, values)| {
            (wall.black() + (1.0 - wall.black()) * linear(values[channel]), light_at(level).collect())
        })
        .collect();
    // The unit of the wall's white, from all levels together.
    let pairs = || fields.iter().flat_map(|(ideal, lights)| lights.iter().map(move |it| (*ideal, it[0])));
    let unit =
        pairs().map(|(ideal, light)| ideal * light).sum::<f64>() / pairs().map(|(ideal, _)| ideal * ideal).sum::<f64>();
    let mut worst = Evenness::default();
    for (ideal, lights) in &fields {
        let away: Vec<f64> = lights.iter().map(|it| it[0] / unit - ideal).collect();
        let smooth = smooth(points, &away);
        for ((away, smooth), [_, rounding]) in away.iter().zip(&smooth).zip(lights) {
            let rounding = rounding / unit;
            let here = Evenness { seam: (away - smooth).abs() - rounding, uneven: away.abs() - rounding, rounding };
            worst = worst.or(here);
        }
    }
    worst
}

/// Points on the wall, with their places on the canvas; a little within its edges.
fn points(rig: &Rig, wall: &Wall, n_points: u32) -> Vec<(DVec2, DVec2)> {
    let mut points = Vec::new();
    for (index, projector) in rig.projectors.iter().enumerate() {
        for n in 0..n_points {
            // Roberts' R2 sequence.
            let part = |step: f64| (0.5 + f64::from(n) * step).fract();
            let px = DVec2::new(part(0.754_877_666_246_693), part(0.569_840_290_998_053)) * projector.size_px();
            let canvas = wall.canvas_at(wall.projectors()[index].output.origin() + px);
            if canvas.min(1.0 - canvas).min_element() > 0.015 {
                points.push((projector.point(px), canvas));
            }
        }
    }
    points
}

/// The light at a point, and the largest error by rounding to 8 bits.
fn light(rig: &Rig, shown: Shown<'_>, level: usize, channel: usize, point: DVec2) -> [f64; 2] {
    let (mut sum, mut rounding) = (0.0, 0.0);
    for (index, projector) in rig.projectors.iter().enumerate().filter(|(_, it)| it.is_near(point, 0.5)) {
        let light = &projector.light;
        let part = light.part(projector.px(point) / projector.size_px());
        for (px, weight) in projector.taps(point) {
            let value = usize::from(shown(level, index, px)[channel]);
            let curve = |value: usize| light.curve[value.min(255)];
            sum += weight * part * (light.black[channel] + light.white[channel] * curve(value));
            let step = (curve(value + 1) - curve(value)).max(curve(value) - curve(value.max(1) - 1));
            rounding += weight * part * light.white[channel] * step / 2.0;
        }
    }
    [sum, rounding]
}

/// The polynomial of the canvas that is nearest to values, at each point: by Gram and Schmidt.
fn smooth(points: &[(DVec2, DVec2)], values: &[f64]) -> Vec<f64> {
    let powers: Vec<[i32; 2]> = (0..=4).flat_map(|x| (0..=4 - x).map(move |y| [x, y])).collect();
    let term = |at: DVec2, [x, y]: [i32; 2]| (2.0 * at.x - 1.0).powi(x) * (2.0 * at.y - 1.0).powi(y);
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let mut basis: Vec<Vec<f64>> = Vec::new();
    for powers in powers {
        let mut own: Vec<f64> = points.iter().map(|(_, canvas)| term(*canvas, powers)).collect();
        for other in &basis {
            let part = dot(&own, other);
            own.iter_mut().zip(other).for_each(|(own, other)| *own -= part * other);
        }
        let length = dot(&own, &own).sqrt();
        basis.push(own.into_iter().map(|it| it / length).collect());
    }
    let parts: Vec<f64> = basis.iter().map(|it| dot(it, values)).collect();
    (0..values.len()).map(|n| basis.iter().zip(&parts).map(|(it, part)| it[n] * part).sum()).collect()
}

fn linear(value: u8) -> f64 {
    let value = f64::from(value) / 255.0;
    if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}
