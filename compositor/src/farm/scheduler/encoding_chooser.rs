//! Chooses by measurement how one render server's samples travel: raw or encoded.
//!
//! Nothing is assumed about links and machines. Most tasks use the encoding that was best; now and then, a trial of a few
//! tasks uses the other, which becomes the best if it was clearly faster. Rates are placed samples per time since the
//! render server had nothing else to do, so tracing, encoding, the link and the wall all count.

use std::{collections::VecDeque, time::Duration};

use shared::protocol::Encoding;

/// Tasks of a trial, and tasks that it is compared with.
const TASKS_PER_TRIAL: usize = 8;

/// Tasks between two trials; the number doubles after each trial that fails…
const SHORTEST_PAUSE: u32 = 32;

/// …up to this many, of which a trial is less than 1 %.
const LONGEST_PAUSE: u32 = 1024;

/// The other encoding must be this many times as fast to become the best.
const LEAST_SPEEDUP: f64 = 1.05;

/// A trial ends with the first task that is this many times as slow: eight tasks at a tenth of the speed would be visible.
const ABORT_SLOWDOWN: f64 = 2.0;

/// Smaller tasks measure latency rather than rates.
const SMALLEST_TASK_SAMPLES: u32 = 4096;

/// The encodings' rates from one render server, and the choice between them.
#[derive(Clone, Debug)]
pub(super) struct EncodingChooser {
    best: Encoding,
    /// Samples per second of the last tasks, with `best` and with the other encoding.
    rates: [VecDeque<f64>; 2],
    /// Tasks left before the next trial.
    tasks_before_trial: u32,
    tasks_between_trials: u32,
    /// Tasks left in this trial.
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
    /// Chooses the encoding of the next task.
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

    /// Learns from a task's duration.
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

    /// Seconds for a task: encoding keeps a part of the bytes, and a task is encoded while the one before it is sent.
    fn seconds(encoding: Encoding, link_mbit: f64, kept: f64, encoder_mb: f64) -> f64 {
        let n_bytes = f64::from(3 * N_SAMPLES);
        match encoding {
            Encoding::Raw => n_bytes * 8.0 / (link_mbit * 1e6),
            Encoding::Lz4 => f64::max(n_bytes * kept * 8.0 / (link_mbit * 1e6), n_bytes / (encoder_mb * 1e6)),
        }
    }

    /// Plays tasks whose durations vary by a tenth, and returns the sum of their durations.
    fn play(chooser: &mut EncodingChooser, n_tasks: u32, seconds: impl Fn(Encoding) -> f64) -> f64 {
        let mut sum = 0.0;
        for task in 0..n_tasks {
            let encoding = chooser.choose(N_SAMPLES);
            let variation = 0.95 + 0.1 * f64::from(task.wrapping_mul(2_654_435_761) >> 16 & 0xff) / 255.0;
            let took = seconds(encoding) * variation;
            chooser.learn(encoding, N_SAMPLES, Duration::from_secs_f64(took));
            sum += took;
        }
        sum
    }

    #[test]
    fn a_slow_link_gets_encoded_samples_and_a_fast_one_raw_samples() {
        let mut chooser = EncodingChooser::default();
        play(&mut chooser, 50, |encoding| seconds(encoding, 680.0, 0.3, 500.0));
        assert_eq!(chooser.best, Encoding::Lz4);
        // The cable is replaced by a faster one, and back.
        play(&mut chooser, 1200, |encoding| seconds(encoding, 10_000.0, 0.3, 500.0));
        assert_eq!(chooser.best, Encoding::Raw);
        play(&mut chooser, 1200, |encoding| seconds(encoding, 680.0, 0.3, 500.0));
        assert_eq!(chooser.best, Encoding::Lz4);
    }

    #[test]
    fn equal_rates_change_nothing() {
        let mut chooser = EncodingChooser::default();
        play(&mut chooser, 5000, |_| 0.03);
        assert_eq!(chooser.best, Encoding::Raw);
        assert_eq!(chooser.choose(100), Encoding::Raw);
    }

    proptest! {
        #[test]
        fn trials_cost_next_to_nothing(link_mbit in 10.0..20_000.0, kept in 0.1..1.1, encoder_mb in 200.0..2000.0) {
            let mut chooser = EncodingChooser::default();
            let of = |encoding| seconds(encoding, link_mbit, kept, encoder_mb);
            let faster = f64::min(of(Encoding::Raw), of(Encoding::Lz4));
            play(&mut chooser, 4000, of);
            let n_tasks = 10_000;
            let took = play(&mut chooser, n_tasks, of);
            prop_assert!(took < 1.08 * f64::from(n_tasks) * faster, "{took} s in place of {}", f64::from(n_tasks) * faster);
        }
    }
}
