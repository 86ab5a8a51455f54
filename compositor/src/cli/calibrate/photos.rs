//! Photographs from a folder, complete or while a camera fills it.

use std::{
    collections::HashMap,
    fs,
    io::{Cursor, Read},
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
    time::Duration,
};

use anyhow::{Context, bail};
use channel::files;
use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, RgbImage, metadata::Orientation};
use renderer::formats::images::is_whole_jpeg;

use crate::calibration::{Codebook, Photograph, Plan, Reading};

/// A photograph that was read.
#[derive(Clone, Debug)]
pub(super) struct Photo {
    pub reading: Reading,
    /// How viewers turn it.
    pub orientation: Orientation,
}

/// Endings of files that are read, and of photographs that are not.
const ENDINGS: [&str; 5] = ["jpg", "jpeg", "png", "tif", "tiff"];
const OTHER_ENDINGS: [&str; 9] = ["heic", "heif", "avif", "dng", "cr2", "cr3", "nef", "arw", "raf"];
/// The most photographs of a wall: thirty from each of thirty places.
const MOST_PHOTOS: usize = 900;
/// The most pixels of a photograph, which take a gigabyte while it is read.
const MOST_PIXELS: u64 = 64_000_000;
/// The longest file of so many pixels: three times 16 bits each, and as much again.
const MOST_BYTES: u64 = 12 * MOST_PIXELS;
/// The most shades of a drawing: patterns that show places are black and white.
const MOST_DRAWN: usize = 4;
/// How often a folder is looked at; a file is complete if it has not grown since the last time, and is read again if it has
/// another length later.
const WATCH_INTERVAL: Duration = Duration::from_millis(300);

/// The photographs in a folder, by name.
pub(super) fn in_folder(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let unreadable = || format!("{} cannot be read: name the folder of the photographs", folder.display());
    let entries = fs::read_dir(folder).with_context(unreadable)?;
    let mut paths = Vec::new();
    let mut n_others = 0;
    for entry in entries {
        let path = entry.with_context(unreadable)?.path();
        let ending = path.extension().map(|it| it.to_string_lossy().to_lowercase()).unwrap_or_default();
        n_others += usize::from(OTHER_ENDINGS.contains(&&*ending));
        if ENDINGS.contains(&&*ending) && !path.is_dir() {
            paths.push(path);
        }
    }
    if paths.len() > MOST_PHOTOS {
        bail!(
            "{} has {} photographs, and at most {MOST_PHOTOS} are read: remove others",
            folder.display(),
            paths.len()
        );
    }
    if paths.is_empty() && n_others > 0 {
        bail!(
            "{} has only photographs in formats that are not read: export them as JPEG, PNG or TIFF",
            folder.display()
        );
    }
    paths.sort();
    Ok(paths)
}

impl Photo {
    /// Reads a photograph; an error is one line with the cure.
    pub(super) fn read(path: &Path, codebook: &Codebook<'_>) -> Result<Self, String> {
        let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        let fault = |problem: &dyn std::fmt::Display| {
            format!("{name} cannot be read: {problem}: it does not count; export it as JPEG again")
        };
        let file = files::open(path).map_err(|error| format!("{name} {error}"))?;
        let mut bytes = Vec::new();
        file.take(MOST_BYTES + 1).read_to_end(&mut bytes).map_err(|error| fault(&error))?;
        if bytes.len() as u64 > MOST_BYTES {
            return Err(format!("{name} has more than {} MB: scale it down", MOST_BYTES / 1_000_000));
        }
        if bytes.is_empty() {
            return Err(format!("{name} is empty: it does not count; copy it again"));
        }
        let reader = ImageReader::new(Cursor::new(&bytes)).with_guessed_format().map_err(|error| fault(&error))?;
        let is_jpeg = reader.format() == Some(ImageFormat::Jpeg);
        let mut decoder = reader.into_decoder().map_err(|error| fault(&error))?;
        // The decoder fills in grey, and projectors would be blamed.
        if is_jpeg && !is_whole_jpeg(&bytes) {
            return Err(format!("{name} is cut off: it does not count; copy it again"));
        }
        let (width, height) = decoder.dimensions();
        if u64::from(width) * u64::from(height) > MOST_PIXELS {
            return Err(format!(
                "{name} has {width}×{height} pixels, and at most {} million are read: scale it down",
                MOST_PIXELS / 1_000_000
            ));
        }
        let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
        let image = DynamicImage::from_decoder(decoder).map_err(|error| fault(&error))?;
        drop(bytes);
        let grey = image.to_luma16();
        if is_drawing(grey.as_raw()) {
            return Err(format!(
                "{name} is a drawing, as the patterns themselves, and no photograph: it does not count; take photographs of the \
                 wall"
            ));
        }
        let values = grey.as_raw().iter().map(|value| f32::from(*value) / 65535.0).collect();
        drop(grey);
        let photograph = Photograph { size: [width as usize, height as usize], values };
        let reading = match image {
            DynamicImage::ImageRgb8(colours) => Self::read_colours(name, &photograph, &colours, codebook),
            // Files of raw developers have 16 bits.
            DynamicImage::ImageRgb16(_) | DynamicImage::ImageLuma16(_) | DynamicImage::ImageRgba16(_) => {
                let colours = image.into_rgb16();
                let colour_at = |x: usize, y: usize| {
                    colours.get_pixel(x as u32, y as u32).0.map(|value| f32::from(value) / 65535.0)
                };
                Reading::with_colours(name, &photograph, &colour_at, codebook)
            }
            other => Self::read_colours(name, &photograph, &other.into_rgb8(), codebook),
        };
        Ok(Self { reading, orientation })
    }

