//! Progress bars on a terminal, for tasks that a signal cuts off.

use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};
use shared::printable::printable_line;

use crate::cli::stop::Task;

/// A progress bar on standard error, erased on drop; invisible if standard error is not a terminal.
pub struct Progress {
    bar: ProgressBar,
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
        bar.set_message(printable_line(&task));
        bar.enable_steady_tick(Duration::from_millis(100));
        let cleared = bar.clone();
        let line = move || {
            cleared.finish_and_clear();
            format!("stopped while {task}")
        };
        Self { bar, _task: Task::with_line(line) }
    }

    /// Shows the fraction done, 0 to 1. May be called from any thread, at any rate.
    pub fn set(&self, fraction: f32) {
        self.bar.set_position((fraction * STEPS as f32) as u64);
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}

const STEPS: u64 = 1000;

#[cfg(test)]
mod tests {
    use super::*;

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
