//! Which part of a scene file a frame reads, as the system's page cache tells.

use std::path::Path;

use anyhow::Result;

/// A page of the cache.
#[cfg(target_os = "linux")]
const PAGE: usize = 4096;

/// A file that is no longer may be read, and mapped, whole as it is opened.
#[cfg(target_os = "linux")]
const READ_AT_ONCE: u64 = 1 << 20;

/// Bytes of the pages of a file that `read` reads through the file's mapping in this process; `None` where the system does not
/// tell, or keeps the file in memory. `read` gets a cold mapping: no page of the file is in memory, and none is read ahead.
#[cfg(target_os = "linux")]
pub(super) fn touched_bytes<T>(path: &Path, map: impl Fn() -> Result<T>, read: impl FnOnce(&T)) -> Result<Option<u64>> {
    use std::{fs::File, os::fd::AsRawFd};

    use anyhow::ensure;

    let file = File::open(path)?;
    // Only pages that are on the disk, and that nobody has mapped, can be dropped.
    file.sync_all()?;
    let mapped = map()?;
    let Some((address, n_bytes)) = mapping_of(path)? else { return Ok(None) };
    // SAFETY: the address and the length are those of a mapping that `mapped` keeps, and the advice changes no contents.
    let is_random = unsafe { libc::madvise(address as *mut libc::c_void, n_bytes, libc::MADV_RANDOM) } == 0;
    // SAFETY: `file` is open, and the call touches no memory of this process.
    let is_dropped = unsafe { libc::posix_fadvise(file.as_raw_fd(), 0, 0, libc::POSIX_FADV_DONTNEED) } == 0;
    ensure!(is_random && is_dropped, "{}: the system takes no advice about its pages", path.display());
    let before = resident_bytes(address, n_bytes)?;
    if before > n_bytes as u64 / 2 + READ_AT_ONCE {
        return Ok(None);
    }
    read(&mapped);
    let after = resident_bytes(address, n_bytes)?;
    Ok(Some(after.saturating_sub(before)))
}

/// The bytes of a mapping's file that are in memory.
#[cfg(target_os = "linux")]
fn resident_bytes(address: usize, n_bytes: usize) -> Result<u64> {
    let mut pages = vec![0_u8; n_bytes.div_ceil(PAGE)];
    // SAFETY: `pages` has a byte for each page of the mapping, which is in place.
    let is_told = unsafe { libc::mincore(address as *mut libc::c_void, n_bytes, pages.as_mut_ptr()) } == 0;
    anyhow::ensure!(is_told, "the system does not tell which pages are in memory");
    Ok((pages.iter().filter(|&&page| page & 1 == 1).count() * PAGE) as u64)
}

/// Where a file is mapped in this process, once.
#[cfg(target_os = "linux")]
fn mapping_of(path: &Path) -> Result<Option<(usize, usize)>> {
    let path = path.canonicalize()?;
    let maps = std::fs::read_to_string("/proc/self/maps")?;
    let of_file = |line: &&str| line.split_whitespace().nth(5).is_some_and(|name| Path::new(name) == path);
    let range = |line: &str| {
        let (start, end) = line.split_whitespace().next()?.split_once('-')?;
        let address = |text: &str| usize::from_str_radix(text, 16).ok();
        Some((address(start)?, address(end)? - address(start)?))
    };
    Ok(maps.lines().find(of_file).and_then(range))
}

/// As on Linux; other systems do not tell.
#[cfg(not(target_os = "linux"))]
pub(super) fn touched_bytes<T>(_: &Path, _: impl Fn() -> Result<T>, _: impl FnOnce(&T)) -> Result<Option<u64>> {
    Ok(None)
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use renderer::{
        grid::GridOptions,
        model::scene::SceneSource,
        scene_file::store::{StoredScene, build_file},
    };
    use shared::{
        camera::{Camera, CanvasPart},
        scene::Treatment,
    };

    use super::*;
    use crate::large::MappedScenes;

    #[test]
    fn the_pages_that_are_read_count_and_no_others() {
        // A disk, unlike the folder for temporary files on many machines.
        let folder = tempfile::tempdir_in(std::env::current_exe().unwrap().parent().unwrap()).unwrap();
        let path = folder.path().join("statue.raywall");
        let source = SceneSource::Statue { triangles: 300_000 };
        build_file(&source, Treatment::default(), &GridOptions::default(), &path, &|_, _| ()).unwrap();
        let scenes = MappedScenes::in_folder(folder.path()).unwrap();
        scenes.load(&path).unwrap().finish();
        let n_bytes = std::fs::metadata(&path).unwrap().len();
        let touched = |n_rays: u32| {
            let read = |stored: &StoredScene| {
                let whole = Camera::view_all(&stored.info.shape, stored.info.shape.up, 2.0, CanvasPart::WHOLE);
                (0..n_rays).for_each(|ray| {
                    let _ = stored.scene.probe(&whole, [0.4 + 0.2 * ray as f32 / n_rays as f32, 0.5], None);
                });
            };
            touched_bytes(&path, || scenes.load(&path), read).unwrap()
        };
        let [Some(none), Some(one), Some(many)] = [0, 1, 1000].map(touched) else {
            println!("skipped: the file system of {} keeps files in memory", path.display());
            return;
        };
        assert_eq!(none, 0);
        assert!((PAGE as u64..n_bytes / 20).contains(&one), "{one} of {n_bytes}");
        assert!(many > 2 * one && many < n_bytes, "{many} of {n_bytes}");
    }
}
