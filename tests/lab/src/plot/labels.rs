//! Where the names of points stand: as near to them as can be, but on nothing else.

use std::ops::Range;

/// A point as it is drawn, in pixels.
pub(super) struct Mark {
    pub(super) place: (i32, i32),
    /// From the top down.
    pub(super) bar: Option<Range<i32>>,
}

/// A name that wants a place near a point.
pub(super) struct Label {
    /// The point's.
    pub(super) place: (i32, i32),
    /// Width and height.
    pub(super) size: (i32, i32),
}

/// On which side of its point a name stands.
#[derive(Clone, Copy, Debug)]
pub(super) enum Side {
    Left,
    Right,
    Middle,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Rect {
    pub(super) left: i32,
    pub(super) top: i32,
    pub(super) right: i32,
    pub(super) bottom: i32,
}

impl Rect {
    fn around((x, y): (i32, i32), reach: i32) -> Self {
        Self { left: x - reach, top: y - reach, right: x + reach, bottom: y + reach }
    }

    fn meets(&self, other: &Self) -> bool {
        self.left < other.right && other.left < self.right && self.top < other.bottom && other.top < self.bottom
    }

    fn holds(&self, other: &Self) -> bool {
        self.left <= other.left && other.right <= self.right && self.top <= other.top && other.bottom <= self.bottom
    }
}

/// Places within `inside`, label by label. `lines` are runs of places that are joined. A label for which there is no
/// room at all gets none.
pub(super) fn arrange(
    labels: &[Label],
    marks: &[Mark],
    lines: &[Vec<(i32, i32)>],
    inside: &Rect,
) -> Vec<Option<(Rect, Side)>> {
    let mut taken: Vec<Rect> = Vec::new();
    for Mark { place: (x, y), bar } in marks {
        taken.push(Rect::around((*x, *y), 6));
        taken.extend(bar.as_ref().map(|bar| Rect { left: x - 5, top: bar.start, right: x + 5, bottom: bar.end }));
    }
    for ends in lines.iter().flat_map(|line| line.windows(2)) {
        let [(x, y), (to_x, to_y)] = [ends[0], ends[1]];
        let n_steps = ((to_x - x).abs().max((to_y - y).abs()) / 4).max(1);
        taken.extend(
            (0..=n_steps)
                .map(|step| Rect::around((x + (to_x - x) * step / n_steps, y + (to_y - y) * step / n_steps), 2)),
        );
    }
    let mut placed = Vec::new();
    for &Label { place: (x, y), size: (width, height) } in labels {
        let rect = |left: i32, top: i32| Rect { left, top, right: left + width, bottom: top + height };
        let steps = (0..30).flat_map(|step| [step * 7, -step * 7]);
        let mut places = steps.flat_map(|step| {
            let top = y - height / 2 + step;
            let aside = if step.abs() > 20 { 26 } else { 9 };
            [
                (rect(x + aside, top), Side::Right),
                (rect(x - aside - width, top), Side::Left),
                (rect(x - width / 2, top), Side::Middle),
            ]
        });
        let is_free = |rect: &Rect| inside.holds(rect) && taken.iter().all(|other| !other.meets(rect));
        let place = places.find(|(rect, _)| is_free(rect));
        taken.extend(place.map(|(rect, _)| rect));
        placed.push(place);
    }
    placed
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_cover_neither_each_other_nor_points() {
        let inside = Rect { left: 78, top: 50, right: 594, bottom: 374 };
        for spread in [0, 3, 10, 40, 90] {
            let places: Vec<_> =
                (0..5).map(|n| (330 + (n * 7 % 5 - 2) * spread, 200 + (n * 3 % 5 - 2) * spread / 2)).collect();
            let marks: Vec<_> =
                places.iter().map(|&(x, y)| Mark { place: (x, y), bar: Some(y - 20..y + 15) }).collect();
            let labels: Vec<_> = places.iter().map(|&place| Label { place, size: (120 + place.0 % 7, 17) }).collect();
            let placed = arrange(&labels, &marks, &[vec![places[0], places[1]]], &inside);
            let rects: Vec<_> = placed.iter().flatten().map(|(rect, _)| *rect).collect();
            assert_eq!(rects.len(), labels.len(), "there is room for all");
            for (index, rect) in rects.iter().enumerate() {
                assert!(inside.holds(rect), "{rect:?}");
                assert!(rects[..index].iter().all(|other| !other.meets(rect)), "{spread}: {rects:?}");
                assert!(!places.iter().any(|&place| rect.meets(&Rect::around(place, 5))), "{spread}: {rect:?}");
            }
        }
    }
}
