//! Draws figures as SVG and PNG: rows of plots, each with a legend at its right.

mod bitmap;

use std::{ops::Range, path::Path, sync::Once};

use anyhow::{Context, Result, anyhow};
use plotters::{
    coord::{Shift, types::RangedCoordf64},
    prelude::*,
    style::{
        FontStyle, register_font,
        text_anchor::{HPos, Pos, VPos},
    },
};
use renderer::render::image;
use shared::division::FrameSize;

use self::bitmap::Bitmap;
use crate::files;

/// Okabe and Ito's colours, which colour-blind people can tell apart.
pub(crate) const COLORS: [RGBColor; 7] = [
    RGBColor(213, 94, 0),
    RGBColor(204, 121, 167),
    RGBColor(0, 114, 178),
    RGBColor(0, 158, 115),
    RGBColor(86, 60, 20),
    RGBColor(178, 132, 0),
    RGBColor(70, 150, 200),
];

/// The colour of bounds and of other ray tracers.
pub(crate) const GREY: RGBColor = RGBColor(110, 110, 110);

const INK: RGBColor = RGBColor(40, 44, 52);

const FONT: &str = "sans-serif";
const FONT_BYTES: &[u8] = epaint_default_fonts::UBUNTU_LIGHT;

const WIDTH: u32 = 1240;
const LEGEND_WIDTH: u32 = 230;
const LEGEND_LINE: i32 = 22;
const HEADER_HEIGHT: u32 = 50;
const NOTE_HEIGHT: u32 = 20;

pub(crate) struct Figure {
    pub title: String,
    pub notes: Vec<String>,
    /// The height of each row in pixels, and its plots side by side.
    pub rows: Vec<(u32, Vec<Plot>)>,
}

/// One plot. Its numbers are plain or decades (logarithms of what is shown), as its axes say.
pub(crate) struct Plot {
    pub title: String,
    pub x: Axis,
    pub y: Axis,
    pub series: Vec<Series>,
}

pub(crate) struct Axis {
    pub title: &'static str,
    /// The label of a number; may be empty.
    pub label: fn(f64) -> String,
    /// The range of numbers; `None` fits the points.
    pub range: Option<Range<f64>>,
}

#[derive(Clone)]
pub(crate) struct Series {
    pub name: String,
    pub color: RGBColor,
    pub mark: Mark,
    /// Whether a line joins them; without marks it is dashed.
    pub is_joined: bool,
    /// From one end of the line to the other.
    pub points: Vec<Point>,
}

#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Mark {
    Disc,
    Circle,
    Nothing,
}

#[derive(Clone)]
pub(crate) struct Point {
    /// The setting that it was measured with; may be empty.
    pub label: String,
    pub x: f64,
    pub y: f64,
    /// A range of y, drawn as a bar.
    pub bar: Option<Range<f64>>,
}

impl Point {
    pub(crate) fn new(x: f64, y: f64) -> Self {
        Self { label: String::new(), x, y, bar: None }
    }
}

type DrawResult = Result<(), Box<dyn std::error::Error>>;
type Plane<'a, DB> = ChartContext<'a, DB, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

impl Figure {
    pub(crate) fn write(&self, folder: &Path, name: &str) -> Result<()> {
        let header_height = HEADER_HEIGHT + NOTE_HEIGHT * self.notes.len() as u32;
        let size = FrameSize::new(WIDTH, header_height + self.rows.iter().map(|(height, _)| height).sum::<u32>())?;
        let mut svg = String::new();
        self.draw(SVGBackend::with_string(&mut svg, (size.xres(), size.yres())), header_height)?;
        files::write(folder, &format!("{name}.svg"), svg.as_bytes())?;
        let mut rgb = vec![0; 3 * size.n_samples() as usize];
        let font = ab_glyph::FontRef::try_from_slice(FONT_BYTES).context("the built-in font is valid")?;
        self.draw(Bitmap::new(&mut rgb, (size.xres(), size.yres()), font), header_height)?;
        // PNG takes the bottom row first.
        let rows: Vec<u8> = rgb.rchunks_exact(3 * WIDTH as usize).flatten().copied().collect();
        let png_path = folder.join(format!("{name}.png"));
        image::write_png(&png_path, size, &rows).with_context(|| format!("cannot write {}", png_path.display()))
    }

    fn draw<DB: DrawingBackend<ErrorType: 'static>>(&self, backend: DB, header_height: u32) -> Result<()> {
        static REGISTERED: Once = Once::new();
        REGISTERED.call_once(|| {
            // The built-in bytes are a valid font.
            let _ = register_font(FONT, FontStyle::Normal, FONT_BYTES);
        });
        self.draw_on(&backend.into_drawing_area(), header_height)
            .map_err(|error| anyhow!("cannot draw the chart: {error}"))
    }

    fn draw_on<DB: DrawingBackend<ErrorType: 'static>>(
        &self,
        root: &DrawingArea<DB, Shift>,
        header_height: u32,
    ) -> DrawResult {
        root.fill(&WHITE)?;
        root.draw_text(&self.title, &style(22), (24, 14))?;
        for (note, y) in self.notes.iter().zip((46..).step_by(NOTE_HEIGHT as usize)) {
            root.draw_text(note, &style(14), (24, y))?;
        }
        let (_, mut below) = root.split_vertically(header_height);
        for (height, plots) in &self.rows {
            let (row, rest) = below.split_vertically(*height);
            below = rest;
            let (row, legend) = row.split_horizontally(WIDTH - LEGEND_WIDTH);
            for (plot, area) in plots.iter().zip(row.split_evenly((1, plots.len()))) {
                plot.draw(&area)?;
            }
            draw_legend(&legend, plots)?;
        }
        Ok(root.present()?)
    }
}

