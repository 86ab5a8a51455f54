//! Puts crossings together to lattices: parts of checkerboards, square by square.

use std::collections::{HashMap, VecDeque};

use glam::{DVec2, IVec2};

use super::{
    crossing::{Crossing, refined},
    photograph::Photograph,
};

/// A connected part of a checkerboard in a photograph.
#[derive(Clone, Debug, Default)]
pub(super) struct Lattice {
    /// Crossings by column and row; where they begin, how they are turned, and whether they are mirrored is unknown.
    pub crossings: HashMap<IVec2, DVec2>,
    /// Squares by the column and row of the crossing with the lowest column and row.
    pub squares: HashMap<IVec2, Square>,
}

/// A square of which four crossings were found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Square {
    pub is_white: bool,
    /// Whether it has a dot.
    pub has_dot: bool,
}

/// Lattices of fewer crossings say nothing.
const FEWEST_CROSSINGS: usize = 16;
/// Squares are at most this long, in pixels.
const LONGEST_SIDE: f64 = 400.0;
/// After as many searches without a lattice, a photograph most likely shows none: only squares of a usual length are
/// searched, so that one of leaves takes no minutes.
const MOST_WIDE_SEARCHES: usize = 500;
/// Squares of a wall that fills a photograph are at most this long, in pixels.
const USUAL_SIDE: f64 = 100.0;
/// A crossing lies within this distance of where its neighbours let expect it, as a part of a square's side.
const TOLERANCE: f64 = 0.22;
/// The steps along both lines of a crossing differ by no more than this factor: where the next crossings of one line are missing,
/// those three squares away look like them.
const LARGEST_SLANT: f64 = 2.4;
/// Neighbours' lines agree within an angle of this sine.
const LARGEST_TURN: f64 = 0.3;
/// Dot and square differ by this part of the contrast between squares at least.
const LEAST_DOT: f64 = 0.35;
/// The side of a cell of the index in pixels.
const CELL: f64 = 16.0;

/// All lattices of a photograph, the largest first.
pub(super) fn find(photograph: &Photograph, crossings: &[Crossing]) -> Vec<Lattice> {
    let index = Index::new(crossings);
    let mut is_used = vec![false; crossings.len()];
    let mut lattices = Vec::new();
    // The strongest crossings tell how long squares are; the others are mostly noise, and need no wide search.
    let mut reach = LONGEST_SIDE;
    let mut n_searched = 0;
    for seed in 0..crossings.len() {
        if is_used[seed] {
            continue;
        }
        n_searched += 1;
        if lattices.is_empty() && n_searched > MOST_WIDE_SEARCHES {
            reach = USUAL_SIDE;
        }
        let Some(steps) = steps_from(crossings, &index, seed, reach) else { continue };
        let nodes = grow(crossings, &index, &mut is_used, seed, steps);
        if nodes.len() >= FEWEST_CROSSINGS {
            let side = steps[0].length().min(steps[1].length());
            let longest = if lattices.is_empty() { 0.0 } else { reach };
            reach = longest.max(2.5 * side);
            lattices.push(Lattice::new(photograph, crossings, &nodes, side));
        }
    }
    lattices.sort_by_key(|lattice| std::cmp::Reverse(lattice.squares.len()));
    lattices
}

/// Crossings by place.
struct Index<'a> {
    crossings: &'a [Crossing],
    cells: HashMap<IVec2, Vec<usize>>,
}

impl<'a> Index<'a> {
    fn new(crossings: &'a [Crossing]) -> Self {
        let mut cells: HashMap<IVec2, Vec<usize>> = HashMap::new();
        for (index, crossing) in crossings.iter().enumerate() {
            cells.entry((crossing.at / CELL).floor().as_ivec2()).or_default().push(index);
        }
        Self { crossings, cells }
    }

