//! From regions and their warps to projectors with meshes, and back.

use std::sync::Arc;

use glam::{DVec2, DVec3};

use super::{
    EXPORT_AGAIN,
    document::{Frustum, Region},
    view::view_of,
};
use crate::wall::{
    CanvasRect, Flip, PixelRect, Projector, Rotation, Wall,
    homography::apply,
    mesh::{Mesh, pfm::Pfm},
};

/// A mesh is refined until it lies as near to its warp as this, in pixels.
const NEAR_PX: f64 = 0.05;
/// Distances between control points in pixels, from the first that is tried to the finest.
const SPACINGS: [u32; 4] = [32, 16, 8, 4];

/// A region's warp, with the way from its values to the canvas.
#[derive(Clone, Copy)]
pub struct Source<'a> {
    /// The region.
    pub region: &'a Region,
    /// Its warp.
    pub warp: &'a Pfm,
    /// The point of the canvas, from (0, 0) lower left to (1, 1), at a value of the warp; `None` if there is none.
    pub canvas_from: &'a dyn Fn(DVec3) -> Option<DVec2>,
}

/// The point of the canvas at a value of a warp of profile 2d: the canvas is the picture.
pub fn in_picture(region: &Region) -> impl Fn(DVec3) -> Option<DVec2> + '_ {
    |value| {
        let from_top = DVec2::from(region.at) + value.truncate() * DVec2::from(region.extent);
        Some(DVec2::new(from_top.x, 1.0 - from_top.y))
    }
}

/// The projector of a region: its pixels begin at `output_at` in the spanning output, and its mesh is in a file named so.
///
/// How it hangs follows from the warp, so that its upper-left corner is the one that is seen there.
///
/// # Errors
/// The warp makes no mesh.
pub fn projector(source: Source<'_>, output_at: [u32; 2], mesh_file: &str) -> Result<Projector, String> {
    let fault = |problem: String| format!("region \"{}\": {problem}", source.region.id);
    check(source.region, source.warp)?;
    let hung = hung(source, output_at);
    let mut last = Err("its warp has no points".to_owned());
    for spacing in SPACINGS {
        let n_points = hung.upright_size().map(|side| {
            let n_cells = side.div_ceil(spacing).max(1) as usize;
            (n_cells + 1).min(Mesh::MOST_POINTS_A_SIDE)
        });
        // The points that a coarse warp has are enough.
        let is_finest = spacing == SPACINGS[3] || source.warp.size.iter().zip(n_points).all(|(have, n)| *have < n);
        let mesh = mesh(&hung, source, n_points, mesh_file.to_owned()).map_err(&fault);
        let is_near = mesh.as_ref().is_ok_and(|mesh| farthest_px(&hung, source, mesh) <= NEAR_PX);
        last = mesh;
        if is_near || is_finest {
            break;
        }
    }
    Ok(hung.with_mesh(Arc::new(last?)))
}

/// Refuses warps that leave pixels out; the text names the cure.
///
/// # Errors
/// A pixel has no numbers.
pub fn check(region: &Region, warp: &Pfm) -> Result<(), String> {
    // The third number may be an error that was not computed.
    if warp.values.iter().all(|[u, v, _]| u.is_finite() && v.is_finite()) {
        return Ok(());
    }
    Err(format!("region \"{}\": its warp has pixels without numbers: export it with a value for each pixel", region.id))
}

/// The same, quickly: with so many control points, and no name for the mesh. `None` if the warp makes none.
pub(super) fn rough(source: Source<'_>, n_points: [usize; 2]) -> Option<Projector> {
    let hung = hung(source, [0; 2]);
    let mesh = mesh(&hung, source, n_points, String::new()).ok()?;
    Some(hung.with_mesh(Arc::new(mesh)))
}

/// The warp of a projector: the point of the region, from (0, 0) upper left to (1, 1), at the centre of each pixel.
///
/// `None` if its corners make none.
pub fn warp(projector: &Projector) -> Option<Pfm> {
    let of_rect = |at: Option<DVec2>| at.unwrap_or(DVec2::NAN).extend(0.0);
    of_pixels(projector, of_rect)
}

