//! The chart: for each placement speed against depth error, and speed against wrong pixels.

use std::ops::Range;

use anyhow::{Result, anyhow};
use plotters::{
    coord::{Shift, types::RangedCoordf64},
    prelude::*,
    style::text_anchor::{HPos, Pos, VPos},
};

use super::{candidates::Placement, methods::Method, table::Row};

/// All methods at one placement, over all cameras.
pub(super) struct Panel {
    pub(super) placement: Placement,
    pub(super) rows: Vec<Row>,
}

type Plane<'a, 'b> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;
type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

const WIDTH: u32 = 1240;
const PANEL_HEIGHT: u32 = 330;
const HEADER_HEIGHT: u32 = 96;
const FONT: &str = "sans-serif";
const INK: RGBColor = RGBColor(40, 44, 52);
const FRONT: RGBColor = RGBColor(150, 150, 150);
const PAPER: RGBColor = WHITE;

/// Okabe and Ito's colours, which those who see few colours can tell apart.
fn color(method: Method) -> RGBColor {
    match method {
        Method::OriginEdgesF32 => RGBColor(213, 94, 0),
        Method::MollerTrumboreF32 => RGBColor(204, 121, 167),
        Method::PluckerF32 => RGBColor(0, 114, 178),
        Method::Raywall => RGBColor(0, 158, 115),
        Method::MollerTrumboreF64 => RGBColor(86, 60, 20),
    }
}

/// A method in a panel, in decades: the logarithms of what is shown.
struct Point {
    method: Method,
    x: f64,
    y: f64,
    /// Median and maximum, where they are shown.
    whisker: Option<Range<f64>>,
}

/// Draws the chart as SVG.
pub(super) fn svg(title: &str, subtitles: [&str; 2], panels: &[Panel]) -> Result<String> {
    let mut svg = String::new();
    {
        let height = HEADER_HEIGHT + PANEL_HEIGHT * panels.len() as u32;
        let root = SVGBackend::with_string(&mut svg, (WIDTH, height)).into_drawing_area();
        draw(&root, title, subtitles, panels).map_err(|error| anyhow!("cannot draw the chart: {error}"))?;
    }
    Ok(svg)
}

type Drawn = Result<(), Box<dyn std::error::Error>>;

fn draw(root: &Area<'_>, title: &str, subtitles: [&str; 2], panels: &[Panel]) -> Drawn {
    root.fill(&PAPER)?;
    root.draw_text(title, &style(22), (24, 14))?;
    for (subtitle, y) in subtitles.into_iter().zip([46, 66]) {
        root.draw_text(subtitle, &style(14), (24, y))?;
    }
    let rows = panels.iter().flat_map(|panel| &panel.rows);
    let x = around(rows.clone().map(|row| row.cpu_ns_per_ray.log10()), 0.25, 0.25);
    let depths = rows.clone().flat_map(|row| [row.depth_error_p50, row.depth_error_max]);
    let depth = whole_decades(depths.map(decades));
    let wrong = NONE - 0.4..7.4;
    let (_, below) = root.split_vertically(HEADER_HEIGHT);
    for (panel, area) in panels.iter().zip(below.split_evenly((panels.len(), 1))) {
        let (left, right) = area.split_horizontally(WIDTH / 2);
        let point = |row: &Row, y, whisker| Point { method: row.method, x: row.cpu_ns_per_ray.log10(), y, whisker };
        let points: Vec<_> = panel
            .rows
            .iter()
            .map(|row| {
                let whisker = decades(row.depth_error_p50)..decades(row.depth_error_max);
                point(row, decades(row.depth_error_p999), Some(whisker))
            })
            .collect();
        let placement = panel.placement.title();
        draw_panel(&left, placement, "relative depth error", &points, &x, &depth, power)?;
        let points: Vec<_> = panel.rows.iter().map(|row| point(row, decades_per_million(row), None)).collect();
        let no_title = format!("{} pixels compared", panel.rows.first().map_or(0, |row| row.compared));
        draw_panel(&right, &no_title, "wrong pixels in a million", &points, &x, &wrong, |decade| match decade {
            NONE => "none".to_owned(),
            0.0..=6.0 => power(decade),
            _ => String::new(),
        })?;
    }
    root.present()?;
    Ok(())
}

