//! Messages over any byte stream: a socket, an encrypted channel ([`crate::secure`]), a test's pipe.

use std::{io, marker::PhantomData, net::SocketAddr, time::Duration};

use serde::{Serialize, de::DeserializeOwned};
use shared::{
    codec::{self, BodyKind, CONTROL_LIMIT, CodecError, HANDSHAKE_LIMIT, HEADER_BYTES, Header},
    protocol::{Chunk, PREAMBLE, PROTOCOL_VERSION, SECURE_PREAMBLE},
};
use tokio::{
    io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt},
    time::timeout,
};

/// Whether a connection's two ends are on one machine: it reaches itself on loopback, or from the address that it goes to.
pub fn is_same_machine(here: SocketAddr, peer: SocketAddr) -> bool {
    let [here, peer] = [here, peer].map(|address| address.ip().to_canonical());
    peer.is_loopback() || here == peer
}

/// The conversation fails.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum WireError {
    #[error("{0}")]
    Io(#[from] io::Error),
    #[error("{0}")]
    Codec(#[from] CodecError),
    #[error("the peer speaks another protocol")]
    NotRaywall,
    #[error("the peer speaks protocol {0}, this program speaks {PROTOCOL_VERSION}: build both from one commit")]
    OtherVersion(u8),
    #[error("the peer encrypts with a key, and this side was given none: give it the peer's key file with --key FILE")]
    Encrypted,
    #[error("the peer was silent for {} ms", .0.as_millis())]
    Silent(Duration),
}

/// A message that was read.
#[derive(Debug)]
pub enum Incoming<'a, M> {
    /// A control message.
    Control(M),
    /// Samples, unpacked, in the reader's buffer.
    Samples {
        /// The samples.
        chunk: Chunk<'a>,
        /// Bytes of the message on the wire.
        n_bytes: usize,
    },
    /// Bytes of a scene file, in the reader's buffer.
    FilePart(&'a [u8]),
}

/// Reads messages of type `M`.
#[derive(Debug)]
pub struct MessageReader<S, M> {
    stream: S,
    body: Vec<u8>,
    unpacked: Vec<u8>,
    /// The bytes of the next message's header that have arrived.
    next_header: [u8; HEADER_BYTES],
    n_next_header: usize,
    control_limit: usize,
    silence_limit: Duration,
    message: PhantomData<M>,
}

impl<S: AsyncRead + Unpin, M: DeserializeOwned> MessageReader<S, M> {
    /// Reads from `stream`, at first within a stranger's limits; silence for `silence_limit` is an error.
    pub fn new(stream: S, silence_limit: Duration) -> Self {
        Self {
            stream,
            body: Vec::new(),
            unpacked: Vec::new(),
            next_header: [0; HEADER_BYTES],
            n_next_header: 0,
            control_limit: HANDSHAKE_LIMIT,
            silence_limit,
            message: PhantomData,
        }
    }

    /// After the handshake: the peer may send messages of full size, and has a new `silence_limit`.
    pub fn raise_limits(&mut self, silence_limit: Duration) {
        self.control_limit = CONTROL_LIMIT;
        self.silence_limit = silence_limit;
    }

    /// Reads the peer's first bytes.
    pub async fn read_preamble(&mut self) -> Result<(), WireError> {
        let mut preamble = [0; PREAMBLE.len()];
        // Another program may send less than this and wait, so the first wrong byte is an error.
        for at in 0..preamble.len() {
            self.fill(&mut preamble[at..=at]).await?;
            let is_version = at + 1 == preamble.len();
            if preamble[at] != PREAMBLE[at] {
                return Err(match preamble[at] {
                    version if is_version => WireError::OtherVersion(version),
                    _ if preamble[..=at] == SECURE_PREAMBLE[..=at] => WireError::Encrypted,
                    _ => WireError::NotRaywall,
                });
            }
        }
        Ok(())
    }

    /// Reads the next message; `None` if the peer has closed the stream between two messages.
    pub async fn read(&mut self) -> Result<Option<Incoming<'_, M>>, WireError> {
        let mut header = self.next_header;
        let mut n_read = std::mem::take(&mut self.n_next_header);
        if n_read == 0 {
            n_read = self.read_some(&mut header).await?;
            if n_read == 0 {
                return Ok(None);
            }
        }
        self.fill(&mut header[n_read..]).await?;
        let Header { kind, n_bytes } = Header::parse(header, self.control_limit)?;
        let mut body = std::mem::take(&mut self.body);
        // The buffer never shrinks, so that no bytes are cleared before each read.
        body.resize(body.len().max(n_bytes + HEADER_BYTES), 0);
        self.n_next_header = self.fill_with_lookahead(&mut body[..n_bytes + HEADER_BYTES], n_bytes).await?;
        self.next_header.copy_from_slice(&body[n_bytes..n_bytes + HEADER_BYTES]);
        self.body = body;
        let body = &self.body[..n_bytes];
        Ok(Some(match kind {
            BodyKind::Control => Incoming::Control(codec::decode(body)?),
            BodyKind::Samples(encoding) => {
                let chunk = Chunk::decode(body)?.unpack(encoding, &mut self.unpacked)?;
                Incoming::Samples { chunk, n_bytes: HEADER_BYTES + n_bytes }
            }
            BodyKind::FilePart => Incoming::FilePart(body),
        }))
    }

    /// Whether the next message has begun to arrive.
    pub fn has_more(&self) -> bool {
        self.n_next_header > 0
    }

    /// Fills `bytes`. Slowness is no error, silence is.
    async fn fill(&mut self, mut bytes: &mut [u8]) -> Result<(), WireError> {
        while !bytes.is_empty() {
            let n_read = self.read_some(bytes).await?;
            if n_read == 0 {
                return Err(truncated());
            }
            bytes = &mut bytes[n_read..];
        }
        Ok(())
    }

    /// Fills the first `n_needed` bytes, and more if they have arrived; returns the number of the latter.
    async fn fill_with_lookahead(&mut self, bytes: &mut [u8], n_needed: usize) -> Result<usize, WireError> {
        let mut n_filled = 0;
        while n_filled < n_needed {
            let n_read = self.read_some(&mut bytes[n_filled..]).await?;
            if n_read == 0 {
                return Err(truncated());
            }
            n_filled += n_read;
        }
        Ok(n_filled - n_needed)
    }

    async fn read_some(&mut self, bytes: &mut [u8]) -> Result<usize, WireError> {
        let silent = |_| WireError::Silent(self.silence_limit);
        Ok(timeout(self.silence_limit, self.stream.read(bytes)).await.map_err(silent)??)
    }
}

