//! Measures the cost of encryption: bytes that one core encrypts, decrypts and copies in a second of CPU time.
//!
//!     cargo run --release -p lab --example link_cost

use std::{
    pin::Pin,
    sync::{Arc, Mutex},
    task::{Context, Poll},
};

use channel::{key::Key, secure};
use cpu_time::ThreadTime;
use lab::statistics::median;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, ReadBuf, duplex, split};

/// One frame of 1024×512 samples, 3 bytes each.
const FRAME_BYTES: usize = 1024 * 512 * 3;

/// Frames of a measurement: 250 ms or more with any cipher.
const N_FRAMES: usize = 200;

/// Measurements; the median counts.
const N_RUNS: usize = 7;

fn main() -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().build()?;
    let [mut sealing, mut opening, mut copying] = [const { Vec::new() }; 3];
    for _ in 0..N_RUNS {
        let (seal_s, open_s) = runtime.block_on(seal_and_open())?;
        sealing.push(seal_s);
        opening.push(open_s);
        copying.push(copy());
    }
    println!("{:<24}{:>12}{:>24}", "one core, CPU time", "MB/s", "ms per 1024×512 frame");
    let rows = [("encrypt", sealing), ("decrypt", opening), ("memcpy", copying)];
    for (name, seconds) in rows {
        let frame_s = median(seconds) / N_FRAMES as f64;
        println!("{name:<24}{:>12.0}{:>24.3}", FRAME_BYTES as f64 / 1e6 / frame_s, frame_s * 1e3);
    }
    Ok(())
}

/// Seconds to encrypt and to decrypt all frames, in writes of a render server's size and reads of a chunk.
async fn seal_and_open() -> anyhow::Result<(f64, f64)> {
    let key = Key::random()?;
    let (server, wall) = duplex(1 << 20);
    let (server_in, server_out) = split(server);
    let (wall_in, wall_out) = split(wall);
    let tape = Tape::default();
    let (server, wall) = tokio::join!(
        secure::connect(server_in, tape.behind(server_out), &key),
        secure::accept(tape.behind(wall_in), wall_out, &key)
    );
    let ((_, mut writer), (mut reader, _)) = (server?, wall?);
    tape.cut_in();
    let frame: Vec<u8> = (0..FRAME_BYTES).map(|at| (at.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
    let (mut seal_s, mut open_s) = (0.0, 0.0);
    let mut chunk = vec![0; 64 * 1024];
    for _ in 0..N_FRAMES {
        let started = ThreadTime::now();
        for bytes in frame.chunks(256 * 1024) {
            writer.write_all(bytes).await?;
        }
        writer.flush().await?;
        seal_s += started.elapsed().as_secs_f64();
        let started = ThreadTime::now();
        for bytes in frame.chunks(chunk.len()) {
            reader.read_exact(&mut chunk[..bytes.len()]).await?;
        }
        open_s += started.elapsed().as_secs_f64();
        anyhow::ensure!(chunk[..] == frame[FRAME_BYTES - chunk.len()..], "decrypted bytes differ");
    }
    Ok((seal_s, open_s))
}

/// Seconds to copy all frames in chunks.
fn copy() -> f64 {
    let frame = vec![1; FRAME_BYTES];
    let mut to = vec![0_u8; FRAME_BYTES];
    let started = ThreadTime::now();
    for _ in 0..N_FRAMES {
        for (to, from) in to.chunks_mut(64 * 1024).zip(frame.chunks(64 * 1024)) {
            to.copy_from_slice(std::hint::black_box(from));
        }
        std::hint::black_box(&mut to);
    }
    started.elapsed().as_secs_f64()
}

/// Encrypted bytes, and how many of them have been read; `None` during the handshake.
type Sealed = Option<(Vec<u8>, usize)>;

/// Stands in for a socket after the handshake: keeps encrypted bytes in memory.
#[derive(Clone, Default)]
struct Tape(Arc<Mutex<Sealed>>);

impl Tape {
    fn behind<S>(&self, stream: S) -> Taped<S> {
        Taped { stream, tape: self.clone() }
    }

    fn cut_in(&self) {
        *self.0.lock().expect("nobody panics with it") = Some((Vec::with_capacity(FRAME_BYTES * 2), 0));
    }
}

struct Taped<S> {
    stream: S,
    tape: Tape,
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Taped<S> {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<std::io::Result<usize>> {
        if let Some((tape, _)) = &mut *self.tape.0.lock().expect("nobody panics with it") {
            tape.extend_from_slice(bytes);
            return Poll::Ready(Ok(bytes.len()));
        }
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<std::io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Taped<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<std::io::Result<()>> {
        if let Some((tape, at)) = &mut *self.tape.0.lock().expect("nobody panics with it") {
            let n_bytes = buffer.remaining().min(tape.len() - *at);
            buffer.put_slice(&tape[*at..][..n_bytes]);
            *at += n_bytes;
            if *at == tape.len() {
                tape.clear();
                *at = 0;
            }
            return Poll::Ready(Ok(()));
        }
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}
