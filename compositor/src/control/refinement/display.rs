//! What the display takes for frames: the time between two refreshes, and the time to upload and draw one, of which a part
//! grows with the frame's samples.

use std::time::Duration;

use shared::division::FrameSize;

/// What showing a frame took.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ShowTimes {
    /// All of it, from when the frame was there until the next can be shown.
    pub took: Duration,
    /// The upload alone.
    pub upload: Duration,
    /// Between two refreshes of the fastest output; zero where it is not known.
    pub refresh: Duration,
}

/// Older frames than about so many are forgotten: two seconds' worth.
const N_REMEMBERED: u32 = 64;
/// A frame that takes longer than so many times the mean counts as one that takes as long.
const LONGEST: f64 = 3.0;
/// How far sizes must differ before what they took says more of the part that grows with samples than the upload does: the
/// variance of their samples, as parts of those of the wall's own resolution.
const LEAST_VARIANCE: f64 = 1e-3;

/// A straight line through what the last frames took over their samples, with the slope of the upload alone as long as
/// these have about the same size: ridge regression, with forgetting.
#[derive(Clone, Debug)]
pub(super) struct DisplayCost {
    native: FrameSize,
    last_size: Option<FrameSize>,
    refresh_s: f64,
    n_frames: u32,
    /// Only the very first frame is known.
    is_guess: bool,
    mean_upload_s: f64,
    /// Samples are parts of those of the wall's own resolution.
    mean_samples: f64,
    mean_s: f64,
    variance: f64,
    covariance_s: f64,
}

impl DisplayCost {
    /// Nothing is known yet.
    pub(super) fn new(native: FrameSize) -> Self {
        Self {
            native,
            last_size: None,
            refresh_s: 0.0,
            n_frames: 0,
            is_guess: false,
            mean_upload_s: 0.0,
            mean_samples: 0.0,
            mean_s: 0.0,
            variance: 0.0,
            covariance_s: 0.0,
        }
    }

    /// A frame of this size was shown.
    pub(super) fn learn(&mut self, size: FrameSize, times: &ShowTimes) {
        self.refresh_s = times.refresh.as_secs_f64();
        // The first frame of a size also takes what is done once: it counts only while there is nothing better.
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

    /// Between two refreshes, in seconds; 0 where it is not known.
    pub(super) fn refresh_s(&self) -> f64 {
        self.refresh_s
    }

    /// What a frame of some size is expected to take, in seconds; 0 as long as nothing is known.
    pub(super) fn expected_s(&self, size: FrameSize) -> f64 {
        if self.n_frames == 0 {
            return 0.0;
        }
        let of_upload_s = self.mean_upload_s / self.mean_samples;
        let slope_s = (self.covariance_s + LEAST_VARIANCE * of_upload_s) / (self.variance + LEAST_VARIANCE);
        // No frame takes less than no time.
        let slope_s = slope_s.clamp(0.0, self.mean_s / self.mean_samples);
        self.mean_s + slope_s * (self.samples(size) - self.mean_samples)
    }

    fn samples(&self, size: FrameSize) -> f64 {
        f64::from(size.n_samples()) / f64::from(self.native.n_samples())
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
    fn the_upload_says_what_other_sizes_take_until_they_say_it_themselves() {
        let of_one_size = display(&[([2048, 1152], 0.1, 0.02); 20]);
        assert!((expected_s(&of_one_size, [2048, 1152]) - 0.1).abs() < 1e-9);
        assert!((expected_s(&of_one_size, [4096, 2304]) - 0.16).abs() < 1e-9, "four times the upload");
        assert!((expected_s(&of_one_size, [8, 8]) - 0.08).abs() < 1e-5);
        let of_two = display(&[[([4096, 2304], 0.2, 0.08); 20], [([2048, 1152], 0.1, 0.02); 20]].concat());
        assert!((expected_s(&of_two, [8, 8]) - 0.2 / 3.0).abs() < 2e-3, "{}", expected_s(&of_two, [8, 8]));
    }

    #[test]
    fn what_is_done_once_for_a_size_and_what_was_long_ago_do_not_count() {
        let times = [[([1024, 576], 9.0, 0.0); 1].as_slice(), &[([1024, 576], 0.03, 0.0); 3]].concat();
        assert!((expected_s(&display(&times), [1024, 576]) - 0.03).abs() < 1e-9);
        let times = [[([1024, 576], 0.3, 0.0); 100], [([1024, 576], 0.03, 0.0); 100]].concat();
        assert!(expected_s(&display(&[times.as_slice(), &times[100..], &times[100..]].concat()), [8, 8]) < 0.035);
        assert_eq!(expected_s(&display(&[]), [8, 8]), 0.0);
    }
}
