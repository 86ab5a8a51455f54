//! How samples travel from one render server: as they are, or encoded, whichever was measured to bring more of them.
//!
//! Nothing is assumed about links and machines. Most works travel as what was best; now and then a few travel the other
//! way, and if these were clearly faster, that is best from then on. What is compared is samples in their places per time
//! since the render server had nothing else to do, so tracing, encoding, the link and the wall all count as much as they
//! hold up.

use std::{collections::VecDeque, time::Duration};

use shared::protocol::Encoding;

/// Works of a trial, and of what it is compared with.
const TASKS_PER_TRIAL: usize = 8;

/// Works between two trials; twice as many after each that failed…
const SHORTEST_PAUSE: u32 = 32;

/// …up to so many, of which a trial is less than a hundredth.
const LONGEST_PAUSE: u32 = 1024;

/// How many times as fast the other encoding must be.
const LEAST_SPEEDUP: f64 = 1.05;

/// A trial whose work is so many times as slow ends there: eight works that each take ten times as long would be felt.
const ABORT_SLOWDOWN: f64 = 2.0;

/// Smaller works tell more about latency than about rates.
const SMALLEST_TASK_SAMPLES: u32 = 4096;

/// One render server's link.
#[derive(Clone, Debug)]
pub(super) struct EncodingChooser {
    best: Encoding,
    /// Samples per second of the last works, of `best` and of the other.
    rates: [VecDeque<f64>; 2],
    /// Works to be given before the next trial begins, and how long such a pause is.
    tasks_before_trial: u32,
    tasks_between_trials: u32,
    /// Works of the trial still to be given.
    tasks_of_trial: usize,
}

impl Default for EncodingChooser {
    fn default() -> Self {
        let (best, rates) = (Encoding::Raw, Default::default());
        Self {
            best,
            rates,
            tasks_before_trial: TASKS_PER_TRIAL as u32,
            tasks_between_trials: SHORTEST_PAUSE,
            tasks_of_trial: 0,
        }
    }
}

impl EncodingChooser {
    /// How the next work is to travel.
    pub(super) fn choose(&mut self, n_samples: u32) -> Encoding {
        if n_samples < SMALLEST_TASK_SAMPLES {
            return self.best;
        }
        if self.tasks_of_trial > 0 {
            self.tasks_of_trial -= 1;
            return self.best.other();
        }
        self.tasks_before_trial = self.tasks_before_trial.saturating_sub(1);
        if self.tasks_before_trial == 0 {
            self.tasks_of_trial = TASKS_PER_TRIAL;
            self.tasks_before_trial = self.tasks_between_trials;
        }
        self.best
    }

    /// A work of so many samples took so long.
    pub(super) fn learn(&mut self, encoding: Encoding, n_samples: u32, took: Duration) {
        if n_samples < SMALLEST_TASK_SAMPLES {
            return;
        }
        let rates = &mut self.rates[usize::from(encoding != self.best)];
        rates.push_back(f64::from(n_samples) / took.as_secs_f64().max(1e-9));
        if rates.len() > TASKS_PER_TRIAL {
            rates.pop_front();
        }
        let [best, other] = &self.rates;
        let (Some(newest), false) = (other.back(), best.is_empty()) else {
            return;
        };
        let is_hopeless = newest * ABORT_SLOWDOWN < median(best);
        if other.len() < TASKS_PER_TRIAL && !is_hopeless {
            return;
        }
        let is_better = !is_hopeless && median(other) > LEAST_SPEEDUP * median(best);
        self.rates[1].clear();
        self.tasks_of_trial = 0;
        if is_better {
            self.best = self.best.other();
            self.rates[0].clear();
            self.tasks_between_trials = SHORTEST_PAUSE;
        } else {
            self.tasks_between_trials = (self.tasks_between_trials * 2).min(LONGEST_PAUSE);
        }
        self.tasks_before_trial = self.tasks_between_trials;
    }
}

fn median(rates: &VecDeque<f64>) -> f64 {
    let mut sorted = Vec::from_iter(rates.iter().copied());
    sorted.sort_by(f64::total_cmp);
    sorted[sorted.len() / 2]
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const N_SAMPLES: u32 = 40_000;

    /// Seconds for a work: encoding keeps part of the bytes, at so many of them per second, and while one work is sent the
    /// next is encoded.
    fn seconds(encoding: Encoding, link_mbit: f64, kept: f64, encoder_mb: f64) -> f64 {
        let n_bytes = f64::from(3 * N_SAMPLES);
        match encoding {
            Encoding::Raw => n_bytes * 8.0 / (link_mbit * 1e6),
            Encoding::Lz4 => f64::max(n_bytes * kept * 8.0 / (link_mbit * 1e6), n_bytes / (encoder_mb * 1e6)),
        }
    }

    /// Plays so many works that waver by a tenth, and gives what the link came to, and how long they took altogether.
    fn play(link: &mut EncodingChooser, n_works: u32, seconds: impl Fn(Encoding) -> f64) -> f64 {
        let mut sum = 0.0;
        for task in 0..n_works {
            let encoding = link.choose(N_SAMPLES);
            let waver = 0.95 + 0.1 * f64::from(task.wrapping_mul(2_654_435_761) >> 16 & 0xff) / 255.0;
            let took = seconds(encoding) * waver;
            link.learn(encoding, N_SAMPLES, Duration::from_secs_f64(took));
            sum += took;
        }
        sum
    }

    #[test]
    fn a_slow_link_gets_encoded_samples_and_a_fast_one_raw_samples() {
        let mut link = EncodingChooser::default();
        play(&mut link, 50, |encoding| seconds(encoding, 680.0, 0.3, 500.0));
        assert_eq!(link.best, Encoding::Lz4);
        // The cable is changed, and back.
        play(&mut link, 1200, |encoding| seconds(encoding, 10_000.0, 0.3, 500.0));
        assert_eq!(link.best, Encoding::Raw);
        play(&mut link, 1200, |encoding| seconds(encoding, 680.0, 0.3, 500.0));
        assert_eq!(link.best, Encoding::Lz4);
    }

    #[test]
    fn what_makes_no_difference_changes_nothing() {
        let mut link = EncodingChooser::default();
        play(&mut link, 5000, |_| 0.03);
        assert_eq!(link.best, Encoding::Raw);
        assert_eq!(link.choose(100), Encoding::Raw);
    }

    proptest! {
        #[test]
        fn trials_cost_next_to_nothing(link_mbit in 10.0..20_000.0, kept in 0.1..1.1, encoder_mb in 200.0..2000.0) {
            let mut link = EncodingChooser::default();
            let of = |encoding| seconds(encoding, link_mbit, kept, encoder_mb);
            let faster = f64::min(of(Encoding::Raw), of(Encoding::Lz4));
            play(&mut link, 4000, of);
            let n_works = 10_000;
            let took = play(&mut link, n_works, of);
            prop_assert!(took < 1.08 * f64::from(n_works) * faster, "{took} s in place of {}", f64::from(n_works) * faster);
        }
    }
}