/// Draws each series of the plots once, as a point or a short line beside its name.
fn draw_legend<DB: DrawingBackend<ErrorType: 'static>>(area: &DrawingArea<DB, Shift>, plots: &[Plot]) -> DrawResult {
    let n_lines = f64::from(area.dim_in_pixel().1 as i32 / LEGEND_LINE);
    let mut legend = ChartBuilder::on(area).build_cartesian_2d(0.0..10.0, -n_lines..1.5)?;
    let mut named: Vec<&Series> = Vec::new();
    for series in plots.iter().flat_map(|plot| &plot.series) {
        if named.iter().all(|other| other.name != series.name) {
            let y = -(named.len() as f64);
            let name = Point { label: series.name.clone(), ..Point::new(1.0, y) };
            let points = if series.is_joined { vec![Point::new(0.2, y), name] } else { vec![name] };
            Series { points, ..series.clone() }.draw(&mut legend, 2, VPos::Center)?;
            named.push(series);
        }
    }
    Ok(())
}

impl Plot {
    /// Adds the Pareto front: the points that no other point beats in both coordinates, the least x first.
    pub(crate) fn with_front(mut self) -> Self {
        let points = self.series.iter().flat_map(|series| &series.points);
        let mut front: Vec<_> = points.map(|point| Point::new(point.x, point.y)).collect();
        front.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
        let mut least = f64::INFINITY;
        front.retain(|point| {
            let is_better = point.y < least;
            least = least.min(point.y);
            is_better
        });
        let name = "Pareto front".to_owned();
        self.series.insert(0, Series { name, color: GREY, mark: Mark::Nothing, is_joined: true, points: front });
        self
    }

    fn draw<DB: DrawingBackend<ErrorType: 'static>>(&self, area: &DrawingArea<DB, Shift>) -> DrawResult {
        let range = |axis: &Axis, value: fn(&Point) -> f64| {
            axis.range.clone().unwrap_or_else(|| {
                let (low, high) = extremes(self.series.iter().flat_map(|series| &series.points).map(value));
                let room = ((high - low) * 0.12).max(0.1);
                low - room..high + room
            })
        };
        let (x, y) = (range(&self.x, |point| point.x), range(&self.y, |point| point.y));
        let mut chart = ChartBuilder::on(area)
            .caption(&self.title, style(15))
            .margin(8)
            .margin_right(24)
            .x_label_area_size(44)
            .y_label_area_size(66)
            .build_cartesian_2d(x, y.clone())?;
        chart
            .configure_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(INK.mix(0.12))
            .axis_style(INK.mix(0.5))
            .x_labels(7)
            .y_labels(((y.end - y.start) as usize + 1).clamp(6, 20))
            .x_desc(self.x.title)
            .y_desc(self.y.title)
            .x_label_formatter(&|x| (self.x.label)(*x))
            .y_label_formatter(&|y| (self.y.label)(*y))
            .label_style(style(13))
            .axis_desc_style(style(14))
            .draw()?;
        for (index, series) in self.series.iter().enumerate() {
            // Earlier lines are wider, so that lines that coincide all show.
            series.draw(&mut chart, 4 - index.min(2) as u32, VPos::Bottom)?;
        }
        Ok(())
    }
}

impl Series {
    /// A single point that carries the name of its series.
    pub(crate) fn single(name: &str, color: RGBColor, mark: Mark, point: Point) -> Self {
        Self { name: name.to_owned(), color, mark, is_joined: false, points: vec![point] }
    }

    /// A line through points; without `mark` it is dashed.
    pub(crate) fn line(
        name: String,
        color: RGBColor,
        mark: Mark,
        points: impl IntoIterator<Item = (f64, f64)>,
    ) -> Self {
        let points = points.into_iter().map(|(x, y)| Point::new(x, y)).collect();
        Self { name, color, mark, is_joined: true, points }
    }

