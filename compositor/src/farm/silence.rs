//! Measures how long a connection's peer has been silent. A silent render server is given no tasks, but is not yet lost.

use std::{
    io,
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    task::{Context, Poll},
    time::{Duration, Instant},
};

use tokio::io::{AsyncRead, ReadBuf};

/// When the last byte arrived.
#[derive(Clone, Debug)]
pub(super) struct LastHeard {
    since: Instant,
    /// Nanoseconds after `since`.
    at_ns: Arc<AtomicU64>,
}

impl LastHeard {
    /// The peer is heard now.
    pub(super) fn now() -> Self {
        Self { since: Instant::now(), at_ns: Arc::default() }
    }

    /// Wraps a stream to note when bytes arrive. Wrap the encrypted stream: the decrypted one delivers nothing before a
    /// whole record is there.
    pub(super) fn observe<S>(&self, stream: S) -> ObservedStream<S> {
        ObservedStream { stream, heard: self.clone() }
    }

    /// The time since the last byte.
    pub(super) fn silence(&self) -> Duration {
        self.since.elapsed().saturating_sub(Duration::from_nanos(self.at_ns.load(Relaxed)))
    }

    /// The peer is heard, or has had no reason to speak.
    pub(super) fn note(&self) {
        self.at_ns.store(self.since.elapsed().as_nanos() as u64, Relaxed);
    }
}

/// A stream that notes when bytes arrive.
#[derive(Debug)]
pub(super) struct ObservedStream<S> {
    stream: S,
    heard: LastHeard,
}

impl<S: AsyncRead + Unpin> AsyncRead for ObservedStream<S> {
    fn poll_read(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let n_before = bytes.filled().len();
        let polled = Pin::new(&mut self.stream).poll_read(context, bytes);
        if bytes.filled().len() > n_before {
            self.heard.note();
        }
        polled
    }
}

/// Calls `on_change` with true when the peer has been silent for `limit`, and with false when it is heard again. Never
/// returns.
pub(super) async fn watch<F: Future<Output = ()>>(heard: &LastHeard, limit: Duration, on_change: impl Fn(bool) -> F) {
    let mut is_silent = false;
    loop {
        let silence = heard.silence();
        if (silence >= limit) != is_silent {
            is_silent = !is_silent;
            on_change(is_silent).await;
        }
        // A silent peer is checked often, so that it gets tasks again soon.
        let pause = if is_silent { limit / 25 } else { limit.saturating_sub(silence).max(limit / 250) };
        tokio::time::sleep(pause).await;
    }
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use tokio::io::{AsyncReadExt, AsyncWriteExt, duplex};

    use super::*;

    #[test]
    fn silence_and_its_end_are_reported_once_each() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        let limit = Duration::from_millis(60);
        let reported = RefCell::new(Vec::new());
        runtime.block_on(async {
            let heard = LastHeard::now();
            let (mut peer, stream) = duplex(64);
            let mut stream = heard.observe(stream);
            let read = async {
                let mut bytes = [0; 8];
                while stream.read(&mut bytes).await.is_ok_and(|n_read| n_read > 0) {}
            };
            // Single bytes count.
            let speak = async {
                for pause_ms in [5, 5, 300, 5, 5] {
                    peer.write_all(&[0]).await.unwrap();
                    tokio::time::sleep(Duration::from_millis(pause_ms)).await;
                }
                drop(peer);
            };
            let on_change = |is_silent| {
                reported.borrow_mut().push(is_silent);
                std::future::ready(())
            };
            tokio::select! {
                _ = async { tokio::join!(read, speak) } => {}
                () = watch(&heard, limit, on_change) => {}
            }
        });
        // On a busy machine, a short pause may become a long one.
        let reported = reported.into_inner();
        assert!(
            reported.len() >= 2 && reported.iter().enumerate().all(|(index, &is_silent)| is_silent == (index % 2 == 0))
        );
    }
}
