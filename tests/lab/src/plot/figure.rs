//! Figures: scatter plots with logarithmic axes, where left is better and down is better.

use std::{ops::Range, path::Path};

use anyhow::{Context, Result, anyhow};
use plotters::{
    coord::{Shift, types::RangedCoordf64},
    prelude::*,
    style::text_anchor::{HPos, Pos, VPos},
};
use renderer::render::image;
use shared::division::FrameSize;

use super::{
    DrawResult, INK,
    labels::{self, Label, Mark, Rect, Side},
    register_fonts, style,
};
use crate::files;

/// A sheet of plots, in rows.
pub struct Figure {
    /// Above all plots.
    pub title: String,
    /// Lines below the title.
    pub notes: Vec<String>,
    /// The height of each row in pixels, and its plots side by side.
    pub rows: Vec<(u32, Vec<Plot>)>,
}

/// One plot. All numbers are decades: logarithms of what is shown.
pub struct Plot {
    /// Above the plot.
    pub title: String,
    /// From left to right.
    pub x: Axis,
    /// From the bottom up.
    pub y: Axis,
    /// The points, by series.
    pub series: Vec<Series>,
    /// Whether the Pareto front is drawn and named.
    pub has_front: bool,
}

/// One of a plot's two axes.
pub struct Axis {
    /// Beside the axis.
    pub title: &'static str,
    /// The label at a decade; may be empty.
    pub label: fn(f64) -> String,
    /// The range in decades; `None` fits the points.
    pub range: Option<Range<f64>>,
}

/// Points that belong together.
pub struct Series {
    /// Written beside a point.
    pub name: String,
    /// The colour of points, lines and names.
    pub color: RGBColor,
    /// Whether points are circles instead of discs.
    pub is_hollow: bool,
    /// Whether a line joins them; then one point carries the name.
    pub is_joined: bool,
    /// From one end of the line to the other.
    pub points: Vec<Point>,
}

/// A point of a series.
pub struct Point {
    /// The setting that it was measured with; may be empty.
    pub label: String,
    /// Its decade along x.
    pub x: f64,
    /// Its decade along y.
    pub y: f64,
    /// A range of y, drawn as a bar.
    pub bar: Option<Range<f64>>,
}

impl Series {
    /// A single point that carries the name of its series.
    pub fn single(name: &str, color: RGBColor, is_hollow: bool, point: Point) -> Self {
        Self { name: name.to_owned(), color, is_hollow, is_joined: false, points: vec![point] }
    }
}

impl Point {
    /// A point without label and bar.
    pub fn new(x: f64, y: f64) -> Self {
        Self { label: String::new(), x, y, bar: None }
    }
}

const WIDTH: u32 = 1240;
const HEADER_HEIGHT: u32 = 50;
const NOTE_HEIGHT: u32 = 20;
const FRONT: RGBColor = RGBColor(120, 120, 120);

type Plane<'a, DB> = ChartContext<'a, DB, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

impl Figure {
    /// Writes NAME.svg and NAME.png.
    pub fn write(&self, folder: &Path, name: &str) -> Result<()> {
        files::write(folder, &format!("{name}.svg"), self.svg()?.as_bytes())?;
        let png_path = folder.join(format!("{name}.png"));
        let (size, rows) = self.bitmap()?;
        image::write_png(&png_path, size, &rows).with_context(|| format!("cannot write {}", png_path.display()))
    }

    fn height(&self) -> u32 {
        self.header_height() + self.rows.iter().map(|(height, _)| height).sum::<u32>()
    }

    fn header_height(&self) -> u32 {
        HEADER_HEIGHT + NOTE_HEIGHT * self.notes.len() as u32
    }

    fn svg(&self) -> Result<String> {
        let mut svg = String::new();
        self.draw_on(SVGBackend::with_string(&mut svg, (WIDTH, self.height())))?;
        Ok(svg)
    }

