//! Where labels stand: beside their points, never over each other, and as still as they can while the camera moves. Pure.

use egui::{Pos2, Rect, Vec2};

/// A place beside a point: a direction, and a distance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Slot {
    direction: u8,
    distance: u8,
}

/// A label to place; all lengths are in the same unit along both axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Wanted {
    /// The point that it belongs to.
    pub anchor: Pos2,
    pub size: Vec2,
    /// Its slot in the picture before.
    pub slot: Option<Slot>,
}

/// The parts of the canvas that labels share with others.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Room {
    pub bounds: Rect,
    /// Covered by panels and other texts.
    pub covered: Vec<Rect>,
    /// Screens or projectors, across whose edges no label should reach.
    pub screens: Vec<Rect>,
    /// Points of measurements, which no label hides.
    pub points: Vec<Pos2>,
    /// Space between labels, and around points.
    pub gap: f32,
}

/// Directions around a point, each with its rank: above and to the right come first.
const DIRECTIONS: [(Vec2, u8); 12] = [
    (Vec2::new(0.71, -0.71), 0),
    (Vec2::new(-0.71, -0.71), 1),
    (Vec2::new(0.71, 0.71), 2),
    (Vec2::new(-0.71, 0.71), 3),
    (Vec2::new(1.0, 0.0), 4),
    (Vec2::new(-1.0, 0.0), 5),
    (Vec2::new(0.0, -1.0), 6),
    (Vec2::new(0.0, 1.0), 7),
    (Vec2::new(0.92, -0.39), 8),
    (Vec2::new(-0.92, -0.39), 9),
    (Vec2::new(0.92, 0.39), 10),
    (Vec2::new(-0.92, 0.39), 11),
];
/// Distances from a point, in gaps.
const DISTANCES: [f32; 6] = [2.0, 4.0, 7.0, 11.0, 16.0, 24.0];
/// A farther distance is as bad as so many ranks of direction.
const FARTHER: u32 = 6;
/// Reaching across the edge of a screen is worse than any place beside it.
const ACROSS_EDGE: u32 = 1000;

/// A label that has its place.
struct Placed {
    area: Rect,
    leader: [Pos2; 2],
}

/// Finds a place for each label, the first in the list first; `None` where there is none.
///
/// A label keeps its slot as long as nothing is in the way: it moves with its point, and jumps only to make room.
pub(super) fn place(wanted: &[Wanted], room: &Room) -> Vec<Option<(Slot, Rect)>> {
    let mut placed: Vec<Placed> = Vec::new();
    // Those that have a place keep it before others look for one.
    let mut order: Vec<usize> = (0..wanted.len()).collect();
    order.sort_by_key(|&index| (index > 0 && wanted[index].slot.is_none(), index));
    let mut slots = vec![None; wanted.len()];
    for index in order {
        let label = &wanted[index];
        let is_free = |slot: Slot| is_free(label, slot, index, wanted, &placed, room);
        let found = label.slot.filter(|&slot| is_free(slot)).or_else(|| {
            let mut free: Vec<Slot> = all_slots().filter(|&slot| is_free(slot)).collect();
            free.sort_by_key(|&slot| cost(label, slot, room));
            free.first().copied()
        });
        if let Some(slot) = found {
            let area = area(label, slot, room.gap);
            placed.push(Placed { area, leader: leader(label.anchor, area) });
            slots[index] = Some((slot, area));
        }
    }
    slots
}

/// The line from a point to the nearest point of its label.
pub(super) fn leader(anchor: Pos2, area: Rect) -> [Pos2; 2] {
    [anchor, area.clamp(anchor)]
}

fn all_slots() -> impl Iterator<Item = Slot> {
    let directions = || 0..DIRECTIONS.len() as u8;
    (0..DISTANCES.len() as u8).flat_map(move |distance| directions().map(move |direction| Slot { direction, distance }))
}

fn area(label: &Wanted, Slot { direction, distance }: Slot, gap: f32) -> Rect {
    let direction = DIRECTIONS[usize::from(direction) % DIRECTIONS.len()].0;
    let distance = DISTANCES[usize::from(distance) % DISTANCES.len()] * gap;
    // The box touches the end of the way: with a side, or at 45° with a corner.
    let toward = direction / direction.abs().max_elem();
    Rect::from_center_size(label.anchor + direction * distance + toward * label.size * 0.5, label.size)
}

fn cost(label: &Wanted, slot: Slot, room: &Room) -> u32 {
    let area = area(label, slot, room.gap);
    let is_across = !room.screens.is_empty() && !room.screens.iter().any(|screen| screen.contains_rect(area));
    let rank = u32::from(DIRECTIONS[usize::from(slot.direction) % DIRECTIONS.len()].1);
    rank + FARTHER * u32::from(slot.distance) + if is_across { ACROSS_EDGE } else { 0 }
}

