//! The figures as charts that a person reads at a glance.

use std::{ops::Range, path::Path, sync::Once};

use anyhow::Context;
use plotters::{
    coord::{combinators::BindKeyPoints, ranged1d::AsRangedCoord},
    prelude::*,
    style::{FontStyle, register_font},
};
use shared::division::Division;

use super::results::{MeasuredRow, PredictedRow, Results};

/// Sides of one panel in pixels.
const PANEL: (u32, u32) = (620, 460);
const FONT: &str = "sans-serif";

/// One diagram.
#[derive(Debug, Default)]
struct Panel {
    title: String,
    /// A line below the title.
    note: String,
    x_label: &'static str,
    y_label: String,
    is_log: bool,
    lines: Vec<Line>,
}

impl Panel {
    /// So few that none lies between two whole numbers of render servers.
    fn n_x_labels(&self) -> usize {
        let last = self.lines.iter().flat_map(|line| &line.points).map(|point| point.0).fold(1.0, f64::max);
        (last as usize + 1).min(15)
    }
}

/// One line of a diagram.
#[derive(Debug)]
struct Line {
    name: String,
    color: RGBColor,
    /// Bounds are dashed and have no marks.
    is_bound: bool,
    points: Vec<(f64, f64)>,
}

/// Draws all that there are figures for.
pub(super) fn draw(results: &Results, folder: &Path) -> anyhow::Result<()> {
    if !results.measured.is_empty() {
        write(&folder.join("bytes-per-frame.svg"), &bytes_panels(&results.measured))?;
        write(&folder.join("time-per-frame.svg"), &[time_panel(&results.measured, results.n_cores)])?;
    }
    let mut sizes: Vec<&str> = results.predicted.iter().map(|row| &*row.size).collect();
    sizes.dedup();
    for size in sizes {
        let rows: Vec<_> = results.predicted.iter().filter(|row| row.size == size && row.n_slow == 0).collect();
        for (name, is_moving) in [("still", false), ("moving", true)] {
            let rows: Vec<_> = rows.iter().copied().filter(|row| row.is_moving == is_moving).collect();
            let mut links: Vec<f64> = rows.iter().map(|row| row.mbit_per_s).collect();
            links.dedup();
            links.sort_by(f64::total_cmp);
            links.dedup();
            let panels: Vec<_> = links.into_iter().map(|link| cluster_panel(&rows, size, name, link)).collect();
            if !panels.is_empty() {
                write(&folder.join(format!("predicted-{size}-{name}.svg")), &panels)?;
            }
        }
    }
    Ok(())
}

/// Blue, vermilion and green of Okabe and Ito, which colour-blind people tell apart.
fn color(division: Division) -> RGBColor {
    match division {
        Division::Interleaved => RGBColor(213, 94, 0),
        Division::Tiled => RGBColor(0, 114, 178),
        Division::Dynamic => RGBColor(0, 158, 115),
    }
}

const GREY: RGBColor = RGBColor(110, 110, 110);

fn by_division<T>(
    rows: &[&T],
    division: impl Fn(&T) -> Option<Division>,
    point: impl Fn(&T) -> (f64, f64),
) -> Vec<Line> {
    let line = |of: Division| Line {
        name: of.name().to_owned(),
        color: color(of),
        is_bound: false,
        points: rows.iter().filter(|row| division(row) == Some(of)).map(|row| point(row)).collect(),
    };
    Division::ALL.into_iter().map(line).filter(|line| !line.points.is_empty()).collect()
}

/// The paper's figure 8.
fn bytes_panels(rows: &[MeasuredRow]) -> [Panel; 2] {
    let panel = |title: &str, unit: &str, value: fn(&MeasuredRow) -> f64| Panel {
        title: title.to_owned(),
        note: "median of the frames; where lines lie one upon another, the divisions are alike".to_owned(),
        x_label: "render servers",
        y_label: unit.to_owned(),
        lines: by_division(
            &rows.iter().collect::<Vec<_>>(),
            |row| row.division,
            |row| (f64::from(row.n_nodes), value(row)),
        ),
        ..Panel::default()
    };
    [
        panel("Received by the wall per frame", "kB", |row| row.bytes_in / 1e3),
        panel("Sent by the wall per frame", "kB", |row| row.bytes_out / 1e3),
    ]
}

