//! What was measured as a table: CSV for spreadsheets, JSON for programs.

use serde::Serialize;

use super::{candidates::Placement, measure::Measurement, methods::Method};

/// A line of the table: one method on one view.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Row {
    pub(super) camera: String,
    pub(super) placement: Placement,
    pub(super) method: Method,
    pub(super) cpu_ns_per_ray: f64,
    pub(super) depth_error_p50: f64,
    pub(super) depth_error_p999: f64,
    pub(super) depth_error_max: f64,
    pub(super) wrong_pixels: u64,
    pub(super) lost: u64,
    pub(super) invented: u64,
    pub(super) other_triangle: u64,
    pub(super) compared: u64,
    pub(super) undecided: u64,
}

impl Row {
    pub(super) fn new(camera: &str, placement: Placement, method: Method, measurement: &Measurement) -> Self {
        let [depth_error_p50, depth_error_p999, depth_error_max] = measurement.depth_error_quantiles();
        Self {
            camera: camera.to_owned(),
            placement,
            method,
            cpu_ns_per_ray: measurement.cpu_ns_per_ray(),
            depth_error_p50,
            depth_error_p999,
            depth_error_max,
            wrong_pixels: measurement.n_wrong(),
            lost: measurement.n_lost,
            invented: measurement.n_invented,
            other_triangle: measurement.n_other_triangle,
            compared: measurement.n_compared,
            undecided: measurement.n_undecided,
        }
    }

    fn to_csv(&self) -> String {
        format!(
            "\"{}\",{},{},{:.2},{:e},{:e},{:e},{},{},{},{},{},{}\n",
            self.camera.replace('"', "\"\""),
            self.placement.name(),
            self.method.name(),
            self.cpu_ns_per_ray,
            self.depth_error_p50,
            self.depth_error_p999,
            self.depth_error_max,
            self.wrong_pixels,
            self.lost,
            self.invented,
            self.other_triangle,
            self.compared,
            self.undecided
        )
    }
}

/// All rows, with a line of names first.
pub(super) fn to_csv(rows: &[Row]) -> String {
    let names = "camera,placement,method,cpu_ns_per_ray,depth_error_p50,depth_error_p999,depth_error_max,\
        wrong_pixels,lost,invented,other_triangle,compared,undecided\n";
    names.to_owned() + &rows.iter().map(Row::to_csv).collect::<String>()
}