    /// Pixels, the bottom row first.
    fn bitmap(&self) -> Result<(FrameSize, Vec<u8>)> {
        let size = FrameSize::new(WIDTH, self.height())?;
        let mut rgb = vec![0; 3 * size.n_samples() as usize];
        self.draw_on(BitMapBackend::with_buffer(&mut rgb, (size.xres(), size.yres())))?;
        Ok((size, rgb.rchunks_exact(3 * WIDTH as usize).flatten().copied().collect()))
    }

    fn draw_on<DB: DrawingBackend>(&self, backend: DB) -> Result<()>
    where
        DB::ErrorType: 'static,
    {
        register_fonts();
        self.draw(&backend.into_drawing_area()).map_err(|error| anyhow!("cannot draw the chart: {error}"))
    }

    fn draw<DB: DrawingBackend>(&self, root: &DrawingArea<DB, Shift>) -> DrawResult
    where
        DB::ErrorType: 'static,
    {
        root.fill(&WHITE)?;
        root.draw_text(&self.title, &style(22), (24, 14))?;
        for (note, y) in self.notes.iter().zip((46..).step_by(NOTE_HEIGHT as usize)) {
            root.draw_text(note, &style(14), (24, y))?;
        }
        let (_, mut below) = root.split_vertically(self.header_height());
        for (height, plots) in &self.rows {
            let (row, rest) = below.split_vertically(*height);
            below = rest;
            for (plot, area) in plots.iter().zip(row.split_evenly((1, plots.len()))) {
                plot.draw(&area)?;
            }
        }
        root.present()?;
        Ok(())
    }
}

impl Plot {
    fn points(&self) -> impl Iterator<Item = (&Series, &Point)> {
        self.series.iter().flat_map(|series| series.points.iter().map(move |point| (series, point)))
    }

    fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>) -> DrawResult
    where
        DB::ErrorType: 'static,
    {
        let ranges = |axis: &Axis, values: Vec<f64>| axis.range.clone().unwrap_or_else(|| around(values));
        let x = ranges(&self.x, self.points().map(|(_, point)| point.x).collect());
        let y = ranges(&self.y, self.points().map(|(_, point)| point.y).collect());
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
            .y_labels(((y.end - y.start) as usize + 1).max(6))
            .x_desc(self.x.title)
            .y_desc(self.y.title)
            .x_label_formatter(&|decade| (self.x.label)(*decade))
            .y_label_formatter(&|decade| (self.y.label)(*decade))
            .label_style(style(13))
            .axis_desc_style(style(14))
            .draw()?;
        let front = if self.has_front { pareto_front(self.points()) } else { Vec::new() };
        let along_front = front.iter().map(|(_, point)| (point.x, point.y));
        chart.draw_series(DashedLineSeries::new(along_front, 6, 4, FRONT.stroke_width(2)))?;
        for series in &self.series {
            if series.is_joined {
                let line = series.points.iter().map(|point| (point.x, point.y));
                chart.draw_series(LineSeries::new(line, series.color.mix(0.7).stroke_width(1)))?;
            }
            for point in &series.points {
                draw_point(area, &mut chart, series, point)?;
            }
        }
        self.draw_labels(area, &chart, &front)
    }

    /// Writes the names of the front, of series and of points where they cover no name, point, bar or line.
    fn draw_labels<DB: DrawingBackend>(
        &self,
        area: &DrawingArea<DB, Shift>,
        chart: &Plane<'_, DB>,
        front: &[(&Series, &Point)],
    ) -> DrawResult
    where
        DB::ErrorType: 'static,
    {
        let corner = area.get_base_pixel();
        let at = |x: f64, y: f64| {
            let (x, y) = chart.backend_coord(&(x, y));
            (x - corner.0, y - corner.1)
        };
        let (width, height) = area.dim_in_pixel();
        let mut inside = Rect { left: 78, top: 50, right: width as i32 - 26, bottom: height as i32 - 56 };
        for line in front_lines(front, inside.right - inside.left) {
            let text = style(12).color(&FRONT).pos(Pos::new(HPos::Right, VPos::Top));
            area.draw_text(&line, &text, (inside.right, inside.top - 16))?;
            inside.top += 14;
        }

        let marks = self.points().map(|(_, point)| Mark {
            position_px: at(point.x, point.y),
            bar: point.bar.as_ref().map(|bar| at(point.x, bar.end).1..at(point.x, bar.start).1),
        });
        let joined = self.series.iter().filter(|series| series.is_joined);
        let lines = joined.map(|series| series.points.iter().map(|point| at(point.x, point.y)).collect());
        let front_line = front.iter().map(|(_, point)| at(point.x, point.y)).collect();
        let (marks, lines): (Vec<_>, Vec<_>) = (marks.collect(), lines.chain([front_line]).collect());

        let mut texts: Vec<(&str, &Series, (i32, i32), i32)> = Vec::new();
        for series in &self.series {
            // The last point carries the name of its series.
            if let Some(point) = series.points.last() {
                texts.push((&series.name, series, at(point.x, point.y), 14));
            }
            let labelled = series.points.iter().filter(|point| !point.label.is_empty());
            texts.extend(labelled.map(|point| (&*point.label, series, at(point.x, point.y), 12)));
        }
        let sized = texts.iter().map(|&(text, _, position_px, size)| {
            let (width, height) = area.estimate_text_size(text, &style(size))?;
            Ok(Label { position_px, size: (width as i32 + 4, height as i32 + 2) })
        });
        let sized: Vec<_> = sized.collect::<Result<_, DrawingAreaErrorKind<DB::ErrorType>>>()?;
        for ((text, series, point, size), place) in
            texts.into_iter().zip(labels::arrange(&sized, &marks, &lines, &inside))
        {
            let Some((rect, side)) = place else { continue };
            let (horizontal, x) = match side {
                Side::Left => (HPos::Right, rect.right - 2),
                Side::Right => (HPos::Left, rect.left + 2),
                Side::Middle => (HPos::Center, (rect.left + rect.right) / 2),
            };
            let text_style = style(size).color(&series.color).pos(Pos::new(horizontal, VPos::Top));
            area.draw_text(text, &text_style, (x, rect.top))?;
            // A line ties a distant name to its point.
            let middle = (rect.top + rect.bottom) / 2;
            if (middle - point.1).abs() > 20 {
                let end = (x, if middle < point.1 { rect.bottom } else { rect.top });
                area.draw(&PathElement::new(vec![point, end], series.color.mix(0.5).stroke_width(1)))?;
            }
        }
        Ok(())
    }
}

