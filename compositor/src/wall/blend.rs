//! Blend weights where projectors overlap, and the black level of the whole wall.

use std::sync::Arc;

use glam::{DMat3, DVec2, DVec4, Vec2Swizzles};

use super::{
    fall_off::FallOff,
    homography::{UNIT_SQUARE, apply},
    mesh::Mesh,
    projector::{CanvasRect, Projector},
};

/// A projector that lights a part of another one's rectangle, or that one itself.
#[derive(Clone, Debug, PartialEq)]
pub struct Neighbour {
    /// Its index among the wall's projectors.
    pub projector_idx: usize,
    /// Whether it has a blend weight there. If not, only its black counts.
    pub blends: bool,
    /// Its black level.
    pub black_level: f64,
    /// The fall-off of its light.
    pub fall_off: Option<FallOff>,
    /// From units of the projector's rectangle to those of the neighbour's: `rect_origin + rect_scale * point`.
    pub rect_scale: DVec2,
    /// See `rect_scale`.
    pub rect_origin: DVec2,
    /// The neighbour's mesh, if it has one: its image at a point of its rectangle, which is the same without one.
    pub mesh: Option<Arc<Mesh>>,
    /// From the neighbour's image to its pixels, both as seen on the wall: [`Projector::upright_from_image`].
    pub upright_from_image: DMat3,
    /// The columns and rows of those pixels.
    pub upright_size: DVec2,
    /// The edges of its image towards which its light fades, 1 or 0: left, upper, right, lower. Without a mesh, edges of
    /// the canvas are not among them: no projector takes over there.
    pub image_edges: DVec4,
    /// The same for the edges of its pixels that cut its image, and how steeply it fades: the inverse of the distance, in
    /// sides of its pixels, over which it does; 0 for the others.
    pub raster_fades: DVec4,
    /// The least and greatest corner of the part of the projector's rectangle that it can change.
    pub reach: [DVec2; 2],
}

/// The most neighbours that a projector may have.
pub const MOST_NEIGHBOURS: usize = 24;

/// The least distance from an edge, in units of the image or the pixels: where all weights vanish, they keep their
/// ratios. A tenth of a pixel of the largest projectors.
pub const LEAST_DISTANCE: f64 = 1e-5;

/// A point that lies outside of an image by this much counts as at its edge, if the image has a mesh: its way back is
/// found to within a part in ten thousand.
pub const MESH_TOLERANCE: f64 = 1e-3;

/// Where pixels' edges cut an image at the edge of the canvas, its light fades over so many times the deepest cut: it is
/// nearly all there elsewhere, as without the cut.
const FADE_PER_CUT: f64 = 4.0;
/// And over at least so many pixels.
const LEAST_FADE_PX: f64 = 4.0;

impl Neighbour {
    /// The point of the neighbour's image at a point of the projector's rectangle, as the GPU finds it.
    pub fn image_near(&self, rect_point: DVec2) -> DVec2 {
        let own = self.rect_origin + self.rect_scale * rect_point;
        self.mesh.as_ref().map_or(own, |mesh| mesh.image_near(mesh.bounds().canvas_from_rect(own)))
    }

    /// The light of its black at a point of the projector's rectangle.
    fn leak(&self, rect_point: DVec2) -> f64 {
        let upright = apply(self.upright_from_image, self.image_near(rect_point));
        let is_lit = |upright: &DVec2| upright.cmpge(DVec2::ZERO).all() && upright.cmple(DVec2::ONE).all();
        upright.filter(is_lit).map_or(0.0, |upright| self.black_level * self.excess(upright))
    }

    /// Its light at a point of its pixels, over that at its darkest point.
    pub fn excess(&self, upright: DVec2) -> f64 {
        self.fall_off.as_ref().map_or(1.0, |fall_off| fall_off.excess(upright))
    }
}

/// The neighbours of each projector, itself first; or a projector that has too many, and their number.
pub fn neighbours(projectors: &[Projector]) -> Result<Vec<Vec<Neighbour>>, (usize, usize)> {
    let maps: Vec<Option<DMat3>> = projectors.iter().map(Projector::upright_from_image).collect();
    let boxes: Vec<_> = projectors.iter().map(|projector| bounds(&lit_outline(projector))).collect();
    let of = |projector_idx: usize| {
        let projector = &projectors[projector_idx];
        let neighbour = |other_idx: usize| {
            let other = &projectors[other_idx];
            let leaks = other.black_level > 0.0 && boxes[other_idx].is_some_and(|it| boxes_meet(it, box_of(projector)));
            let blends = other_idx == projector_idx || overlap(projector, other);
            if !blends && !leaks {
                return None;
            }
            let (rect, other_rect) = (projector.canvas, other.canvas);
            let rect_origin = other_rect.rect_from_canvas(rect.canvas_from_rect(DVec2::ZERO));
            let rect_scale = DVec2::new(rect.width / other_rect.width, rect.height / other_rect.height);
            let upright_from_image = maps[other_idx]?;
            let upright_size = DVec2::from(other.upright_size().map(f64::from));
            let image_edges = if other.mesh.is_some() { DVec4::ONE } else { inner_edges(other.canvas) };
            Some(Neighbour {
                projector_idx: other_idx,
                blends,
                black_level: other.black_level,
                fall_off: other.fall_off.clone(),
                rect_scale,
                rect_origin,
                mesh: other.mesh.clone(),
                upright_from_image,
                upright_size,
                image_edges,
                raster_fades: raster_fades(upright_from_image, upright_size, image_edges),
                reach: reach(projector, other, boxes[other_idx].filter(|_| leaks)),
            })
        };
        let others = (0..projectors.len()).filter(|&other_idx| other_idx != projector_idx);
        let all: Vec<_> = std::iter::once(projector_idx).chain(others).filter_map(neighbour).collect();
        if all.len() <= MOST_NEIGHBOURS + 1 { Ok(all) } else { Err((projector_idx, all.len() - 1)) }
    };
    (0..projectors.len()).map(of).collect()
}

