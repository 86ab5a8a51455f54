//! `renderer cache`: lists and clears the scene files that are kept.

use anyhow::{Result, anyhow};
use indicatif::HumanDuration;
use shared::printable::{bytes, counted};

use crate::{
    cli::say,
    scene_file::cache::{Cache, CachedScene, MOST_BYTES},
};

/// Lists the scene files of models that this user has shown on this machine, or removes them.
#[derive(Debug, clap::Args)]
pub struct CacheArgs {
    /// Remove all of them; programs that use one keep it until they end
    #[arg(long)]
    clear: bool,
}

/// Lists or clears the user's cache.
pub fn run(args: &CacheArgs) -> Result<()> {
    let cache = Cache::of_user().map_err(|fault| anyhow!(fault))?;
    let Some(cache) = cache else {
        return say("there is no cache: neither XDG_CACHE_HOME nor HOME names a folder");
    };
    let folder = cache.folder().display();
    if args.clear {
        return say(format_args!("{folder}: {} are free again", bytes(cache.clear())));
    }
    let scenes = cache.scenes();
    for CachedScene { model, n_triangles, n_bytes, used_at, .. } in &scenes {
        let model = model.as_deref().unwrap_or("a scene file that cannot be used");
        let ago = HumanDuration(used_at.elapsed().unwrap_or_default());
        say(format_args!("{model}: {}, {}, used {ago} ago", counted(*n_triangles, "triangle"), bytes(*n_bytes)))?;
    }
    let n_bytes = scenes.iter().map(|scene| scene.n_bytes).sum();
    let n_scenes = counted(scenes.len(), "scene");
    say(format_args!("{folder}: {n_scenes}, {} of at most {}", bytes(n_bytes), bytes(MOST_BYTES)))
}
