//! Camera paths: cameras at given times with smooth motion between them; recorded, kept in files, and played.

use std::fmt::Write;

use glam::DVec3;
use serde::Deserialize;
use toml::Spanned;

use super::{
    Camera, CameraFileError, UpAxis,
    pose::{POSE_LEN, Pose},
};

/// A camera that moves: keys, each a time and a camera, with smooth motion between them.
///
/// Between keys, each number of the [`Pose`] follows the monotone cubic of Fritsch and Butland, "A Method for Constructing
/// Local Monotone Piecewise Cubic Interpolants" (1984). It stays within the range of its two keys, so a camera that rests
/// does not move, and no camera on the way is degenerate.
///
/// Invariant: from 1 to [`CameraPath::MOST_KEYS`] keys; the first is at 0 s, each later than the one before, the last
/// at [`CameraPath::LONGEST_SECONDS`] at most.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraPath {
    up: UpAxis,
    keys: Vec<(f64, Camera)>,
    poses: Vec<Pose>,
    /// Change of each number per second at each key.
    tangents: Vec<[f64; POSE_LEN]>,
}

/// The keys are not a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum CameraPathError {
    #[error("a path has at least one key")]
    NoKeys,
    #[error("a path has at most {} keys", CameraPath::MOST_KEYS)]
    TooManyKeys,
    #[error("key {0}: seconds must begin at 0 and grow from key to key, to {longest} at most",
        longest = CameraPath::LONGEST_SECONDS)]
    OutOfOrder(usize),
}

impl CameraPath {
    /// The most keys: an hour of recording at [`CameraRecorder::KEYS_PER_SECOND`].
    pub const MOST_KEYS: usize = 72_000;

    /// The longest path: a day.
    pub const LONGEST_SECONDS: f64 = 86_400.0;

    /// A path through cameras at times in seconds; `up` defines a level horizon.
    pub fn new(keys: Vec<(f64, Camera)>, up: UpAxis) -> Result<Self, CameraPathError> {
        if keys.is_empty() {
            return Err(CameraPathError::NoKeys);
        }
        if keys.len() > Self::MOST_KEYS {
            return Err(CameraPathError::TooManyKeys);
        }
        for (index, &(seconds, _)) in keys.iter().enumerate() {
            let is_next = if index == 0 { seconds == 0.0 } else { seconds > keys[index - 1].0 };
            if !is_next || seconds > Self::LONGEST_SECONDS {
                return Err(CameraPathError::OutOfOrder(index + 1));
            }
        }
        let mut poses: Vec<Pose> = Vec::with_capacity(keys.len());
        for (_, camera) in &keys {
            let pose = Pose::new(camera, camera.plane_distance(), up);
            poses.push(poses.last().map_or(pose, |before| pose.unwrapped_after(before)));
        }
        let tangents = tangents(&keys, &poses);
        Ok(Self { up, keys, poses, tangents })
    }

    /// Time of the last key, in seconds.
    pub fn duration_seconds(&self) -> f64 {
        self.keys.last().map_or(0.0, |&(seconds, _)| seconds)
    }

    /// The keys: times in seconds and cameras.
    pub fn keys(&self) -> &[(f64, Camera)] {
        &self.keys
    }

    /// The axis that points up.
    pub fn up(&self) -> UpAxis {
        self.up
    }

    /// The camera at a time: the first before the path, the last after it, and exactly the key's at a key.
    pub fn at(&self, seconds: f64) -> Camera {
        let n_keys_passed = self.keys.partition_point(|&(at, _)| at <= seconds);
        let Some(index) = n_keys_passed.checked_sub(1) else { return self.keys[0].1 };
        let (start, camera) = self.keys[index];
        let Some(&(end, next)) = self.keys.get(index + 1) else { return camera };
        let (from, to) = (&self.poses[index], &self.poses[index + 1]);
        // A resting camera stays the same to the last bit, so that its frame is not rendered again.
        if seconds == start || camera == next || !from.can_interpolate_to(to) {
            return camera;
        }
        let step = end - start;
        let t = (seconds - start) / step;
        let interpolated = std::array::from_fn(|number| {
            // Cubic Hermite; the clamp undoes rounding beyond either key.
            let (a, b) = (from.0[number], to.0[number]);
            let (da, db) = (self.tangents[index][number] * step, self.tangents[index + 1][number] * step);
            let value = a + t * (da + t * (3.0 * (b - a) - 2.0 * da - db + t * (da + db - 2.0 * (b - a))));
            value.clamp(a.min(b), a.max(b))
        });
        Pose(interpolated).camera(self.up).unwrap_or(camera)
    }

