//! Line charts over the number of nodes, side by side in one SVG file.

use std::{ops::Range, path::Path};

use anyhow::{Context, Result, anyhow};
use plotters::{
    coord::{
        Shift,
        combinators::BindKeyPoints,
        ranged1d::{AsRangedCoord, ValueFormatter},
    },
    prelude::*,
};

use super::{DrawResult, FONT, GREY, register_fonts};
use crate::files;

/// Width and height of one chart in pixels.
const CHART_SIZE: (u32, u32) = (620, 460);

/// One line chart. All coordinates are plain numbers.
#[derive(Debug, Default)]
pub struct LineChart {
    /// Above the chart.
    pub title: String,
    /// A line below the title.
    pub note: String,
    /// Below the x axis.
    pub x_label: &'static str,
    /// Beside the y axis.
    pub y_label: String,
    /// Whether both axes are logarithmic.
    pub is_log: bool,
    /// The lines, those behind first.
    pub lines: Vec<Line>,
}

impl LineChart {
    /// Labels along x: few enough that all stand at whole numbers.
    fn n_x_labels(&self) -> usize {
        let last = self.lines.iter().flat_map(|line| &line.points).map(|point| point.0).fold(1.0, f64::max);
        (last as usize + 1).min(15)
    }
}

/// One line of a chart.
#[derive(Debug)]
pub struct Line {
    /// In the legend.
    pub name: String,
    /// Of line and marks.
    pub color: RGBColor,
    /// Whether it is a bound: dashed, without marks.
    pub is_bound: bool,
    /// From left to right: x and y.
    pub points: Vec<(f64, f64)>,
}

/// Writes charts side by side as NAME in a folder.
pub fn write_line_charts(folder: &Path, name: &str, charts: &[LineChart]) -> Result<()> {
    let mut svg = String::new();
    draw_all(&mut svg, charts).map_err(|error| anyhow!("{error}")).context("cannot draw a chart")?;
    files::write(folder, name, svg.as_bytes())
}

fn draw_all(svg: &mut String, charts: &[LineChart]) -> DrawResult {
    register_fonts();
    let root = SVGBackend::with_string(svg, (CHART_SIZE.0 * charts.len() as u32, CHART_SIZE.1)).into_drawing_area();
    root.fill(&WHITE)?;
    for (area, chart) in root.split_evenly((1, charts.len())).iter().zip(charts) {
        draw(area, chart)?;
    }
    Ok(root.present()?)
}

fn draw(area: &DrawingArea<SVGBackend<'_>, Shift>, chart: &LineChart) -> DrawResult {
    let points = || chart.lines.iter().flat_map(|line| &line.points);
    let mut nodes: Vec<f64> = points().map(|point| point.0).collect();
    nodes.sort_by(f64::total_cmp);
    nodes.dedup();
    let (first, last) = (nodes.first().copied().unwrap_or(0.0), nodes.last().copied().unwrap_or(1.0));
    let most = points().map(|point| point.1).fold(f64::MIN_POSITIVE, f64::max);
    let least = points().map(|point| point.1).fold(most, f64::min);
    if chart.is_log {
        let (x, y) = (first * 0.85..last * 1.2, least * 0.2..most * 1.5);
        let ticks = log_ticks(&y);
        draw_axes(area, chart, x.log_scale().with_key_points(nodes), y.log_scale().with_key_points(ticks))
    } else {
        let (x, y) = (first - 0.4..last + 0.4, 0.0..most * 1.3);
        draw_axes(area, chart, x, y)
    }
}

/// 1, 2 and 5 times the powers of ten within a range.
fn log_ticks(range: &Range<f64>) -> Vec<f64> {
    let decades = range.start.log10().floor() as i32..=range.end.log10().ceil() as i32;
    let ticks = decades.flat_map(|decade| [1.0, 2.0, 5.0].map(|step| step * 10f64.powi(decade)));
    ticks.filter(|tick| range.contains(tick)).collect()
}

fn draw_axes<X, Y>(area: &DrawingArea<SVGBackend<'_>, Shift>, chart: &LineChart, x: X, y: Y) -> DrawResult
where
    X: AsRangedCoord<Value = f64>,
    Y: AsRangedCoord<Value = f64>,
    X::CoordDescType: ValueFormatter<f64>,
    Y::CoordDescType: ValueFormatter<f64>,
{
    let area = area.titled(&chart.title, (FONT, 17).into_font())?;
    let area = area.titled(&chart.note, (FONT, 13).into_font().color(&GREY))?;
    let mut axes = ChartBuilder::on(&area)
        .margin(12)
        .margin_right(20)
        .x_label_area_size(44)
        .y_label_area_size(64)
        .build_cartesian_2d(x, y)?;
    axes.configure_mesh()
        .disable_x_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(BLACK.mix(0.12))
        .x_desc(chart.x_label)
        .y_desc(&chart.y_label)
        .x_label_formatter(&|value| number(*value))
        .x_labels(chart.n_x_labels())
        .y_labels(8)
        .y_label_formatter(&|value| number(*value))
        .label_style((FONT, 14))
        .axis_desc_style((FONT, 15))
        .draw()?;
    for (index, line) in chart.lines.iter().enumerate() {
        // Earlier lines are wider, so that lines that coincide all show.
        let width = if line.is_bound { 2 } else { 6 - 2 * index.min(2) as u32 };
        let style = line.color.stroke_width(width);
        let points = line.points.iter().copied();
        let series = if line.is_bound {
            axes.draw_series(DashedLineSeries::new(points, 7, 5, style))?
        } else {
            let radius = 8 - 2 * index.min(2) as i32;
            axes.draw_series(line.points.iter().map(|&point| Circle::new(point, radius, line.color.filled())))?;
            axes.draw_series(LineSeries::new(points, style))?
        };
        // The legend shows a bound as a short dash.
        let ends =
            |(x, y): (i32, i32)| if line.is_bound { vec![(x, y), (x + 9, y)] } else { vec![(x, y), (x + 22, y)] };
        series.label(&line.name).legend(move |start| PathElement::new(ends(start), style));
    }
    axes.configure_series_labels()
        .position(if chart.is_log { SeriesLabelPosition::LowerRight } else { SeriesLabelPosition::UpperRight })
        .background_style(WHITE.mix(0.85))
        .border_style(TRANSPARENT)
        .label_font((FONT, 14))
        .legend_area_size(28)
        .draw()?;
    Ok(())
}

fn number(value: f64) -> String {
    if value >= 10.0 || value.fract() == 0.0 {
        format!("{value:.0}")
    } else {
        format!("{}", (value * 1e3).round() / 1e3)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithmic_ticks_are_round_and_inside() {
        assert_eq!(log_ticks(&(0.9..30.0)), [1.0, 2.0, 5.0, 10.0, 20.0]);
    }
}
