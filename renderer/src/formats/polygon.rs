//! Divides polygons into triangles.

use glam::{DVec2, DVec3};

/// Most corners of a polygon that is not fanned in any case, and how often its corners may be tested, for each of them: a file
/// of polygons whose edges cross everywhere takes seconds a megabyte.
const MOST_CORNERS: usize = 1024;
const MOST_TESTS: usize = 8;

/// Divides polygons one after the other, in memory that all of them share.
#[derive(Default)]
pub(super) struct PolygonDivider {
    /// Of the present polygon: its corners from the first one, and the same in a plane, where they run counter-clockwise.
    corners: Vec<DVec3>,
    in_plane: Vec<DVec2>,
    ears: Vec<[u32; 3]>,
    /// The numbers of the corners that are left.
    ring: Vec<u32>,
}

/// The triangles of a polygon by the numbers of its corners: ears, and a fan around the first of those that are left. A fan of all
/// takes no memory, because a file may be one polygon.
#[derive(Clone, Copy)]
pub(super) struct Division<'a> {
    ears: &'a [[u32; 3]],
    /// None if all are left.
    ring: Option<&'a [u32]>,
    n_left: usize,
}

impl<'a> Division<'a> {
    /// All triangles around the first of `n` corners: (0, 1, 2), (0, 2, 3), …
    pub(super) fn fan(n: usize) -> Self {
        Self { ears: &[], ring: None, n_left: n }
    }

    /// Number of triangles.
    pub(super) fn len(self) -> usize {
        self.ears.len() + self.n_left.saturating_sub(2)
    }

    pub(super) fn triangles(self) -> impl Iterator<Item = [u32; 3]> + 'a {
        let left = move |index: usize| self.ring.map_or(index as u32, |ring| ring[index]);
        let fan = (2..self.n_left).map(move |last| [0, last - 1, last].map(left));
        self.ears.iter().copied().chain(fan)
    }
}

