//! Finds the triangle under the cursor by asking a render server: the wall keeps no triangles.

use std::time::{Duration, Instant};

use shared::{camera::Camera, protocol::ProbeHit};

use crate::{farm::stats::Probed, overlay::Pick};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Purpose {
    /// To read which triangle it is.
    Inspect,
    GoTo,
    /// To annotate it.
    Annotate,
    /// To give it to the ruler.
    Measure,
    /// To move nearer to it with the wheel.
    Approach,
    /// To fly slower before it.
    Ahead,
}

impl Purpose {
    /// Whether its answer does more than to tell something.
    fn acts(self) -> bool {
        matches!(self, Self::GoTo | Self::Annotate | Self::Measure)
    }
}

#[derive(Clone, Copy, Debug)]
struct PendingProbe {
    purpose: Purpose,
    camera: Camera,
    since: Instant,
}

/// The pause between probes ahead.
const AHEAD_INTERVAL: Duration = Duration::from_millis(60);

/// A probe without an answer by then is dropped.
const PROBE_TIMEOUT: Duration = Duration::from_secs(2);

#[derive(Debug, Default)]
pub(super) struct Probing {
    last_number: u32,
    /// When the last probe ahead was started.
    ahead_at: Option<Instant>,
    pending: Option<PendingProbe>,
}

impl Probing {
    /// Starts a probe from a camera, and returns its number.
    ///
    /// `None` while a probe is pending whose answer does something, which another purpose must not replace; a probe ahead replaces none, and
    /// is rare.
    pub(super) fn start(&mut self, purpose: Purpose, camera: Camera, now: Instant) -> Option<u32> {
        let is_awaited =
            |pending: &PendingProbe| pending.purpose.acts() && now.duration_since(pending.since) < PROBE_TIMEOUT;
        if purpose != Purpose::GoTo && self.pending.as_ref().is_some_and(is_awaited) {
            return None;
        }
        if purpose == Purpose::Ahead {
            let is_pending = |pending: &PendingProbe| now.duration_since(pending.since) < PROBE_TIMEOUT;
            let is_recent = self.ahead_at.is_some_and(|at| now.duration_since(at) < AHEAD_INTERVAL);
            if is_recent || self.pending.as_ref().is_some_and(is_pending) {
                return None;
            }
            self.ahead_at = Some(now);
        }
        self.last_number = self.last_number.wrapping_add(1);
        self.pending = Some(PendingProbe { purpose, camera, since: now });
        Some(self.last_number)
    }

    /// Drops the probe that is not answered yet, as when another model opens.
    pub(super) fn forget(&mut self) {
        self.pending = None;
    }

    /// The purpose of the last probe and what it hit, once, if this is its answer.
    pub(super) fn finish(&mut self, probed: Probed) -> Option<(Purpose, Option<Pick>)> {
        let PendingProbe { purpose, camera, .. } = self.pending.take_if(|_| probed.number == self.last_number)?;
        Some((purpose, probed.hit.map(|hit| pick(hit, &camera))))
    }
}

fn pick(ProbeHit { triangle, point, normal, .. }: ProbeHit, camera: &Camera) -> Pick {
    Pick { triangle, point, normal, distance: (point - camera.eye()).length() }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use renderer::{formats::ply, grid::GridOptions, render::scene::Scene};

    use super::*;

    fn camera() -> Camera {
        Camera::look_at(DVec3::new(5.0, -9.0, 4.0), DVec3::ONE, DVec3::Z, 0.7, 2.0).unwrap()
    }

    #[test]
    fn a_point_on_a_map_grid_has_the_digits_of_its_file() {
        let text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty double x\nproperty double y\nproperty double z\n\
            element face 1\nproperty list uchar int vertex_indices\nend_header\n512345.123 5412345.678 71.25\n\
            512355.123 5412345.678 71.25\n512345.123 5412355.678 71.25\n3 0 1 2\n";
        let mesh = ply::read_from(text.as_bytes(), text.len() as u64).unwrap().mesh;
        let scene = Scene::build(mesh, &GridOptions::default(), &|_| ());
        let target = DVec3::new(512_347.501, 5_412_348.252, 71.25);
        let camera = Camera::look_at(target + DVec3::Z * 98.0, target, DVec3::Y, 0.7, 2.0).unwrap();
        let pick = pick(scene.probe(&camera, [0.5; 2], None).unwrap(), &camera);
        assert_eq!(pick.to_string(), "Triangle 0 at (512347.501, 5412348.252, 71.250), 98.000 from the eye");
    }

    #[test]
    fn only_the_last_probe_is_answered_and_going_somewhere_comes_first() {
        let (mut probing, now) = (Probing::default(), Instant::now());
        let first = probing.start(Purpose::Inspect, camera(), now).unwrap();
        let second = probing.start(Purpose::GoTo, camera(), now).unwrap();
        assert_eq!(probing.start(Purpose::Approach, camera(), now), None);
        let miss = |number| Probed { number, hit: None };
        assert!(probing.finish(miss(first)).is_none());
        assert_eq!(probing.finish(miss(second)).unwrap().0, Purpose::GoTo);
        assert!(probing.finish(miss(second)).is_none());
        let last = probing.start(Purpose::Inspect, camera(), now).unwrap();
        assert_eq!(probing.start(Purpose::Ahead, camera(), now), None, "a hand waits for the last");
        probing.forget();
        assert!(probing.finish(miss(last)).is_none(), "another model is on the wall");
        let ahead = probing.start(Purpose::Ahead, camera(), now).unwrap();
        assert!(probing.finish(miss(ahead)).is_some());
        assert_eq!(probing.start(Purpose::Ahead, camera(), now), None, "not so often");
        assert!(probing.start(Purpose::Ahead, camera(), now + AHEAD_INTERVAL).is_some());
        assert!(probing.start(Purpose::Approach, camera(), now).is_some());
    }
}
