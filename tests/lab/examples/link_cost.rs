//! Measures the cost of encryption: CPU time to send and to receive a frame within one process, with a key and without.
//!
//!     cargo run --release -p lab --example link_cost

use channel::{key::Key, secure};
use cpu_time::ThreadTime;
use lab::statistics::median;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, duplex, split};

/// One frame of 1024×512 samples, 3 bytes each.
const FRAME_BYTES: usize = 1024 * 512 * 3;

/// Frames of a measurement; the median counts.
const N_FRAMES: usize = 1000;

#[tokio::main(flavor = "current_thread")]
async fn main() -> anyhow::Result<()> {
    let key = Key::random()?;
    // The pipe holds a whole frame, so that one side can work after the other.
    let (server, wall) = duplex(2 * FRAME_BYTES);
    let plain = milliseconds(server, wall).await?;
    let (server, wall) = duplex(2 * FRAME_BYTES);
    let ((server_in, server_out), (wall_in, wall_out)) = (split(server), split(wall));
    let (server, wall) =
        tokio::join!(secure::connect(server_in, server_out, &key), secure::accept(wall_in, wall_out, &key));
    let encrypted = milliseconds(server?.1, wall?.0).await?;
    println!("CPU time of one core for a 1024×512 frame, ms: {:>10}{:>10}", "send", "receive");
    for (name, [send, receive]) in [("without a key", plain), ("with a key", encrypted)] {
        println!("{name:<46}{send:>11.3}{receive:>10.3}");
    }
    Ok(())
}

/// CPU time to write a frame, as a render server does, and to read it, as a wall does.
async fn milliseconds(mut out: impl AsyncWrite + Unpin, mut input: impl AsyncRead + Unpin) -> anyhow::Result<[f64; 2]> {
    let frame: Vec<u8> = (0..FRAME_BYTES).map(|at| (at.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
    let mut chunk = vec![0; 64 * 1024];
    let mut times = [const { Vec::new() }; 2];
    for _ in 0..N_FRAMES {
        let started_at = ThreadTime::now();
        for bytes in frame.chunks(256 * 1024) {
            out.write_all(bytes).await?;
        }
        out.flush().await?;
        times[0].push(started_at.elapsed().as_secs_f64() * 1e3);
        let started_at = ThreadTime::now();
        for bytes in frame.chunks(chunk.len()) {
            input.read_exact(&mut chunk[..bytes.len()]).await?;
        }
        times[1].push(started_at.elapsed().as_secs_f64() * 1e3);
        anyhow::ensure!(chunk[..] == frame[FRAME_BYTES - chunk.len()..], "other bytes arrived");
    }
    Ok(times.map(median))
}
