//! The results as charts, the paper's figures 8 and 9 among them.

use std::path::Path;

use plotters::style::{BLACK, RGBColor};
use shared::division::Division;
use strum::VariantArray;

use super::results::{MeasuredRow, PredictedRow, Results};
use crate::plot::{COLORS, GREY, Line, LineChart, write_line_charts};

/// Draws every chart that has results.
pub(super) fn draw(results: &Results, folder: &Path) -> anyhow::Result<()> {
    if !results.measured.is_empty() {
        write_line_charts(folder, "bytes-per-frame.svg", &bytes_charts(&results.measured))?;
        write_line_charts(folder, "time-per-frame.svg", &[time_chart(&results.measured, results.n_cores)])?;
    }
    let mut sizes: Vec<&str> = results.predicted.iter().map(|row| &*row.size).collect();
    sizes.dedup();
    for size in sizes {
        let rows: Vec<_> = results.predicted.iter().filter(|row| row.size == size && row.n_slow == 0).collect();
        for (name, is_moving) in [("still", false), ("moving", true)] {
            let rows: Vec<_> = rows.iter().copied().filter(|row| row.is_moving == is_moving).collect();
            let mut links: Vec<f64> = rows.iter().map(|row| row.mbit_per_s).collect();
            links.sort_by(f64::total_cmp);
            links.dedup();
            let charts: Vec<_> = links.into_iter().map(|link| cluster_chart(&rows, size, name, link)).collect();
            if !charts.is_empty() {
                write_line_charts(folder, &format!("predicted-{size}-{name}.svg"), &charts)?;
            }
        }
    }
    Ok(())
}

fn color(division: Division) -> RGBColor {
    match division {
        Division::Interleaved => COLORS[0],
        Division::Tiled => COLORS[2],
        Division::Dynamic => COLORS[3],
    }
}

fn by_division<T>(
    rows: &[&T],
    division: impl Fn(&T) -> Option<Division>,
    point: impl Fn(&T) -> (f64, f64),
) -> Vec<Line> {
    let line = |of: Division| Line {
        name: of.to_string(),
        color: color(of),
        is_bound: false,
        points: rows.iter().filter(|row| division(row) == Some(of)).map(|row| point(row)).collect(),
    };
    Division::VARIANTS.iter().copied().map(line).filter(|line| !line.points.is_empty()).collect()
}

/// The paper's figure 8.
fn bytes_charts(rows: &[MeasuredRow]) -> [LineChart; 2] {
    let chart = |title: &str, unit: &str, value: fn(&MeasuredRow) -> f64| LineChart {
        title: title.to_owned(),
        note: "median over frames; lines that coincide lie one upon another".to_owned(),
        x_label: "render servers",
        y_label: unit.to_owned(),
        lines: by_division(
            &rows.iter().collect::<Vec<_>>(),
            |row| row.division,
            |row| (f64::from(row.n_nodes), value(row)),
        ),
        ..LineChart::default()
    };
    [
        chart("Received by the wall per frame", "kB", |row| row.bytes_in / 1e3),
        chart("Sent by the wall per frame", "kB", |row| row.bytes_out / 1e3),
    ]
}

/// The paper's figure 9.
fn time_chart(rows: &[MeasuredRow], n_cores: usize) -> LineChart {
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
    LineChart {
        title: "Time per frame".to_owned(),
        note: format!("render servers of one thread; they and the wall share {n_cores} cores"),
        x_label: "render servers",
        y_label: "ms, median".to_owned(),
        lines,
        ..LineChart::default()
    }
}

fn cluster_chart(rows: &[&PredictedRow], size: &str, motion: &str, mbit_per_s: f64) -> LineChart {
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
    LineChart {
        title: format!("Predicted: {size}, {motion} camera, {link} into the wall"),
        note,
        x_label: "one-core render servers",
        y_label: "frames a second".to_owned(),
        is_log: true,
        lines,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let chart = cluster_chart(&rows.iter().collect::<Vec<_>>(), "1024x512", "still", 680.0);
        let folder = tempfile::tempdir().unwrap();
        write_line_charts(folder.path(), "chart.svg", &[chart]).unwrap();
        let svg = std::fs::read_to_string(folder.path().join("chart.svg")).unwrap();
        for text in
            ["680 Mbit/s", "compute binds at 1; link binds at 64", "dynamic", "bound by the link", "frames a second"]
        {
            assert!(svg.contains(text), "{text}");
        }
    }
}
