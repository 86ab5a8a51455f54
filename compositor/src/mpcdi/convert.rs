//! From regions and their warps to projectors with meshes, and back.

use std::sync::Arc;

use glam::DVec2;

use super::document::Region;
use crate::wall::{
    CanvasRect, Flip, PixelRect, Projector, Rotation,
    homography::apply,
    mesh::{Mesh, pfm::Pfm},
};

/// A mesh is refined until it lies as near to its warp as this, in pixels.
const NEAR_PX: f64 = 0.05;
/// Distances between control points in pixels, from the first that is tried to the finest.
const SPACINGS: [u32; 4] = [32, 16, 8, 4];

/// The projector of a region: its pixels begin at `output_at` in the spanning output, and its mesh is in a file named so.
///
/// How it hangs follows from the warp, so that its upper-left corner is the one that is seen there.
///
/// # Errors
/// The warp makes no mesh.
pub fn projector(region: &Region, warp: &Pfm, output_at: [u32; 2], mesh_file: &str) -> Result<Projector, String> {
    let fault = |problem: String| format!("region \"{}\": {problem}", region.id);
    if warp.values.iter().any(|[u, v, _]| !u.is_finite() || !v.is_finite()) {
        return Err(fault("its warp has pixels without numbers: export it with a value for each pixel".to_owned()));
    }
    let [width, height] = region.size;
    let output = PixelRect { x: output_at[0], y: output_at[1], width, height };
    let anywhere = CanvasRect { left: 0.0, bottom: 0.0, width: 1.0, height: 1.0 };
    let hung = hung(Projector::plain(region.id.clone(), anywhere, output), region, warp);
    let mut last = Err("its warp has no points".to_owned());
    for spacing in SPACINGS {
        let n_points = hung.upright_size().map(|side| {
            let n_cells = side.div_ceil(spacing).max(1) as usize;
            (n_cells + 1).min(Mesh::MOST_POINTS_A_SIDE)
        });
        // The points that a coarse warp has are enough.
        let is_finest = spacing == SPACINGS[3] || warp.size.iter().zip(n_points).all(|(have, n)| *have < n);
        let mesh = mesh(&hung, region, warp, n_points, mesh_file.to_owned()).map_err(&fault);
        let is_near = mesh.as_ref().is_ok_and(|mesh| farthest_px(&hung, region, warp, mesh) <= NEAR_PX);
        last = mesh;
        if is_near || is_finest {
            break;
        }
    }
    Ok(hung.with_mesh(Arc::new(last?)))
}

/// The warp of a projector: the point of the region, from (0, 0) upper left to (1, 1), at the centre of each pixel.
///
/// `None` if its corners make none.
pub fn warp(projector: &Projector) -> Option<Pfm> {
    let image_from_raster = projector.raster_from_image()?.inverse();
    let size = [projector.output.width as usize, projector.output.height as usize];
    let of_pixel = |index: usize| {
        let px = DVec2::new((index % size[0]) as f64, (index / size[0]) as f64) + 0.5;
        let image = apply(image_from_raster, px / projector.output.size());
        let at = image.map_or(DVec2::NAN, |image| projector.rect_at(image)).as_vec2();
        [at.x, at.y, 0.0]
    };
    Some(Pfm { size, values: (0..size[0] * size[1]).map(of_pixel).collect() })
}

/// The point of the canvas at a part of a projector's pixels as stored, from (0, 0) to (1, 1).
///
/// A warp with a pixel for each of the projector's has their centres; a coarser one reaches from edge to edge.
fn canvas_at(region: &Region, warp: &Pfm, raster: DVec2) -> DVec2 {
    let size = DVec2::new(warp.size[0] as f64, warp.size[1] as f64);
    let is_whole = warp.size == region.size.map(|side| side as usize);
    let at = if is_whole { raster * size - 0.5 } else { raster * (size - 1.0) };
    // Beyond the outermost pixels the warp continues straight.
    let cell = at.floor().clamp(DVec2::ZERO, (size - 2.0).max(DVec2::ZERO));
    let part = at - cell;
    let value = |column: f64, row: f64| {
        let [column, row] = [column.min(size.x - 1.0), row.min(size.y - 1.0)].map(|it| it as usize);
        let [u, v, _] = warp.values[row * warp.size[0] + column].map(f64::from);
        DVec2::new(u, v)
    };
    let row = |row: f64| value(cell.x, row).lerp(value(cell.x + 1.0, row), part.x);
    let in_region = row(cell.y).lerp(row(cell.y + 1.0), part.y);
    let from_top = DVec2::from(region.at) + in_region * DVec2::from(region.extent);
    DVec2::new(from_top.x, 1.0 - from_top.y)
}

/// The projector turned and flipped as its warp shows it.
fn hung(projector: Projector, region: &Region, warp: &Pfm) -> Projector {
    let step = |from: DVec2, to: DVec2| canvas_at(region, warp, to) - canvas_at(region, warp, from);
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

fn mesh(
    projector: &Projector,
    region: &Region,
    warp: &Pfm,
    n_points: [usize; 2],
    file: String,
) -> Result<Mesh, String> {
    let raster_from_upright = projector.raster_from_upright();
    let place = |index: usize| {
        let [column, row] = [index % n_points[0], index / n_points[0]].map(|it| it as f64);
        let upright = DVec2::new(column / (n_points[0] - 1) as f64, row / (n_points[1] - 1) as f64);
        canvas_at(region, warp, raster_from_upright.transform_point2(upright))
    };
    let points: Vec<DVec2> = (0..n_points[0] * n_points[1]).map(place).collect();
    Mesh::new(file, n_points, &points).map_err(|error| error.to_string())
}

/// The farthest that a mesh lies from its warp, in pixels, at some ten thousand of these.
fn farthest_px(projector: &Projector, region: &Region, warp: &Pfm, mesh: &Mesh) -> f64 {
    const SIDE: u32 = 97;
    let raster_from_upright = projector.raster_from_upright();
    let size = DVec2::from(projector.upright_size().map(f64::from));
    let steps = || (0..SIDE).map(|step| (f64::from(step) + 0.5) / f64::from(SIDE));
    let away_px = |image: DVec2| {
        let wanted = canvas_at(region, warp, raster_from_upright.transform_point2(image));
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

    /// A region of 64×48 pixels in the picture's right half.
    fn region() -> Region {
        Region {
            id: "a".to_owned(),
            size: [64, 48],
            at: [0.5, 0.0],
            extent: [0.5, 1.0],
            warp: String::new(),
            alpha: None,
            beta: None,
        }
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
