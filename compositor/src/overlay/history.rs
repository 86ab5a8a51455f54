//! The times of the last frames, as curves whose scale does not jump.

use std::collections::VecDeque;

use egui::{Ui, Vec2b};
use egui_plot::{Line, Plot, PlotPoints};

use super::style;

const N_FRAMES: usize = 240;
/// The curve's height in points.
const HEIGHT: f32 = 64.0;

/// The times of the last frames, oldest first.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct History {
    frames: VecDeque<FrameTimes>,
}

/// The times of one frame in milliseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct FrameTimes {
    /// In the farm: from the first task to the last sample placed.
    pub render_ms: f64,
    /// From the camera's motion to the frame on the wall.
    pub latency_ms: f64,
}

impl History {
    pub(crate) fn add(&mut self, times: FrameTimes) {
        if self.frames.len() == N_FRAMES {
            self.frames.pop_front();
        }
        self.frames.push_back(times);
    }

    /// The upper end of the scale: the first of 10, 20, 50, 100 … ms that is above 95 % of the frames.
    ///
    /// After a single slow frame, for example a model's first, the rest stays legible.
    fn top_ms(&self) -> f64 {
        let mut times: Vec<_> = self.frames.iter().map(|times| times.render_ms.max(times.latency_ms)).collect();
        times.sort_by(f64::total_cmp);
        let nearly_all = times.get(times.len().saturating_sub(1) * 95 / 100).copied().unwrap_or(0.0);
        let steps = (1..7).flat_map(|decade| [1.0, 2.0, 5.0].map(|step| step * 10f64.powi(decade)));
        steps.into_iter().find(|&step| step >= nearly_all).unwrap_or(1e7)
    }
}

pub(super) fn show(ui: &mut Ui, history: &History) {
    let top_ms = history.top_ms();
    let first = N_FRAMES - history.frames.len();
    let curve = |value: fn(&FrameTimes) -> f64| {
        let points = history.frames.iter().enumerate();
        PlotPoints::from_iter(points.map(|(index, times)| [(first + index) as f64, value(times).min(top_ms)]))
    };
    style::legend(ui, &format!("Last frames, to {top_ms} ms"), &[("render", style::ACCENT), ("latency", style::BUSY)]);
    Plot::new("frame times")
        .height(HEIGHT)
        .show_axes(Vec2b::FALSE)
        .show_background(false)
        .show_x(false)
        .show_y(false)
        .allow_drag(false)
        .allow_zoom(false)
        .allow_scroll(false)
        .allow_boxed_zoom(false)
        .allow_double_click_reset(false)
        .show_grid(Vec2b::new(false, true))
        .set_margin_fraction(egui::Vec2::ZERO)
        .include_x(0.0)
        .include_x((N_FRAMES - 1) as f64)
        .include_y(0.0)
        .include_y(top_ms)
        .show(ui, |plot| {
            plot.line(Line::new("latency", curve(|times| times.latency_ms)).color(style::BUSY));
            plot.line(Line::new("render", curve(|times| times.render_ms)).color(style::ACCENT));
        });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scale_is_round_and_one_slow_frame_does_not_move_it() {
        let mut history = History::default();
        assert_eq!(history.top_ms(), 10.0);
        for frame in 0..1000 {
            let latency_ms = if frame == 990 { 4000.0 } else { 30.0 };
            history.add(FrameTimes { render_ms: 12.0, latency_ms });
        }
        assert_eq!((history.frames.len(), history.top_ms()), (N_FRAMES, 50.0));
        (0..N_FRAMES).for_each(|_| history.add(FrameTimes { render_ms: 700.0, latency_ms: 800.0 }));
        assert_eq!(history.top_ms(), 1000.0);
    }
}