fn is_free(label: &Wanted, slot: Slot, index: usize, wanted: &[Wanted], placed: &[Placed], room: &Room) -> bool {
    let area = area(label, slot, room.gap);
    let (wide, line) = (area.expand(room.gap * 0.5), leader(label.anchor, area));
    let hides_point = |(other, wanted): (usize, &Wanted)| other != index && wide.contains(wanted.anchor);
    let is_in_the_way = |other: &Placed| {
        wide.intersects(other.area)
            || crosses(other.area, line)
            || crosses(wide, other.leader)
            || lines_cross(line, other.leader)
    };
    room.bounds.contains_rect(area)
        && !room.covered.iter().any(|panel| panel.intersects(wide) || crosses(*panel, line))
        && !room.points.iter().any(|&point| wide.contains(point))
        && !wanted.iter().enumerate().any(hides_point)
        && !placed.iter().any(is_in_the_way)
}

/// Whether a line meets a box: Liang and Barsky, "A New Concept and Method for Line Clipping" (1984).
fn crosses(area: Rect, line: [Pos2; 2]) -> bool {
    clipped(area, line).is_some()
}

/// Whether two lines cross: the ends of each lie on both sides of the other.
fn lines_cross([a, b]: [Pos2; 2], [c, d]: [Pos2; 2]) -> bool {
    let side = |from: Pos2, to: Pos2, point: Pos2| {
        let (way, to_point) = (to - from, point - from);
        way.x * to_point.y - way.y * to_point.x
    };
    side(a, b, c) * side(a, b, d) < 0.0 && side(c, d, a) * side(c, d, b) < 0.0
}

/// The part of a line within a box.
pub(super) fn clipped(area: Rect, [from, to]: [Pos2; 2]) -> Option<[Pos2; 2]> {
    let way = to - from;
    let (mut first, mut last) = (0.0_f32, 1.0_f32);
    for (start, step, min, max) in [(from.x, way.x, area.min.x, area.max.x), (from.y, way.y, area.min.y, area.max.y)] {
        if step == 0.0 {
            if start < min || start > max {
                return None;
            }
            continue;
        }
        let (a, b) = ((min - start) / step, (max - start) / step);
        (first, last) = (first.max(a.min(b)), last.min(a.max(b)));
    }
    (first <= last).then(|| [from + way * first, from + way * last])
}

#[cfg(test)]
mod tests {
    use egui::{pos2, vec2};
    use proptest::prelude::*;

    use super::*;

    const GAP: f32 = 8.0;

    fn room() -> Room {
        let bounds = Rect::from_min_size(Pos2::ZERO, vec2(1600.0, 900.0));
        Room { bounds, covered: Vec::new(), screens: vec![bounds], points: Vec::new(), gap: GAP }
    }

    fn label(x: f32, y: f32) -> Wanted {
        Wanted { anchor: pos2(x, y), size: vec2(120.0, 30.0), slot: None }
    }

    /// The labels with the slots that they were given.
    fn again(wanted: &[Wanted], placed: &[Option<(Slot, Rect)>]) -> Vec<Wanted> {
        wanted.iter().zip(placed).map(|(it, placed)| Wanted { slot: placed.map(|(slot, _)| slot), ..*it }).collect()
    }

    /// Checks all that must hold of places.
    fn check(wanted: &[Wanted], room: &Room, placed: &[Option<(Slot, Rect)>]) {
        let areas: Vec<_> = placed.iter().enumerate().filter_map(|(index, it)| Some((index, (*it)?.1))).collect();
        for &(index, area) in &areas {
            assert!(room.bounds.contains_rect(area), "{area} leaves the canvas");
            assert!(!room.covered.iter().any(|panel| panel.intersects(area)), "{area} lies over a panel");
            let line = leader(wanted[index].anchor, area);
            for &(other, other_area) in areas.iter().filter(|(other, _)| *other != index) {
                assert!(!area.intersects(other_area), "{area} lies over {other_area}");
                assert!(!area.contains(wanted[other].anchor), "{area} hides the point of {other}");
                assert!(!crosses(other_area, line), "the line of {index} crosses {other_area}");
                let other_line = leader(wanted[other].anchor, other_area);
                assert!(!lines_cross(line, other_line), "the lines of {index} and {other} cross");
            }
        }
    }