/// Errors below what `f64` resolves are shown as that.
fn decades(error: f64) -> f64 {
    error.max(1e-17).log10()
}

/// Where no wrong pixel at all is shown: one decade below one in a million.
const NONE: f64 = -1.0;

fn decades_per_million(row: &Row) -> f64 {
    if row.wrong_pixels == 0 {
        return NONE;
    }
    (row.wrong_pixels as f64 * 1e6 / row.compared as f64).log10().max(0.0)
}

fn around(values: impl Iterator<Item = f64>, below: f64, above: f64) -> Range<f64> {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
    low - below..high + above
}

fn whole_decades(values: impl Iterator<Item = f64>) -> Range<f64> {
    let Range { start, end } = around(values, 0.05, 0.05);
    start.floor()..end.ceil().max(start.floor() + 2.0) + 1.5
}

fn draw_panel(
    area: &Area<'_>,
    title: &str,
    y_title: &str,
    points: &[Point],
    x: &Range<f64>,
    y: &Range<f64>,
    y_label: impl Fn(f64) -> String,
) -> Drawn {
    let mut chart = ChartBuilder::on(area)
        .caption(title, style(15))
        .margin(8)
        .margin_right(24)
        .x_label_area_size(44)
        .y_label_area_size(66)
        .build_cartesian_2d(x.clone(), y.clone())?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(INK.mix(0.12))
        .axis_style(INK.mix(0.5))
        .x_labels(6)
        .y_labels((y.end - y.start) as usize + 1)
        .x_desc("CPU ns per ray")
        .y_desc(y_title)
        .x_label_formatter(&|decade| significant(10f64.powf(*decade)))
        .y_label_formatter(&|decade| y_label(decade.round()))
        .label_style(style(13))
        .axis_desc_style(style(14))
        .draw()?;
    let front = pareto_front(points);
    chart.draw_series(DashedLineSeries::new(
        front.iter().map(|point| (point.x, point.y)),
        6,
        4,
        FRONT.stroke_width(2),
    ))?;
    for point in points {
        let color = color(point.method);
        if let Some(whisker) = &point.whisker {
            chart.draw_series([PathElement::new(
                vec![(point.x, whisker.start), (point.x, whisker.end)],
                color.stroke_width(2),
            )])?;
            for end in [whisker.start, whisker.end] {
                let (x, y) = chart.backend_coord(&(point.x, end));
                let corner = area.get_base_pixel();
                let (x, y) = (x - corner.0, y - corner.1);
                area.draw(&PathElement::new(vec![(x - 4, y), (x + 4, y)], color.stroke_width(2)))?;
            }
        }
        chart.draw_series([Circle::new((point.x, point.y), 6, color.filled())])?;
    }
    draw_labels(area, &chart, points, &front)
}

/// Methods that no other beats in both, the fastest first.
fn pareto_front(points: &[Point]) -> Vec<&Point> {
    let mut by_speed: Vec<_> = points.iter().collect();
    by_speed.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    let mut least = f64::INFINITY;
    by_speed.retain(|point| {
        let is_better = point.y < least;
        least = least.min(point.y);
        is_better
    });
    by_speed
}

