//! The wall's scene files, for render servers that lack the models: made when the first of them asks.

use std::{
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, OnceLock, PoisonError,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    thread,
    time::{Duration, Instant},
};

use renderer::{
    grid::GridOptions,
    render::threads,
    scene_file::{SceneStore, travelling::TravellingFile},
};
use shared::scene::SceneId;
use tokio::{sync::watch, time::sleep};

use super::rate_limit::RateLimit;

/// A scene file that could not be made is tried again after this time.
const RETRY_AFTER: Duration = Duration::from_secs(10);

/// Frames go first: for so long after a request for one, scene files travel slowly. Most frames take less.
const BUSY_FOR: Duration = Duration::from_secs(1);

/// The pause between messages of 64 KB to all render servers together while frames are rendered: 13 MB a second, a tenth of
/// the common link. A message delays a frame's request by half a millisecond there.
const BUSY_INTERVAL: Duration = Duration::from_millis(5);

/// Makes and keeps the scene files of the model on show and of the one that may come next.
#[derive(Debug)]
pub(super) struct SceneSupply {
    started_at: Instant,
    /// How scene files are made; without it, none are given.
    maker: OnceLock<(SceneStore, GridOptions)>,
    offers: watch::Sender<Vec<Offer>>,
    /// Held while a file is made.
    making: Mutex<()>,
    /// Microseconds since the start until which frames go first.
    busy_until_us: AtomicU64,
    /// Of messages while frames go first.
    pace: Mutex<RateLimit>,
}

/// A scene that render servers may fetch, and its file.
#[derive(Clone, Debug)]
pub(super) struct Offer {
    pub(super) scene: SceneId,
    path: Option<PathBuf>,
    pub(super) supply: Supply,
}

impl Offer {
    /// The offer of a scene, if there is one.
    pub(super) fn find(offers: &[Self], scene: SceneId) -> Option<&Self> {
        offers.iter().find(|offer| offer.scene == scene)
    }
}

/// The state of a scene file.
#[derive(Clone, Debug, Default)]
pub(super) enum Supply {
    /// Nobody has asked for it.
    #[default]
    Unasked,
    /// It is being made: the fraction done, 0 to 1.
    Making(f32),
    Ready(Arc<TravellingFile>),
    /// It cannot be made: the cause and the cure, and when that was found.
    Failed(String, Instant),
}

impl Default for SceneSupply {
    fn default() -> Self {
        Self {
            started_at: Instant::now(),
            maker: OnceLock::new(),
            offers: watch::Sender::default(),
            making: Mutex::default(),
            busy_until_us: AtomicU64::new(0),
            pace: Mutex::new(RateLimit::new(1, BUSY_INTERVAL)),
        }
    }
}

impl SceneSupply {
    /// From now on, scene files are made with these options and kept in the store's cache.
    pub(super) fn make_with(&self, store: SceneStore, options: GridOptions) {
        // Set once, as the wall starts.
        let _ = self.maker.set((store, options));
    }

    /// Notes the scenes on show and to come, with their models; all transfers of others end.
    pub(super) fn set_scenes(&self, scenes: impl Iterator<Item = (SceneId, Option<PathBuf>)>) {
        let scenes: Vec<_> = scenes.collect();
        self.offers.send_if_modified(|offers| {
            if offers
                .iter()
                .map(|offer| (offer.scene, &offer.path))
                .eq(scenes.iter().map(|(scene, path)| (*scene, path)))
            {
                return false;
            }
            let old = std::mem::take(offers);
            offers.extend(scenes.into_iter().map(|(scene, path)| {
                let known = Offer::find(&old, scene).filter(|offer| offer.path == path);
                known.cloned().unwrap_or(Offer { scene, path, supply: Supply::Unasked })
            }));
            true
        });
    }

    /// Forgets a file that is damaged: the next to ask has it made or opened again.
    pub(super) fn forget(&self, scene: SceneId) {
        self.put(scene, Supply::Unasked);
    }

