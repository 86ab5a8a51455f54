//! Lays the canvas where projectors light the wall, for files that say directions or points in space.

use glam::{DVec2, DVec3};

use super::{
    convert::{self, Source},
    document::Region,
};
use crate::wall::{Projector, homography::apply, mesh::pfm::Pfm};

/// The place on the wall, unrolled, at a value of a region's warp, to the right and up in any unit; `None` if there is none.
pub type Places = Box<dyn Fn(&Region, DVec3) -> Option<DVec2>>;

/// The regions of a file with their warps, and with their light if they have alpha maps.
pub struct Rough<'a> {
    /// One for each projector.
    pub regions: &'a [Region],
    /// One for each region.
    pub warps: &'a [Pfm],
    /// One for each region.
    pub maps: &'a [Option<Light>],
}

/// The light of an alpha map on a coarse lattice over a projector's pixels, from 0 to 1.
#[derive(Clone, Debug, PartialEq)]
pub struct Light {
    values: Vec<f64>,
}

/// A rectangle of the wall: least and greatest place.
pub type Rect = [DVec2; 2];

/// Points of a light's lattice, each way; ramps of blending are wider than its cells.
const LIGHT_SIDE: usize = 129;
/// Control points of warps by which the wall is found: they hold its shape, and all fit into memory.
const THIN: [usize; 2] = [65, 49];
/// Control points of rough meshes.
const ROUGH: [usize; 2] = [17, 13];
/// Points of a projector at which light is added up.
const SAMPLES: [u32; 2] = [24, 18];
/// Light by which a point counts as faded.
const FADED: f64 = 0.98;
/// Light by which a point is beyond the picture.
const DARK: f64 = 0.02;
/// Light that changes by more from one point of its lattice to the next has an edge: ramps of blending are wider.
const STEEP: f64 = 0.25;
/// The farthest beyond its edge, as a part of a projector, that a place counts as lit: projectors that meet without an overlap
/// leave a gap, by rounding.
const GAP: f64 = 1e-3;
/// Cells in which the largest rectangle that is lit is found, along the wall's longer side.
const CELLS: f64 = 192.0;

impl Light {
    /// The light of a map's value at each pixel, from 0 to 1, whose size is columns and rows.
    ///
    /// Between the centres of pixels it is interpolated: a ramp of a coarse projector has few of them.
    pub fn new(size: [usize; 2], light_at: impl Fn(usize, usize) -> f64) -> Self {
        // The pixel before a place along an axis, the one after, and how far it is on the way.
        let near = |n: usize, side: usize| {
            let last = side.saturating_sub(1);
            let at = n as f64 / (LIGHT_SIDE - 1) as f64 * side as f64 - 0.5;
            let at = at.clamp(0.0, last as f64);
            (at as usize, (at as usize + 1).min(last), at.fract())
        };
        let of = |n: usize| {
            let ((left, right, x), (upper, lower, y)) = (near(n % LIGHT_SIDE, size[0]), near(n / LIGHT_SIDE, size[1]));
            let row = |row: usize| light_at(left, row) * (1.0 - x) + light_at(right, row) * x;
            row(upper) * (1.0 - y) + row(lower) * y
        };
        Self { values: (0..LIGHT_SIDE * LIGHT_SIDE).map(of).collect() }
    }

    /// The light at a part of the pixels, from (0, 0) upper left to (1, 1).
    fn at(&self, raster: DVec2) -> f64 {
        let at = raster.clamp(DVec2::ZERO, DVec2::ONE) * (LIGHT_SIDE - 1) as f64;
        let cell = at.floor().min(DVec2::splat((LIGHT_SIDE - 2) as f64));
        let part = at - cell;
        let first = cell.y as usize * LIGHT_SIDE + cell.x as usize;
        let row = |first: usize| self.values[first] * (1.0 - part.x) + self.values[first + 1] * part.x;
        row(first) * (1.0 - part.y) + row(first + LIGHT_SIDE) * part.y
    }

