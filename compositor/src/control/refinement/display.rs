//! A model of the display's time: the interval between refreshes, and the time to upload and draw a frame, a part of
//! which grows with its samples.

use std::time::Duration;

use shared::division::FrameSize;

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct ShowTimes {
    /// From the frame's arrival until the next can be shown.
    pub took: Duration,
    pub upload: Duration,
    /// The refresh interval of the fastest output; zero if unknown.
    pub refresh: Duration,
}

/// Frames that the averages cover, about two seconds' worth.
const N_REMEMBERED: u32 = 64;
/// Times are clamped to this multiple of the mean.
const LONGEST: f64 = 3.0;
/// The weight of the upload's slope in the regression: a variance of samples, as parts of the native resolution. Only
/// sizes that differ by more outweigh it.
const LEAST_VARIANCE: f64 = 1e-3;

/// A line through the last frames' times over their samples: ridge regression with forgetting, toward the slope of the
/// upload alone.
#[derive(Clone, Debug, Default)]
pub(super) struct DisplayCost {
    native_samples: f64,
    last_size: Option<FrameSize>,
    /// The refresh interval; 0 if unknown.
    pub(super) refresh_s: f64,
    n_frames: u32,
    /// Only the first frame is known, which includes one-time costs.
    is_guess: bool,
    mean_upload_s: f64,
    /// In parts of the native resolution's samples.
    mean_samples: f64,
    mean_s: f64,
    variance: f64,
    covariance_s: f64,
}

impl DisplayCost {
    /// A model without data.
    pub(super) fn new(native: FrameSize) -> Self {
        Self { native_samples: f64::from(native.n_samples()), ..Self::default() }
    }

    /// Accounts for a frame of this size that was shown.
    pub(super) fn learn(&mut self, size: FrameSize, times: &ShowTimes) {
        self.refresh_s = times.refresh.as_secs_f64();
        // The first frame of a size includes one-time costs: use it only while there is no other.
        let is_first_of_size = self.last_size.replace(size) != Some(size);
        if is_first_of_size && self.n_frames > 0 {
            return;
        }
        if self.is_guess {
            self.n_frames = 0;
        }
        self.is_guess = is_first_of_size;
        let longest_s = if self.n_frames == 0 { f64::INFINITY } else { LONGEST * self.mean_s };
        self.n_frames = (self.n_frames + 1).min(N_REMEMBERED);
        let weight = 1.0 / f64::from(self.n_frames);
        let delta_samples = self.samples(size) - self.mean_samples;
        let delta_s = times.took.as_secs_f64().min(longest_s) - self.mean_s;
        self.mean_samples += weight * delta_samples;
        self.mean_s += weight * delta_s;
        self.mean_upload_s += weight * (times.upload.as_secs_f64().min(longest_s) - self.mean_upload_s);
        self.variance = (1.0 - weight) * (self.variance + weight * delta_samples * delta_samples);
        self.covariance_s = (1.0 - weight) * (self.covariance_s + weight * delta_samples * delta_s);
    }

    /// The expected time of a frame of this size, in seconds; 0 without data.
    pub(super) fn expected_s(&self, size: FrameSize) -> f64 {
        if self.n_frames == 0 {
            return 0.0;
        }
        let upload_slope_s = self.mean_upload_s / self.mean_samples;
        let slope_s = (self.covariance_s + LEAST_VARIANCE * upload_slope_s) / (self.variance + LEAST_VARIANCE);
        // No size may be expected to take negative time.
        let slope_s = slope_s.clamp(0.0, self.mean_s / self.mean_samples);
        self.mean_s + slope_s * (self.samples(size) - self.mean_samples)
    }

    fn samples(&self, size: FrameSize) -> f64 {
        f64::from(size.n_samples()) / self.native_samples
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn display(times: &[([u32; 2], f64, f64)]) -> DisplayCost {
        let mut display = DisplayCost::new(FrameSize::new(4096, 2304).unwrap());
        for &([xres, yres], took_s, upload_s) in times {
            let [took, upload] = [took_s, upload_s].map(Duration::from_secs_f64);
            let times = ShowTimes { took, upload, refresh: Duration::ZERO };
            display.learn(FrameSize::new(xres, yres).unwrap(), &times);
        }
        display
    }

    fn expected_s(display: &DisplayCost, [xres, yres]: [u32; 2]) -> f64 {
        display.expected_s(FrameSize::new(xres, yres).unwrap())
    }

    #[test]
    fn the_upload_predicts_other_sizes_until_they_are_measured() {
        let of_one_size = display(&[([2048, 1152], 0.1, 0.02); 20]);
        assert!((expected_s(&of_one_size, [2048, 1152]) - 0.1).abs() < 1e-9);
        assert!((expected_s(&of_one_size, [4096, 2304]) - 0.16).abs() < 1e-9, "four times the upload");
        assert!((expected_s(&of_one_size, [8, 8]) - 0.08).abs() < 1e-5);
        let of_two = display(&[[([4096, 2304], 0.2, 0.08); 20], [([2048, 1152], 0.1, 0.02); 20]].concat());
        assert!((expected_s(&of_two, [8, 8]) - 0.2 / 3.0).abs() < 2e-3, "{}", expected_s(&of_two, [8, 8]));
    }

    #[test]
    fn one_time_costs_and_old_frames_do_not_count() {
        let times = [[([1024, 576], 9.0, 0.0); 1].as_slice(), &[([1024, 576], 0.03, 0.0); 3]].concat();
        assert!((expected_s(&display(&times), [1024, 576]) - 0.03).abs() < 1e-9);
        let times = [[([1024, 576], 0.3, 0.0); 100], [([1024, 576], 0.03, 0.0); 100]].concat();
        assert!(expected_s(&display(&[times.as_slice(), &times[100..], &times[100..]].concat()), [8, 8]) < 0.035);
        assert_eq!(expected_s(&display(&[]), [8, 8]), 0.0);
    }
}