    #[test]
    fn a_label_alone_stands_above_and_to_the_right_of_its_point() {
        let placed = place(&[label(500.0, 500.0)], &room());
        let (_, area) = placed[0].unwrap();
        assert!(area.min.x > 500.0 && area.max.y < 500.0 && area.size() == vec2(120.0, 30.0), "{area}");
        let (_, at_the_edge) = place(&[label(1590.0, 5.0)], &room())[0].unwrap();
        assert!(at_the_edge.max.x < 1590.0 && at_the_edge.min.y > 5.0, "{at_the_edge}");
    }

    #[test]
    fn a_label_moves_with_its_point_and_jumps_only_to_make_room() {
        let mut wanted = vec![label(500.0, 500.0), label(800.0, 500.0)];
        let before = place(&wanted, &room());
        let mut slots: Vec<_> = before.iter().map(|it| it.unwrap().0).collect();
        let mut n_jumps = 0;
        // The second passes the first.
        for step in 0..120 {
            wanted = again(&wanted, &place(&wanted, &room()));
            wanted[1].anchor = pos2(800.0 - 5.0 * step as f32, 505.0);
            let placed = place(&wanted, &room());
            check(&wanted, &room(), &placed);
            let now: Vec<_> = placed.iter().map(|it| it.unwrap().0).collect();
            assert_eq!(now[0], slots[0], "the first has no reason to move");
            n_jumps += u32::from(now[1] != slots[1]);
            slots = now;
        }
        assert!((1..=4).contains(&n_jumps), "{n_jumps} jumps");
    }

    #[test]
    fn a_label_that_had_a_place_keeps_it_when_an_earlier_one_comes() {
        let late = label(520.0, 500.0);
        let alone = place(&[late], &room());
        let wanted = [label(900.0, 100.0), label(500.0, 500.0), Wanted { slot: alone[0].map(|it| it.0), ..late }];
        let both = place(&wanted, &room());
        assert_eq!(both[2], alone[0]);
        check(&wanted, &room(), &both);
    }

    #[test]
    fn a_measurement_s_value_hides_none_of_its_points() {
        let points = vec![pos2(540.0, 470.0), pos2(460.0, 530.0)];
        let room = Room { points: points.clone(), ..room() };
        let (_, area) = place(&[label(500.0, 500.0)], &room)[0].unwrap();
        assert!(!points.into_iter().any(|point| area.contains(point)), "{area}");
    }

    #[test]
    fn panels_and_the_edges_of_screens_are_kept_free() {
        let panel = Rect::from_min_max(pos2(520.0, 300.0), pos2(900.0, 600.0));
        let covered = Room { covered: vec![panel], ..room() };
        let wanted = [label(500.0, 500.0), label(700.0, 450.0)];
        let placed = place(&wanted, &covered);
        check(&wanted, &covered, &placed);
        assert!(placed[0].is_some() && placed[1].is_none(), "under a panel, a point has no label");
        let (left, right) = room().bounds.split_left_right_at_x(560.0);
        let split = Room { screens: vec![left, right], ..room() };
        let (_, area) = place(&wanted, &split)[0].unwrap();
        assert!(left.contains_rect(area), "{area}");
    }

    #[test]
    fn a_line_is_cut_at_a_box() {
        let area = Rect::from_min_max(pos2(0.0, 0.0), pos2(10.0, 10.0));
        let cut = |from, to| clipped(area, [from, to]);
        assert_eq!(cut(pos2(-5.0, 5.0), pos2(15.0, 5.0)), Some([pos2(0.0, 5.0), pos2(10.0, 5.0)]));
        assert_eq!(cut(pos2(2.0, 3.0), pos2(4.0, 5.0)), Some([pos2(2.0, 3.0), pos2(4.0, 5.0)]));
        assert_eq!(cut(pos2(-5.0, 8.0), pos2(5.0, 20.0)), None);
        assert_eq!(cut(pos2(11.0, 0.0), pos2(11.0, 10.0)), None);
    }

    proptest! {
        #[test]
        fn labels_never_lie_over_each_other(
            points in proptest::collection::vec((0.0..1600.0f32, 0.0..900.0f32, 20.0..400.0f32), 0..40),
            motion in -60.0..60.0f32,
        ) {
            let sized = |&(x, y, width): &(f32, f32, f32)| Wanted { size: vec2(width, 24.0), ..label(x, y) };
            let wanted: Vec<_> = points.iter().map(sized).collect();
            let placed = place(&wanted, &room());
            check(&wanted, &room(), &placed);
            let mut moved = again(&wanted, &placed);
            moved.iter_mut().for_each(|it| it.anchor.x += motion * (it.anchor.y / 450.0 - 1.0));
            check(&moved, &room(), &place(&moved, &room()));
            let still = again(&wanted, &placed);
            let kept = place(&still, &room());
            prop_assert!(placed.iter().zip(&kept).all(|(was, is)| was.is_none() || was == is), "nothing moves at rest");
        }
    }
}