    /// Whether this scene is on show, or to come.
    pub(super) fn offers(&self, scene: SceneId) -> bool {
        Offer::find(&self.offers.borrow(), scene).is_some()
    }

    /// Has the scene file made if it is not there.
    pub(super) fn ask(self: &Arc<Self>, scene: SceneId) -> watch::Receiver<Vec<Offer>> {
        let mut job = None;
        self.offers.send_if_modified(|offers| {
            let Some(offer) = offers.iter_mut().find(|offer| offer.scene == scene) else { return false };
            let is_due = match &offer.supply {
                Supply::Unasked => true,
                Supply::Failed(_, at) => at.elapsed() > RETRY_AFTER,
                Supply::Making(_) | Supply::Ready(_) => false,
            };
            if !is_due {
                return false;
            }
            offer.supply = match (&offer.path, self.maker.get()) {
                (Some(path), Some((store, options))) => {
                    job = Some((path.clone(), store.clone(), *options));
                    Supply::Making(0.0)
                }
                _ => Supply::Failed(
                    "it gives no scene files: start the server with --model FILE".to_owned(),
                    Instant::now(),
                ),
            };
            true
        });
        if let Some((path, store, options)) = job {
            let supply = Arc::clone(self);
            let make = move || supply.make(scene, &path, &store, &options);
            if let Err(error) = thread::Builder::new().name("scene file".to_owned()).spawn(make) {
                self.put(scene, Supply::Failed(format!("it cannot start a thread: {error}"), Instant::now()));
            }
        }
        self.offers.subscribe()
    }

    fn make(&self, scene: SceneId, path: &Path, store: &SceneStore, options: &GridOptions) {
        // One after the other: an operator may open models faster than their files are made.
        let _turn = self.making.lock().unwrap_or_else(PoisonError::into_inner);
        if !self.offers(scene) {
            return;
        }
        // The rest of the cores place samples and draw.
        let n_threads = thread::available_parallelism().map_or(1, |n| (usize::from(n) / 2).max(1));
        let report = |done: f32| self.put(scene, Supply::Making(done));
        let made = threads::pool(Some(n_threads)).map_err(|error| error.to_string()).and_then(|pool| {
            pool.install(|| store.travelling(path, scene.treatment(), options, &|_, done| report(done)))
        });
        let supply = match made {
            Ok(file) if file.scene == scene => Supply::Ready(Arc::new(file)),
            Ok(_) => Supply::Failed("its model has changed: open it again on the wall".to_owned(), Instant::now()),
            Err(reason) => Supply::Failed(reason, Instant::now()),
        };
        match &supply {
            Supply::Failed(reason, _) => tracing::warn!("render servers cannot fetch {}: {reason}", path.display()),
            _ => tracing::info!("render servers may fetch {}", path.display()),
        }
        self.put(scene, supply);
    }

    /// Changes the state of a scene's file, unless other scenes are on show by now.
    fn put(&self, scene: SceneId, supply: Supply) {
        self.offers.send_if_modified(|offers| {
            let Some(offer) = offers.iter_mut().find(|offer| offer.scene == scene) else { return false };
            let is_step = !matches!((&offer.supply, &supply), (Supply::Making(old), Supply::Making(new))
                if (new - old).abs() < 0.01);
            if is_step {
                offer.supply = supply;
            }
            is_step
        });
    }

    /// Notes that a frame is rendered now.
    pub(super) fn note_frame(&self) {
        let until = self.started_at.elapsed() + BUSY_FOR;
        self.busy_until_us.store(until.as_micros() as u64, Relaxed);
    }

    /// Waits until the next message of a scene file may leave: at once unless frames are rendered.
    pub(super) async fn pace(&self) {
        loop {
            let now = self.started_at.elapsed();
            let wait = {
                let mut pace = self.pace.lock().unwrap_or_else(PoisonError::into_inner);
                let wait = pace.wait(now);
                if wait.is_zero() {
                    pace.count(now);
                }
                wait
            };
            if wait.is_zero() || now.as_micros() as u64 >= self.busy_until_us.load(Relaxed) {
                return;
            }
            sleep(wait).await;
        }
    }
}