/// The same with points in space: X to the left, Y up and Z ahead, in metres.
pub fn points(wall: &Wall, projector: &Projector) -> Option<Pfm> {
    let of_rect = |at: Option<DVec2>| {
        let point = at.map_or(DVec3::NAN, |at| in_space(wall, projector.canvas.canvas_from_rect(at)));
        DVec3::new(-point.x, point.y, -point.z)
    };
    of_pixels(projector, of_rect)
}

/// The same as the view from an eye on the wall's axis, or before its middle or edge. `None` if one view does not show it.
pub fn view(wall: &Wall, projector: &Projector) -> Option<(Frustum, Pfm)> {
    let [width_m, height_m] = wall.canvas_m();
    let eye = match wall.surface() {
        Some(surface) => surface.middle(height_m / 2.0),
        None => DVec3::new(width_m / 2.0, height_m / 2.0, width_m),
    };
    let points =
        of_pixels(projector, |at| at.map_or(DVec3::NAN, |at| in_space(wall, projector.canvas.canvas_from_rect(at))))?;
    let seen: Vec<DVec3> = points.values.iter().map(|point| DVec3::from(point.map(f64::from))).collect();
    let (frustum, at) = view_of(eye, &seen)?;
    let values = at.iter().map(|at| at.extend(0.0).as_vec3().to_array()).collect();
    Some((frustum, Pfm { values, ..points }))
}

/// The point in space at a point of the canvas.
fn in_space(wall: &Wall, canvas: DVec2) -> DVec3 {
    let place = canvas * DVec2::from(wall.canvas_m());
    wall.surface().map_or(place.extend(0.0), |surface| surface.in_space(place))
}

/// A value for the centre of each pixel, by its point of the projector's rectangle; `None` if corners make no picture.
fn of_pixels(projector: &Projector, value: impl Fn(Option<DVec2>) -> DVec3) -> Option<Pfm> {
    let image_from_raster = projector.raster_from_image()?.inverse();
    let size = [projector.output.width as usize, projector.output.height as usize];
    let of_pixel = |index: usize| {
        let px = DVec2::new((index % size[0]) as f64, (index / size[0]) as f64) + 0.5;
        let image = apply(image_from_raster, px / projector.output.size());
        value(image.map(|image| projector.rect_at(image))).as_vec3().to_array()
    };
    Some(Pfm { size, values: (0..size[0] * size[1]).map(of_pixel).collect() })
}

impl Source<'_> {
    /// The point of the canvas at a part of a projector's pixels as stored, from (0, 0) to (1, 1); not a number if there is
    /// none.
    ///
    /// A warp with a pixel for each of the projector's has their centres; a coarser one reaches from edge to edge.
    pub(super) fn canvas_at(&self, raster: DVec2) -> DVec2 {
        (self.canvas_from)(self.value_at(raster)).unwrap_or(DVec2::NAN)
    }

    /// The warp's value there.
    pub(super) fn value_at(&self, raster: DVec2) -> DVec3 {
        let Self { region, warp, .. } = self;
        let size = DVec2::new(warp.size[0] as f64, warp.size[1] as f64);
        let is_whole = warp.size == region.size.map(|side| side as usize);
        let at = if is_whole { raster * size - 0.5 } else { raster * (size - 1.0) };
        // Beyond the outermost pixels the warp continues straight.
        let cell = at.floor().clamp(DVec2::ZERO, (size - 2.0).max(DVec2::ZERO));
        let part = at - cell;
        let value = |column: f64, row: f64| {
            let [column, row] = [column.min(size.x - 1.0), row.min(size.y - 1.0)].map(|it| it as usize);
            DVec3::from(warp.values[row * warp.size[0] + column].map(f64::from))
        };
        let row = |row: f64| value(cell.x, row).lerp(value(cell.x + 1.0, row), part.x);
        row(cell.y).lerp(row(cell.y + 1.0), part.y)
    }
}