impl PolygonDivider {
    /// The triangles of a polygon of `n` corners: two fewer than corners.
    ///
    /// They are a fan unless a part of it would lie outside the polygon: then ears are cut off, after
    /// Meisters, "Polygons Have Ears" (1975). A polygon with a corner that has no finite position is fanned.
    pub(super) fn divide(&mut self, n: usize, corner: impl Fn(usize) -> Option<DVec3>) -> Division<'_> {
        if !(4..=MOST_CORNERS).contains(&n) || !self.place(n, corner) || self.is_fan_inside() {
            return Division::fan(n);
        }
        self.cut_ears();
        Division { ears: &self.ears, ring: Some(&self.ring), n_left: self.ring.len() }
    }

    /// Places the corners in the plane that the polygon faces most. Returns false if it has no area.
    fn place(&mut self, n: usize, corner: impl Fn(usize) -> Option<DVec3>) -> bool {
        let Some(first) = corner(0) else { return false };
        self.corners.clear();
        self.corners.extend((0..n).map_while(|number| Some(corner(number)? - first)));
        // Products of tiny or huge numbers may leave the range.
        let size = self.corners.iter().fold(0.0, |size: f64, corner| size.max(corner.abs().max_element()));
        self.corners.iter_mut().for_each(|corner| *corner /= size);

        let normal: DVec3 = self.corners.windows(2).map(|edge| edge[0].cross(edge[1])).sum();
        let axis = normal.abs().max_position();
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let (u, v) = if normal[axis] > 0.0 { (u, v) } else { (v, u) };
        self.in_plane.clear();
        self.in_plane.extend(self.corners.iter().map(|corner| DVec2::new(corner[u], corner[v])));
        self.corners.len() == n && normal[axis].abs() > 0.0
    }

    /// Twice the area of a triangle, less than zero if its corners run clockwise.
    fn area(&self, [a, b, c]: [u32; 3]) -> f64 {
        let [a, b, c] = [a, b, c].map(|number| self.in_plane[number as usize]);
        (b - a).perp_dot(c - a)
    }

    /// Whether no triangle of the fan is turned over.
    fn is_fan_inside(&self) -> bool {
        (2..self.in_plane.len() as u32).all(|last| self.area([0, last - 1, last]) >= 0.0)
    }

    /// Cuts ears off the ring of all corners until three are left, or no ear is found.
    fn cut_ears(&mut self) {
        self.ears.clear();
        self.ring.clear();
        self.ring.extend(0..self.in_plane.len() as u32);
        let (mut at, mut n_refused, mut n_tests) = (0, 0, MOST_TESTS * self.ring.len());
        while self.ring.len() > 3 && n_refused < self.ring.len() && n_tests > 0 {
            let n = self.ring.len();
            let ear = [self.ring[(at + n - 1) % n], self.ring[at], self.ring[(at + 1) % n]];
            if self.is_ear(ear, &mut n_tests) {
                self.ears.push(ear);
                self.ring.remove(at);
                (at, n_refused) = (at % (n - 1), 0);
            } else {
                (at, n_refused) = ((at + 1) % n, n_refused + 1);
            }
        }
    }

    /// Whether three neighbours of the ring are a triangle that no other corner lies in or on.
    fn is_ear(&self, ear: [u32; 3], n_tests: &mut usize) -> bool {
        if self.area(ear) <= 0.0 {
            return false;
        }
        *n_tests -= 1;
        let [a, b, c] = ear;
        self.ring.iter().all(|&other| {
            // A slit to a hole passes two corners of one position.
            let is_corner = ear.iter().any(|&it| self.in_plane[it as usize] == self.in_plane[other as usize]);
            is_corner || [[a, b, other], [b, c, other], [c, a, other]].into_iter().any(|side| self.area(side) < 0.0)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn divide(corners: &[[f64; 2]], place: impl Fn([f64; 2]) -> DVec3) -> Vec<[u32; 3]> {
        triangles(&mut PolygonDivider::default(), corners.len(), |number| Some(place(corners[number])))
    }

    fn triangles(divider: &mut PolygonDivider, n: usize, corner: impl Fn(usize) -> Option<DVec3>) -> Vec<[u32; 3]> {
        let division = divider.divide(n, corner);
        assert_eq!(division.triangles().count(), division.len());
        division.triangles().collect()
    }

    fn fan(n: u32) -> Vec<[u32; 3]> {
        (2..n).map(|last| [0, last - 1, last]).collect()
    }

    /// Twice the area of a polygon in the plane.
    fn area(corners: &[[f64; 2]]) -> f64 {
        let last = corners[corners.len() - 1];
        let starts = std::iter::once(&last).chain(corners);
        starts.zip(corners).map(|(p, q)| p[0] * q[1] - p[1] * q[0]).sum()
    }

    #[test]
    fn convex_polygons_are_fanned() {
        let round: Vec<_> = (0..7).map(|k| f64::from(k) * 0.9).map(|angle| [angle.cos(), angle.sin()]).collect();
        for n in 0..=7 {
            assert_eq!(divide(&round[..n], |[x, y]| DVec3::new(x, y, 0.0)), fan(n as u32));
        }
        // With a corner between its neighbours, and one that is there twice.
        let square = [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]];
        assert_eq!(divide(&square, |[x, y]| DVec3::new(0.0, x, y)), fan(6));
    }

    #[test]
    fn triangles_of_concave_polygons_fill_them_and_face_their_way() {
        let dart = vec![[4.0, 0.0], [4.0, 4.0], [2.0, 1.0], [0.0, 0.0]];
        let letter =
            vec![[0.0, 0.0], [3.0, 0.0], [3.0, 3.0], [2.0, 3.0], [2.0, 1.0], [1.0, 1.0], [1.0, 3.0], [0.0, 3.0]];
        let star = (0..20).map(|k| (f64::from(k) * 0.314_159, f64::from(1 + k % 2)));
        let star: Vec<_> = star.map(|(angle, radius)| [radius * angle.cos(), radius * angle.sin()]).collect();
        for corners in [dart, letter, star] {
            for size in [1e-30, 1.0, 1e17] {
                let [along, across] = [DVec3::new(0.6, 0.0, 0.8), DVec3::new(0.0, 1.0, 0.0)];
                for across in [across, -across] {
                    let place = |[x, y]: [f64; 2]| (along * x + across * y + DVec3::new(7.0, 8.0, 9.0)) * size;
                    for first in 0..corners.len() {
                        let corners = [&corners[first..], &corners[..first]].concat();
                        let triangles = divide(&corners, place);
                        let of_triangle = |triangle: &[u32; 3]| area(&triangle.map(|number| corners[number as usize]));
                        assert!(triangles.iter().all(|triangle| of_triangle(triangle) > 0.0), "{triangles:?}");
                        let sum: f64 = triangles.iter().map(of_triangle).sum();
                        assert!((sum / area(&corners) - 1.0).abs() < 1e-9, "{triangles:?} of {corners:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_slit_to_a_hole_and_corners_on_edges_are_no_obstacle() {
        let ring = [
            [0.0, 0.0],
            [2.0, 0.0],
            [4.0, 0.0],
            [4.0, 4.0],
            [0.0, 4.0],
            [0.0, 0.0],
            [1.0, 1.0],
            [1.0, 3.0],
            [3.0, 3.0],
            [3.0, 1.0],
            [1.0, 1.0],
        ];
        let triangles = divide(&ring, |[x, y]| DVec3::new(x, y, 5.0));
        assert_eq!(triangles.len(), ring.len() - 2);
        let areas = triangles.iter().map(|triangle| area(&triangle.map(|number| ring[number as usize])));
        assert!(areas.clone().all(|area| area >= 0.0));
        assert_eq!(areas.sum::<f64>(), 2.0 * (16.0 - 4.0));
    }

    #[test]
    fn polygons_without_a_shape_have_as_many_triangles() {
        let mut divider = PolygonDivider::default();
        let on_line = |number: usize| Some(DVec3::X * [0.0, 3.0, 1.0, 2.0, 5.0][number]);
        assert_eq!(triangles(&mut divider, 5, on_line), fan(5));
        assert_eq!(triangles(&mut divider, 5, |_| Some(DVec3::ONE)), fan(5));
        assert_eq!(triangles(&mut divider, 5, |number| (number != 3).then_some(DVec3::ONE)), fan(5));
        for n in [4, 5, 100, MOST_CORNERS, MOST_CORNERS + 1, 3 * MOST_CORNERS] {
            let crossing = |number: usize| DVec3::new((number * number) as f64 % 97.0, number as f64 % 13.0, 0.0);
            assert_eq!(triangles(&mut divider, n, |number| Some(crossing(number))).len(), n - 2);
        }
    }
}
