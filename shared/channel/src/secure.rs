//! An encrypted and mutually authenticated channel between two machines that hold copies of one [`Key`].
//!
//! It lies beneath the conversation of [`crate::wire`], which is the same with and without it. The handshake is Noise
//! (revision 34) with the pattern `NNpsk0`:
//!
//! | from | bytes | content |
//! |---|---|---|
//! | both | 8 | [`SECURE_PREAMBLE`], the prologue of the handshake |
//! | render server | 48 | ephemeral public key, tag |
//! | wall | 48 | ephemeral public key, tag |
//! | render server | 16 | tag with the new keys, which no recording can contain |
//! | both | … | records: length (2, little endian), at most [`RECORD_BYTES`] sealed bytes, tag (16) |
//!
//! Reasons for this pattern and these ciphers:
//! - One key file for all machines: nodes of a farm come and go, and a list of their public keys would have to follow.
//! - `psk0` instead of a later place: a stranger fails at the tag of its first message, which costs the wall a few hashes
//!   and no curve arithmetic. A recorded first message gets the wall's answer, and fails at the last tag.
//! - AES-256-GCM through ring seals and opens about seven times the bytes of the pure Rust ciphers on one core, and the
//!   wall opens the records of all nodes. Nonces are counted and never repeat; one connection stays far below the cipher's
//!   limit of bytes for a key.
//!
//! A recording stays secret even if the key is stolen later, and a cut connection completes no answer, because each marks
//! its own end. ARCHITECTURE.md ("Trust") has the other guarantees, and the limits.

mod records;

use std::{io, sync::Arc};

use shared::protocol::{PREAMBLE, PROTOCOL_VERSION, SECURE_PREAMBLE};
use snow::{Builder, HandshakeState, StatelessTransportState};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};

pub use self::records::{RECORD_BYTES, RecordReader, RecordWriter};
use crate::key::Key;

const NOISE: &str = "Noise_NNpsk0_25519_AESGCM_SHA256";

const TAG_BYTES: usize = 16;

/// Bytes of either handshake message: an X25519 public key and the tag of an empty payload.
const HANDSHAKE_BYTES: usize = 32 + TAG_BYTES;

/// The nonce of the render server's last tag in the handshake; its records continue from here.
const PROOF_NONCE: u64 = 0;

/// The handshake fails.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum SecureError {
    #[error("{0}")]
    Io(#[from] io::Error),
    #[error("the peer closed the connection in the handshake")]
    Closed,
    #[error("the peer speaks another protocol")]
    NotRaywall,
    #[error("the peer has no key, and this side has one: start the peer with a copy of it, --key FILE")]
    NoKey,
    #[error("the peer speaks protocol {0}, this program speaks {PROTOCOL_VERSION}: build both from one commit")]
    OtherVersion(u8),
    #[error("the peer has another key: start both sides with --key and copies of one key file")]
    OtherKey,
    // It closed the connection after this side's first message with its key.
    #[error("the peer refuses this side's key: start both sides with --key and copies of one key file")]
    Refused,
    #[error(
        "the peer replays another machine's handshake and does not have the key: look for an attacker in the network"
    )]
    Replayed,
    #[error("the handshake fails: {0}")]
    Noise(snow::Error),
}

/// The encrypted halves of a connection.
pub type Channel<R, W> = (RecordReader<R>, RecordWriter<W>);

/// Makes a channel for the side that connects, the render server. The caller sets a time limit.
///
/// # Errors
/// The peer does not have the key, or the stream fails.
pub async fn connect<R, W>(mut input: R, mut output: W, key: &Key) -> Result<Channel<R, W>, SecureError>
where
    R: AsyncRead + Unpin,
    W: AsyncWrite + Unpin,
{
    let mut handshake = builder(key)?.build_initiator().map_err(SecureError::Noise)?;
    let mut opening = [0; SECURE_PREAMBLE.len() + HANDSHAKE_BYTES];
    let (preamble, message) = opening.split_at_mut(SECURE_PREAMBLE.len());
    preamble.copy_from_slice(&SECURE_PREAMBLE);
    handshake.write_message(&[], message).map_err(SecureError::Noise)?;
    send(&mut output, &opening).await?;
    read_preamble(&mut input).await?;
    let answer: [u8; HANDSHAKE_BYTES] = read(&mut input).await.map_err(|error| match error {
        SecureError::Closed => SecureError::Refused,
        error => error,
    })?;
    read_handshake(&mut handshake, &answer)?;
    let transport = handshake.into_stateless_transport_mode().map_err(SecureError::Noise)?;
    let mut proof = [0; TAG_BYTES];
    transport.write_message(PROOF_NONCE, &[], &mut proof).map_err(SecureError::Noise)?;
    send(&mut output, &proof).await?;
    let transport = Arc::new(transport);
    let reader = RecordReader::new(input, Arc::clone(&transport), PROOF_NONCE);
    Ok((reader, RecordWriter::new(output, transport, PROOF_NONCE + 1)))
}