    /// Reads the text of a path file; see [`CameraPath::to_toml`].
    ///
    /// Each table is parsed alone, because a parsed text takes about 75 times its own memory. So a table has at most
    /// 256 KB, a thousand times a key.
    pub fn from_toml(text: &str) -> Result<Self, CameraFileError> {
        let at = |offset, problem: &str| {
            let format = "a path file has up = \"y\", \"z\", \"x\", \"-y\", \"-z\" or \"-x\", and for each camera a [[key]] \
                          with seconds, eye, ll, u and v";
            CameraFileError::at(text, offset, problem, format)
        };
        let (mut up, mut keys, mut starts) = (UpAxis::default(), Vec::new(), Vec::new());
        let mut table_start = 0;
        for table in tables(text) {
            if table.len() > LONGEST_TABLE {
                return Err(at(table_start, &format!("a part of the file has more than {LONGEST_TABLE} bytes")));
            }
            let file: PathFile = toml::from_str(table)
                .map_err(|error| at(table_start + error.span().map_or(0, |span| span.start), error.message()))?;
            if table_start == 0 {
                up = file.up;
            }
            for key in file.key {
                let start = table_start + key.span().start;
                let PathKey { seconds, eye, ll, u, v } = key.into_inner();
                keys.push((seconds, Camera::new(eye, ll, u, v).map_err(|error| at(start, &error.to_string()))?));
                starts.push(start);
            }
            if keys.len() > Self::MOST_KEYS {
                break;
            }
            table_start += table.len();
        }
        Self::new(keys, up).map_err(|error| {
            let start = match error {
                CameraPathError::OutOfOrder(number) => starts[number - 1],
                CameraPathError::NoKeys | CameraPathError::TooManyKeys => 0,
            };
            at(start, &error.to_string())
        })
    }

