//! A camera path as a film: one frame for each picture, without dropped frames.

use std::{
    collections::VecDeque,
    io,
    panic::resume_unwind,
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering::Relaxed},
    },
    thread::{self, ScopedJoinHandle},
    time::Instant,
};

use anyhow::{Context, bail};
use renderer::cli::{progress::Progress, stop::Task};
use shared::camera::{Camera, CameraPath};

use super::{Headless, Wakeups, milliseconds, next_frame};
use crate::{
    cli::report::Report,
    farm::{Farm, Frame},
};

/// A film of a camera path.
#[derive(Clone, Debug)]
pub struct Film {
    /// The camera's path.
    pub path: CameraPath,
    /// Pictures a second, above 0.
    pub fps: f64,
    /// The most pictures.
    pub most: u32,
    /// The folder for the pictures, if they are written.
    pub folder: Option<PathBuf>,
}

/// Pictures that are compressed at once: a wall's picture takes about as long to compress as to render.
const N_WRITERS: usize = 2;

impl Film {
    /// The number of pictures: the last is at the path's end, or just before.
    pub fn n_pictures(&self) -> u32 {
        // Tolerates rounding errors of half a millionth of a picture.
        let n = (self.path.duration_seconds() * self.fps + 5e-7).floor() + 1.0;
        (n as u32).min(self.most)
    }

    fn camera(&self, index: u32) -> Camera {
        self.path.at(f64::from(index) / self.fps)
    }
}

impl Headless {
    /// Shows each picture of a film once, in order, and writes it to the film's folder, if there is one.
    ///
    /// The next picture is rendered while one is drawn, read back and compressed. A camera at rest is rendered once.
    pub fn show_film(&mut self, farm: &Farm, wakeups: &Wakeups, film: &Film) -> anyhow::Result<Report> {
        if let Some(folder) = &film.folder {
            prepare(folder)?;
        }
        let (n_pictures, mut report) = (film.n_pictures(), Report::default());
        let bar = Progress::new(format!("filming {n_pictures} pictures"));
        let n_begun = Arc::new(AtomicU32::new(0));
        let _task = film.folder.clone().map(|folder| {
            let n_begun = Arc::clone(&n_begun);
            Task::with_line(move || written_so_far(&folder, n_begun.load(Relaxed), n_pictures))
        });
        thread::scope(|scope| {
            let mut writers = VecDeque::with_capacity(N_WRITERS);
            let mut last: Option<Frame> = None;
            request_frame(farm, film.camera(0));
            for index in 0..n_pictures {
                let started_at = Instant::now();
                let camera = film.camera(index);
                let frame = match last.take().filter(|frame| frame.spec.camera == camera) {
                    Some(frame) => frame,
                    None => match frame_of(farm, wakeups, camera)? {
                        Some(frame) => frame,
                        None => break,
                    },
                };
                if index + 1 < n_pictures {
                    request_frame(farm, film.camera(index + 1));
                }
                let display = self.show(&frame)?;
                if let Some(folder) = &film.folder {
                    if writers.len() == N_WRITERS {
                        writers.pop_front().map_or(Ok(()), finish)?;
                    }
                    n_begun.store(index + 1, Relaxed);
                    let image = self.offscreen.read(&self.gpu)?;
                    writers.push_back(scope.spawn(move || image.write_png(&picture_file(folder, index))));
                }
                report.add(&frame, display, milliseconds(started_at.elapsed()));
                last = Some(frame);
                bar.set((index + 1) as f32 / n_pictures as f32);
            }
            anyhow::Ok(writers.into_iter().try_for_each(finish)?)
        })?;
        Ok(report)
    }
}

/// Waits until a picture is written.
fn finish(writer: ScopedJoinHandle<'_, io::Result<()>>) -> io::Result<()> {
    writer.join().unwrap_or_else(|panic| resume_unwind(panic))
}

fn request_frame(farm: &Farm, camera: Camera) {
    farm.update_goal(|goal| {
        goal.repeat = false;
        goal.moved_at = Instant::now();
        if let Some(spec) = &mut goal.spec {
            spec.camera = camera;
        }
    });
}

/// The next frame of a camera, without those of earlier cameras; `None` once the operator stops the wall.
fn frame_of(farm: &Farm, wakeups: &Wakeups, camera: Camera) -> anyhow::Result<Option<Frame>> {
    loop {
        match next_frame(farm, wakeups)? {
            Some(frame) if frame.spec.camera != camera => {}
            frame => return Ok(frame),
        }
    }
}

/// The line about a film that is cut off, after `n_begun` of its pictures were handed to writers.
fn written_so_far(folder: &Path, n_begun: u32, n_pictures: u32) -> String {
    // Only the pictures of the writers may be missing.
    let first_open = n_begun.saturating_sub(N_WRITERS as u32);
    let n_open = (first_open..n_begun).filter(|&index| picture_file(folder, index).exists()).count();
    let n_written = first_open as usize + n_open;
    format!("stopped after {n_written} of {n_pictures} pictures; those in {} are complete", folder.display())
}

fn picture_file(folder: &Path, index: u32) -> PathBuf {
    folder.join(format!("picture-{:06}.png", index + 1))
}

/// Creates the folder, and refuses one that holds a film: the two would be mixed.
fn prepare(folder: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    if picture_file(folder, 0).exists() {
        bail!("{} holds a film already: give --pictures another folder, or remove its pictures", folder.display());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use shared::camera::UpAxis;

    use super::*;

    #[test]
    fn a_film_has_a_picture_at_each_end_and_no_more_than_asked_for() {
        let camera = Camera::look_at(DVec3::splat(3.0), DVec3::ZERO, DVec3::Y, 0.7, 1.0).unwrap();
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
