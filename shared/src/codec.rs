//! Messages as bytes.
//!
//! | bytes | content |
//! |---|---|
//! | 4 | length of the body, little endian |
//! | 1 | kind: 0 control, 1 samples, 2 samples as an LZ4 block |
//! | … | body |
//!
//! The body of samples is frame (8 bytes), task (4), first unit (4), number of units (4), all little endian, then RGB, or
//! an LZ4 block of it.
//! A reader takes the five bytes of the [`Header`] first and checks the size before it allocates anything.

use serde::{Serialize, de::DeserializeOwned};

use crate::{
    printable::counted,
    protocol::{CHUNK_BYTES, Chunk, Encoding, FrameId, TaskId},
};

/// Bytes of a [`Header`].
pub const HEADER_BYTES: usize = 5;

/// Bytes of a chunk's body before its samples.
pub const CHUNK_HEADER_BYTES: usize = 20;

/// The largest body before the handshake is accepted: it bounds the memory that a stranger can take.
pub const HANDSHAKE_LIMIT: usize = 1024;

/// The largest body of a control message after the handshake: the costs of the largest task fit.
pub const CONTROL_LIMIT: usize = 256 * 1024;

/// The largest body of samples.
pub const CHUNK_LIMIT: usize = CHUNK_HEADER_BYTES + CHUNK_BYTES;

/// The bytes are not a message.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum CodecError {
    #[error("a message of {n_bytes} bytes: at most {limit} are allowed")]
    TooLong { n_bytes: usize, limit: usize },
    // Or of one that is not allowed yet.
    #[error("a message of unknown kind {0}")]
    UnknownKind(u8),
    #[error("a malformed message: {0}")]
    Malformed(#[from] bincode::error::DecodeError),
    #[error("a message with {} too many", counted(.0, "byte"))]
    Trailing(usize),
    #[error("a chunk of {0} bytes: too short for its header")]
    ShortChunk(usize),
    // Or that unpack to more than a chunk.
    #[error("samples that do not unpack: {0}")]
    Unpack(#[from] lz4_flex::block::DecompressError),
}

/// The kind of a body.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BodyKind {
    /// A bincode message.
    Control,
    /// A [`Chunk`], its samples encoded.
    Samples(Encoding),
    /// Bytes of a scene file.
    FilePart,
}

/// The bytes before each body.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// Kind of the body.
    pub kind: BodyKind,
    /// Bytes of the body.
    pub n_bytes: usize,
}

impl Header {
    /// Reads a header and checks its length: against `control_limit`, or [`CHUNK_LIMIT`] for samples.
    ///
    /// Samples and parts of files are refused while `control_limit` is [`HANDSHAKE_LIMIT`]: nobody has asked for any yet.
    pub fn parse(bytes: [u8; HEADER_BYTES], control_limit: usize) -> Result<Self, CodecError> {
        let [length @ .., kind] = bytes;
        let n_bytes = u32::from_le_bytes(length) as usize;
        let (kind, limit) = match kind {
            0 => (BodyKind::Control, control_limit),
            1 if control_limit > HANDSHAKE_LIMIT => (BodyKind::Samples(Encoding::Raw), CHUNK_LIMIT),
            2 if control_limit > HANDSHAKE_LIMIT => (BodyKind::Samples(Encoding::Lz4), CHUNK_LIMIT),
            3 if control_limit > HANDSHAKE_LIMIT => (BodyKind::FilePart, CHUNK_BYTES),
            unknown => return Err(CodecError::UnknownKind(unknown)),
        };
        if n_bytes > limit {
            return Err(CodecError::TooLong { n_bytes, limit });
        }
        Ok(Self { kind, n_bytes })
    }

    fn write(kind: BodyKind, n_bytes: usize, out: &mut Vec<u8>) {
        let length = u32::try_from(n_bytes).expect("every body is below its limit");
        out.extend(length.to_le_bytes());
        out.push(match kind {
            BodyKind::Control => 0,
            BodyKind::Samples(Encoding::Raw) => 1,
            BodyKind::Samples(Encoding::Lz4) => 2,
            BodyKind::FilePart => 3,
        });
    }
}

/// The bytes of anything that [`from_bytes`] reads.
pub fn to_bytes(record: &impl Serialize) -> Vec<u8> {
    bincode::serde::encode_to_vec(record, bincode::config::standard()).expect("bincode can write every message")
}

/// Reads what [`to_bytes`] has written, with at most `LIMIT` bytes of memory for each list in it.
///
/// # Errors
/// The bytes are no such record, or more follow.
pub fn from_bytes<M: DeserializeOwned, const LIMIT: usize>(bytes: &[u8]) -> Result<M, CodecError> {
    let config = bincode::config::standard().with_limit::<LIMIT>();
    let (record, n_read) = bincode::serde::decode_from_slice(bytes, config)?;
    match bytes.len() - n_read {
        0 => Ok(record),
        n_trailing => Err(CodecError::Trailing(n_trailing)),
    }
}

