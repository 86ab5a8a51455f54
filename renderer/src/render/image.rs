//! Writes images as PNG files, and any file atomically.

use std::{
    fs::File,
    io::{self, BufWriter, Write},
    path::Path,
};

use shared::division::FrameSize;

/// BLAKE3 of a frame's RGB samples, row by row from the bottom, in hexadecimal. Equal hashes mean equal images.
pub fn hash_samples(rgb: &[u8]) -> String {
    blake3::hash(rgb).to_hex().to_string()
}

/// Atomically writes an sRGB-encoded RGB8 image, given bottom row first.
pub fn write_png(path: &Path, size: FrameSize, rgb: &[u8]) -> io::Result<()> {
    write_atomically(path, |out| {
        let mut encoder = png::Encoder::new(out, size.xres(), size.yres());
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
        let mut writer = encoder.write_header()?;
        let rows: Vec<u8> = rgb.rchunks_exact(3 * size.xres() as usize).flatten().copied().collect();
        writer.write_image_data(&rows)?;
        Ok(writer.finish()?)
    })
}

/// Writes a temporary file beside `path` and renames it when it is complete. Follows links; writes directly to devices
/// and pipes.
pub fn write_atomically(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<()> {
    let resolved = std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    let path = resolved.as_path();
    if std::fs::metadata(path).is_ok_and(|metadata| !metadata.is_file()) {
        let mut out = BufWriter::new(File::options().write(true).open(path)?);
        write(&mut out)?;
        return out.flush();
    }
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(format!(".{}.part", std::process::id()));
    let temporary = Path::new(&temporary);
    let written = File::create(temporary).and_then(|file| {
        let mut out = BufWriter::new(file);
        write(&mut out)?;
        out.flush()
    });
    let renamed = written.and_then(|()| std::fs::rename(temporary, path));
    if renamed.is_err() {
        // Report the first error; the temporary file may not even exist.
        let _ = std::fs::remove_file(temporary);
    }
    renamed
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bottom_row_is_the_last_in_the_file() {
        let path = std::env::temp_dir().join(format!("rows-{}.png", std::process::id()));
        let size = FrameSize::new(2, 2).unwrap();
        let bottom_first = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12];
        write_png(&path, size, &bottom_first).unwrap();
        let mut reader = png::Decoder::new(io::BufReader::new(File::open(&path).unwrap())).read_info().unwrap();
        let mut pixels = [0; 12];
        reader.next_frame(&mut pixels).unwrap();
        assert_eq!(pixels, [7, 8, 9, 10, 11, 12, 1, 2, 3, 4, 5, 6]);
        std::fs::remove_file(path).unwrap();
    }

    #[cfg(unix)]
    #[test]
    fn links_are_followed_and_devices_stay_devices() {
        let folder = std::env::temp_dir().join(format!("links-{}", std::process::id()));
        std::fs::create_dir(&folder).unwrap();
        let (file, link) = (folder.join("file"), folder.join("link"));
        std::fs::write(&file, "old").unwrap();
        std::os::unix::fs::symlink(&file, &link).unwrap();
        write_atomically(&link, |out| out.write_all(b"new")).unwrap();
        assert!(std::fs::symlink_metadata(&link).unwrap().is_symlink());
        assert_eq!(std::fs::read(&file).unwrap(), b"new");
        let device = folder.join("device");
        std::os::unix::fs::symlink("/dev/null", &device).unwrap();
        write_atomically(&device, |out| out.write_all(b"gone")).unwrap();
        assert!(!std::fs::metadata("/dev/null").unwrap().is_file());
        std::fs::remove_dir_all(folder).unwrap();
    }

    #[test]
    fn failed_writes_leave_nothing_behind() {
        let folder = std::env::temp_dir();
        let path = folder.join(format!("half-{}.png", std::process::id()));
        write_atomically(&path, |_| Err(io::Error::other("disk full"))).unwrap_err();
        let left = std::fs::read_dir(folder).unwrap().flatten();
        let name = format!("half-{}", std::process::id());
        assert!(!left.map(|entry| entry.file_name()).any(|file| file.to_string_lossy().starts_with(&name)));
        assert!(write_png(Path::new("/no/such/folder/a.png"), FrameSize::PAPER, &[]).is_err());
    }
}