    fn read_colours(name: String, photograph: &Photograph, colours: &RgbImage, codebook: &Codebook<'_>) -> Reading {
        let colour_at =
            |x: usize, y: usize| colours.get_pixel(x as u32, y as u32).0.map(|value| f32::from(value) / 255.0);
        Reading::with_colours(name, photograph, &colour_at, codebook)
    }
}

/// Whether a picture has few shades, from black to white: cameras blur edges, and make noise.
fn is_drawing(shades: &[u16]) -> bool {
    let mut seen = Vec::new();
    for shade in shades {
        if !seen.contains(shade) {
            seen.push(*shade);
            if seen.len() > MOST_DRAWN {
                return false;
            }
        }
    }
    seen.iter().any(|shade| *shade < 0x1000) && seen.iter().any(|shade| *shade > 0xf000)
}

/// Reads photographs as they come into a folder, on a thread of its own, until it is dropped.
pub(super) struct Watch {
    is_ended: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Watch {
    /// Reports each photograph that comes from now on; those that are there already are of another time.
    pub(super) fn start(
        folder: &Path,
        plan: Plan,
        report: impl Fn(Result<Photo, String>) + Send + 'static,
    ) -> anyhow::Result<Self> {
        let n_bytes = |path: &Path| fs::metadata(path).map_or(0, |metadata| metadata.len());
        // The length of each file when it was seen last, and whether it was read then.
        let old = in_folder(folder)?.into_iter().map(|path| (path.clone(), (n_bytes(&path), true)));
        let mut seen: HashMap<PathBuf, (u64, bool)> = old.collect();
        if !seen.is_empty() {
            tracing::info!("{} photographs that are in {} already do not count", seen.len(), folder.display());
        }
        let is_ended = Arc::new(AtomicBool::new(false));
        let (ends, folder) = (Arc::clone(&is_ended), folder.to_owned());
        let run = move || {
            let codebook = Codebook::new(&plan);
            let mut problem = None;
            while !ends.load(Ordering::Relaxed) {
                let paths = in_folder(&folder).unwrap_or_else(|error| {
                    // Once, not three times a second.
                    let error = format!("{error:#}");
                    if problem.as_ref() != Some(&error) {
                        report(Err(error.clone()));
                        problem = Some(error);
                    }
                    Vec::new()
                });
                for path in paths {
                    let n_bytes = n_bytes(&path);
                    let is_complete = n_bytes > 0 && seen.get(&path) == Some(&(n_bytes, false));
                    if seen.get(&path) == Some(&(n_bytes, true)) || ends.load(Ordering::Relaxed) {
                        continue;
                    }
                    if is_complete {
                        report(Photo::read(&path, &codebook));
                    }
                    seen.insert(path, (n_bytes, is_complete));
                }
                thread::sleep(WATCH_INTERVAL);
            }
        };
        let thread = thread::Builder::new().name("photographs".to_owned()).spawn(run)?;
        Ok(Self { is_ended, thread: Some(thread) })
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        self.is_ended.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A photograph that is being read is finished first.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drawings_have_few_shades_from_black_to_white_and_photographs_many() {
        assert!(is_drawing(&[0, 0xffff, 0x8000, 0xffff, 0]));
        // Too dark, too bright, or with blurred edges.
        assert!(!is_drawing(&[0, 0x300, 0x500]) && !is_drawing(&[0xffff; 9]) && !is_drawing(&[]));
        let shades: Vec<u16> = (0..=255).map(|shade| shade * 257).collect();
        assert!(!is_drawing(&shades));
    }
}
