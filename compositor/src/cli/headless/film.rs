//! A camera path as a film: one frame for each picture, none left out however long it takes.

use std::{
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError, mpsc},
    thread,
    time::Instant,
};

use anyhow::{Context, bail};
use renderer::cli::progress::Progress;
use shared::camera::{Camera, CameraPath};

use super::{Headless, Wakeup, Wakeups, milliseconds, wait};
use crate::{
    cli::report::Report,
    farm::{Farm, Frame},
    gpu::{RgbImage, picture::PictureError},
};

/// What to film.
#[derive(Clone, Debug)]
pub struct Film {
    /// Where the camera goes.
    pub path: CameraPath,
    /// Pictures of a second, above zero.
    pub fps: f64,
    /// No more pictures than this.
    pub most: u32,
    /// Where the pictures go, if anywhere.
    pub folder: Option<PathBuf>,
}

/// Threads that compress pictures: a wall's takes about as long to compress as to render.
const N_WRITERS: usize = 2;

impl Film {
    /// How many pictures the film has: the last is where the path ends, or just before.
    pub fn n_pictures(&self) -> u32 {
        // Half a millionth of a picture is a rounding error.
        let n = (self.path.duration_seconds() * self.fps + 5e-7).floor() + 1.0;
        (n as u32).min(self.most)
    }

    fn camera(&self, index: u32) -> Camera {
        self.path.at(f64::from(index) / self.fps)
    }
}

impl Headless {
    /// Shows each picture of a film once, in order, and writes them to files if a folder is given.
    ///
    /// The next is rendered while one is drawn, read back and compressed. A camera that rests is rendered once.
    pub fn show_film(&mut self, farm: &Farm, wakeups: &Wakeups, film: &Film) -> anyhow::Result<Report> {
        if let Some(folder) = &film.folder {
            prepare(folder)?;
        }
        let (n_pictures, mut report) = (film.n_pictures(), Report::default());
        let bar = Progress::new(format!("filming {n_pictures} pictures"));
        thread::scope(|scope| {
            let writers = film.folder.as_deref().map(|folder| Writers::start(scope, folder));
            let mut last: Option<Frame> = None;
            request_frame(farm, film.camera(0));
            for index in 0..n_pictures {
                let started_at = Instant::now();
                let camera = film.camera(index);
                let frame = match last.take().filter(|frame| frame.spec.camera == camera) {
                    Some(frame) => frame,
                    None => match next_frame(farm, wakeups, camera)? {
                        Some(frame) => frame,
                        None => break,
                    },
                };
                if index + 1 < n_pictures {
                    request_frame(farm, film.camera(index + 1));
                }
                let display = self.show(&frame)?;
                if let Some(writers) = &writers
                    && !writers.write(index, self.offscreen.read(&self.gpu)?)
                {
                    break;
                }
                report.add(Some(&frame), display, milliseconds(started_at.elapsed()));
                last = Some(frame);
                bar.set((index + 1) as f32 / n_pictures as f32);
            }
            anyhow::Ok(writers.map_or(Ok(()), Writers::finish)?)
        })?;
        Ok(report)
    }
}

fn request_frame(farm: &Farm, camera: Camera) {
    farm.update_goal(|wanted| {
        wanted.repeat = false;
        wanted.moved_at = Instant::now();
        if let Some(picture) = &mut wanted.spec {
            picture.camera = camera;
        }
    });
}

/// Waits for the frame of a camera; `None` if the operator wants an end.
fn next_frame(farm: &Farm, wakeups: &Wakeups, camera: Camera) -> anyhow::Result<Option<Frame>> {
    loop {
        if wakeups.try_recv() == Ok(Wakeup::Stop) {
            return Ok(None);
        }
        match farm.take_frame() {
            Some(frame) if frame.spec.camera == camera => return Ok(Some(frame)),
            // Of a camera that was wanted before.
            Some(_) => {}
            None if wait(farm, wakeups)? == Wakeup::Stop => return Ok(None),
            None => {}
        }
    }
}

fn picture_file(folder: &Path, index: u32) -> PathBuf {
    folder.join(format!("picture-{:06}.png", index + 1))
}

/// Makes the folder, and refuses one that holds a film: two would be mixed.
fn prepare(folder: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    if picture_file(folder, 0).exists() {
        bail!("{} holds a film already: give --pictures another folder, or remove its pictures", folder.display());
    }
    Ok(())
}

/// Threads that compress and write pictures; who gives them one waits while all are busy.
struct Writers<'scope> {
    pictures: mpsc::SyncSender<(u32, RgbImage)>,
    threads: Vec<thread::ScopedJoinHandle<'scope, Result<(), PictureError>>>,
}

impl<'scope> Writers<'scope> {
    fn start<'env>(scope: &'scope thread::Scope<'scope, 'env>, folder: &'env Path) -> Self {
        let (pictures, inbox) = mpsc::sync_channel::<(u32, RgbImage)>(1);
        let inbox = Arc::new(Mutex::new(inbox));
        let threads = (0..N_WRITERS).map(|_| {
            let inbox = Arc::clone(&inbox);
            scope.spawn(move || {
                loop {
                    // Held only while waiting.
                    let next = inbox.lock().unwrap_or_else(PoisonError::into_inner).recv();
                    let Ok((index, picture)) = next else { return Ok(()) };
                    picture.write_png(&picture_file(folder, index))?;
                }
            })
        });
        Self { pictures, threads: threads.collect() }
    }

    /// Whether the picture was taken; it is not once all threads have failed.
    fn write(&self, index: u32, picture: RgbImage) -> bool {
        !self.threads.iter().any(thread::ScopedJoinHandle::is_finished) && self.pictures.send((index, picture)).is_ok()
    }

    /// Waits until everything is written.
    fn finish(self) -> Result<(), PictureError> {
        drop(self.pictures);
        for thread in self.threads {
            thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use shared::camera::UpAxis;

    use super::*;

    #[test]
    fn a_film_has_a_picture_at_each_end_and_no_more_than_asked_for() {
        let camera = Camera::view_all(DVec3::ZERO, DVec3::ONE, UpAxis::Y, 1.0);
        let film = |seconds: f64, fps: f64, most: u32| {
            let keys = [(0.0, camera), (seconds, camera)].into_iter().take(if seconds > 0.0 { 2 } else { 1 });
            let path = CameraPath::new(keys.collect(), UpAxis::Y).unwrap();
            Film { path, fps, most, folder: None }.n_pictures()
        };
        assert_eq!(film(0.0, 30.0, 9), 1);
        assert_eq!(film(1.0, 30.0, u32::MAX), 31);
        assert_eq!(film(0.1, 30.0, u32::MAX), 4, "0.1 · 30 is a little below 3 or above");
        assert_eq!(film(1.04, 25.0, u32::MAX), 27);
        assert_eq!(film(86_400.0, 1000.0, 12), 12);
    }
}