    /// Writes a path file: `up`, and for each key `seconds` and the camera's `eye`, `ll`, `u` and `v`, exact to the last
    /// bit.
    pub fn to_toml(&self) -> String {
        let mut text = format!("up = \"{}\"\n", self.up);
        for (seconds, camera) in &self.keys {
            // Writing to a string cannot fail.
            let _ = write!(text, "\n[[key]]\nseconds = {seconds:?}\n{}", camera.to_toml());
        }
        text
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PathFile {
    #[serde(default)]
    up: UpAxis,
    #[serde(default)]
    key: Vec<Spanned<PathKey>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PathKey {
    seconds: f64,
    eye: DVec3,
    ll: DVec3,
    u: DVec3,
    v: DVec3,
}

/// The longest table of a path file; bytes.
const LONGEST_TABLE: usize = 1 << 18;

/// The text before the first line that begins a table of an array (`[[key]]`), and the text from each to the next.
fn tables(text: &str) -> impl Iterator<Item = &str> {
    let mut rest = Some(text);
    std::iter::from_fn(move || {
        let text = rest?;
        let mut end = 0;
        for line in text.split_inclusive('\n') {
            if end > 0 && line.trim_start().starts_with("[[") {
                rest = Some(&text[end..]);
                return Some(&text[..end]);
            }
            end += line.len();
        }
        rest = None;
        Some(text)
    })
}

/// Change of each number per second at each key, after Fritsch and Butland.
fn tangents(keys: &[(f64, Camera)], poses: &[Pose]) -> Vec<[f64; POSE_LEN]> {
    let slope = |index: usize, number: usize| {
        (poses[index + 1].0[number] - poses[index].0[number]) / (keys[index + 1].0 - keys[index].0)
    };
    let last = keys.len() - 1;
    let tangent = |index: usize, number: usize| {
        if last == 0 {
            return 0.0;
        }
        if index == 0 || index == last {
            return slope(index.min(last - 1), number);
        }
        let (slope_before, slope_after) = (slope(index - 1, number), slope(index, number));
        if slope_before * slope_after <= 0.0 {
            return 0.0;
        }
        let (h_before, h_after) = (keys[index].0 - keys[index - 1].0, keys[index + 1].0 - keys[index].0);
        let (w_before, w_after) = (2.0 * h_after + h_before, h_after + 2.0 * h_before);
        (w_before + w_after) / (w_before / slope_before + w_after / slope_after)
    };
    (0..keys.len()).map(|index| std::array::from_fn(|number| tangent(index, number))).collect()
}

/// Records a camera's path. The caller keeps the time.
#[derive(Clone, Debug)]
pub struct CameraRecorder {
    keys: Vec<(f64, Camera)>,
    /// The latest camera, and the time of its arrival.
    latest: (f64, Camera),
}

impl CameraRecorder {
    /// The most keys a second; motion between them is interpolated.
    pub const KEYS_PER_SECOND: f64 = 20.0;

    /// Begins at a camera.
    pub fn new(camera: Camera) -> Self {
        Self { keys: vec![(0.0, camera)], latest: (0.0, camera) }
    }

    /// Records the camera if it has moved, `seconds` after the beginning. False when the recording is full.
    pub fn record(&mut self, seconds: f64, camera: Camera) -> bool {
        let interval = 1.0 / Self::KEYS_PER_SECOND;
        let (arrived_seconds, latest) = self.latest;
        if camera != latest && seconds > arrived_seconds && seconds <= CameraPath::LONGEST_SECONDS {
            if seconds - arrived_seconds >= 2.0 * interval {
                // The camera rested until a moment ago: a key at either end of the rest.
                self.push_latest();
                self.keys.push((seconds - interval, latest));
            }
            if seconds - self.last_key_at() >= interval {
                self.keys.push((seconds, camera));
            }
            self.latest = (seconds, camera);
        }
        seconds <= CameraPath::LONGEST_SECONDS && self.keys.len() + 4 <= CameraPath::MOST_KEYS
    }

    /// The path, up to the last movement; `None` if the camera never moved.
    pub fn finish(mut self, up: UpAxis) -> Option<CameraPath> {
        self.push_latest();
        if self.keys.len() < 2 { None } else { CameraPath::new(self.keys, up).ok() }
    }

    fn push_latest(&mut self) {
        if self.latest.0 > self.last_key_at() {
            self.keys.push(self.latest);
        }
    }

    fn last_key_at(&self) -> f64 {
        self.keys.last().map_or(0.0, |&(seconds, _)| seconds)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use strum::VariantArray;

    use super::{super::pose::tests::any_camera, *};

    fn front() -> Camera {
        Camera::look_at(DVec3::new(1.5, 1.0, 4.0), DVec3::ZERO, DVec3::Y, 0.7, 16.0 / 9.0).unwrap()
    }

    fn turned(yaw: f64) -> Camera {
        front().orbit(DVec3::ZERO, UpAxis::Y, yaw, 0.0)
    }

    #[test]
    fn a_circle_of_few_keys_is_followed_all_around() {
        let keys = (0..=8).map(|key| (f64::from(key), turned(f64::from(key) * 1.0))).collect();
        let path = CameraPath::new(keys, UpAxis::Y).unwrap();
        for step in 0..=800 {
            let seconds = f64::from(step) / 100.0;
            let expected = turned(seconds);
            assert!((path.at(seconds).eye() - expected.eye()).length() < 1e-9, "at {seconds}");
        }
        assert_eq!((path.at(-1.0), path.at(9.0)), (turned(0.0), turned(8.0)));
        assert_eq!(path.duration_seconds(), 8.0);
    }

    #[test]
    fn a_camera_that_rests_between_two_motions_rests() {
        let keys = vec![(0.0, turned(0.0)), (1.0, turned(1.0)), (5.0, turned(1.0)), (6.0, turned(3.0))];
        let path = CameraPath::new(keys, UpAxis::Y).unwrap();
        for seconds in [1.5, 3.0, 4.99] {
            assert!((path.at(seconds).eye() - turned(1.0).eye()).length() < 1e-9, "it swings");
        }
    }

    #[test]
    fn a_recording_is_played_as_it_was() {
        let camera_at = |seconds: f64| if seconds < 4.0 { turned(seconds.min(1.0)) } else { turned(seconds - 3.0) };
        let mut recorder = CameraRecorder::new(camera_at(0.0));
        for step in 1..=300 {
            let seconds = f64::from(step) / 50.0;
            assert!(recorder.record(seconds, camera_at(seconds)));
        }
        let path = recorder.finish(UpAxis::Y).unwrap();
        assert!(path.keys().len() < 80, "{} keys", path.keys().len());
        assert_eq!((path.at(6.0), path.at(2.5)), (camera_at(6.0), camera_at(2.5)));
        for step in 0..=600 {
            let seconds = f64::from(step) / 100.0;
            // Each start and stop has a key within a twentieth of a second and one recording step.
            assert!((path.at(seconds).eye() - camera_at(seconds).eye()).length() < 0.12 * front().eye().length());
        }
        let still = CameraRecorder::new(front());
        assert_eq!(still.finish(UpAxis::Y), None);
    }

    #[test]
    fn a_recorder_is_full_before_its_path_would_be_too_long() {
        let mut recorder = CameraRecorder::new(front());
        let mut seconds = 0.0;
        let mut step = 0;
        while recorder.record(seconds, turned(f64::from(step % 7))) {
            seconds += 0.2;
            step += 1;
        }
        assert!(recorder.finish(UpAxis::Y).is_some());
    }

    #[test]
    fn a_path_file_keeps_every_bit_and_a_wrong_one_says_where() {
        let path =
            CameraPath::new(vec![(0.0, turned(0.1)), (1.0 / 3.0, turned(0.2)), (7.5, turned(2.0))], UpAxis::Z).unwrap();
        assert_eq!(CameraPath::from_toml(&path.to_toml()).unwrap(), path);
        let told = |text: &str| CameraPath::from_toml(text).unwrap_err().to_string();
        let backwards = path.to_toml().replace("seconds = 7.5", "seconds = 0.25");
        assert!(told(&backwards).starts_with("line 17: key 3: seconds must"), "{}", told(&backwards));
        assert!(told("up = \"north\"").starts_with("line 1:"), "{}", told("up = \"north\""));
        assert!(told("up = \"y\"\nspeed = 3").starts_with("line 2:"), "{}", told("up = \"y\"\nspeed = 3"));
        assert!(told("").contains("at least one key"));
        let unknown = format!("{}\n\n[[lens]]\nzoom = 2", path.to_toml().trim_end());
        assert!(told(&unknown).starts_with("line 24: "), "{}", told(&unknown));
        let flat = "\n[[key]]\nseconds=0.0\neye=[0,0,1]\nll=[0,0,0]\nu=[1,0,0]\nv=[2,0,0]";
        assert!(told(flat).contains("line 2: the view plane has no area"), "{}", told(flat));
    }

    #[test]
    fn each_axis_that_may_point_up_is_read_and_named() {
        let told = CameraPath::from_toml("up = \"north\"").unwrap_err().to_string();
        for &up in UpAxis::VARIANTS {
            let path = CameraPath::new(vec![(0.0, front())], up).unwrap();
            assert_eq!(CameraPath::from_toml(&path.to_toml()).unwrap().up(), up);
            assert!(told.contains(&format!(" \"{up}\"")), "{up}: {told}");
        }
    }

    #[test]
    fn any_spelling_of_tables_is_read_and_a_huge_one_is_refused() {
        let key = |seconds: f64| format!("seconds = {seconds:?}\n{}", turned(seconds).to_toml());
        let spelled = format!("# up is y\n[[ key ]] # one\n{}\n  [[\"key\"]]\r\n{}", key(0.0), key(1.0));
        assert_eq!(CameraPath::from_toml(&spelled).unwrap().keys().len(), 2);
        let inline = "key = [{ seconds = 0.0, eye = [0,0,1], ll = [-1,-1,0], u = [2,0,0], v = [0,2,0] }]";
        assert_eq!(CameraPath::from_toml(inline).unwrap().keys().len(), 1);
        let told = |text: &str| CameraPath::from_toml(text).unwrap_err().to_string();
        // As one text, either would take gigabytes.
        let huge = format!("up = \"y\"\n[[key]]\nseconds = [{}]", "0,".repeat(1 << 24));
        assert!(told(&huge).starts_with("line 2: a part of the file has more than"), "{}", told(&huge));
        let many = format!("[[key]]\n{}", key(0.0)).repeat(CameraPath::MOST_KEYS + 1);
        assert!(told(&many).contains("at most 72000 keys"), "{}", told(&many));
    }

    proptest! {
        #[test]
        fn no_moment_has_a_degenerate_camera(
            cameras in proptest::collection::vec((any_camera(), 1e-9..1e3f64), 1..6), up in 0..UpAxis::VARIANTS.len(),
            moments in proptest::collection::vec(-0.5..1.5f64, 1..20),
        ) {
            let mut seconds = 0.0;
            let keys: Vec<_> = cameras.into_iter().map(|(camera, step)| {
                let key = (seconds, camera);
                seconds += step;
                key
            }).collect();
            let path = CameraPath::new(keys.clone(), UpAxis::VARIANTS[up]).unwrap();
            for (at, camera) in keys {
                prop_assert_eq!(path.at(at), camera);
            }
            for moment in moments.into_iter().map(|part| part * path.duration_seconds()).chain([f64::NAN, f64::INFINITY]) {
                let camera = path.at(moment);
                prop_assert!(Camera::new(camera.eye(), camera.ll(), camera.u(), camera.v()).is_ok());
            }
        }

        #[test]
        fn no_text_is_a_danger(text in "(up = |\\[\\[key\\]\\]\n|seconds = |[-0-9e.]{1,5}|eye = \\[0,0,1\\]\n|\n){0,30}") {
            let _ = CameraPath::from_toml(&text);
        }
    }
}