/// The projector without a mesh, turned and flipped as its warp shows it.
pub(super) fn hung(source: Source<'_>, output_at: [u32; 2]) -> Projector {
    let [width, height] = source.region.size;
    let output = PixelRect { x: output_at[0], y: output_at[1], width, height };
    let anywhere = CanvasRect { left: 0.0, bottom: 0.0, width: 1.0, height: 1.0 };
    let projector = Projector::plain(source.region.id.clone(), anywhere, output);
    let step = |from: DVec2, to: DVec2| source.canvas_at(to) - source.canvas_at(from);
    let ways = [Rotation::None, Rotation::Right, Rotation::Half, Rotation::Left]
        .into_iter()
        .flat_map(|rotation| [Flip::None, Flip::Horizontal].map(|flip| (rotation, flip)));
    let uprightness = |(rotation, flip): &(Rotation, Flip)| {
        let way = Projector { rotation: *rotation, flip: *flip, ..projector.clone() }.raster_from_upright();
        let raster = |upright: DVec2| way.transform_point2(upright);
        let middle = |x: f64, y: f64| raster(DVec2::new(x, y));
        let right = step(middle(0.4, 0.5), middle(0.6, 0.5)).normalize_or_zero();
        let down = step(middle(0.5, 0.4), middle(0.5, 0.6)).normalize_or_zero();
        right.x - down.y
    };
    let best = ways.max_by(|a, b| uprightness(a).total_cmp(&uprightness(b)));
    let (rotation, flip) = best.unwrap_or_default();
    Projector { rotation, flip, ..projector }
}

fn mesh(projector: &Projector, source: Source<'_>, n_points: [usize; 2], file: String) -> Result<Mesh, String> {
    let raster_from_upright = projector.raster_from_upright();
    let place = |index: usize| {
        let [column, row] = [index % n_points[0], index / n_points[0]].map(|it| it as f64);
        let upright = DVec2::new(column / (n_points[0] - 1) as f64, row / (n_points[1] - 1) as f64);
        source.canvas_at(raster_from_upright.transform_point2(upright))
    };
    let points: Vec<DVec2> = (0..n_points[0] * n_points[1]).map(place).collect();
    Mesh::new(file, n_points, &points).map_err(|error| format!("{error}; {EXPORT_AGAIN}"))
}