/// Appends a control message with its header.
///
/// # Errors
/// The message is longer than [`CONTROL_LIMIT`]; `out` is unchanged.
pub fn encode(message: &impl Serialize, out: &mut Vec<u8>) -> Result<(), CodecError> {
    let body = to_bytes(message);
    if body.len() > CONTROL_LIMIT {
        return Err(CodecError::TooLong { n_bytes: body.len(), limit: CONTROL_LIMIT });
    }
    Header::write(BodyKind::Control, body.len(), out);
    out.extend(body);
    Ok(())
}

/// Appends bytes of a scene file, at most [`CHUNK_BYTES`], with their header.
pub fn encode_file_part(bytes: &[u8], out: &mut Vec<u8>) {
    Header::write(BodyKind::FilePart, bytes.len(), out);
    out.extend(bytes);
}

/// Reads the body of a control message.
pub fn decode<M: DeserializeOwned>(body: &[u8]) -> Result<M, CodecError> {
    from_bytes::<M, CONTROL_LIMIT>(body)
}

impl<'a> Chunk<'a> {
    /// Appends the chunk with its header. Samples that do not shrink are sent raw.
    pub fn encode(&self, encoding: Encoding, out: &mut Vec<u8>) {
        let packed = match encoding {
            Encoding::Raw => None,
            Encoding::Lz4 => Some(lz4_flex::block::compress(self.rgb)).filter(|packed| packed.len() < self.rgb.len()),
        };
        let (encoding, samples) = packed.as_deref().map_or((Encoding::Raw, self.rgb), |packed| (encoding, packed));
        Header::write(BodyKind::Samples(encoding), CHUNK_HEADER_BYTES + samples.len(), out);
        out.extend(self.frame.0.to_le_bytes());
        for number in [self.task_id.0, self.first_unit, self.n_units] {
            out.extend(number.to_le_bytes());
        }
        out.extend(samples);
    }

