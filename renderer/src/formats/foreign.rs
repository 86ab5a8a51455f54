//! Says of a file that is no model, or no image, what it is, and what to do about it.

use crate::formats::{file::BYTE_ORDER_MARK, stl};

/// Beginnings of files of other kinds, and what each is, with the cure.
const KINDS: [(&[u8], &str); 22] = [
    (b"raywall\0", "is a scene file, which walls and render servers show: name the model that it was built from"),
    (b"\x1f\x8b", "is compressed with gzip: unpack it"),
    (
        b"PK\x03\x04",
        "is a ZIP archive, or a format that is one, such as 3MF: unpack it, or export PLY, OBJ, STL or GLB",
    ),
    (b"\x28\xb5\x2f\xfd", "is compressed with zstd: unpack it"),
    (b"7z\xbc\xaf\x27\x1c", "is a 7z archive: unpack it"),
    (b"\xfd7zXZ\0", "is compressed with xz: unpack it"),
    (b"BZh", "is compressed with bzip2: unpack it"),
    (b"Rar!", "is a RAR archive: unpack it"),
    (b"\xff\xfe", "is text in UTF-16: save it as UTF-8"),
    (b"\xfe\xff", "is text in UTF-16: save it as UTF-8"),
    (b"<!doctype html", "is a web page: download the file itself"),
    (b"<html", "is a web page: download the file itself"),
    (b"version https://git-lfs", "is a pointer of Git LFS: run `git lfs pull` to get the file itself"),
    (b"kaydara fbx", "is FBX: convert it to GLB, for example with Blender"),
    (b"blender", "is a file of Blender: export PLY, OBJ, STL or GLB from it"),
    (b"iso-10303-21", "is STEP: export STL or GLB from CAD"),
    (b"<?xml", "is XML, for example COLLADA or X3D: convert it to GLB, for example with Blender"),
    (b"off\n", "is OFF: convert it to PLY, for example with MeshLab"),
    (b"lasf", "is a point cloud (LAS or LAZ): a point cloud must be meshed first"),
    (b"astm-e57", "is a point cloud (E57): a point cloud must be meshed first"),
    (b"\x89png", "is an image: choose the model that it belongs to"),
    (b"\xff\xd8\xff", "is an image: choose the model that it belongs to"),
];

/// Names the kind of a file that begins with no format that is read, and the cure.
pub(super) fn fault(start: &[u8], n_bytes: u64) -> String {
    if n_bytes == 0 {
        "is empty: copy or export the model again".to_owned()
    } else if start.iter().all(|&byte| byte == 0 || byte.is_ascii_whitespace()) {
        "begins with nothing but zeros or spaces, as an interrupted copy does: copy the model again".to_owned()
    } else if let Some(kind) = kind(start) {
        kind.to_owned()
    } else if is_utf_16(start) {
        "is text in UTF-16: save it as UTF-8".to_owned()
    } else if let Some(needed) = stl::binary_bytes(start).filter(|_| stl::begins_with_triangle(start)) {
        match needed > n_bytes {
            true => format!(
                "is a binary STL that is cut short: its header needs {needed} bytes, it has {n_bytes}; copy it again"
            ),
            false => "is a binary STL whose header counts no triangles: export the model again".to_owned(),
        }
    } else {
        "is no model that is read (PLY, OBJ, STL, glTF, GLB), or its beginning is damaged: export it again in one of \
            these formats"
            .to_owned()
    }
}

/// The kind of a file by its beginning, and the cure.
pub(super) fn kind(start: &[u8]) -> Option<&'static str> {
    let text = start.strip_prefix(BYTE_ORDER_MARK).unwrap_or(start).trim_ascii_start();
    let begins = |with: &&(&[u8], &str)| {
        let same = |bytes: &[u8]| bytes.get(..with.0.len()).is_some_and(|it| it.eq_ignore_ascii_case(with.0));
        same(start) || same(text)
    };
    KINDS.iter().find(begins).map(|(_, kind)| *kind)
}

/// Whether every other byte of a text is zero, as in UTF-16 without a mark.
fn is_utf_16(start: &[u8]) -> bool {
    let pairs = start.as_chunks::<2>().0;
    let is_half =
        |byte: usize| pairs.iter().all(|pair| pair[byte] == 0 && pair[1 - byte].is_ascii() && pair[1 - byte] != 0);
    !pairs.is_empty() && (is_half(0) || is_half(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn utf_16(text: &str) -> Vec<u8> {
        text.encode_utf16().flat_map(u16::to_be_bytes).collect()
    }

    #[test]
    fn files_of_other_kinds_are_told_apart() {
        let mut stl = [b' '; 80].to_vec();
        stl.extend(9_u32.to_le_bytes());
        stl.extend(
            [0.0_f32, 0.0, 1.0, 0.5, 2.0, 3.0, 1.5, 2.0, 3.0, 0.5, 4.0, 3.0].iter().flat_map(|x| x.to_le_bytes()),
        );
        let mut uncounted = stl.clone();
        uncounted[80] = 0;
        let noise: Vec<u8> = (0..200_u32).map(|i| (i * i * 37 + 11 * i + 130) as u8).collect();
        for (bytes, expected) in [
            (Vec::new(), "is empty: copy or export"),
            (vec![0; 100], "begins with nothing but zeros or spaces"),
            (b"\x1f\x8b\x08".to_vec(), "is compressed with gzip: unpack it"),
            (b"PK\x03\x04\x14".to_vec(), "is a ZIP archive"),
            ([&b"\xff\xfe"[..], b"v\0 \0"].concat(), "is text in UTF-16: save it as UTF-8"),
            (utf_16("v 1 2 3\n"), "is text in UTF-16: save it as UTF-8"),
            (b" <!DOCTYPE HTML>".to_vec(), "is a web page"),
            (b"LASF\0\0".to_vec(), "is a point cloud"),
            (stl, "is a binary STL that is cut short: its header needs 534 bytes, it has 132"),
            (uncounted, "is a binary STL whose header counts no triangles: export the model again"),
            (noise, "is no model that is read"),
            (b"OFFICE".to_vec(), "is no model that is read"),
        ] {
            let told = fault(&bytes, bytes.len() as u64);
            assert!(told.starts_with(expected) && !told.contains('\n'), "{expected}: {told}");
        }
    }
}
