//! The bytes of a glTF: buffers and views of them.

use std::{borrow::Cow, collections::HashMap};

use rayon::prelude::*;

use crate::formats::{
    companions::Companions,
    gltf::{document::Document, meshopt},
};

/// The longest file of a buffer.
const LONGEST_BUFFER: u64 = 1 << 40;

/// Buffers, and the views that are compressed. What cannot be had is a text that says why.
pub(super) struct Buffers<'a> {
    buffers: Vec<Result<Cow<'a, [u8]>, String>>,
    /// For each buffer the first one of the same URI: a few bytes of JSON must not read a file again and again.
    firsts: Vec<usize>,
    decoded: Vec<Option<Result<Vec<u8>, String>>>,
    /// Bytes of all buffers.
    pub(super) n_bytes: usize,
}

impl<'a> Buffers<'a> {
    /// Reads buffers. `binary` is the one in a GLB.
    pub(super) fn read(document: &Document<'_>, binary: &'a [u8], companions: &Companions) -> Self {
        let mut read = Vec::<Result<Cow<'a, [u8]>, String>>::new();
        let (mut firsts, mut seen) = (Vec::new(), HashMap::new());
        for (index, buffer) in document.buffers.iter().enumerate() {
            let first = buffer.uri.as_deref().map_or(index, |uri| *seen.entry(uri).or_insert(index));
            firsts.push(first);
            let bytes = match buffer.uri.as_deref() {
                Some(_) if first < index => Ok(Cow::Borrowed(&[][..])),
                Some(uri) => bytes_of(uri, companions).map(Cow::Owned),
                None if index == 0 && !binary.is_empty() => Ok(Cow::Borrowed(binary)),
                // A buffer of compressed views may exist on paper only.
                None => Err(format!("buffer {index} ({} bytes) is nowhere", buffer.byte_length)),
            };
            read.push(bytes);
        }
        let n_bytes = read.iter().flatten().map(|bytes| bytes.len()).sum();
        let mut buffers = Self { buffers: read, firsts, decoded: Vec::new(), n_bytes };
        // Views do not share bytes, so all of them together decode to no more than the file could hold.
        let mut n_left = n_bytes;
        let fits: Vec<bool> = (document.buffer_views.iter())
            .map(|view| view.extensions.meshopt.as_deref().map_or(0, |view| view.byte_length))
            .map(|n_bytes| n_left.checked_sub(n_bytes).inspect(|left| n_left = *left).is_some())
            .collect();
        let decode = |index: usize| {
            let view = document.buffer_views[index].extensions.meshopt.as_deref()?;
            if !fits[index] {
                return Some(Err("compressed views share their bytes: export the model again".to_owned()));
            }
            let decoded = buffers.part(view.buffer, view.byte_offset, view.byte_length).and_then(|data| {
                meshopt::decode(data, view.mode, view.filter, view.count, view.byte_stride)
                    .ok_or_else(|| format!("compressed view {index} is damaged"))
            });
            Some(decoded)
        };
        buffers.decoded = (0..document.buffer_views.len()).into_par_iter().map(decode).collect();
        buffers
    }

    /// The bytes of a view, and their stride if it has one.
    pub(super) fn view(&self, document: &Document<'_>, index: usize) -> Result<(&[u8], Option<usize>), String> {
        let view = document.buffer_views.get(index).ok_or_else(|| format!("there is no buffer view {index}"))?;
        match (&self.decoded[index], view.extensions.meshopt.as_deref()) {
            (Some(decoded), Some(compressed)) => Ok((decoded.as_ref()?, Some(compressed.byte_stride))),
            _ => Ok((self.part(view.buffer, view.byte_offset, view.byte_length)?, view.byte_stride)),
        }
    }

    /// The bytes of a part of a buffer.
    pub(super) fn part(&self, buffer: usize, start: usize, n_bytes: usize) -> Result<&[u8], String> {
        let first = *self.firsts.get(buffer).ok_or_else(|| format!("there is no buffer {buffer}"))?;
        let bytes = self.buffers[first].as_ref()?;
        let end = start.saturating_add(n_bytes);
        bytes
            .get(start..end)
            .ok_or_else(|| format!("buffer {buffer} is cut short: it has {} bytes, and {end} are needed", bytes.len()))
    }
}

/// The bytes that a URI names: in itself, or in a file beside the model.
pub(super) fn bytes_of(uri: &str, companions: &Companions) -> Result<Vec<u8>, String> {
    match uri.strip_prefix("data:") {
        Some(data) => data_of(data),
        None => companions.read("", &file_name(uri), LONGEST_BUFFER),
    }
}

/// The bytes of a data URI after `data:`.
pub(super) fn data_of(data: &str) -> Result<Vec<u8>, String> {
    let (kind, data) = data.split_once(',').unwrap_or(("", ""));
    let bytes = kind.ends_with(";base64").then(|| base64(data.as_bytes())).flatten();
    bytes.ok_or_else(|| "a data URI is damaged: export the model again".to_owned())
}

/// The file that a URI names: `%20` stands for a space.
pub(super) fn file_name(uri: &str) -> String {
    let mut bytes = Vec::new();
    let mut rest = uri.as_bytes();
    while let Some((&byte, after)) = rest.split_first() {
        let hex = after.get(..2).and_then(|hex| u8::from_str_radix(str::from_utf8(hex).ok()?, 16).ok());
        match hex.filter(|_| byte == b'%') {
            Some(escaped) => {
                bytes.push(escaped);
                rest = &after[2..];
            }
            None => {
                bytes.push(byte);
                rest = after;
            }
        }
    }
    String::from_utf8(bytes).unwrap_or_else(|_| uri.to_owned())
}

fn base64(text: &[u8]) -> Option<Vec<u8>> {
    let mut bytes = Vec::with_capacity(text.len() / 4 * 3 + 3);
    let (mut bits, mut n_bits) = (0_u32, 0);
    for &letter in text.trim_ascii_end() {
        let value = match letter {
            b'A'..=b'Z' => letter - b'A',
            b'a'..=b'z' => letter - b'a' + 26,
            b'0'..=b'9' => letter - b'0' + 52,
            b'+' | b'-' => 62,
            b'/' | b'_' => 63,
            b'=' => break,
            _ => return None,
        };
        bits = bits << 6 | u32::from(value);
        n_bits += 6;
        if n_bits >= 8 {
            n_bits -= 8;
            bytes.push((bits >> n_bits) as u8);
        }
    }
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_and_names_are_decoded() {
        for (text, expected) in [("", ""), ("TQ==", "M"), ("TWE", "Ma"), ("TWFu\n", "Man")] {
            assert_eq!(data_of(&format!("application/octet-stream;base64,{text}")), Ok(expected.into()), "{text}");
        }
        assert!(data_of(";base64,T?").is_err() && data_of("text/plain,abc").is_err() && data_of("").is_err());
        assert_eq!(file_name("a%20b%C3%A4.bin"), "a b\u{e4}.bin");
        assert_eq!(file_name("100%.%zz%f"), "100%.%zz%f");
    }
}