    /// The same chunk with its samples unpacked into `buffer`, which grows to [`CHUNK_BYTES`] at most.
    ///
    /// # Errors
    /// The samples are not an LZ4 block of at most [`CHUNK_BYTES`].
    pub fn unpack<'b>(&self, encoding: Encoding, buffer: &'b mut Vec<u8>) -> Result<Chunk<'b>, CodecError>
    where
        'a: 'b,
    {
        let rgb = match encoding {
            Encoding::Raw => self.rgb,
            Encoding::Lz4 => {
                buffer.resize(CHUNK_BYTES, 0);
                let n_bytes = lz4_flex::block::decompress_into(self.rgb, buffer)?;
                &buffer[..n_bytes]
            }
        };
        Ok(Chunk { rgb, ..*self })
    }

    /// Reads the body of samples without copying them.
    pub fn decode(body: &'a [u8]) -> Result<Self, CodecError> {
        let short = || CodecError::ShortChunk(body.len());
        let (frame, rest) = body.split_first_chunk().ok_or_else(short)?;
        let (task_id, rest) = rest.split_first_chunk().ok_or_else(short)?;
        let (first_unit, rest) = rest.split_first_chunk().ok_or_else(short)?;
        let (n_units, rgb) = rest.split_first_chunk().ok_or_else(short)?;
        Ok(Self {
            frame: FrameId(u64::from_le_bytes(*frame)),
            task_id: TaskId(u32::from_le_bytes(*task_id)),
            first_unit: u32::from_le_bytes(*first_unit),
            n_units: u32::from_le_bytes(*n_units),
            rgb,
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{
        appearance::Appearance,
        camera::Camera,
        detail::Detail,
        division::{Division, FrameSize},
        protocol::{FrameSpec, LightingMode, RunCosts, SampleRange, ShadingMode, TaskTimings, ToServer, ToWall},
        scene::SceneId,
    };

    fn render_frame() -> ToServer {
        let camera = Camera::look_at(glam::DVec3::Z, glam::DVec3::ZERO, glam::DVec3::Y, 0.7, 16.0 / 9.0).unwrap();
        let spec = FrameSpec {
            scene: SceneId::Mesh { blake3: [7; 32], treatment: Default::default() },
            camera,
            size: FrameSize::PAPER,
            view: ShadingMode::Shaded,
            rays: LightingMode::Shadows,
            samples: SampleRange::CENTRE,
            detail: Detail::FULL,
            appearance: Appearance::default(),
        };
        ToServer::RenderFrame {
            frame: FrameId(9),
            task_id: TaskId(3),
            spec,
            task: Division::Tiled.task(2, 12),
            encoding: Encoding::Lz4,
        }
    }

    #[test]
    fn a_message_comes_out_as_it_went_in() {
        let mut bytes = vec![];
        encode(&render_frame(), &mut bytes).unwrap();
        let (header, body) = bytes.split_first_chunk().unwrap();
        assert_eq!(
            Header::parse(*header, CONTROL_LIMIT).unwrap(),
            Header { kind: BodyKind::Control, n_bytes: body.len() }
        );
        assert_eq!(decode::<ToServer>(body).unwrap(), render_frame());
    }

    #[test]
    fn a_chunk_is_a_header_and_its_bytes() {
        let chunk = Chunk { frame: FrameId(1), task_id: TaskId(2), first_unit: 3, n_units: 1, rgb: &[10, 20, 30] };
        let mut bytes = vec![];
        chunk.encode(Encoding::Raw, &mut bytes);
        assert_eq!(
            bytes,
            [23, 0, 0, 0, 1, 1, 0, 0, 0, 0, 0, 0, 0, 2, 0, 0, 0, 3, 0, 0, 0, 1, 0, 0, 0, 10, 20, 30],
            "the layout is part of the protocol's version"
        );
        assert_eq!(Chunk::decode(&bytes[HEADER_BYTES..]).unwrap(), chunk);
    }

    #[test]
    fn the_costs_of_the_largest_task_fit_a_message() {
        let task = Division::Dynamic.task(0, 1);
        let share = task
            .share(FrameSize::new(FrameSize::LARGEST, FrameSize::MOST_SAMPLES / FrameSize::LARGEST).unwrap())
            .unwrap();
        let (n_units, run_units) = (share.count(), RunCosts::run_units(&share));
        let cpu_ns = vec![u32::MAX; n_units.div_ceil(run_units) as usize];
        let costs = RunCosts { run_units, cpu_ns };
        assert!(costs.fits(n_units) && !costs.fits(n_units - run_units) && !costs.fits(n_units + 1));
        let (frame, task_id, timings) = (FrameId(u64::MAX), TaskId(u32::MAX), TaskTimings::default());
        let done = ToWall::TaskDone { frame, task_id, timings, costs };
        let mut bytes = vec![];
        encode(&done, &mut bytes).unwrap();
        assert_eq!(decode::<ToWall>(&bytes[HEADER_BYTES..]).unwrap(), done);
    }

    #[test]
    fn costs_that_do_not_fit_are_told_apart() {
        assert!(RunCosts::default().fits(0) && RunCosts::default().fits(9));
        let costs = |run_units, n_runs| RunCosts { run_units, cpu_ns: vec![1; n_runs] };
        assert!(costs(4, 3).fits(9) && !costs(4, 2).fits(9) && !costs(4, 4).fits(9) && !costs(0, 1).fits(9));
        let runs: Vec<_> = costs(4, 3).runs(9).map(|(units, _)| units).collect();
        assert_eq!(runs, [0..4, 4..8, 8..9]);
        assert_eq!(costs(u32::MAX, 1).runs(9).next(), Some((0..9, 1)));
    }

    #[test]
    fn sizes_are_refused_before_anything_is_allocated() {
        let header = |n_bytes: u32, kind: u8| {
            let [a, b, c, d] = n_bytes.to_le_bytes();
            [a, b, c, d, kind]
        };
        assert!(Header::parse(header(1024, 0), HANDSHAKE_LIMIT).is_ok());
        assert!(matches!(Header::parse(header(1025, 0), HANDSHAKE_LIMIT), Err(CodecError::TooLong { .. })));
        assert!(matches!(Header::parse(header(10, 1), HANDSHAKE_LIMIT), Err(CodecError::UnknownKind(1))));
        assert!(matches!(Header::parse(header(u32::MAX, 1), CONTROL_LIMIT), Err(CodecError::TooLong { .. })));
        assert!(matches!(Header::parse(header(0, 4), CONTROL_LIMIT), Err(CodecError::UnknownKind(4))));
    }

    #[test]
    fn a_camera_that_makes_no_rays_is_no_message() {
        let mut bytes = vec![];
        encode(&render_frame(), &mut bytes).unwrap();
        let body = &mut bytes[HEADER_BYTES..];
        let eye_z = body.windows(8).position(|window| window == 1f64.to_le_bytes()).unwrap();
        body[eye_z..eye_z + 8].copy_from_slice(&f64::NAN.to_le_bytes());
        assert!(matches!(decode::<ToServer>(body), Err(CodecError::Malformed(_))));
    }

    #[test]
    fn a_frame_or_a_statue_that_fills_the_memory_is_no_message() {
        let is_message = |message: &ToServer| {
            let mut bytes = vec![];
            encode(message, &mut bytes).unwrap();
            decode::<ToServer>(&bytes[HEADER_BYTES..]).is_ok()
        };
        for (triangles, fits) in [(SceneId::LARGEST_STATUE, true), (SceneId::LARGEST_STATUE + 1, false)] {
            let scene = SceneId::Statue { triangles, treatment: Default::default() };
            assert_eq!(
                is_message(&ToServer::LoadScene { scene, path: None, structure: None, sky: None }),
                fits,
                "{triangles}"
            );
        }
        // Crease and precision are the bytes after the last of the hash.
        let mut bytes = vec![];
        let scene = SceneId::Mesh { blake3: [7; 32], treatment: Default::default() };
        encode(&ToServer::LoadScene { scene, path: None, structure: None, sky: None }, &mut bytes).unwrap();
        let body = &mut bytes[HEADER_BYTES..];
        let crease = body.iter().rposition(|&byte| byte == 7).unwrap() + 1;
        for (treatment, fits) in [([0, 0], true), ([180, 8], true), ([0, 21], true), ([181, 0], false), ([0, 7], false)]
        {
            body[crease..crease + 2].copy_from_slice(&treatment);
            assert_eq!(decode::<ToServer>(body).is_ok(), fits, "{treatment:?}");
        }
        assert!(FrameSize::new(38_400, 2160).is_ok() && FrameSize::new(65_536, 4096).is_ok());
        for (xres, yres) in [(65_536, 4097), (65_537, 1), (65_536, 65_536), (u32::MAX, u32::MAX)] {
            assert!(FrameSize::new(xres, yres).is_err(), "{xres}×{yres}");
        }
    }

    #[test]
    fn a_pixel_of_endless_samples_is_no_message() {
        for (count, is_message) in [(0, false), (1, true), (256, true), (257, false), (u32::MAX, false)] {
            let mut bytes = vec![];
            let ToServer::RenderFrame { frame, task_id, spec, task, encoding } = render_frame() else { unreachable!() };
            let spec = FrameSpec { samples: SampleRange::all(0, count), ..spec };
            encode(&ToServer::RenderFrame { frame, task_id, spec, task, encoding }, &mut bytes).unwrap();
            assert_eq!(decode::<ToServer>(&bytes[HEADER_BYTES..]).is_ok(), is_message, "{count}");
        }
    }

    proptest! {
        #[test]
        fn random_bytes_never_panic(body in proptest::collection::vec(any::<u8>(), 0..600)) {
            let _ = decode::<ToServer>(&body);
            let _ = decode::<ToWall>(&body);
            let _ = Chunk::decode(&body).map(|chunk| {
                let mut buffer = Vec::new();
                let _ = chunk.unpack(Encoding::Lz4, &mut buffer);
                assert!(buffer.capacity() <= CHUNK_BYTES);
            });
        }

        #[test]
        fn encoded_samples_come_out_as_they_went_in(
            noise in proptest::collection::vec(any::<u8>(), 0..3000), repeats in 1..20usize, cut in any::<proptest::sample::Index>(),
        ) {
            let rgb = noise.repeat(repeats);
            let chunk = Chunk { frame: FrameId(1), task_id: TaskId(2), first_unit: 3, n_units: 4, rgb: &rgb };
            for encoding in [Encoding::Raw, Encoding::Lz4] {
                let mut bytes = vec![];
                chunk.encode(encoding, &mut bytes);
                prop_assert!(bytes.len() <= HEADER_BYTES + CHUNK_HEADER_BYTES + rgb.len(), "never longer");
                let (header, body) = bytes.split_first_chunk().unwrap();
                let Header { kind: BodyKind::Samples(encoding), n_bytes } = Header::parse(*header, CONTROL_LIMIT).unwrap() else {
                    panic!("samples are samples");
                };
                prop_assert_eq!(n_bytes, body.len());
                let mut buffer = Vec::new();
                prop_assert_eq!(Chunk::decode(body).unwrap().unpack(encoding, &mut buffer).unwrap(), chunk);
                // A cut block may fail to unpack, but must not panic.
                let cut = CHUNK_HEADER_BYTES + cut.index(body.len() - CHUNK_HEADER_BYTES + 1);
                let _ = Chunk::decode(&body[..cut]).unwrap().unpack(encoding, &mut buffer);
            }
        }

        #[test]
        fn a_block_that_unpacks_to_more_than_a_chunk_is_refused(n_bytes in CHUNK_BYTES - 3..CHUNK_BYTES + 1000) {
            let packed = lz4_flex::block::compress(&vec![7; n_bytes]);
            let chunk = Chunk { frame: FrameId(1), task_id: TaskId(2), first_unit: 3, n_units: 4, rgb: &packed };
            let mut buffer = Vec::new();
            prop_assert_eq!(chunk.unpack(Encoding::Lz4, &mut buffer).is_ok(), n_bytes <= CHUNK_BYTES);
            prop_assert!(buffer.capacity() <= CHUNK_BYTES);
        }
    }
}
