//! A camera path as a film: one frame for each picture, without dropped frames.

mod output;

use std::{
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering::Relaxed},
    },
    time::Instant,
};

use renderer::cli::{
    progress::{Progress, time_left},
    say,
    stop::Task,
};
use shared::camera::{Camera, CameraPath};

pub use self::output::{Output, Pictures, Video};
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
}

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
    /// Shows each picture of a film once, in order, and hands it on. A film that resumes goes on after its last picture.
    ///
    /// The next picture is rendered while one is drawn, read back and compressed. A camera at rest is rendered once.
    pub fn show_film(
        &mut self,
        farm: &Farm,
        wakeups: &Wakeups,
        film: &Film,
        mut output: Output,
    ) -> anyhow::Result<Report> {
        let (n_pictures, mut report) = (film.n_pictures(), Report::default());
        let first = output.first(n_pictures);
        let bar = Progress::new(format!("filming {n_pictures} pictures"));
        let n_begun = Arc::new(AtomicU32::new(first));
        let line = output.line_if_cut_off(n_pictures);
        let _task = Task::with_line({
            let n_begun = Arc::clone(&n_begun);
            move || line(n_begun.load(Relaxed))
        });
        let mut last: Option<Frame> = None;
        let mut begun_at = None;
        request_frame(farm, film.camera(first));
        for index in first..n_pictures {
            let started_at = Instant::now();
            let camera = film.camera(index);
            let frame = match last.take().filter(|frame| frame.spec.camera == camera) {
                Some(frame) => frame,
                None => match frame_of(farm, wakeups, camera)? {
                    Some(frame) => frame,
                    None => return Ok(report),
                },
            };
            if index + 1 < n_pictures {
                request_frame(farm, film.camera(index + 1));
            }
            let display = self.show(&frame)?;
            n_begun.store(index + 1, Relaxed);
            output.put(index, || Ok(self.offscreen.read(&self.gpu)?))?;
            report.add(&frame, display, milliseconds(started_at.elapsed()));
            last = Some(frame);
            bar.set((index + 1) as f32 / n_pictures as f32);
            // Time counts from the first picture, which waits for render servers.
            let elapsed = begun_at.get_or_insert_with(Instant::now).elapsed();
            let left = time_left(elapsed, index - first, n_pictures - index - 1);
            bar.tell(&format!("picture {} of {n_pictures}{left}", index + 1));
        }
        if let Some(line) = output.finish()? {
            say(line)?;
        }
        Ok(report)
    }
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
            Film { path, fps, most }.n_pictures()
        };
        assert_eq!(film(0.0, 30.0, 9), 1);
        assert_eq!(film(1.0, 30.0, u32::MAX), 31);
        assert_eq!(film(0.1, 30.0, u32::MAX), 4, "0.1 · 30 is a little below 3 or above");
        assert_eq!(film(1.04, 25.0, u32::MAX), 27);
        assert_eq!(film(86_400.0, 1000.0, 12), 12);
    }
}