fn draw_point<DB: DrawingBackend>(
    area: &DrawingArea<DB, Shift>,
    chart: &mut Plane<'_, DB>,
    series: &Series,
    point: &Point,
) -> DrawResult
where
    DB::ErrorType: 'static,
{
    let color = series.color;
    if let Some(bar) = &point.bar {
        let ends = vec![(point.x, bar.start), (point.x, bar.end)];
        chart.draw_series([PathElement::new(ends, color.stroke_width(2))])?;
        for end in [bar.start, bar.end] {
            let (x, y) = chart.backend_coord(&(point.x, end));
            let corner = area.get_base_pixel();
            let (x, y) = (x - corner.0, y - corner.1);
            area.draw(&PathElement::new(vec![(x - 4, y), (x + 4, y)], color.stroke_width(2)))?;
        }
    }
    let radius = if series.is_joined { 4 } else { 6 };
    if series.is_hollow {
        chart.draw_series([Circle::new((point.x, point.y), radius, WHITE.filled())])?;
        chart.draw_series([Circle::new((point.x, point.y), radius, color.stroke_width(2))])?;
    } else {
        chart.draw_series([Circle::new((point.x, point.y), radius, color.filled())])?;
    }
    Ok(())
}

/// Points that no other point beats in both coordinates, the fastest first.
fn pareto_front<'a>(points: impl Iterator<Item = (&'a Series, &'a Point)>) -> Vec<(&'a Series, &'a Point)> {
    let mut by_x: Vec<_> = points.collect();
    by_x.sort_by(|(_, a), (_, b)| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    let mut least = f64::INFINITY;
    by_x.retain(|(_, point)| {
        let is_better = point.y < least;
        least = least.min(point.y);
        is_better
    });
    by_x
}