/// The farthest that a mesh lies from its warp, in pixels, at some ten thousand of these.
fn farthest_px(projector: &Projector, source: Source<'_>, mesh: &Mesh) -> f64 {
    const SIDE: u32 = 97;
    let raster_from_upright = projector.raster_from_upright();
    let size = DVec2::from(projector.upright_size().map(f64::from));
    let steps = || (0..SIDE).map(|step| (f64::from(step) + 0.5) / f64::from(SIDE));
    let away_px = |image: DVec2| {
        let wanted = source.canvas_at(raster_from_upright.transform_point2(image));
        let away = wanted - mesh.canvas_at(image);
        // By the size of a pixel there.
        let per_px = [DVec2::X, DVec2::Y].map(|axis| {
            let step = axis / size;
            (mesh.canvas_at(image + step / 2.0) - mesh.canvas_at(image - step / 2.0)).length()
        });
        away.length() / per_px[0].min(per_px[1]).max(1e-12)
    };
    steps().flat_map(|y| steps().map(move |x| DVec2::new(x, y))).map(away_px).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn projector(region: &Region, warp: &Pfm, at: [u32; 2], file: &str) -> Result<Projector, String> {
        super::projector(Source { region, warp, canvas_from: &in_picture(region) }, at, file)
    }

    /// A region of 64×48 pixels in the picture's right half.
    fn region() -> Region {
        Region { id: "a".to_owned(), size: [64, 48], at: [0.5, 0.0], extent: [0.5, 1.0], ..Region::default() }
    }

    /// The point of the region at a part of the pixels, bent as on a cylinder.
    fn bent(raster: DVec2) -> DVec2 {
        let angle = (raster.x - 0.5) * 1.2;
        DVec2::new(0.5 + 0.45 * angle.sin() / 0.6_f64.sin(), 0.5 + (raster.y - 0.5) * (0.7 + 0.2 * angle.cos()))
    }

    fn warp_of(size: [usize; 2], at: impl Fn(DVec2) -> DVec2, is_whole: bool) -> Pfm {
        let place =
            |n: usize, of: usize| if is_whole { (n as f64 + 0.5) / of as f64 } else { n as f64 / (of - 1) as f64 };
        let value = |index: usize| {
            let at = at(DVec2::new(place(index % size[0], size[0]), place(index / size[0], size[1]))).as_vec2();
            [at.x, at.y, 0.0]
        };
        Pfm { size, values: (0..size[0] * size[1]).map(value).collect() }
    }

    fn away(projector: &Projector, at: impl Fn(DVec2) -> DVec2) -> f64 {
        let image_from_raster = projector.raster_from_image().expect("no corners").inverse();
        let px = (0..48).flat_map(|y| (0..64).map(move |x| DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)));
        px.map(|px| {
            let raster = px / DVec2::new(64.0, 48.0);
            let shown =
                projector.canvas.canvas_from_rect(projector.rect_at(apply(image_from_raster, raster).expect("there")));
            let in_region = at(raster);
            let wanted = DVec2::new(0.5 + 0.5 * in_region.x, 1.0 - in_region.y);
            (shown - wanted).length() * 100.0
        })
        .fold(0.0, f64::max)
    }

    #[test]
    fn whole_and_coarse_warps_become_meshes_however_the_projector_hangs() {
        for turned in [false, true] {
            for mirrored in [false, true] {
                let at = |raster: DVec2| {
                    let raster = if turned { DVec2::ONE - raster } else { raster };
                    bent(if mirrored { DVec2::new(1.0 - raster.x, raster.y) } else { raster })
                };
                for (size, is_whole) in [([64, 48], true), ([17, 13], false)] {
                    let projector =
                        projector(&region(), &warp_of(size, at, is_whole), [7, 0], "a.pfm").expect("a mesh");
                    // In hundredths of the canvas: a pixel is about one wide.
                    assert!(away(&projector, at) < 0.06, "{}", away(&projector, at));
                    let upside_down = projector.rotation == Rotation::Half;
                    assert_eq!((upside_down, projector.flip != Flip::None), (turned, mirrored));
                    assert_eq!((projector.output.x, projector.output.width), (7, 64));
                }
            }
        }
    }

    #[test]
    fn the_warp_of_a_projector_makes_the_same_projector() {
        let first = projector(&region(), &warp_of([64, 48], bent, true), [0, 0], "a.pfm").expect("a mesh");
        let first = Projector { warp_px: [[2.0, 1.0], [0.0, 3.0], [-1.0, -2.0], [0.5, 0.0]], ..first };
        let CanvasRect { left, bottom, width, height } = first.canvas;
        let own = Region { at: [left, 1.0 - bottom - height], extent: [width, height], ..region() };
        let second = projector(&own, &warp(&first).expect("a warp"), [0, 0], "b.pfm").expect("a mesh");
        let canvas_of = |projector: &Projector, raster: DVec2| {
            let image = apply(projector.raster_from_image().expect("convex").inverse(), raster).expect("there");
            projector.canvas.canvas_from_rect(projector.rect_at(image))
        };
        for n in 0..200 {
            let raster = DVec2::new((f64::from(n) * 0.7549).fract(), (f64::from(n) * 0.5698).fract());
            if apply(first.raster_from_image().expect("convex").inverse(), raster)
                .is_some_and(|image| image.cmpge(DVec2::ZERO).all() && image.cmple(DVec2::ONE).all())
            {
                let apart = canvas_of(&first, raster).distance(canvas_of(&second, raster));
                assert!(apart < 1e-3, "{raster}: {apart}");
            }
        }
    }

    #[test]
    fn warps_without_numbers_are_refused() {
        let mut warp = warp_of([64, 48], bent, true);
        warp.values[100] = [f32::NAN; 3];
        let fault = projector(&region(), &warp, [0, 0], "a.pfm").expect_err("a hole");
        assert!(fault.contains("region \"a\": its warp has pixels without numbers"), "{fault}");
        // All pixels show the same point.
        warp.values.fill([0.5, 0.5, 0.0]);
        let fault = projector(&region(), &warp, [0, 0], "a.pfm").expect_err("a point");
        assert!(fault.contains("all lie on one place"), "{fault}");
    }
}
