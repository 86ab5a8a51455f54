//! Programs that run to their end, and the memory that processes take.

use std::{
    fs,
    io::Read,
    ops::RangeInclusive,
    process::{Command, Stdio},
    thread,
    time::{Duration, Instant},
};

use anyhow::{Context, Result, ensure};

/// A process is looked at each hundredth of the time that it has run, within these bounds. What its memory grows by between
/// the last look and its end is missed.
const INTERVALS: RangeInclusive<Duration> = Duration::from_micros(500)..=Duration::from_millis(50);

/// A program that has run to its end.
#[derive(Clone, Copy, Debug)]
pub(super) struct Watched {
    /// From before exec to after its end.
    pub(super) time: Duration,
    /// The most memory that it had (VmHWM); `None` where the system does not tell.
    pub(super) peak_bytes: Option<u64>,
}

impl Watched {
    /// Runs a command that must succeed, without its output.
    ///
    /// # Errors
    /// It does not start, or fails; the text has its own line.
    pub(super) fn run(command: &mut Command) -> Result<Self> {
        let program = command.get_program().display().to_string();
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
        let started_at = Instant::now();
        let process = command.spawn();
        let mut process =
            process.with_context(|| format!("{program} does not start: build it with cargo build --release"))?;
        let path = format!("/proc/{}/status", process.id());
        let mut peak_bytes = None;
        let status = loop {
            if let Some(status) = process.try_wait()? {
                break status;
            }
            peak_bytes = kilobytes(&path, "VmHWM:").max(peak_bytes);
            thread::sleep((started_at.elapsed() / 100).clamp(*INTERVALS.start(), *INTERVALS.end()));
        };
        let time = started_at.elapsed();
        let mut said = String::new();
        process.stderr.take().map(|mut stream| stream.read_to_string(&mut said)).transpose()?;
        ensure!(status.success(), "{program} failed: {}", said.trim());
        Ok(Self { time, peak_bytes })
    }
}

/// The memory of a process, each page divided among the processes that have it; `None` where the system does not tell.
pub(super) fn pss(process: u32) -> Option<u64> {
    kilobytes(&format!("/proc/{process}/smaps_rollup"), "Pss:")
}

/// Bytes of a line of a file of Linux's that has kilobytes.
fn kilobytes(path: &str, name: &str) -> Option<u64> {
    let text = fs::read_to_string(path).ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix(name))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    #[test]
    fn a_program_is_watched_to_its_end() {
        let shell = |script: &str| Watched::run(Command::new("sh").args(["-c", script]));
        let watched = shell("sleep 0.05").unwrap();
        assert!(watched.time > Duration::from_millis(50) && watched.peak_bytes > Some(100_000), "{watched:?}");
        let error = shell("echo no such size >&2; exit 1").unwrap_err();
        assert_eq!(error.to_string(), "sh failed: no such size");
        let own = pss(std::process::id()).unwrap();
        assert!((100_000..100_000_000_000).contains(&own), "{own}");
    }
}