    fn draw<DB: DrawingBackend<ErrorType: 'static>>(
        &self,
        chart: &mut Plane<'_, DB>,
        line_width: u32,
        label_side: VPos,
    ) -> DrawResult {
        let Self { color, mark, .. } = *self;
        let path = self.points.iter().map(|point| (point.x, point.y));
        if mark == Mark::Nothing {
            chart.draw_series(DashedLineSeries::new(path, 6, 4, color.stroke_width(2)))?;
        } else if self.is_joined {
            chart.draw_series(LineSeries::new(path, color.mix(0.7).stroke_width(line_width)))?;
        }
        let radius = if mark == Mark::Nothing { 0 } else { 5 };
        let fill = if mark == Mark::Circle { WHITE } else { color };
        for Point { label, x, y, bar } in &self.points {
            if let Some(bar) = bar {
                let (style, width) = (color.stroke_width(2), 8);
                chart.draw_series([ErrorBar::new_vertical(*x, bar.start, *y, bar.end, style, width)])?;
            }
            let text_style = style(13).color(&color).pos(Pos::new(HPos::Left, label_side));
            chart.draw_series([EmptyElement::at((*x, *y))
                + Circle::new((0, 0), radius, fill.filled())
                + Circle::new((0, 0), radius, color.stroke_width(2))
                + Text::new(label.clone(), (9, 0), text_style)])?;
        }
        Ok(())
    }
}

fn style(size: i32) -> TextStyle<'static> {
    (FONT, size).into_font().color(&INK)
}

/// The least and the largest of some values; 0 and 1 without values.
fn extremes(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let both = |(low, high): (f64, f64), (x, y): (f64, f64)| (low.min(x), high.max(y));
    values.map(|x| (x, x)).reduce(both).unwrap_or((0.0, 1.0))
}

/// Whole decades around some values, with `above` more.
pub(crate) fn whole_decades(values: impl Iterator<Item = f64>, above: f64) -> Range<f64> {
    let (low, high) = extremes(values);
    (low - 0.05).floor()..(high + 0.05).ceil().max((low - 0.05).floor() + 2.0) + above
}

/// A number with at most three decimal places.
pub(crate) fn plain(x: f64) -> String {
    ((x * 1e3).round() / 1e3).to_string()
}

/// A number given by its logarithm, with two significant digits.
pub(crate) fn significant(decade: f64) -> String {
    let x = 10f64.powf(decade);
    let unit = 10f64.powf(x.log10().floor() - 1.0);
    let rounded = (x / unit).round() * unit;
    match rounded {
        x if x >= 9.95 => format!("{x:.0}"),
        x if x >= 0.995 => format!("{x:.1}"),
        x if x >= 0.0995 => format!("{x:.2}"),
        x if x >= 0.00995 => format!("{x:.3}"),
        x => format!("{x:.1e}"),
    }
}

/// A power of ten given by its exponent.
pub(crate) fn power(decade: f64) -> String {
    let decade = decade.round();
    if (-1.0..=4.0).contains(&decade) { format!("{}", 10f64.powf(decade)) } else { format!("1e{decade}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plot(points: &[(&str, f64, f64)]) -> Plot {
        let series = |&(name, x, y): &(&str, f64, f64)| Series::single(name, COLORS[0], Mark::Disc, Point::new(x, y));
        let axis = |title| Axis { title, label: significant, range: None };
        let series = points.iter().map(series).collect();
        Plot { title: "plot".to_owned(), x: axis("time"), y: axis("error"), series }.with_front()
    }

    #[test]
    fn the_front_holds_what_nothing_beats() {
        let plot = plot(&[("a", 1.0, 5.0), ("b", 2.0, 6.0), ("c", 3.0, 1.0), ("d", 0.5, 7.0), ("e", 3.0, 1.0)]);
        let front = &plot.series[0];
        assert_eq!(
            front.points.iter().map(|point| (point.x, point.y)).collect::<Vec<_>>(),
            [(0.5, 7.0), (1.0, 5.0), (3.0, 1.0)]
        );
    }

    #[test]
    fn numbers_are_short() {
        assert_eq!([0.87f64, 1.1, 2.802, 3.3].map(significant), ["7.4", "13", "630", "2000"]);
        assert_eq!([-17.0, 0.0, 6.0, -1.0].map(power), ["1e-17", "1", "1e6", "0.1"]);
        assert_eq!([12.0, 0.1 + 0.2].map(plain), ["12", "0.3"]);
    }

    #[test]
    fn a_plot_without_points_is_drawn() {
        let folder = tempfile::tempdir().unwrap();
        let figure = Figure { title: String::new(), notes: Vec::new(), rows: vec![(300, vec![plot(&[])])] };
        figure.write(folder.path(), "empty").unwrap();
    }

    #[test]
    fn a_figure_is_drawn_as_svg_and_as_png() {
        let plot = || plot(&[("Möller", 1.0, 2.0), ("others", 2.0, 1.0)]);
        let rows = vec![(300, vec![plot(), plot()]), (300, vec![plot()])];
        let figure = Figure { title: "title".to_owned(), notes: vec!["one".to_owned()], rows };
        let folder = tempfile::tempdir().unwrap();
        figure.write(folder.path(), "chart").unwrap();
        let svg = std::fs::read_to_string(folder.path().join("chart.svg")).unwrap();
        for text in ["<svg", "Möller", "others", "Pareto front", "title", "one"] {
            assert!(svg.contains(text), "{text}");
        }
        let png = std::fs::read(folder.path().join("chart.png")).unwrap();
        assert!(png.starts_with(b"\x89PNG") && png.len() > 5000);
    }
}