/// The part of a projector's rectangle where another has a blend weight, or leaks black onto the part of the canvas that it
/// `lights`, plus a margin of two pixels.
fn reach(projector: &Projector, other: &Projector, lights: Option<[DVec2; 2]>) -> [DVec2; 2] {
    let [mut least, mut greatest] = box_of(other);
    if let Some([lit_least, lit_greatest]) = lights {
        (least, greatest) = (least.min(lit_least), greatest.max(lit_greatest));
    }
    let margin = 2.0 * pixel_of(projector).max(pixel_of(other));
    let corners = [least - margin, greatest + margin].map(|corner| projector.canvas.rect_from_canvas(corner));
    [corners[0].min(corners[1]), corners[0].max(corners[1])]
}

/// A point's distances from the edges of the unit square: left, upper, right, lower.
pub fn distances_from_edges(point: DVec2) -> DVec4 {
    DVec4::new(point.x, point.y, 1.0 - point.x, 1.0 - point.y)
}

/// The edges of a rectangle that are not edges of the canvas, 1 or 0.
fn inner_edges(CanvasRect { left, bottom, width, height }: CanvasRect) -> DVec4 {
    let is_inner = |gap: f64| f64::from(u8::from(gap > 1e-6));
    DVec4::new(left, 1.0 - bottom - height, 1.0 - left - width, bottom).map(is_inner)
}

/// See [`Neighbour::raster_fades`]; edges that cut by no more than a rounding error count as those that do not.
fn raster_fades(upright_from_image: DMat3, upright_size: DVec2, image_edges: DVec4) -> DVec4 {
    let corners = UNIT_SQUARE.map(|at| apply(upright_from_image, at).map_or(DVec4::ZERO, distances_from_edges));
    let cuts = -corners.into_iter().fold(DVec4::INFINITY, DVec4::min);
    let sides = upright_size.xyxy();
    let fade = |edge: usize| match cuts[edge] > LEAST_DISTANCE {
        // Fades from edge to edge, as towards the image's own edge.
        true if image_edges[edge] > 0.0 => 1.0,
        true => 1.0 / (FADE_PER_CUT * cuts[edge] + LEAST_FADE_PX / sides[edge]),
        false => 0.0,
    };
    DVec4::from([0, 1, 2, 3].map(fade))
}

/// The greatest sum of black levels on the canvas, to which the black of the whole wall is lifted.
pub fn wall_black(projectors: &[Projector], neighbours: &[Vec<Neighbour>]) -> f64 {
    let is_uneven = projectors.iter().any(|projector| projector.mesh.is_some() || projector.fall_off.is_some());
    if is_uneven { sampled_black(projectors, neighbours) } else { exact_black(projectors, neighbours) }
}

/// The greatest sum at points spread over each projector's pixels: overlaps and light may have any shape.
fn sampled_black(projectors: &[Projector], neighbours: &[Vec<Neighbour>]) -> f64 {
    /// Points a side: an overlap that all of them miss is no wider than a sixty-fourth of a projector.
    const SIDE: u32 = 64;
    let mut most: f64 = 0.0;
    for (projector, all) in projectors.iter().zip(neighbours).filter(|(projector, _)| projector.black_level > 0.0) {
        let Some(image_from_raster) = projector.raster_from_image().map(|map| map.inverse()) else { continue };
        let steps = || (0..SIDE).map(|step| (f64::from(step) + 0.5) / f64::from(SIDE));
        for raster in steps().flat_map(|y| steps().map(move |x| DVec2::new(x, y))) {
            let Some(rect_point) = apply(image_from_raster, raster).map(|image| projector.rect_at(image)) else {
                continue;
            };
            let canvas = projector.canvas.canvas_from_rect(rect_point);
            if canvas.cmpge(DVec2::ZERO).all() && canvas.cmple(DVec2::ONE).all() {
                most = most.max(all.iter().map(|it| it.leak(rect_point)).sum());
            }
        }
    }
    most
}

