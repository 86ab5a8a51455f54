//! Places the names of points as near as possible without covering anything.

use std::ops::Range;

/// A drawn point, in pixels.
pub(super) struct Mark {
    pub(super) position_px: (i32, i32),
    /// The rows of its bar, from the top down.
    pub(super) bar: Option<Range<i32>>,
}

/// A name near a point.
pub(super) struct Label {
    /// The point.
    pub(super) position_px: (i32, i32),
    /// Width and height in pixels.
    pub(super) size: (i32, i32),
}

/// The side of its point on which a name stands.
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

    fn contains(&self, other: &Self) -> bool {
        self.left <= other.left && other.right <= self.right && self.top <= other.top && other.bottom <= self.bottom
    }
}

/// The rectangle of each label within `inside`; `None` without room. `lines` are polylines that labels must not cover.
pub(super) fn arrange(
    labels: &[Label],
    marks: &[Mark],
    lines: &[Vec<(i32, i32)>],
    inside: &Rect,
) -> Vec<Option<(Rect, Side)>> {
    let mut taken: Vec<Rect> = Vec::new();
    for Mark { position_px: (x, y), bar } in marks {
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
    for &Label { position_px: (x, y), size: (width, height) } in labels {
        let rect = |left: i32, top: i32| Rect { left, top, right: left + width, bottom: top + height };
        let steps = (0..30).flat_map(|step| [step * 7, -step * 7]);
        let mut candidates = steps.flat_map(|step| {
            let top = y - height / 2 + step;
            let aside = if step.abs() > 20 { 26 } else { 9 };
            [
                (rect(x + aside, top), Side::Right),
                (rect(x - aside - width, top), Side::Left),
                (rect(x - width / 2, top), Side::Middle),
            ]
        });
        let is_free = |rect: &Rect| inside.contains(rect) && taken.iter().all(|other| !other.meets(rect));
        let rect = candidates.find(|(rect, _)| is_free(rect));
        taken.extend(rect.map(|(rect, _)| rect));
        placed.push(rect);
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
            let positions: Vec<_> =
                (0..5).map(|n| (330 + (n * 7 % 5 - 2) * spread, 200 + (n * 3 % 5 - 2) * spread / 2)).collect();
            let marks: Vec<_> =
                positions.iter().map(|&(x, y)| Mark { position_px: (x, y), bar: Some(y - 20..y + 15) }).collect();
            let labels: Vec<_> = positions
                .iter()
                .map(|&position_px| Label { position_px, size: (120 + position_px.0 % 7, 17) })
                .collect();
            let placed = arrange(&labels, &marks, &[vec![positions[0], positions[1]]], &inside);
            let rects: Vec<_> = placed.iter().flatten().map(|(rect, _)| *rect).collect();
            assert_eq!(rects.len(), labels.len(), "there is room for all");
            for (index, rect) in rects.iter().enumerate() {
                assert!(inside.contains(rect), "{rect:?}");
                assert!(rects[..index].iter().all(|other| !other.meets(rect)), "{spread}: {rects:?}");
                assert!(
                    !positions.iter().any(|&position| rect.meets(&Rect::around(position, 5))),
                    "{spread}: {rect:?}"
                );
            }
        }
    }
}