/// Names the front, and every point where no other name, point or bar is.
fn draw_labels(area: &Area<'_>, chart: &Plane<'_, '_>, points: &[Point], front: &[&Point]) -> Drawn {
    let corner = area.get_base_pixel();
    let at = |x: f64, y: f64| {
        let (x, y) = chart.backend_coord(&(x, y));
        (x - corner.0, y - corner.1)
    };
    let (width, height) = area.dim_in_pixel();
    let inside = Rect { left: 78, top: 50, right: width as i32 - 26, bottom: height as i32 - 56 };
    let names: Vec<_> = front.iter().map(|point| point.method.label()).collect();
    let right = Pos::new(HPos::Right, VPos::Top);
    let text = style(12).color(&FRONT).pos(right);
    area.draw_text(&format!("Pareto front: {}", names.join(" → ")), &text, (inside.right, inside.top - 16))?;

    let size = |point: &Point| if front.iter().any(|other| other.method == point.method) { 15 } else { 13 };
    let marks: Vec<_> = points
        .iter()
        .map(|point| {
            let place = at(point.x, point.y);
            let bar = point.whisker.as_ref().map(|whisker| at(point.x, whisker.end).1..at(point.x, whisker.start).1);
            Mark { place, bar, label: (text_width(point.method.label(), size(point)), size(point) + 3) }
        })
        .collect();
    let line: Vec<_> = front.iter().map(|point| at(point.x, point.y)).collect();
    for ((point, mark), (rect, side)) in points.iter().zip(&marks).zip(place_labels(&marks, &line, &inside)) {
        let color = color(point.method);
        let (horizontal, x) = match side {
            Side::Left => (HPos::Right, rect.right),
            Side::Right => (HPos::Left, rect.left),
            Side::Middle => (HPos::Center, (rect.left + rect.right) / 2),
        };
        let text = style(size(point)).color(&color).pos(Pos::new(horizontal, VPos::Top));
        area.draw_text(point.method.label(), &text, (x, rect.top))?;
        // A name that stands apart is tied to its point.
        let middle = (rect.top + rect.bottom) / 2;
        if (middle - mark.place.1).abs() > 20 {
            let end = (x, if middle < mark.place.1 { rect.bottom } else { rect.top });
            area.draw(&PathElement::new(vec![mark.place, end], color.mix(0.5).stroke_width(1)))?;
        }
    }
    Ok(())
}

/// A point as it is drawn, in pixels.
struct Mark {
    place: (i32, i32),
    /// From the top down.
    bar: Option<Range<i32>>,
    /// Width and height of its name.
    label: (i32, i32),
}

/// On which side of its point a name stands.
#[derive(Clone, Copy, Debug)]
enum Side {
    Left,
    Right,
    Middle,
}

/// Places for the names of points: as near as possible, but on nothing else, if that can be.
fn place_labels(marks: &[Mark], line: &[(i32, i32)], inside: &Rect) -> Vec<(Rect, Side)> {
    let mut taken: Vec<Rect> = Vec::new();
    for Mark { place: (x, y), bar, .. } in marks {
        taken.push(Rect { left: x - 8, top: y - 8, right: x + 8, bottom: y + 8 });
        taken.extend(bar.as_ref().map(|bar| Rect { left: x - 5, top: bar.start, right: x + 5, bottom: bar.end }));
    }
    for ends in line.windows(2) {
        let [(x, y), (to_x, to_y)] = [ends[0], ends[1]];
        taken.extend((0..=50).map(|step| {
            let (x, y) = (x + (to_x - x) * step / 50, y + (to_y - y) * step / 50);
            Rect { left: x - 2, top: y - 2, right: x + 2, bottom: y + 2 }
        }));
    }
    let mut placed = Vec::new();
    for &Mark { place: (x, y), label: (width, height), .. } in marks {
        let rect = |left: i32, top: i32| Rect { left, top, right: left + width, bottom: top + height };
        let steps = (0..18).flat_map(|step| [step * 9, -step * 9]);
        let mut places = steps.flat_map(|step| {
            let top = y - height / 2 + step;
            [
                (rect(x + 12, top), Side::Right),
                (rect(x - 12 - width, top), Side::Left),
                (rect(x - width / 2, top), Side::Middle),
            ]
        });
        let is_free = |rect: &Rect| inside.holds(rect) && taken.iter().all(|other| !other.meets(rect));
        let place = places.find(|(rect, _)| is_free(rect)).unwrap_or((rect(x + 12, y - height / 2), Side::Right));
        taken.push(place.0);
        placed.push(place);
    }
    placed
}

#[derive(Clone, Copy, Debug)]
struct Rect {
    left: i32,
    top: i32,
    right: i32,
    bottom: i32,
}

