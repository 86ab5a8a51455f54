//! A lock on a scene that is being built: one process builds, and others on the machine wait for its file.

use std::{
    fs::File,
    io::{self, Read, Seek, SeekFrom, Write},
    path::Path,
    sync::Mutex,
    thread,
    time::{Duration, Instant},
};

use channel::files;

/// How often a process that waits looks again.
const PAUSE: Duration = Duration::from_millis(30);

/// A builder that says nothing for so long is stopped or stuck; others then build for themselves.
const PATIENCE: Duration = Duration::from_secs(60);

/// The right to build a scene. It ends with its process at the latest.
#[derive(Debug)]
pub(crate) struct Lock {
    /// Holds the progress in percent, for those that wait.
    file: Mutex<(File, u8)>,
}

impl Lock {
    /// Takes the lock of a path, as soon as no other process has it; `progress` receives that process's, 0 to 1. Returns
    /// `None` if it does not go on.
    ///
    /// # Errors
    /// The file cannot be opened, or its file system has no locks.
    pub(crate) fn take(path: &Path, progress: &(dyn Fn(f32) + Sync)) -> io::Result<Option<Self>> {
        Self::take_within(PATIENCE, path, progress)
    }

    fn take_within(patience: Duration, path: &Path, progress: &(dyn Fn(f32) + Sync)) -> io::Result<Option<Self>> {
        let mut file = files::open_shared(path)?;
        // Without an answer yet: whoever waits is told at once.
        let mut last: Option<Option<u8>> = None;
        let mut changed_at = Instant::now();
        loop {
            match file.try_lock() {
                Ok(()) => return Ok(Some(Self { file: Mutex::new((file, u8::MAX)) })),
                Err(std::fs::TryLockError::WouldBlock) => {}
                Err(std::fs::TryLockError::Error(error)) => return Err(error),
            }
            let mut percent = [0];
            file.seek(SeekFrom::Start(0))?;
            let told = file.read_exact(&mut percent).is_ok().then_some(percent[0]);
            if last != Some(told) {
                (last, changed_at) = (Some(told), Instant::now());
                progress(f32::from(percent[0].min(100)) / 100.0);
            }
            if changed_at.elapsed() > patience {
                return Ok(None);
            }
            thread::sleep(PAUSE);
        }
    }

    /// Whether a process has the lock of a path, or may have it: the system does not tell.
    pub(crate) fn is_held(path: &Path) -> bool {
        File::open(path).and_then(|file| Ok(file.try_lock()?)).is_err()
    }

    /// Tells those that wait of the fraction done, 0 to 1. A failure costs them only patience.
    pub(crate) fn tell(&self, done: f32) {
        // Another thread tells about the same.
        let Ok(mut guard) = self.file.try_lock() else { return };
        let (file, last) = &mut *guard;
        let percent = (done.clamp(0.0, 1.0) * 100.0) as u8;
        if percent != *last {
            *last = percent;
            let _ = file.seek(SeekFrom::Start(0)).and_then(|_| file.write_all(&[percent]));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_second_waits_for_the_first_unless_it_is_stuck() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lock");
        let first = Lock::take(&path, &|_| ()).unwrap().expect("free");
        first.tell(0.5);
        assert!(Lock::is_held(&path));
        let told = Mutex::new(Vec::new());
        let tell = |done| told.lock().unwrap().push(done);
        let stuck = Lock::take_within(Duration::from_millis(100), &path, &tell).unwrap();
        assert!(stuck.is_none() && *told.lock().unwrap() == [0.5]);
        thread::scope(|scope| {
            let second = scope.spawn(|| Lock::take(&path, &|_| ()).unwrap());
            thread::sleep(Duration::from_millis(50));
            assert!(!second.is_finished());
            drop(first);
            assert!(second.join().unwrap().is_some());
        });
        assert!(!Lock::is_held(&path));
        assert!(Lock::take(&folder.path().join("no/lock"), &|_| ()).is_err());
    }
}