fn exact_black(projectors: &[Projector], neighbours: &[Vec<Neighbour>]) -> f64 {
    let corners: Vec<Option<[DVec2; 4]>> = projectors.iter().map(shrunk_corners).collect();
    let canvas = UNIT_SQUARE;
    let mut most: f64 = 0.0;
    for all in neighbours {
        // The overlap with the most black is a polygon. Its corners are corners of projectors, or crossings of two edges.
        let polygons: Vec<(&[DVec2; 4], f64)> = all
            .iter()
            .filter_map(|neighbour| Some((corners[neighbour.projector_idx].as_ref()?, neighbour.black_level)))
            .filter(|(_, black_level)| *black_level > 0.0)
            .collect();
        let outlines = || polygons.iter().map(|(polygon, _)| *polygon).chain([&canvas]);
        let crossings = outlines()
            .enumerate()
            .flat_map(|(index, polygon)| outlines().skip(index + 1).flat_map(move |other| crossings(polygon, other)));
        for point in outlines().flatten().copied().chain(crossings) {
            let is_on_canvas = point.cmpge(DVec2::splat(-1e-9)).all() && point.cmple(DVec2::splat(1.0 + 1e-9)).all();
            if is_on_canvas {
                let leaks = polygons.iter().filter(|(polygon, _)| contains(polygon, point));
                most = most.max(leaks.map(|(_, black_level)| black_level).sum());
            }
        }
    }
    most
}

/// Whether both light a part of the canvas more than a pixel wide and high: projectors that only touch do not overlap.
fn overlap(a: &Projector, b: &Projector) -> bool {
    let ([a_min, a_max], [b_min, b_max]) = (box_of(a), box_of(b));
    let shared = a_max.min(b_max) - a_min.max(b_min);
    shared.cmpgt(pixel_of(a).max(pixel_of(b))).all()
}

/// The width and height of an unwarped pixel on the canvas.
fn pixel_of(projector: &Projector) -> DVec2 {
    let [columns, rows] = projector.upright_size().map(f64::from);
    DVec2::new(projector.canvas.width / columns, projector.canvas.height / rows)
}

fn box_of(projector: &Projector) -> [DVec2; 2] {
    let CanvasRect { left, bottom, width, height } = projector.canvas;
    [DVec2::new(left, bottom), DVec2::new(left + width, bottom + height)]
}

fn boxes_meet([a_min, a_max]: [DVec2; 2], [b_min, b_max]: [DVec2; 2]) -> bool {
    a_min.cmple(b_max).all() && b_min.cmple(a_max).all()
}

/// The outline of a projector's light on the canvas.
fn lit_outline(projector: &Projector) -> Option<Vec<DVec2>> {
    let outline = projector.outline_in_rect()?;
    Some(outline.into_iter().map(|corner| projector.canvas.canvas_from_rect(corner)).collect())
}

/// The same without a mesh, half a pixel smaller on all sides: projectors that touch do not overlap.
fn shrunk_corners(projector: &Projector) -> Option<[DVec2; 4]> {
    let corners: [DVec2; 4] = lit_outline(projector)?.try_into().ok()?;
    let centre = (corners[0] + corners[1] + corners[2] + corners[3]) / 4.0;
    let [columns, rows] = projector.upright_size().map(f64::from);
    Some(corners.map(|corner| corner.lerp(centre, 1.0 / columns.min(rows).max(2.0))))
}

fn bounds(outline: &Option<Vec<DVec2>>) -> Option<[DVec2; 2]> {
    let corners = outline.as_ref()?;
    let fold = |pick: fn(DVec2, DVec2) -> DVec2| corners.iter().copied().reduce(pick);
    Some([fold(DVec2::min)?, fold(DVec2::max)?])
}

fn edges(polygon: &[DVec2; 4]) -> impl Iterator<Item = (DVec2, DVec2)> {
    (0..4).map(|index| (polygon[index], polygon[(index + 1) % 4]))
}

fn crossings<'a>(a: &'a [DVec2; 4], b: &'a [DVec2; 4]) -> impl Iterator<Item = DVec2> + 'a {
    edges(a).flat_map(move |(a0, a1)| {
        edges(b).filter_map(move |(b0, b1)| {
            let (along_a, along_b) = (a1 - a0, b1 - b0);
            let area = along_a.perp_dot(along_b);
            let [s, t] = [(b0 - a0).perp_dot(along_b) / area, (b0 - a0).perp_dot(along_a) / area];
            // Parallel edges give infinities or NaN.
            let is_on_both = (0.0..=1.0).contains(&s) && (0.0..=1.0).contains(&t);
            is_on_both.then(|| a0 + s * along_a)
        })
    })
}

/// Whether a point lies in or on the edge of a convex polygon of either orientation.
fn contains(polygon: &[DVec2; 4], point: DVec2) -> bool {
    let sides = || edges(polygon).map(|(from, to)| (to - from).perp_dot(point - from));
    sides().all(|side| side >= -1e-12) || sides().all(|side| side <= 1e-12)
}
