//! Progress bars on a terminal, for tasks that a signal cuts off.

use std::{
    sync::{Mutex, PoisonError},
    time::{Duration, Instant},
};

use indicatif::{HumanDuration, ProgressBar, ProgressStyle};
use shared::printable::printable_line;

use crate::{cli::stop::Task, model::scene::SceneSource, scene_file::store::Stage};

/// A progress bar on standard error, erased on drop; invisible if standard error is not a terminal.
pub struct Progress {
    bar: ProgressBar,
    label: Mutex<String>,
    started_at: Instant,
    /// When the log had the label or the fraction last; only if standard error is not a terminal.
    logged_at: Mutex<Option<Instant>>,
    _task: Task,
}

impl Progress {
    /// Starts a bar labelled `task`, for example "reading dragon.ply".
    pub fn new(task: impl Into<String>) -> Self {
        let task = task.into();
        // indicatif draws on standard error, and only on a terminal.
        let bar = ProgressBar::new(STEPS);
        if let Ok(style) = ProgressStyle::with_template("{msg} {wide_bar} {percent:>3} %") {
            bar.set_style(style);
        }
        let label = printable_line(&task);
        bar.set_message(label.clone());
        bar.enable_steady_tick(Duration::from_millis(100));
        let cleared = bar.clone();
        let line = move || {
            cleared.finish_and_clear();
            format!("stopped while {task}")
        };
        let (started_at, logged_at) = (Instant::now(), Mutex::default());
        Self { bar, label: label.into(), started_at, logged_at, _task: Task::with_line(line) }
    }

    /// Changes the label. Where there is no terminal, the log has it, from time to time.
    pub fn tell(&self, label: &str) {
        self.bar.set_message(printable_line(label));
        let mut logged_at = self.logged_at.lock().unwrap_or_else(PoisonError::into_inner);
        if self.bar.is_hidden() && logged_at.is_none_or(|at| at.elapsed() >= LOG_INTERVAL) {
            tracing::info!("{label}");
            *logged_at = Some(Instant::now());
        }
    }

    /// Shows what is done with a model now, and the fraction of the whole task that is done, 0 to 1. May be called from any
    /// thread, at any rate.
    pub fn report(&self, stage: Stage, source: &SceneSource, fraction: f32) {
        self.rename(&format!("{stage} {source}"));
        self.set(fraction);
    }

    fn rename(&self, label: &str) {
        let mut old = self.label.lock().unwrap_or_else(PoisonError::into_inner);
        if *old != label {
            *old = printable_line(label);
            self.bar.set_message(old.clone());
        }
    }

    /// Shows the fraction done, 0 to 1. May be called from any thread, at any rate. Where there is no terminal, the log has
    /// it from time to time, if the task takes long.
    pub fn set(&self, fraction: f32) {
        self.bar.set_position((fraction * STEPS as f32) as u64);
        if let Some(line) = self.due_line(fraction, Instant::now()).filter(|_| self.bar.is_hidden()) {
            tracing::info!("{line}");
        }
    }

    /// The line for the log, if one is due.
    fn due_line(&self, fraction: f32, now: Instant) -> Option<String> {
        // Another thread has the lock to log the same.
        let mut logged_at = self.logged_at.try_lock().ok()?;
        let last = logged_at.unwrap_or(self.started_at);
        let is_due = now.saturating_duration_since(last) >= LOG_INTERVAL;
        is_due.then(|| {
            *logged_at = Some(now);
            let label = self.label.lock().unwrap_or_else(PoisonError::into_inner);
            format!("{label}: {:.0} %", fraction * 100.0)
        })
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}

const STEPS: u64 = 1000;

/// The pause between log lines of one task.
const LOG_INTERVAL: Duration = Duration::from_secs(10);

/// The time that is left after `n_done` items in `elapsed`, in words such as ", 3 minutes left"; empty if unknown.
pub fn time_left(elapsed: Duration, n_done: u32, n_left: u32) -> String {
    match n_done {
        0 => String::new(),
        _ => format!(", {} left", HumanDuration(elapsed / n_done * n_left)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_left_is_told_in_words() {
        assert_eq!(time_left(Duration::from_secs(9), 0, 10), "");
        assert_eq!(time_left(Duration::from_secs(30), 10, 60), ", 3 minutes left");
        assert_eq!(time_left(Duration::from_secs(30), 10, 0), ", 0 seconds left");
    }

    #[test]
    fn a_long_task_is_logged_from_time_to_time() {
        let progress = Progress::new("loading a.ply");
        let line = |fraction, seconds| progress.due_line(fraction, progress.started_at + Duration::from_secs(seconds));
        assert_eq!(line(0.1, 9), None);
        assert_eq!(line(0.256, 10).as_deref(), Some("loading a.ply: 26 %"));
        assert_eq!((line(0.3, 19), line(0.4, 21).is_some()), (None, true));
    }

    #[test]
    fn any_fraction_can_be_shown_from_any_thread() {
        let progress = Progress::new("testing");
        std::thread::scope(|scope| {
            let progress = &progress;
            for fraction in [-1.0, 0.0, 0.5, 1.0, 2.0, f32::NAN] {
                scope.spawn(move || progress.set(fraction));
            }
        });
    }
}
