//! The parts of the canvas that panels leave free.

use glam::DVec2;
use shared::camera::CanvasPart;

/// Parts of less than this fraction of the canvas are too small: panels over a model are better than a tiny model.
const SMALLEST_PART: f64 = 0.25;

/// The largest rectangles that touch no panel; the whole canvas if all are small.
pub(crate) fn free_parts(panels: &[CanvasPart]) -> Vec<CanvasPart> {
    let ranges = |axis: usize| {
        let panel_edges = panels.iter().flat_map(|panel| [panel.min[axis], panel.max[axis]]);
        let mut edges: Vec<_> = panel_edges.filter(|edge| (0.0..=1.0).contains(edge)).chain([0.0, 1.0]).collect();
        edges.sort_by(f64::total_cmp);
        edges.dedup();
        let ranges = edges.iter().flat_map(|&low| edges.iter().map(move |&high| [low, high]));
        ranges.filter(|[low, high]| low < high).collect::<Vec<_>>()
    };
    let is_free = |part: &CanvasPart| {
        panels.iter().all(|panel| part.min.cmpge(panel.max).any() || part.max.cmple(panel.min).any())
    };
    let [across, upwards] = [ranges(0), ranges(1)];
    let part = |x: &[f64; 2], y: &[f64; 2]| CanvasPart { min: DVec2::new(x[0], y[0]), max: DVec2::new(x[1], y[1]) };
    let parts = across.iter().flat_map(|x| upwards.iter().map(move |y| part(x, y)));
    let is_large = |part: &CanvasPart| (part.max - part.min).element_product() >= SMALLEST_PART;
    let free: Vec<_> = parts.filter(|part| is_large(part) && is_free(part)).collect();
    let is_in = |a: &CanvasPart, b: &CanvasPart| a != b && a.min.cmpge(b.min).all() && a.max.cmple(b.max).all();
    let largest: Vec<_> = free.iter().filter(|a| !free.iter().any(|b| is_in(a, b))).copied().collect();
    if largest.is_empty() { vec![CanvasPart::WHOLE] } else { largest }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(min: [f64; 2], max: [f64; 2]) -> CanvasPart {
        CanvasPart { min: min.into(), max: max.into() }
    }

    #[test]
    fn parts_touch_no_panel() {
        assert_eq!(free_parts(&[]), [CanvasPart::WHOLE]);
        assert_eq!(free_parts(&[part([-0.1, -0.1], [1.1, 1.1])]), [CanvasPart::WHOLE], "nothing is free");
        let panels = [part([0.0, 0.1], [0.3, 1.0]), part([0.8, 0.5], [1.0, 1.0]), part([0.8, 0.0], [1.0, 0.4])];
        let free = free_parts(&panels);
        assert_eq!(free, [part([0.3, 0.0], [0.8, 1.0])], "the parts between and below the panels are too small");
        let panels = [part([0.0, 0.0], [0.4, 1.0]), part([0.6, 0.0], [1.0, 1.0])];
        assert_eq!(free_parts(&panels), [CanvasPart::WHOLE], "a narrow window");
    }
}