/// The names of the front's points, in lines of at most `width` pixels.
fn front_lines(front: &[(&Series, &Point)], width: i32) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for (series, point) in front {
        let name = format!("{} {}", series.name, point.label);
        match lines.last_mut() {
            None => lines.push(format!("Pareto front: {}", name.trim())),
            Some(line) if (line.chars().count() + name.chars().count()) as i32 * 6 < width => {
                line.push_str(" > ");
                line.push_str(name.trim());
            }
            Some(_) => lines.push(format!("> {}", name.trim())),
        }
    }
    lines
}

/// The range of some values, with room for names.
fn around(values: Vec<f64>) -> Range<f64> {
    let (low, high) =
        values.into_iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
    let room = ((high - low) * 0.12).max(0.1);
    low - room..high + room
}

/// Whole decades around some values, with `above` more.
pub fn whole_decades(values: impl Iterator<Item = f64>, above: f64) -> Range<f64> {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
    (low - 0.05).floor()..(high + 0.05).ceil().max((low - 0.05).floor() + 2.0) + above
}

/// A number given by its logarithm, with two significant digits.
pub fn significant(decade: f64) -> String {
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
pub fn power(decade: f64) -> String {
    let decade = decade.round();
    if (-1.0..=4.0).contains(&decade) { format!("{}", 10f64.powf(decade)) } else { format!("1e{decade}") }
}

#[cfg(test)]
mod tests {
    use super::{super::COLORS, *};

    fn series(name: &str, points: &[(f64, f64)]) -> Series {
        let point = |&(x, y): &(f64, f64)| Point::new(x, y);
        Series {
            name: name.to_owned(),
            color: COLORS[0],
            is_hollow: false,
            is_joined: points.len() > 1,
            points: points.iter().map(point).collect(),
        }
    }

    #[test]
    fn the_front_holds_what_nothing_beats() {
        let places = [("a", 1.0, 5.0), ("b", 2.0, 6.0), ("c", 3.0, 1.0), ("d", 0.5, 7.0), ("e", 3.0, 1.0)];
        let all: Vec<_> = places.iter().map(|&(name, x, y)| series(name, &[(x, y)])).collect();
        let front = pareto_front(all.iter().map(|series| (series, &series.points[0])));
        assert_eq!(front.iter().map(|(series, _)| &*series.name).collect::<Vec<_>>(), ["d", "a", "c"]);
        assert_eq!(front_lines(&front, 500), ["Pareto front: d > a > c"]);
    }

    #[test]
    fn numbers_are_short() {
        assert_eq!([0.87f64, 1.1, 2.802, 3.3].map(significant), ["7.4", "13", "630", "2000"]);
        assert_eq!([-17.0, 0.0, 6.0, -1.0].map(power), ["1e-17", "1", "1e6", "0.1"]);
    }

    #[test]
    fn a_figure_is_drawn_as_svg_and_as_png() {
        let axis = |title| Axis { title, label: significant, range: None };
        let plot = || Plot {
            title: "plot".to_owned(),
            x: axis("time"),
            y: axis("error"),
            series: vec![series("Möller", &[(1.0, 2.0)]), series("others", &[(2.0, 1.0), (3.0, 0.5)])],
            has_front: true,
        };
        let rows = vec![(300, vec![plot(), plot()]), (300, vec![plot()])];
        let figure = Figure { title: "title".to_owned(), notes: vec!["one".to_owned()], rows };
        let folder = tempfile::tempdir().unwrap();
        figure.write(folder.path(), "chart").unwrap();
        let svg = std::fs::read_to_string(folder.path().join("chart.svg")).unwrap();
        for text in ["<svg", "Möller", "others", "Pareto front: Möller", "title", "one"] {
            assert!(svg.contains(text), "{text}");
        }
        let png = std::fs::read(folder.path().join("chart.png")).unwrap();
        assert!(png.starts_with(b"\x89PNG") && png.len() > 5000);
    }
}