/// The paper's figure 9.
fn time_panel(rows: &[MeasuredRow], n_cores: usize) -> Panel {
    let mut lines = by_division(
        &rows.iter().collect::<Vec<_>>(),
        |row| row.division,
        |row| (f64::from(row.n_nodes), row.frame_ms_median),
    );
    if let Some(alone) = rows.iter().find(|row| row.division.is_none()) {
        let last = rows.iter().map(|row| row.n_nodes).max().unwrap_or(0);
        lines.push(Line {
            name: "display alone".to_owned(),
            color: GREY,
            is_bound: true,
            points: vec![(0.0, alone.frame_ms_median), (f64::from(last), alone.frame_ms_median)],
        });
    }
    Panel {
        title: "Time per frame".to_owned(),
        note: format!("render servers of one thread; they and the wall share {n_cores} cores"),
        x_label: "render servers",
        y_label: "ms, median".to_owned(),
        lines,
        ..Panel::default()
    }
}

fn cluster_panel(rows: &[&PredictedRow], size: &str, motion: &str, mbit_per_s: f64) -> Panel {
    let rows: Vec<_> = rows.iter().copied().filter(|row| row.mbit_per_s == mbit_per_s).collect();
    let rate = |ms: f64| 1e3 / ms;
    let mut lines = by_division(&rows, |row| Some(row.division), |row| (f64::from(row.n_nodes), rate(row.frame_ms)));
    let of_dynamic: Vec<_> = rows.iter().filter(|row| row.division == Division::Dynamic).collect();
    if let (Some(first), Some(last)) = (of_dynamic.first(), of_dynamic.last()) {
        let alone = first.compute_ms * f64::from(first.n_nodes);
        let ends = [f64::from(first.n_nodes), f64::from(last.n_nodes)];
        let bound = |name: &str, color: RGBColor, rate: &dyn Fn(f64) -> f64| Line {
            name: name.to_owned(),
            color,
            is_bound: true,
            points: ends.map(|n_nodes| (n_nodes, rate(n_nodes))).to_vec(),
        };
        lines.push(bound("bound by compute: linear", GREY, &|n_nodes| rate(alone / n_nodes)));
        lines.push(bound("bound by the link", BLACK, &|_| rate(last.link_ms)));
    }
    let bound_by = |by: &str| {
        let nodes: Vec<_> =
            of_dynamic.iter().filter(|row| row.binds == by).map(|row| row.n_nodes.to_string()).collect();
        (!nodes.is_empty()).then(|| format!("{by} binds at {}", nodes.join(", ")))
    };
    let note = ["compute", "link"].into_iter().filter_map(bound_by).collect::<Vec<_>>().join("; ");
    let link = if mbit_per_s >= 1e3 { format!("{} Gbit/s", mbit_per_s / 1e3) } else { format!("{mbit_per_s} Mbit/s") };
    Panel {
        title: format!("Predicted: {size}, {motion} camera, {link} into the wall"),
        note,
        x_label: "one-core render servers",
        y_label: "frames a second".to_owned(),
        is_log: true,
        lines,
    }
}

fn write(path: &Path, panels: &[Panel]) -> anyhow::Result<()> {
    let mut svg = String::new();
    draw_panels(&mut svg, panels).map_err(|error| anyhow::anyhow!("{error}")).context("a chart cannot be drawn")?;
    std::fs::write(path, svg).with_context(|| format!("cannot write {}", path.display()))
}

/// The font that letters are measured and painted with.
fn register_fonts() {
    static REGISTERED: Once = Once::new();
    REGISTERED.call_once(|| {
        // The built-in bytes are a valid font.
        let _ = register_font(FONT, FontStyle::Normal, epaint_default_fonts::UBUNTU_LIGHT);
    });
}

type DrawResult = Result<(), Box<dyn std::error::Error>>;

fn draw_panels(svg: &mut String, panels: &[Panel]) -> DrawResult {
    register_fonts();
    let root = SVGBackend::with_string(svg, (PANEL.0 * panels.len() as u32, PANEL.1)).into_drawing_area();
    root.fill(&WHITE)?;
    for (area, panel) in root.split_evenly((1, panels.len())).iter().zip(panels) {
        draw_panel(area, panel)?;
    }
    Ok(root.present()?)
}

fn draw_panel(area: &DrawingArea<SVGBackend<'_>, plotters::coord::Shift>, panel: &Panel) -> DrawResult {
    let points = || panel.lines.iter().flat_map(|line| &line.points);
    let mut nodes: Vec<f64> = points().map(|point| point.0).collect();
    nodes.sort_by(f64::total_cmp);
    nodes.dedup();
    let (first, last) = (nodes.first().copied().unwrap_or(0.0), nodes.last().copied().unwrap_or(1.0));
    let most = points().map(|point| point.1).fold(f64::MIN_POSITIVE, f64::max);
    let least = points().map(|point| point.1).fold(most, f64::min);
    if panel.is_log {
        let (x, y) = (first * 0.85..last * 1.2, least * 0.2..most * 1.5);
        let ticks = log_ticks(&y);
        draw_axes(area, panel, x.log_scale().with_key_points(nodes), y.log_scale().with_key_points(ticks))
    } else {
        let (x, y) = (first - 0.4..last + 0.4, 0.0..most * 1.3);
        draw_axes(area, panel, x, y)
    }
}

