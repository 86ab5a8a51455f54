//! `renderer cache`: lists and clears the scene files that are kept, whole or in part.

use std::time::SystemTime;

use anyhow::{Result, anyhow};
use indicatif::HumanDuration;
use shared::printable::{bytes, counted};

use crate::{
    cli::say,
    scene_file::cache::{Cache, CachedPart, CachedScene, MOST_BYTES},
};

/// Lists the scene files of models that this user has shown on this machine, or removes them.
#[derive(Debug, clap::Args)]
pub struct CacheArgs {
    /// Remove all of them; programs that use one keep it until they end, and those that fetch one go on
    #[arg(long)]
    clear: bool,
}

/// Lists or clears the user's cache.
pub fn run(args: &CacheArgs) -> Result<()> {
    let cache = Cache::of_user().map_err(|fault| anyhow!(fault))?;
    let folder = cache.folder().display();
    if args.clear {
        return say(format_args!("{folder}: {} are free again", bytes(cache.clear())));
    }
    let ago = |used_at: SystemTime| HumanDuration(used_at.elapsed().unwrap_or_default());
    let scenes = cache.scenes();
    for CachedScene { model, n_triangles, n_bytes, used_at, .. } in &scenes {
        let model = model.as_deref().unwrap_or("a scene file that cannot be used");
        let (triangles, ago) = (counted(*n_triangles, "triangle"), ago(*used_at));
        say(format_args!("{model}: {triangles}, {}, used {ago} ago", bytes(*n_bytes)))?;
    }
    let parts = cache.parts();
    for CachedPart { whole, n_bytes, used_at, is_arriving, .. } in &parts {
        let there = bytes(*n_bytes);
        let there = match whole {
            Some((n_whole_bytes, n_triangles)) => {
                format!("{}, {there} of {}", counted(*n_triangles, "triangle"), bytes(*n_whole_bytes))
            }
            None => there,
        };
        let state =
            if *is_arriving { "the rest is on its way".to_owned() } else { format!("used {} ago", ago(*used_at)) };
        say(format_args!("fetched from a wall in part: {there}, {state}"))?;
    }
    let of_parts = parts.iter().map(|part| part.n_bytes).sum::<u64>();
    let n_bytes = scenes.iter().map(|scene| scene.n_bytes).sum::<u64>() + of_parts;
    let n_parts = if parts.is_empty() { String::new() } else { format!("{}, ", counted(parts.len(), "part")) };
    let n_scenes = counted(scenes.len(), "scene");
    say(format_args!("{folder}: {n_scenes}, {n_parts}{} of at most {}", bytes(n_bytes), bytes(MOST_BYTES)))
}
