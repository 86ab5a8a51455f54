//! Asking a render server what lies under the cursor: the wall itself keeps no triangle.

use std::time::{Duration, Instant};

use glam::{DVec2, DVec3};
use shared::{camera::Camera, division::FrameSize, protocol::ProbeHit};

use super::App;
use crate::{farm::Probe, overlay::Pick};

/// What somebody wants with what lies under the cursor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Purpose {
    /// To read which triangle it is.
    Inspect,
    /// To go there.
    GoTo,
    /// To move nearer to it with the wheel.
    Approach,
}

/// A question that is not yet answered.
#[derive(Clone, Copy, Debug)]
struct PendingProbe {
    purpose: Purpose,
    camera: Camera,
    at: [f32; 2],
    since: Instant,
}

/// A question that is not answered by then is forgotten.
const PROBE_TIMEOUT: Duration = Duration::from_secs(2);

/// The questions of one wall.
#[derive(Debug, Default)]
pub(super) struct Probing {
    last_number: u32,
    pending: Option<PendingProbe>,
    /// When and where the last click was.
    clicked: Option<(Instant, DVec2)>,
}

/// A second click within this time and this near, in parts of the canvas, makes a double click.
const DOUBLE_CLICK: (Duration, f64) = (Duration::from_millis(400), 0.01);

impl App<'_> {
    /// Asks what lies under the cursor; what is done with the answer is done when it comes.
    pub(super) fn probe(&mut self, purpose: Purpose) {
        let (Some(model), Some(navigator)) = (&self.model, &self.navigator) else { return };
        // Where somebody wants to go is not forgotten for what the next click would show.
        let is_going =
            |pending: &PendingProbe| pending.purpose == Purpose::GoTo && pending.since.elapsed() < PROBE_TIMEOUT;
        if purpose != Purpose::GoTo && self.probing.pending.as_ref().is_some_and(is_going) {
            return;
        }
        let point = self.point_on_canvas();
        let (camera, at) = (navigator.camera(), [point.x as f32, point.y as f32]);
        self.probing.last_number = self.probing.last_number.wrapping_add(1);
        self.probing.pending = Some(PendingProbe { purpose, camera, at, since: Instant::now() });
        let (number, clip) = (self.probing.last_number, self.appearance.clip);
        self.farm.probe(Probe { number, view: Some((model.scene, camera)), at, clip });
    }

    /// A mouse button went down and up again without a drag between.
    pub(super) fn click(&mut self) {
        let (now, at) = (Instant::now(), self.point_on_canvas());
        let is_second = self.probing.clicked.is_some_and(|(then, clicked_at)| {
            now.duration_since(then) <= DOUBLE_CLICK.0 && (at - clicked_at).length() <= DOUBLE_CLICK.1
        });
        self.probing.clicked = (!is_second).then_some((now, at));
        self.probe(if is_second { Purpose::GoTo } else { Purpose::Inspect });
    }

    /// Does what was asked for, if the answer has come.
    pub(super) fn take_probed(&mut self) {
        let Some(probed) = self.farm.status().probed.filter(|probed| probed.number == self.probing.last_number) else {
            return;
        };
        let Some(PendingProbe { purpose, camera, at, .. }) = self.probing.pending.take() else { return };
        let pick = probed.hit.map(|hit| selection(hit, &camera, at));
        match (purpose, pick) {
            (Purpose::Inspect, None) => self.overlay.pick = None,
            (Purpose::Inspect, Some(pick)) => {
                self.show_note(pick.to_string());
                self.overlay.pick = Some(pick);
            }
            (Purpose::GoTo, None) => self.show_note("There is nothing of the model under the cursor"),
            (Purpose::GoTo, Some(pick)) => {
                self.overlay.pick = Some(pick);
                self.steer(|navigator| navigator.go_to_point(pick.point));
            }
            (Purpose::Approach, pick) => {
                if let Some(navigator) = &mut self.navigator {
                    navigator.set_under_cursor(pick.map(|pick| pick.point));
                }
            }
        }
        self.redraw();
    }
}

/// Where a triangle was hit, by the arithmetic of the ray that hit it.
fn selection(ProbeHit { triangle, t }: ProbeHit, camera: &Camera, at: [f32; 2]) -> Pick {
    let direction: DVec3 = camera.rays(FrameSize::ONE).direction_through(at[0], at[1]).as_dvec3();
    let way = direction * f64::from(t);
    Pick { triangle, point: camera.eye() + way, distance: way.length() }
}

#[cfg(test)]
mod tests {
    use shared::camera::UpAxis;

    use super::*;

    #[test]
    fn a_hit_on_the_view_plane_is_the_point_of_the_view_plane() {
        let camera = Camera::view_all(DVec3::ZERO, DVec3::new(3.0, 1.0, 2.0), UpAxis::Z, 2.0);
        let pick = selection(ProbeHit { triangle: 7, t: 1.0 }, &camera, [0.25, 0.5]);
        let expected = camera.ll() + camera.u() * 0.25 + camera.v() * 0.5;
        assert!((pick.point - expected).length() < 1e-5, "{pick:?}");
        assert!((pick.distance - (expected - camera.eye()).length()).abs() < 1e-5);
    }
}
