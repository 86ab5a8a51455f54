//! Byte streams over sealed records: bytes written at one end are read unchanged at the other, or not at all.

use std::{
    fmt, io,
    ops::Range,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll, ready},
};

use snow::StatelessTransportState;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

use super::TAG_BYTES;

/// The most bytes in one record. A record opens only when it is complete, which takes 130 ms at 1 Mbit/s: with records of
/// 64 KB, the most in Noise, the peer on a slow link would seem silent.
pub const RECORD_BYTES: usize = 16 * 1024;

/// Bytes before each record: its length.
const LENGTH_BYTES: usize = 2;

/// The largest record as it is on the wire.
const SEALED_BYTES: usize = LENGTH_BYTES + RECORD_BYTES + TAG_BYTES;

/// Records that are sent or received with one system call.
const BATCH: usize = 4;

/// The reading half of a channel.
pub struct RecordReader<R> {
    stream: R,
    transport: Arc<StatelessTransportState>,
    next_nonce: u64,
    /// Bytes from the stream; the range is not opened yet.
    sealed: Box<[u8]>,
    unopened: Range<usize>,
    /// One opened record; the range is not read yet.
    opened: Box<[u8]>,
    unread: Range<usize>,
}

impl<R> RecordReader<R> {
    pub(super) fn new(stream: R, transport: Arc<StatelessTransportState>, next_nonce: u64) -> Self {
        Self {
            stream,
            transport,
            next_nonce,
            sealed: vec![0; BATCH * SEALED_BYTES].into(),
            unopened: 0..0,
            opened: vec![0; RECORD_BYTES + TAG_BYTES].into(),
            unread: 0..0,
        }
    }

    /// Opens the next record; false if it has not arrived completely.
    fn open_record(&mut self) -> io::Result<bool> {
        let sealed = &self.sealed[self.unopened.clone()];
        let Some((&length, rest)) = sealed.split_first_chunk::<LENGTH_BYTES>() else { return Ok(false) };
        let n_bytes = usize::from(u16::from_le_bytes(length));
        if n_bytes <= TAG_BYTES || n_bytes > RECORD_BYTES + TAG_BYTES {
            return Err(foreign_record());
        }
        let Some(record) = rest.get(..n_bytes) else { return Ok(false) };
        let n_opened =
            self.transport.read_message(self.next_nonce, record, &mut self.opened).map_err(|_| foreign_record())?;
        self.next_nonce += 1;
        self.unopened.start += LENGTH_BYTES + n_bytes;
        self.unread = 0..n_opened;
        Ok(true)
    }
}

impl<R: AsyncRead + Unpin> AsyncRead for RecordReader<R> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let this = &mut *self;
        while this.unread.is_empty() && buffer.remaining() > 0 {
            if this.open_record()? {
                break;
            }
            // Move the incomplete record to the front, to make room for its rest.
            this.sealed.copy_within(this.unopened.clone(), 0);
            this.unopened = 0..this.unopened.len();
            let mut more = ReadBuf::new(&mut this.sealed[this.unopened.end..]);
            ready!(Pin::new(&mut this.stream).poll_read(context, &mut more))?;
            let n_more = more.filled().len();
            if n_more == 0 {
                return Poll::Ready(if this.unopened.is_empty() { Ok(()) } else { Err(cut_record()) });
            }
            this.unopened.end += n_more;
        }
        let n_read = this.unread.len().min(buffer.remaining());
        buffer.put_slice(&this.opened[this.unread.start..][..n_read]);
        this.unread.start += n_read;
        Poll::Ready(Ok(()))
    }
}

/// The writing half of a channel. Bytes are sealed at once; only a flush is sure to send them.
pub struct RecordWriter<W> {
    stream: W,
    transport: Arc<StatelessTransportState>,
    next_nonce: u64,
    /// Sealed records; the range is not sent yet.
    sealed: Box<[u8]>,
    unsent: Range<usize>,
}

impl<W> RecordWriter<W> {
    pub(super) fn new(stream: W, transport: Arc<StatelessTransportState>, next_nonce: u64) -> Self {
        Self { stream, transport, next_nonce, sealed: vec![0; BATCH * SEALED_BYTES].into(), unsent: 0..0 }
    }

    /// Seals one record after the unsent ones.
    fn seal_record(&mut self, bytes: &[u8]) -> io::Result<()> {
        let (length, sealed) = self.sealed[self.unsent.end..].split_at_mut(LENGTH_BYTES);
        // Fails only after 2⁶⁴ records, more than a machine can send in its life.
        let n_bytes = self.transport.write_message(self.next_nonce, bytes, sealed).map_err(io::Error::other)?;
        self.next_nonce += 1;
        length.copy_from_slice(&(n_bytes as u16).to_le_bytes());
        self.unsent.end += LENGTH_BYTES + n_bytes;
        Ok(())
    }
}

impl<W: AsyncWrite + Unpin> RecordWriter<W> {
    fn poll_send(&mut self, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        while !self.unsent.is_empty() {
            let n_sent = ready!(Pin::new(&mut self.stream).poll_write(context, &self.sealed[self.unsent.clone()]))?;
            if n_sent == 0 {
                return Poll::Ready(Err(io::ErrorKind::WriteZero.into()));
            }
            self.unsent.start += n_sent;
        }
        Poll::Ready(Ok(()))
    }
}

impl<W: AsyncWrite + Unpin> AsyncWrite for RecordWriter<W> {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        ready!(self.poll_send(context))?;
        self.unsent = 0..0;
        let n_bytes = bytes.len().min(BATCH * RECORD_BYTES);
        bytes[..n_bytes].chunks(RECORD_BYTES).try_for_each(|record| self.seal_record(record))?;
        // The bytes are accepted, even if the stream has no room for them yet.
        match self.poll_send(context) {
            Poll::Ready(Err(error)) => Poll::Ready(Err(error)),
            _ => Poll::Ready(Ok(n_bytes)),
        }
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        ready!(self.poll_send(context))?;
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        ready!(self.poll_send(context))?;
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

impl<R> fmt::Debug for RecordReader<R> {
    /// Hides keys and data.
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("RecordReader").field("next_nonce", &self.next_nonce).finish_non_exhaustive()
    }
}

impl<W> fmt::Debug for RecordWriter<W> {
    /// Hides keys and data.
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("RecordWriter").field("next_nonce", &self.next_nonce).finish_non_exhaustive()
    }
}

fn foreign_record() -> io::Error {
    io::Error::new(
        io::ErrorKind::InvalidData,
        "encrypted bytes were changed, repeated, swapped or forged on the way: look for a faulty or hostile machine \
         between; the render server connects again by itself",
    )
}

fn cut_record() -> io::Error {
    io::Error::new(io::ErrorKind::UnexpectedEof, "the connection closed in mid-message")
}
