//! A camera path as a film: one frame for each picture, without dropped frames.

mod output;
mod picture_file;

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
use shared::{
    camera::{Camera, CameraPath},
    printable::counted,
};

pub(crate) use self::output::holds_pictures;
pub use self::output::{Output, Pictures, Video};
use super::{Headless, Wakeups, milliseconds};
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
    /// The number of pictures that are made.
    pub fn n_pictures(&self) -> u32 {
        self.n_on_path().min(self.most)
    }

    /// The number of pictures of the whole path: the last is at its end, or just before.
    fn n_on_path(&self) -> u32 {
        // Tolerates rounding errors of half a millionth of a picture.
        let n = (self.path.duration_seconds() * self.fps + 5e-7).floor() + 1.0;
        n as u32
    }

    fn camera(&self, index: u32) -> Camera {
        self.path.at(f64::from(index) / self.fps)
    }

    /// Whether the camera comes to a picture from elsewhere and leaves it again. Films of other rates, or of other paths with
    /// the same rests, have another picture there.
    fn is_moving(&self, index: u32) -> bool {
        let differs = |other: u32| self.camera(other) != self.camera(index);
        index.checked_sub(1).is_some_and(differs) && differs(index + 1)
    }
}

impl Headless {
    /// Shows each picture of a film once, in order, and hands it on. A film that resumes has the pictures made that are
    /// missing or damaged.
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
        let pictures = output.pictures_to_render(n_pictures, |index| film.is_moving(index))?;
        let bar = Progress::new(format!("filming {}", counted(pictures.len(), "picture")));
        let n_begun = Arc::new(AtomicU32::new(0));
        let line = output.line_if_cut_off(n_pictures);
        let _task = Task::with_line({
            let n_begun = Arc::clone(&n_begun);
            move || line(n_begun.load(Relaxed))
        });
        let mut last: Option<Frame> = None;
        let mut begun_at = None;
        pictures.first().into_iter().for_each(|&index| request_frame(farm, film.camera(index)));
        for (n_done, &index) in pictures.iter().enumerate() {
            let started_at = Instant::now();
            let camera = film.camera(index);
            let frame = match last.take().filter(|frame| frame.spec.camera == camera) {
                Some(frame) => frame,
                None => match self.frame_of(farm, wakeups, camera)? {
                    Some(frame) => frame,
                    None => return Ok(report),
                },
            };
            if let Some(&next) = pictures.get(n_done + 1) {
                request_frame(farm, film.camera(next));
            }
            let display = self.show(&frame)?;
            n_begun.store(n_done as u32 + 1, Relaxed);
            output.put(index, || Ok(self.offscreen.read(&self.gpu)?))?;
            report.add(&frame, display, milliseconds(started_at.elapsed()));
            last = Some(frame);
            bar.set((n_done + 1) as f32 / pictures.len() as f32);
            // Time counts from the first picture, which waits for render servers.
            let elapsed = begun_at.get_or_insert_with(Instant::now).elapsed();
            let left = time_left(elapsed, n_done as u32, (pictures.len() - n_done - 1) as u32);
            bar.tell(&format!("picture {} of {n_pictures}{left}", index + 1));
        }
        if let Some(line) = output.finish(n_pictures, film.n_on_path())? {
            say(line)?;
        }
        Ok(report)
    }

    /// The next frame of a camera, without those of earlier cameras; `None` once the operator stops the wall.
    fn frame_of(&self, farm: &Farm, wakeups: &Wakeups, camera: Camera) -> anyhow::Result<Option<Frame>> {
        loop {
            match self.next_frame(farm, wakeups)? {
                Some(frame) if frame.spec.camera != camera => {}
                frame => return Ok(frame),
            }
        }
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

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use shared::camera::UpAxis;

    use super::*;

    #[test]
    fn a_camera_moves_between_its_rests() {
        let camera = Camera::look_at(DVec3::splat(3.0), DVec3::ZERO, DVec3::Y, 0.7, 1.0).unwrap();
        let turned = camera.orbit(DVec3::ZERO, UpAxis::Y, 1.0, 0.0);
        let keys = [(0.0, camera), (0.2, camera), (0.6, turned), (1.0, turned)];
        let film = Film { path: CameraPath::new(keys.into(), UpAxis::Y).unwrap(), fps: 10.0, most: u32::MAX };
        let moving: Vec<u32> = (0..film.n_pictures()).filter(|&index| film.is_moving(index)).collect();
        assert_eq!(moving, [3, 4, 5]);
    }

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