    /// Whether the light begins or ends there at once, as at the picture's edge.
    fn is_steep(&self, raster: DVec2) -> bool {
        let last = DVec2::splat((LIGHT_SIDE - 2) as f64);
        let cell = (raster * (LIGHT_SIDE - 1) as f64).floor().clamp(DVec2::ZERO, last);
        let first = cell.y as usize * LIGHT_SIDE + cell.x as usize;
        let corners = [0, 1, LIGHT_SIDE, LIGHT_SIDE + 1].map(|n| self.values[first + n]);
        let [least, greatest] = [f64::min, f64::max].map(|of| corners.into_iter().fold(corners[0], of));
        greatest - least > STEEP
    }
}

impl Rough<'_> {
    /// Whether all regions have alpha maps.
    pub fn has_maps(&self) -> bool {
        self.maps.iter().all(Option::is_some)
    }

    /// The part of white by which the alpha maps fail to add up, on average where one fades or several light a place.
    /// Without maps, it is 0 if overlaps join all regions, else 1. `None` if places make no meshes.
    pub fn unevenness(&self, places: &Places) -> Option<f64> {
        let projectors = self.projectors(places, self.bounds(places)?)?;
        let mut overlaps: Vec<Vec<usize>> = Vec::new();
        let (mut all, mut contested) = (Vec::new(), Vec::new());
        for (index, projector) in projectors.iter().enumerate() {
            for n in 0..SAMPLES[0] * SAMPLES[1] {
                let raster = (DVec2::new(f64::from(n % SAMPLES[0]), f64::from(n / SAMPLES[0])) + 0.5)
                    / DVec2::from(SAMPLES.map(f64::from));
                let canvas = canvas_at(projector, raster)?;
                let there: Vec<(usize, DVec2)> = projectors
                    .iter()
                    .enumerate()
                    .filter_map(|(other, it)| {
                        let raster = if other == index { Some(raster) } else { raster_at(it, canvas) };
                        Some((other, raster?))
                    })
                    .collect();
                let is_steep =
                    |(other, at): &(usize, DVec2)| self.maps[*other].as_ref().is_some_and(|it| it.is_steep(*at));
                // By less than a pixel, one map shows the picture there and another does not.
                if there.iter().any(is_steep) {
                    continue;
                }
                let light = |(other, at): &(usize, DVec2)| Some(self.maps[*other].as_ref()?.at(*at));
                let sum: f64 = there.iter().filter_map(light).sum();
                all.push(sum);
                let own = self.maps[index].as_ref().map_or(1.0, |map| map.at(raster));
                // Beyond the picture all maps are dark.
                if sum > DARK && (own < FADED || there.len() > 1) {
                    contested.push(sum);
                }
                let together: Vec<usize> = there.iter().map(|(other, _)| *other).collect();
                if !overlaps.contains(&together) {
                    overlaps.push(together);
                }
            }
        }
        if !self.has_maps() {
            let mut joined = vec![0];
            for _ in 0..projectors.len() {
                let near = overlaps.iter().filter(|all| all.iter().any(|it| joined.contains(it))).flatten();
                let more: Vec<usize> = near.copied().collect();
                joined.extend(more);
                joined.sort_unstable();
                joined.dedup();
            }
            return Some(if joined.len() == projectors.len() { 0.0 } else { 1.0 });
        }
        all.retain(|sum| *sum > DARK);
        all.sort_by(f64::total_cmp);
        let usual = *all.get(all.len() / 2)?;
        let n = contested.len().max(1) as f64;
        Some(contested.iter().map(|sum| (sum / usual.max(1e-6) - 1.0).abs()).sum::<f64>() / n)
    }

    /// The largest rectangle that is lit all over, by maps as well if there are any. `None` if places make no meshes.
    pub fn lit(&self, places: &Places) -> Option<Rect> {
        let bounds @ [least, greatest] = self.bounds(places)?;
        let projectors = self.projectors(places, bounds)?;
        let cell = (greatest - least).max_element() / CELLS;
        let [columns, rows] = ((greatest - least) / cell).floor().max(DVec2::ONE).to_array().map(|n| n as usize);
        // Heights of columns of lit cells below each row, and the largest rectangle among them.
        let mut heights = vec![0_usize; columns];
        let mut best = (0, [0; 4]);
        for row in 0..rows {
            for (column, height) in heights.iter_mut().enumerate() {
                let corners = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]].map(DVec2::from);
                let is_lit = corners.iter().all(|corner| {
                    let at = (DVec2::new(column as f64, row as f64) + *corner) * cell / (greatest - least);
                    let light = |index: usize, at: DVec2| self.maps[index].as_ref().map_or(1.0, |map| map.at(at));
                    let lights = projectors.iter().enumerate();
                    lights.filter_map(|(index, it)| Some(light(index, raster_at(it, at)?))).sum::<f64>() > DARK
                });
                *height = if is_lit { *height + 1 } else { 0 };
            }
            for first in 0..columns {
                let mut lowest = usize::MAX;
                for (last, height) in heights.iter().enumerate().skip(first) {
                    lowest = lowest.min(*height);
                    let area = lowest * (last + 1 - first);
                    if area > best.0 {
                        best = (area, [first, last + 1, row + 1 - lowest, row + 1]);
                    }
                }
            }
        }
        let [left, right, bottom, top] = best.1.map(|n| n as f64);
        (best.0 > 0).then(|| [least + DVec2::new(left, bottom) * cell, least + DVec2::new(right, top) * cell])
    }

    /// The projectors with rough meshes, on a canvas that is this rectangle.
    fn projectors(&self, places: &Places, rect: Rect) -> Option<Vec<Projector>> {
        let projector = |(region, warp): (&Region, &Pfm)| {
            let canvas_from = on_canvas(places, region, rect);
            convert::rough(Source { region, warp, canvas_from: &canvas_from }, ROUGH)
        };
        self.regions.iter().zip(self.warps).map(projector).collect()
    }

    /// The smallest rectangle that holds all places.
    fn bounds(&self, places: &Places) -> Option<Rect> {
        let mut bounds = [DVec2::INFINITY, DVec2::NEG_INFINITY];
        for (region, warp) in self.regions.iter().zip(self.warps) {
            let source = Source { region, warp, canvas_from: &|value| places(region, value) };
            for n in 0..33 * 25 {
                let raster = DVec2::new(f64::from(n % 33) / 32.0, f64::from(n / 33) / 24.0);
                let place = source.canvas_at(raster);
                if !place.is_finite() {
                    return None;
                }
                bounds = [bounds[0].min(place), bounds[1].max(place)];
            }
        }
        let size = bounds[1] - bounds[0];
        (size.min_element() > 1e-6 * size.max_element() && size.max_element() < 1e6).then_some(bounds)
    }
}

