//! PFM, the portable float map: a picture of three floats a pixel, as mesh files and MPCDI use it.
//!
//! A header of text, then rows from the bottom up (Debevec, "HDR Image File Formats", 2001).

/// A picture of three floats a pixel.
#[derive(Clone, Debug, PartialEq)]
pub struct Pfm {
    /// Columns and rows.
    pub size: [usize; 2],
    /// Row by row from the top.
    pub values: Vec<[f32; 3]>,
}

/// Longer headers are not PFM; bytes.
const LONGEST_HEADER: usize = 256;

impl Pfm {
    /// Reads a file's bytes; nothing is allocated that they do not fill.
    ///
    /// # Errors
    /// They are no PFM of three channels; the text names the cure.
    pub fn read(bytes: &[u8]) -> Result<Self, String> {
        let fault = |problem: &str| Err(format!("it is no PFM file of three channels: {problem}"));
        let head = &bytes[..bytes.len().min(LONGEST_HEADER)];
        // Four words, each followed by one white space.
        let ends: Vec<usize> = (1..head.len())
            .filter(|&index| head[index].is_ascii_whitespace() && !head[index - 1].is_ascii_whitespace())
            .take(4)
            .collect();
        let &[.., end] = &ends[..] else { return fault("it has no header") };
        let text = String::from_utf8_lossy(&head[..end]);
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        let &[kind, width, height, scale] = &words[..] else { return fault("it has no header") };
        if kind != "PF" {
            return fault("it does not begin with PF");
        }
        let (Ok(width), Ok(height), Ok(scale)) =
            (width.parse::<usize>(), height.parse::<usize>(), scale.parse::<f64>())
        else {
            return fault("its header has no columns, rows and scale");
        };
        let body = &bytes[end + 1..];
        let n_bytes = width.checked_mul(height).and_then(|n| n.checked_mul(12));
        if n_bytes != Some(body.len()) || body.is_empty() {
            return fault(&format!("{width}×{height} pixels are not {} bytes", body.len()));
        }
        let float = |bytes: &[u8]| {
            let bytes = [bytes[0], bytes[1], bytes[2], bytes[3]];
            // A negative scale says little endian.
            if scale < 0.0 { f32::from_le_bytes(bytes) } else { f32::from_be_bytes(bytes) }
        };
        let pixel = |bytes: &[u8]| [float(bytes), float(&bytes[4..]), float(&bytes[8..])];
        let values = body.chunks_exact(12 * width).rev().flat_map(|row| row.chunks_exact(12).map(pixel)).collect();
        Ok(Self { size: [width, height], values })
    }

    /// The file's bytes, little endian.
    pub fn write(&self) -> Vec<u8> {
        let [width, height] = self.size;
        let mut bytes = format!("PF\n{width} {height}\n-1.0\n").into_bytes();
        for row in self.values.chunks_exact(width).rev() {
            bytes.extend(row.iter().flatten().flat_map(|value| value.to_le_bytes()));
        }
        bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_stored_from_the_bottom_up_in_either_byte_order() {
        let values = vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0], [10.0, 11.0, 12.0]];
        let pfm = Pfm { size: [2, 2], values };
        let bytes = pfm.write();
        assert!(bytes.starts_with(b"PF\n2 2\n-1.0\n"));
        assert_eq!(bytes[12..16], 7.0_f32.to_le_bytes(), "the lower row comes first");
        assert_eq!(Pfm::read(&bytes), Ok(pfm.clone()));
        let (head, body) = bytes.split_at(12);
        let swapped = body.chunks_exact(4).flat_map(|it| it.iter().rev().copied());
        let big_endian: Vec<u8> = b"PF 2 2 1.0\n".iter().copied().chain(swapped).collect();
        assert_eq!((head.len(), Pfm::read(&big_endian)), (12, Ok(pfm)));
    }

    #[test]
    fn other_files_are_refused_without_allocating_what_they_claim() {
        let refused = |bytes: &[u8]| Pfm::read(bytes).expect_err("refused");
        for bytes in [&b""[..], b"PF", b"PF\n1 1\n", b"Pf\n1 1\n-1\n0000", b"P6\n1 1\n255\n000", b"PF\n1 1\n-1\n0000"] {
            assert!(refused(bytes).contains("no PFM file"), "{bytes:?}");
        }
        assert!(refused(b"PF\n4000000000 4000000000\n-1\n0000").contains("are not 4 bytes"));
        assert!(refused(b"PF\n0 7\n-1\n").contains("are not 0 bytes"));
    }
}