    /// Crossings within a distance of a point.
    fn within(&self, at: DVec2, radius: f64) -> impl Iterator<Item = usize> {
        let (from, to) = (((at - radius) / CELL).floor().as_ivec2(), ((at + radius) / CELL).floor().as_ivec2());
        let cells = (from.y..=to.y).flat_map(move |y| (from.x..=to.x).map(move |x| IVec2::new(x, y)));
        let all = cells.filter_map(|cell| self.cells.get(&cell)).flatten().copied();
        all.filter(move |&index| self.crossings[index].at.distance_squared(at) <= radius * radius)
    }
}

/// Whether two crossings can be next to each other on a line: black and white are exchanged, and lines go on.
fn are_neighbours(a: &Crossing, b: &Crossing) -> bool {
    let goes_on = |line: DVec2| b.lines.iter().any(|other| line.perp_dot(*other).abs() <= LARGEST_TURN);
    a.white.dot(b.white).abs() < 0.6 && goes_on(a.lines[0]) && goes_on(a.lines[1])
}

/// The steps to the next crossings along both lines, if there is one on each side, and squares are not far longer than wide.
fn steps_from(crossings: &[Crossing], index: &Index<'_>, seed: usize, reach: f64) -> Option<[DVec2; 2]> {
    let own = &crossings[seed];
    let nearest = |direction: DVec2| {
        // Most squares are small: search wider only if nothing is near.
        [32.0, 96.0, LONGEST_SIDE].into_iter().map(|radius: f64| radius.min(reach)).find_map(|radius| {
            let away = |other: usize| crossings[other].at - own.at;
            let is_ahead = |other: &usize| {
                let step = away(*other);
                let along = step.dot(direction);
                along > 4.0
                    && step.perp_dot(direction).abs() <= TOLERANCE * along
                    && are_neighbours(own, &crossings[*other])
            };
            let ahead = index.within(own.at, radius).filter(|&other| other != seed).filter(is_ahead);
            ahead.map(away).min_by(|a, b| a.length_squared().total_cmp(&b.length_squared()))
        })
    };
    let step = |line: DVec2| {
        let (forward, back) = (nearest(line)?, nearest(-line)?);
        let ratio = forward.length() / back.length();
        (0.75..1.34).contains(&ratio).then(|| (forward - back) / 2.0)
    };
    let [first, mut second] = [step(own.lines[0])?, step(own.lines[1])?];
    if first.perp_dot(second) < 0.0 {
        second = -second;
    }
    let slant = first.length() / second.length();
    (LARGEST_SLANT.recip()..=LARGEST_SLANT).contains(&slant).then_some([first, second])
}

/// Follows lines from crossing to crossing.
fn grow(
    crossings: &[Crossing],
    index: &Index<'_>,
    is_used: &mut [bool],
    seed: usize,
    [right, down]: [DVec2; 2],
) -> HashMap<IVec2, usize> {
    // Each crossing with its steps along both axes.
    let mut nodes: HashMap<IVec2, usize> = HashMap::from([(IVec2::ZERO, seed)]);
    let mut queue = VecDeque::from([(IVec2::ZERO, [right, down])]);
    is_used[seed] = true;
    while let Some((place, steps)) = queue.pop_front() {
        let own = nodes[&place];
        for (axis, sign) in [(0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0)] {
            let step = sign * steps[axis];
            let next = place + if axis == 0 { IVec2::X } else { IVec2::Y } * sign as i32;
            if nodes.contains_key(&next) {
                continue;
            }
            let expected = crossings[own].at + step;
            let is_next = |other: &usize| !is_used[*other] && are_neighbours(&crossings[own], &crossings[*other]);
            let near = index.within(expected, TOLERANCE * step.length()).filter(is_next);
            let distance = |other: &usize| crossings[*other].at.distance_squared(expected);
            let Some(found) = near.min_by(|a, b| distance(a).total_cmp(&distance(b))) else { continue };
            is_used[found] = true;
            nodes.insert(next, found);
            let mut next_steps = steps;
            next_steps[axis] = sign * (crossings[found].at - crossings[own].at);
            queue.push_back((next, next_steps));
        }
    }
    nodes
}

