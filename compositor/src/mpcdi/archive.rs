//! The zip around an MPCDI.

use std::{
    fmt::Display,
    io::{Cursor, Read, Seek, Write},
};

use image::{ImageFormat, ImageReader, Limits};
use zip::{CompressionMethod, ZipArchive, ZipWriter, write::SimpleFileOptions};

use super::{
    EXPORT_AGAIN,
    canvas::Light,
    document::{LARGEST_SIDE, Mpcdi},
};
use crate::wall::mesh::pfm::Pfm;

/// An archive that is read; nothing is unpacked beyond its limit.
pub struct Archive<R: Read + Seek> {
    zip: ZipArchive<R>,
    /// Bytes that were unpacked so far: regions may name one file again and again.
    n_unpacked: u64,
}

/// The standard's name, and one that some programs write.
const DOCUMENT_NAMES: [&str; 2] = ["mpcdi.xml", "mpacs.xml"];
/// The longest `mpcdi.xml`, in bytes.
const LONGEST_DOCUMENT: u64 = 1 << 20;
/// The longest alpha map, in bytes, and the memory that it may take.
const LONGEST_MAP: u64 = 1 << 29;
/// The longest warp, in bytes, which memory holds: 12 for each pixel of a projector, of which the largest have 7680×4320.
const LONGEST_WARP: u64 = 12 * (1 << 25) + 256;
/// The most bytes of all that is unpacked, some of it twice: the warps and maps of 32 of the largest projectors.
const MOST_UNPACKED: u64 = 1 << 35;
const _: () = assert!(LONGEST_WARP >= 12 * 7680 * 4320);

impl<R: Read + Seek> Archive<R> {
    /// Opens an archive.
    ///
    /// # Errors
    /// It is no zip.
    pub fn open(file: R) -> Result<Self, String> {
        let zip = ZipArchive::new(file)
            .map_err(|error| format!("it is no MPCDI file, which is a zip ({error}): name one, or {EXPORT_AGAIN}"))?;
        Ok(Self { zip, n_unpacked: 0 })
    }

    /// The document in it.
    ///
    /// # Errors
    /// There is none, or it is no MPCDI.
    pub fn document(&mut self) -> Result<Mpcdi, String> {
        let name = DOCUMENT_NAMES.into_iter().find(|name| self.name_of(name).is_some()).unwrap_or(DOCUMENT_NAMES[0]);
        let bytes = self.unpacked(name, LONGEST_DOCUMENT)?;
        let text = String::from_utf8(bytes).map_err(|_| format!("{name} is not UTF-8: {EXPORT_AGAIN}"))?;
        Mpcdi::read(text.trim_start_matches('\u{feff}'))
    }

    /// The warp in a file of the archive.
    ///
    /// # Errors
    /// There is no such file, or it is no PFM of three channels.
    pub fn warp(&mut self, name: &str) -> Result<Pfm, String> {
        Pfm::read(&self.unpacked(name, LONGEST_WARP)?).map_err(|fault| format!("{name}: {fault}; {EXPORT_AGAIN}"))
    }

    /// The light of an alpha map in a file of the archive, in which this gamma was applied.
    ///
    /// # Errors
    /// There is no such file, or it is no PNG.
    pub fn light(&mut self, name: &str, gamma: f64) -> Result<Light, String> {
        let mut reader = ImageReader::with_format(Cursor::new(self.unpacked(name, LONGEST_MAP)?), ImageFormat::Png);
        let mut limits = Limits::default();
        limits.max_image_width = Some(LARGEST_SIDE);
        limits.max_image_height = Some(LARGEST_SIDE);
        limits.max_alloc = Some(LONGEST_MAP);
        reader.limits(limits);
        let image = reader
            .decode()
            .map_err(|error| format!("{name} cannot be read as PNG ({error}): {EXPORT_AGAIN}"))?
            .into_luma16();
        let size = [image.width() as usize, image.height() as usize];
        let light = |x: usize, y: usize| (f64::from(image.get_pixel(x as u32, y as u32).0[0]) / 65535.0).powf(gamma);
        Ok(Light::new(size, light))
    }

    /// The archive's name for a file, whatever its case.
    fn name_of(&self, name: &str) -> Option<String> {
        let name = name.trim_start_matches("./");
        self.zip.file_names().find(|it| it.eq_ignore_ascii_case(name)).map(str::to_owned)
    }

    fn unpacked(&mut self, name: &str, longest: u64) -> Result<Vec<u8>, String> {
        let found = self.name_of(name).ok_or_else(|| format!("it has no file {name}: {EXPORT_AGAIN}"))?;
        let damaged = |error: &dyn Display| format!("{name} cannot be unpacked ({error}): {EXPORT_AGAIN}");
        let entry = self.zip.by_name(&found).map_err(|error| damaged(&error))?;
        // What an entry says of its size may be wrong, so reading has the same limit.
        let mut bytes = Vec::new();
        let mut start = entry.take(longest + 1);
        start.read_to_end(&mut bytes).map_err(|error| damaged(&error))?;
        if start.limit() == 0 {
            return Err(format!("{name} has more than {longest} bytes: export it smaller or coarser"));
        }
        self.n_unpacked += bytes.len() as u64;
        if self.n_unpacked > MOST_UNPACKED {
            return Err(format!("its warps and maps have more than {} GB: write coarser ones", MOST_UNPACKED >> 30));
        }
        Ok(bytes)
    }
}

/// Packs files by name, the document first. In memory: a writer of zips that fails, as on a full disk, says so itself.
///
/// # Errors
/// There are more files than a zip holds.
pub fn pack(document: &str, files: impl Iterator<Item = (String, Vec<u8>)>) -> zip::result::ZipResult<Vec<u8>> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Deflated);
    for (name, bytes) in std::iter::once((DOCUMENT_NAMES[0].to_owned(), document.as_bytes().to_vec())).chain(files) {
        zip.start_file(name, options)?;
        zip.write_all(&bytes)?;
    }
    Ok(zip.finish()?.into_inner())
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;

    #[test]
    fn what_is_packed_is_unpacked_and_nothing_beyond_its_limit() {
        let pfm = Pfm { size: [2, 1], values: vec![[0.0, 0.25, 0.0], [1.0, 0.75, 0.0]] };
        // A bomb: a gigabyte of zeros would be a thousandth of that.
        let files = [("Warps/a.pfm".to_owned(), pfm.write()), ("b.pfm".to_owned(), vec![0; 4 << 20])];
        let packed = pack("<MPCDI/>", files.into_iter()).expect("few files");
        let mut archive = Archive::open(Cursor::new(packed)).expect("a zip");
        assert_eq!(archive.warp("./warps/a.pfm"), Ok(pfm));
        assert_eq!(
            archive.unpacked("b.pfm", 1 << 20),
            Err("b.pfm has more than 1048576 bytes: export it smaller or coarser".to_owned())
        );
        assert_eq!(archive.warp("c.pfm"), Err(format!("it has no file c.pfm: {EXPORT_AGAIN}")));
        assert!(archive.document().expect_err("no profile").contains("its profile is none"));
    }

    #[test]
    fn other_files_are_refused() {
        for bytes in [&b""[..], b"PK", b"canvas_m = [1, 1]"] {
            let fault = Archive::open(Cursor::new(bytes.to_vec())).err().expect("refused");
            assert!(fault.contains("no MPCDI file") && fault.ends_with(EXPORT_AGAIN), "{fault}");
        }
    }
}
