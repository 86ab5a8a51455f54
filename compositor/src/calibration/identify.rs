//! Finds which part of which projector's pattern a lattice is.

use std::collections::HashMap;

use glam::{DVec2, IVec2};

use super::{
    lattice::Lattice,
    pattern::{Plan, is_white},
};

/// A part of a projector's pattern in a photograph.
#[derive(Clone, Debug, PartialEq)]
pub struct Sighting {
    /// The projector.
    pub projector_idx: usize,
    /// The pattern that it showed.
    pub pattern: u32,
    /// Whether the photograph shows it mirrored.
    pub is_mirrored: bool,
    /// Crossings: their places in the projector's pixels, and in the photograph's.
    pub points: Vec<[DVec2; 2]>,
}

/// The squares of a window by which places are looked up: four by four.
const WINDOW: i32 = 4;
/// Bits that must be read right beyond those that tell all places apart: one lattice in 2²⁰ is taken for another.
const SPARE_BITS: f64 = 20.0;

/// Where each window of squares occurs in the patterns of a wall.
#[derive(Debug)]
pub struct Codebook<'a> {
    plan: &'a Plan,
    places: HashMap<u32, Vec<Place>>,
    /// Bits that tell all places and directions apart.
    n_bits: f64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Place {
    projector_idx: usize,
    pattern: u32,
    at: IVec2,
}

/// A way to lay a lattice onto a projector's squares.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Match {
    place: Place,
    turn: usize,
}

/// The eight ways to turn and mirror a square lattice: new column and row, each from column and row.
const TURNS: [[[i32; 2]; 2]; 8] = [
    [[1, 0], [0, 1]],
    [[0, -1], [1, 0]],
    [[-1, 0], [0, -1]],
    [[0, 1], [-1, 0]],
    [[-1, 0], [0, 1]],
    [[0, 1], [1, 0]],
    [[1, 0], [0, -1]],
    [[0, -1], [-1, 0]],
];

/// The turns from here on are mirrored.
const FIRST_MIRRORED: usize = 4;

fn turned(turn: usize, place: IVec2) -> IVec2 {
    let [column, row] = TURNS[turn];
    IVec2::new(IVec2::from(column).dot(place), IVec2::from(row).dot(place))
}

/// A square of the turned lattice, named by its lowest crossing as before.
fn turned_square(turn: usize, square: IVec2) -> IVec2 {
    (turned(turn, 2 * square + 1) - 1) / 2
}

impl<'a> Codebook<'a> {
    /// The windows of all patterns.
    pub fn new(plan: &'a Plan) -> Self {
        let mut places: HashMap<u32, Vec<Place>> = HashMap::new();
        let mut n_places = 0_u64;
        for (projector_idx, board) in plan.boards.iter().enumerate() {
            for pattern in 0..plan.n_with_light() {
                let [columns, rows] = board.squares.map(|it| it as i32 - WINDOW + 1);
                for at in (0..rows).flat_map(|row| (0..columns).map(move |column| IVec2::new(column, row))) {
                    let read = |square: IVec2| {
                        let square = square.as_uvec2().to_array();
                        Some((is_white(square), plan.bit(pattern, projector_idx, square)))
                    };
                    let key = key_of(at, read).unwrap_or_default();
                    places.entry(key).or_default().push(Place { projector_idx, pattern, at });
                    n_places += 1;
                }
            }
        }
        let n_bits = (n_places.max(1) as f64 * TURNS.len() as f64).log2();
        Self { plan, places, n_bits }
    }