/// The way from a region's warp to a canvas that is this rectangle of the wall.
pub fn on_canvas<'a>(
    places: &'a Places,
    region: &'a Region,
    [least, greatest]: Rect,
) -> impl Fn(DVec3) -> Option<DVec2> + 'a {
    move |value| Some((places(region, value)? - least) / (greatest - least))
}

/// A warp with no more control points than its shape needs.
pub fn thin(region: &Region, warp: &Pfm) -> Pfm {
    if warp.size.iter().zip(THIN).all(|(have, most)| *have <= most) {
        return warp.clone();
    }
    let source = Source { region, warp, canvas_from: &|_| None };
    let raster = |n: usize| {
        let [column, row] = [n % THIN[0], n / THIN[0]].map(|it| it as f64);
        DVec2::new(column / (THIN[0] - 1) as f64, row / (THIN[1] - 1) as f64)
    };
    let values = (0..THIN[0] * THIN[1]).map(|n| source.value_at(raster(n)).as_vec3().to_array()).collect();
    Pfm { size: THIN, values }
}

/// The point of the canvas that a part of a projector's pixels lights.
fn canvas_at(projector: &Projector, raster: DVec2) -> Option<DVec2> {
    let image = apply(projector.raster_from_image()?.inverse(), raster)?;
    Some(projector.canvas.canvas_from_rect(projector.rect_at(image)))
}

/// The part of a projector's pixels that lights a point of the canvas, if one does.
fn raster_at(projector: &Projector, canvas: DVec2) -> Option<DVec2> {
    let image = projector.mesh.as_ref()?.image_near(canvas);
    let raster = apply(projector.raster_from_image()?, image)?;
    (raster.cmpge(DVec2::splat(-GAP)).all() && raster.cmple(DVec2::splat(1.0 + GAP)).all()).then_some(raster)
}