impl Lattice {
    fn new(photograph: &Photograph, coarse: &[Crossing], nodes: &HashMap<IVec2, usize>, side: f64) -> Self {
        // A third of the way to the dots, whose edges begin at 0.41 sides from a crossing.
        let radius = (0.3 * side).clamp(2.5, 12.0);
        let refine = |(place, index): (&IVec2, &usize)| Some((*place, refined(photograph, coarse[*index].at, radius)?));
        let crossings: HashMap<IVec2, DVec2> = nodes.iter().filter_map(refine).collect();
        let mut readings = HashMap::new();
        for (place, at) in &crossings {
            let corners = [IVec2::X, IVec2::ONE, IVec2::Y].map(|offset| crossings.get(&(place + offset)));
            if let [Some(b), Some(c), Some(d)] = corners {
                readings.insert(*place, Reading::of(photograph, [*at, *b, *c, *d]));
            }
        }
        let square = |(place, reading): (&IVec2, &Reading)| {
            let around = [IVec2::X, IVec2::NEG_X, IVec2::Y, IVec2::NEG_Y];
            let others: Vec<f64> =
                around.iter().filter_map(|step| readings.get(&(place + step))).map(|it| it.square).collect();
            let others_mean = others.iter().sum::<f64>() / others.len() as f64;
            let contrast = reading.square - others_mean;
            let has_dot = (reading.square - reading.centre) / contrast >= LEAST_DOT;
            (!others.is_empty()).then_some((*place, Square { is_white: contrast > 0.0, has_dot }))
        };
        let squares = readings.iter().filter_map(square).collect();
        Self { crossings, squares }
    }
}

/// The brightness of a square, at its centre and beside its dot.
struct Reading {
    centre: f64,
    square: f64,
}

impl Reading {
    fn of(photograph: &Photograph, [a, b, c, d]: [DVec2; 4]) -> Self {
        let at = |s: f64, t: f64| {
            let point = (a * (1.0 - s) + b * s) * (1.0 - t) + (d * (1.0 - s) + c * s) * t;
            f64::from(photograph.at(point))
        };
        let near = [0.44, 0.56];
        let centre = near.iter().flat_map(|&t| near.map(|s| at(s, t))).sum::<f64>() / 4.0;
        let far = [0.2, 0.8];
        let square = far.iter().flat_map(|&t| far.map(|s| at(s, t))).sum::<f64>() / 4.0;
        Self { centre, square }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_crossing_whose_neighbours_on_one_line_are_missing_begins_no_lattice() {
        let crossing = |place: IVec2| {
            let white = DVec2::new(1.0, if (place.x + place.y) % 2 == 0 { 1.0 } else { -1.0 }).normalize();
            let at = place.as_dvec2() * DVec2::new(38.0, 20.0);
            Crossing { at, white, lines: [DVec2::X, DVec2::Y], strength: 1.0 }
        };
        let places = (0..9).flat_map(|row| (0..9).map(move |column| IVec2::new(column, row)));
        let is_missing = |place: &IVec2| [IVec2::new(3, 4), IVec2::new(5, 4)].contains(place);
        let places: Vec<IVec2> = places.filter(|place| !is_missing(place)).collect();
        let crossings: Vec<Crossing> = places.iter().copied().map(crossing).collect();
        let steps = |at: IVec2| {
            let seed = places.iter().position(|place| *place == at).expect("it is there");
            steps_from(&crossings, &Index::new(&crossings), seed, LONGEST_SIDE)
        };
        assert_eq!(steps(IVec2::new(4, 4)), None);
        assert_eq!(steps(IVec2::new(4, 2)), Some([DVec2::new(38.0, 0.0), DVec2::new(0.0, 20.0)]));
    }
}