impl Rect {
    fn meets(&self, other: &Self) -> bool {
        self.left < other.right && other.left < self.right && self.top < other.bottom && other.top < self.bottom
    }

    fn holds(&self, other: &Self) -> bool {
        self.left <= other.left && other.right <= self.right && self.top <= other.top && other.bottom <= self.bottom
    }
}

/// About as wide as browsers draw it.
fn text_width(text: &str, size: i32) -> i32 {
    text.chars().count() as i32 * size / 2 + 6
}

fn style(size: i32) -> TextStyle<'static> {
    (FONT, size).into_font().color(&INK)
}

/// Two significant digits.
fn significant(x: f64) -> String {
    let unit = 10f64.powf(x.log10().floor() - 1.0);
    let rounded = (x / unit).round() * unit;
    if rounded < 10.0 { format!("{rounded:.1}") } else { format!("{rounded:.0}") }
}

/// A power of ten.
fn power(decade: f64) -> String {
    let digits = (decade as i32).to_string();
    let raised = digits.chars().map(|digit| match digit {
        '-' => '⁻',
        '1' => '¹',
        '2' => '²',
        '3' => '³',
        digit => char::from_u32('⁰' as u32 + digit as u32 - '0' as u32).unwrap_or(digit),
    });
    format!("10{}", raised.collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chart::measure::Measurement;

    #[test]
    fn names_cover_neither_each_other_nor_points() {
        let inside = Rect { left: 78, top: 50, right: 594, bottom: 274 };
        for spread in [0, 3, 10, 40, 90] {
            let marks: Vec<_> = (0..5)
                .map(|n| {
                    let (x, y) = (330 + (n * 7 % 5 - 2) * spread, 150 + (n * 3 % 5 - 2) * spread / 2);
                    Mark { place: (x, y), bar: Some(y - 20..y + 15), label: (120 + n, 17) }
                })
                .collect();
            let placed = place_labels(&marks, &[marks[0].place, marks[1].place], &inside);
            for (index, (rect, _)) in placed.iter().enumerate() {
                assert!(inside.holds(rect), "{rect:?}");
                assert!(placed[..index].iter().all(|(other, _)| !other.meets(rect)), "{spread}: {placed:?}");
                let covers = |mark: &Mark| {
                    let (x, y) = mark.place;
                    rect.meets(&Rect { left: x - 6, top: y - 6, right: x + 6, bottom: y + 6 })
                };
                assert!(!marks.iter().any(covers), "{spread}: {rect:?}");
            }
        }
    }

    #[test]
    fn the_front_holds_what_nothing_beats() {
        let point = |method, x, y| Point { method, x, y, whisker: None };
        let [a, b, c, d, e] = Method::ALL;
        let points =
            [point(a, 1.0, 5.0), point(b, 2.0, 6.0), point(c, 3.0, 1.0), point(d, 0.5, 7.0), point(e, 3.0, 1.0)];
        let front: Vec<_> = pareto_front(&points).iter().map(|point| point.method).collect();
        assert_eq!(front, [d, a, c]);
    }

    #[test]
    fn numbers_are_short() {
        assert_eq!([7.34, 12.6, 634.0, 1999.0].map(significant), ["7.3", "13", "630", "2000"]);
        assert_eq!([-17.0, 0.0, 6.0].map(power), ["10⁻¹⁷", "10⁰", "10⁶"]);
    }

    #[test]
    fn a_chart_of_nothing_much_can_be_drawn() {
        let row = |method| Row::new("all", Placement::Near, method, &Measurement::default());
        let mut rows: Vec<_> = Method::ALL.into_iter().map(row).collect();
        for (n, row) in rows.iter_mut().enumerate() {
            row.cpu_ns_per_ray = 10.0 + n as f64;
            row.compared = 100;
        }
        let svg = svg("title", ["one", "two"], &[Panel { placement: Placement::Near, rows }]).unwrap();
        assert!(svg.starts_with("<svg") && Method::ALL.iter().all(|method| svg.contains(method.label())));
    }
}