fn truncated() -> WireError {
    io::Error::new(io::ErrorKind::UnexpectedEof, "the connection closed in mid-message").into()
}

/// A message of this size is written at once: copying it behind others would cost as much as a system call.
const DIRECT_WRITE_BYTES: usize = 8 * 1024;

/// Writes messages.
#[derive(Debug)]
pub struct MessageWriter<S> {
    stream: S,
    out: Vec<u8>,
}

impl<S: AsyncWrite + Unpin> MessageWriter<S> {
    /// Writes to `stream`, the preamble first.
    pub fn new(stream: S) -> Self {
        Self { stream, out: PREAMBLE.to_vec() }
    }

    /// Queues a control message.
    pub fn push(&mut self, message: &impl Serialize) -> Result<(), CodecError> {
        codec::encode(message, &mut self.out)
    }

    /// Queues an encoded message.
    pub fn push_encoded(&mut self, bytes: &[u8]) {
        self.out.extend_from_slice(bytes);
    }

    /// Queues an encoded message if it is short; else sends the queue and then the message, without copying it.
    pub async fn write_encoded(&mut self, bytes: &[u8]) -> io::Result<()> {
        if bytes.len() < DIRECT_WRITE_BYTES {
            self.push_encoded(bytes);
            return Ok(());
        }
        self.stream.write_all(&self.out).await?;
        self.out.clear();
        self.stream.write_all(bytes).await
    }

    /// Sends the queue; returns its number of bytes.
    pub async fn flush(&mut self) -> io::Result<usize> {
        self.stream.write_all(&self.out).await?;
        self.stream.flush().await?;
        let n_bytes = self.out.len();
        self.out.clear();
        Ok(n_bytes)
    }

    /// Queues and sends one control message.
    pub async fn send(&mut self, message: &impl Serialize) -> Result<usize, WireError> {
        self.push(message)?;
        Ok(self.flush().await?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_machine_is_known_by_loopback_and_by_its_own_address() {
        let is_same = |here: &str, peer: &str| is_same_machine(here.parse().unwrap(), peer.parse().unwrap());
        assert!(is_same("127.0.0.1:7117", "127.0.0.1:40000") && is_same("[::1]:7117", "[::1]:40000"));
        assert!(is_same("192.0.2.1:7117", "192.0.2.1:40000"));
        assert!(is_same("[::ffff:192.0.2.1]:7117", "192.0.2.1:40000"));
        assert!(!is_same("192.0.2.1:7117", "192.0.2.2:7117"));
    }
}
