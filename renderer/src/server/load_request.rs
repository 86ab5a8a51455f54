//! The scenes that a wall asks for, until the loading thread takes the requests.

use std::{
    path::PathBuf,
    sync::{Condvar, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use shared::{protocol::SkyFile, scene::SceneId, structure::Structure};

/// A scene, its sky, and where their files may be.
pub(crate) struct LoadRequest {
    pub(crate) scene: SceneId,
    /// A file on this machine that may hold it.
    pub(crate) path: Option<PathBuf>,
    pub(crate) structure: Option<Structure>,
    pub(crate) sky: Option<SkyFile>,
}

/// A wish of the wall.
pub(crate) enum Request {
    /// The scene to render.
    Load(LoadRequest),
    /// The scene that may come after it.
    Prepare(LoadRequest),
}

/// The last request of each kind: a wall that orders many has one loaded.
#[derive(Default)]
pub(crate) struct LatestRequests {
    waiting: Mutex<Waiting>,
    changed: Condvar,
}

#[derive(Default)]
struct Waiting {
    load: Option<LoadRequest>,
    prepare: Option<LoadRequest>,
}

impl LatestRequests {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn put(&self, request: Request) {
        let mut waiting = self.lock();
        match request {
            Request::Load(request) => waiting.load = Some(request),
            Request::Prepare(request) => waiting.prepare = Some(request),
        }
        drop(waiting);
        self.changed.notify_one();
    }

    /// Whether another scene is to be rendered.
    pub(crate) fn has_load(&self) -> bool {
        self.lock().load.is_some()
    }

    /// Waits for a request, at most for `limit`. The scene to render comes first.
    pub(crate) fn take(&self, limit: Duration) -> Option<Request> {
        let is_empty = |waiting: &mut Waiting| waiting.load.is_none() && waiting.prepare.is_none();
        let waited = self.changed.wait_timeout_while(self.lock(), limit, is_empty);
        let (mut waiting, _) = waited.unwrap_or_else(PoisonError::into_inner);
        let load = waiting.load.take().map(Request::Load);
        load.or_else(|| waiting.prepare.take().map(Request::Prepare))
    }
}

/// The path in [`std::ffi::OsStr::as_encoded_bytes`] of this machine; it need not be text. Other bytes name no file.
pub(crate) fn path_from_bytes(bytes: Vec<u8>) -> PathBuf {
    #[cfg(unix)]
    let path = <std::ffi::OsString as std::os::unix::ffi::OsStringExt>::from_vec(bytes);
    #[cfg(not(unix))]
    let path = String::from_utf8_lossy(&bytes).into_owned();
    path.into()
}

#[cfg(test)]
mod tests {
    use shared::scene::Treatment;

    use super::*;

    #[test]
    fn the_last_request_of_a_kind_counts_and_the_scene_to_render_comes_first() {
        let requests = LatestRequests::default();
        let statue = |triangles| {
            let scene = SceneId::Statue { triangles, treatment: Treatment::FLAT };
            LoadRequest { scene, path: None, structure: None, sky: None }
        };
        requests.put(Request::Prepare(statue(8)));
        requests.put(Request::Prepare(statue(16)));
        requests.put(Request::Load(statue(24)));
        assert!(requests.has_load());
        let take = || match requests.take(Duration::ZERO)? {
            Request::Load(request) => Some((true, request.scene)),
            Request::Prepare(request) => Some((false, request.scene)),
        };
        assert_eq!(take(), Some((true, statue(24).scene)));
        assert_eq!(take(), Some((false, statue(16).scene)));
        assert_eq!(take(), None);
    }

    #[cfg(unix)]
    #[test]
    fn a_path_that_is_no_text_comes_out_as_it_went_in() {
        let bytes = b"/models/b\xfcste.ply".to_vec();
        let path = path_from_bytes(bytes.clone());
        assert!(path.to_str().is_none());
        assert_eq!(path.as_os_str().as_encoded_bytes(), bytes);
    }
}