    /// The patterns whose windows it holds.
    pub(super) fn plan(&self) -> &'a Plan {
        self.plan
    }

    /// The parts of patterns that a lattice shows; none if it belongs to another wall, or is no pattern.
    pub(super) fn identify(&self, lattice: &Lattice) -> Vec<Sighting> {
        let mut rest = lattice.clone();
        let mut sightings = Vec::new();
        // Two projectors' boards may happen to continue each other.
        while let Some(best) = self.best_match(&rest) {
            let agreeing = self.agreeing(&rest, best);
            if !self.is_certain(agreeing.values().filter(|agrees| **agrees).count(), agreeing.len()) {
                break;
            }
            sightings.push(self.sighting(&rest, best, &agreeing));
            rest.squares.retain(|square, _| !agreeing.get(square).copied().unwrap_or(false));
        }
        sightings.retain(|sighting: &Sighting| sighting.points.len() >= 12);
        sightings
    }

    /// The match with the most windows.
    fn best_match(&self, lattice: &Lattice) -> Option<Match> {
        let mut votes: HashMap<Match, u32> = HashMap::new();
        for turn in 0..TURNS.len() {
            let squares: HashMap<IVec2, _> =
                lattice.squares.iter().map(|(square, read)| (turned_square(turn, *square), *read)).collect();
            for at in squares.keys() {
                let key = key_of(*at, |square| squares.get(&square).map(|read| (read.is_white, read.has_dot)));
                for place in key.and_then(|key| self.places.get(&key)).into_iter().flatten() {
                    let place = Place { at: place.at - at, ..*place };
                    *votes.entry(Match { place, turn }).or_default() += 1;
                }
            }
        }
        let by_votes = |(a, n): &(Match, u32), (b, m): &(Match, u32)| {
            // Equal votes: always the same one.
            let order = |it: &Match| (it.place.projector_idx, it.place.pattern, it.turn, it.place.at.to_array());
            n.cmp(m).then(order(b).cmp(&order(a)))
        };
        votes.into_iter().max_by(by_votes).map(|(best, _)| best)
    }

    /// For each square that lies on the board: whether it looks as it should.
    fn agreeing(&self, lattice: &Lattice, Match { place, turn }: Match) -> HashMap<IVec2, bool> {
        let board = &self.plan.boards[place.projector_idx];
        let compare = |(square, read): (&IVec2, &super::lattice::Square)| {
            let on_board = turned_square(turn, *square) + place.at;
            let [columns, rows] = board.squares.map(|it| it as i32);
            let is_on_board = (0..columns).contains(&on_board.x) && (0..rows).contains(&on_board.y);
            let agrees = is_on_board && {
                let on_board = on_board.as_uvec2().to_array();
                let bit = self.plan.bit(place.pattern, place.projector_idx, on_board);
                read.is_white == is_white(on_board) && read.has_dot == bit
            };
            is_on_board.then_some((*square, agrees))
        };
        lattice.squares.iter().filter_map(compare).collect()
    }

    /// Whether so many right bits of `n` are no accident: bits that agree by chance carry none of the information that
    /// a noisy channel with that rate of errors does (Shannon 1948).
    fn is_certain(&self, n_right: usize, n: usize) -> bool {
        let wrong = (n - n_right) as f64 / n.max(1) as f64;
        let entropy = |part: f64| if part > 0.0 { -part * part.log2() } else { 0.0 };
        wrong < 0.5 && n as f64 * (1.0 - entropy(wrong) - entropy(1.0 - wrong)) >= self.n_bits + SPARE_BITS
    }

    fn sighting(&self, lattice: &Lattice, best: Match, agreeing: &HashMap<IVec2, bool>) -> Sighting {
        let Match { place, turn } = best;
        let board = &self.plan.boards[place.projector_idx];
        let mut points: Vec<[DVec2; 2]> = Vec::new();
        for (crossing, at) in &lattice.crossings {
            let around = [IVec2::ZERO, IVec2::NEG_X, IVec2::NEG_Y, IVec2::NEG_ONE];
            let around: Vec<bool> =
                around.iter().filter_map(|step| agreeing.get(&(crossing + step)).copied()).collect();
            let n_right = around.iter().filter(|agrees| **agrees).count();
            let on_board = turned(turn, *crossing) + place.at;
            let is_inside = (1..board.squares[0] as i32).contains(&on_board.x)
                && (1..board.squares[1] as i32).contains(&on_board.y);
            // One square beside it may be misread, as by a reflection.
            if is_inside && n_right >= 2 && around.len() - n_right <= n_right / 3 {
                points.push([board.corner_px([on_board.x.into(), on_board.y.into()]), *at]);
            }
        }
        points.sort_by(|a, b| a[0].y.total_cmp(&b[0].y).then(a[0].x.total_cmp(&b[0].x)));
        Sighting {
            projector_idx: place.projector_idx,
            pattern: place.pattern,
            is_mirrored: turn >= FIRST_MIRRORED,
            points,
        }
    }
}