/// Makes a channel for the side that accepts, the wall. The caller sets a time limit.
///
/// Before the peer has proved that it has the key, it can send 72 bytes and costs a few KB.
///
/// # Errors
/// The peer does not have the key, or the stream fails.
pub async fn accept<R, W>(mut input: R, mut output: W, key: &Key) -> Result<Channel<R, W>, SecureError>
where
    R: AsyncRead + Unpin,
    W: AsyncWrite + Unpin,
{
    // Sent first, so that a peer without a key or of another version can report it.
    send(&mut output, &SECURE_PREAMBLE).await?;
    read_preamble(&mut input).await?;
    let greeting: [u8; HANDSHAKE_BYTES] = read(&mut input).await?;
    let transport = answer(&mut output, &greeting, key).await?;
    let proof: [u8; TAG_BYTES] = read(&mut input).await?;
    let mut empty_payload = [0; TAG_BYTES];
    transport.read_message(PROOF_NONCE, &proof, &mut empty_payload).map_err(|_| SecureError::Replayed)?;
    let transport = Arc::new(transport);
    let reader = RecordReader::new(input, Arc::clone(&transport), PROOF_NONCE + 1);
    Ok((reader, RecordWriter::new(output, transport, PROOF_NONCE)))
}

async fn answer(
    output: &mut (impl AsyncWrite + Unpin),
    greeting: &[u8],
    key: &Key,
) -> Result<StatelessTransportState, SecureError> {
    let mut handshake = builder(key)?.build_responder().map_err(SecureError::Noise)?;
    read_handshake(&mut handshake, greeting)?;
    let mut message = [0; HANDSHAKE_BYTES];
    handshake.write_message(&[], &mut message).map_err(SecureError::Noise)?;
    let transport = handshake.into_stateless_transport_mode().map_err(SecureError::Noise)?;
    send(output, &message).await?;
    Ok(transport)
}

fn builder(key: &Key) -> Result<Builder<'_>, SecureError> {
    let parameters = NOISE.parse().map_err(SecureError::Noise)?;
    let builder = Builder::new(parameters).prologue(&SECURE_PREAMBLE).map_err(SecureError::Noise)?;
    builder.psk(0, key.bytes()).map_err(SecureError::Noise)
}

/// Reads a handshake message; one that does not decrypt was made with another key.
fn read_handshake(handshake: &mut HandshakeState, message: &[u8]) -> Result<(), SecureError> {
    let mut empty_payload = [0; HANDSHAKE_BYTES];
    handshake.read_message(message, &mut empty_payload).map_err(|_| SecureError::OtherKey)?;
    Ok(())
}

/// Reads byte by byte, because another program may send less and wait.
async fn read_preamble(input: &mut (impl AsyncRead + Unpin)) -> Result<(), SecureError> {
    for (at, expected) in SECURE_PREAMBLE.into_iter().enumerate() {
        let [byte] = read(input).await?;
        if byte != expected {
            return Err(match byte {
                version if at + 1 == SECURE_PREAMBLE.len() => SecureError::OtherVersion(version),
                // The two preambles are equal up to here.
                byte if at == 3 && byte == PREAMBLE[3] => SecureError::NoKey,
                _ => SecureError::NotRaywall,
            });
        }
    }
    Ok(())
}

async fn read<const N: usize>(input: &mut (impl AsyncRead + Unpin)) -> Result<[u8; N], SecureError> {
    let mut bytes = [0; N];
    input.read_exact(&mut bytes).await.map_err(|error| match error.kind() {
        io::ErrorKind::UnexpectedEof | io::ErrorKind::ConnectionReset => SecureError::Closed,
        _ => SecureError::Io(error),
    })?;
    Ok(bytes)
}

async fn send(output: &mut (impl AsyncWrite + Unpin), bytes: &[u8]) -> Result<(), SecureError> {
    output.write_all(bytes).await?;
    Ok(output.flush().await?)
}

#[cfg(test)]
mod tests;