/// 1, 2 and 5 times powers of ten.
fn log_ticks(range: &Range<f64>) -> Vec<f64> {
    let decades = range.start.log10().floor() as i32..=range.end.log10().ceil() as i32;
    let ticks = decades.flat_map(|decade| [1.0, 2.0, 5.0].map(|step| step * 10f64.powi(decade)));
    ticks.filter(|tick| range.contains(tick)).collect()
}

fn draw_axes<X, Y>(area: &DrawingArea<SVGBackend<'_>, plotters::coord::Shift>, panel: &Panel, x: X, y: Y) -> DrawResult
where
    X: AsRangedCoord<Value = f64>,
    Y: AsRangedCoord<Value = f64>,
    X::CoordDescType: plotters::coord::ranged1d::ValueFormatter<f64>,
    Y::CoordDescType: plotters::coord::ranged1d::ValueFormatter<f64>,
{
    let area = area.titled(&panel.title, (FONT, 17).into_font())?;
    let area = area.titled(&panel.note, (FONT, 13).into_font().color(&GREY))?;
    let mut chart = ChartBuilder::on(&area)
        .margin(12)
        .margin_right(20)
        .x_label_area_size(44)
        .y_label_area_size(64)
        .build_cartesian_2d(x, y)?;
    chart
        .configure_mesh()
        .disable_x_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(BLACK.mix(0.12))
        .x_desc(panel.x_label)
        .y_desc(&panel.y_label)
        .x_label_formatter(&|value| number(*value))
        .x_labels(panel.n_x_labels())
        .y_labels(8)
        .y_label_formatter(&|value| number(*value))
        .label_style((FONT, 14))
        .axis_desc_style((FONT, 15))
        .draw()?;
    for (index, line) in panel.lines.iter().enumerate() {
        // Lines that coincide are seen one around the other.
        let width = if line.is_bound { 2 } else { 6 - 2 * index.min(2) as u32 };
        let style = line.color.stroke_width(width);
        let points = line.points.iter().copied();
        let series = if line.is_bound {
            chart.draw_series(DashedLineSeries::new(points, 7, 5, style))?
        } else {
            let radius = 8 - 2 * index.min(2) as i32;
            chart.draw_series(line.points.iter().map(|&point| Circle::new(point, radius, line.color.filled())))?;
            chart.draw_series(LineSeries::new(points, style))?
        };
        // A bound is short dashes in the legend, too.
        let ends =
            |(x, y): (i32, i32)| if line.is_bound { vec![(x, y), (x + 9, y)] } else { vec![(x, y), (x + 22, y)] };
        series.label(&line.name).legend(move |place| PathElement::new(ends(place), style));
    }
    chart
        .configure_series_labels()
        .position(if panel.is_log { SeriesLabelPosition::LowerRight } else { SeriesLabelPosition::UpperRight })
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

    #[test]
    fn a_chart_names_its_lines_axes_and_bounds() {
        let row = |n_nodes: u32, frame_ms: f64, binds: &'static str| PredictedRow {
            division: Division::Dynamic,
            n_nodes,
            n_slow: 0,
            size: "1024x512".into(),
            is_moving: false,
            mbit_per_s: 680.0,
            n_frames: 4,
            frame_ms,
            compute_ms: 120.0 / f64::from(n_nodes),
            link_ms: 18.5,
            binds,
            over_bound: 1.0,
            efficiency: 1.0,
            imbalance_median: 1.0,
            imbalance_p95: 1.0,
            bytes_in: 1.6e6,
        };
        let rows = [row(1, 121.0, "compute"), row(64, 19.0, "link")];
        let panel = cluster_panel(&rows.iter().collect::<Vec<_>>(), "1024x512", "still", 680.0);
        let mut svg = String::new();
        draw_panels(&mut svg, &[panel]).unwrap();
        for text in
            ["680 Mbit/s", "compute binds at 1; link binds at 64", "dynamic", "bound by the link", "frames a second"]
        {
            assert!(svg.contains(text), "{text}");
        }
    }
}