/// The bits of a window and the colour of its first square; `None` if a square was not read.
fn key_of(at: IVec2, read: impl Fn(IVec2) -> Option<(bool, bool)>) -> Option<u32> {
    let mut key = 0;
    for step in (0..WINDOW).flat_map(|row| (0..WINDOW).map(move |column| IVec2::new(column, row))) {
        let (_, has_dot) = read(at + step)?;
        key = key << 1 | u32::from(has_dot);
    }
    Some(key << 1 | u32::from(read(at)?.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{calibration::lattice::Square, wall::Wall};

    fn plan() -> Plan {
        let text = "canvas_m = [2, 1]\n[grid]\ncolumns = 2\nrows = 1\npixels = [640, 480]\noverlap = [0.1, 0.0]";
        Plan::of_wall(&Wall::from_toml("two", text).expect("a wall")).expect("patterns")
    }

    /// A part of a board, from a square on, turned.
    fn part(plan: &Plan, from: [i32; 2], size: [i32; 2], turn: usize) -> Lattice {
        let mut lattice = Lattice::default();
        for (x, y) in (0..size[0]).flat_map(|x| (0..size[1]).map(move |y| (x, y))) {
            let square = (IVec2::from(from) + IVec2::new(x, y)).as_uvec2().to_array();
            let read = Square { is_white: is_white(square), has_dot: plan.bit(1, 1, square) };
            lattice.squares.insert(turned_square(turn, IVec2::new(x, y)), read);
        }
        for (x, y) in (0..=size[0]).flat_map(|x| (0..=size[1]).map(move |y| (x, y))) {
            let place = IVec2::new(x, y);
            lattice.crossings.insert(turned(turn, place), (IVec2::from(from) + place).as_dvec2());
        }
        lattice
    }

    #[test]
    fn parts_of_a_board_are_placed_however_they_are_turned_and_with_squares_misread() {
        let plan = plan();
        let codebook = Codebook::new(&plan);
        for turn in 0..TURNS.len() {
            let mut lattice = part(&plan, [5, 9], [12, 9], turn);
            for misread in [[2, 3], [7, 7], [10, 1]] {
                let square = lattice.squares.get_mut(&turned_square(turn, misread.into())).expect("in the part");
                square.has_dot = !square.has_dot;
            }
            let sightings = codebook.identify(&lattice);
            let [sighting] = &sightings[..] else { panic!("{turn}: {sightings:?}") };
            assert_eq!((sighting.projector_idx, sighting.pattern), (1, 1));
            assert_eq!(sighting.is_mirrored, turn >= FIRST_MIRRORED);
            assert!(sighting.points.len() > 80);
            for [px, at] in &sighting.points {
                assert_eq!(*px, plan.boards[1].corner_px(at.to_array()), "{turn}");
            }
        }
    }

    #[test]
    fn noise_and_small_parts_are_nobodys() {
        let plan = plan();
        let codebook = Codebook::new(&plan);
        assert_eq!(codebook.identify(&part(&plan, [5, 9], [5, 5], 0)), []);
        let mut lattice = part(&plan, [5, 9], [25, 20], 0);
        for (square, read) in &mut lattice.squares {
            read.has_dot = square.x.wrapping_mul(48_271).wrapping_add(square.y * 69_621) / 7 % 2 == 0;
        }
        assert_eq!(codebook.identify(&lattice), []);
    }
}
