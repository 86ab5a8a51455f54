//! The messages that wait to be sent to one render server.
//!
//! A message that makes an earlier one needless replaces it, so the queue stays short however slowly the peer reads: a render
//! server is never dropped because the wall had much to say.

use std::{
    collections::{BTreeSet, VecDeque},
    sync::{Mutex, MutexGuard, PoisonError},
};

use shared::{
    codec,
    protocol::{FrameId, ToServer},
};
use tokio::sync::Notify;

/// A queue of encoded messages, filled by the farm and emptied by a connection.
#[derive(Debug, Default)]
pub(super) struct Outbox {
    queue: Mutex<Queue>,
    changed: Notify,
}

#[derive(Debug, Default)]
struct Queue {
    messages: VecDeque<Encoded>,
    /// The frames that tasks were sent of; their end must be sent too.
    begun: BTreeSet<FrameId>,
    is_closed: bool,
}

#[derive(Debug)]
struct Encoded {
    kind: Kind,
    bytes: Vec<u8>,
}

/// Kinds of messages: a later one can make some of them needless.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    LoadScene,
    PrepareScene,
    Probe,
    Look,
    Measure,
    Render(FrameId),
    Other,
}

impl Outbox {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Queues a message, and returns its size in bytes.
    pub(super) fn push(&self, message: &ToServer) -> u64 {
        let mut bytes = Vec::new();
        codec::encode(message, &mut bytes).expect("the wall's requests are short");
        let n_bytes = bytes.len() as u64;
        let mut queue = self.lock();
        let kind = match message {
            ToServer::LoadScene { .. } => Kind::LoadScene,
            ToServer::PrepareScene { .. } => Kind::PrepareScene,
            ToServer::Probe { .. } => Kind::Probe,
            ToServer::Look { .. } => Kind::Look,
            ToServer::Measure { .. } => Kind::Measure,
            ToServer::RenderFrame { frame, .. } => Kind::Render(*frame),
            ToServer::Cancel { frame } => {
                queue.messages.retain(|queued| queued.kind != Kind::Render(*frame));
                if !queue.begun.remove(frame) {
                    return 0;
                }
                Kind::Other
            }
            ToServer::Refused { .. }
            | ToServer::Ping { .. }
            | ToServer::Welcome
            | ToServer::SceneFileAwaited { .. }
            | ToServer::SceneFile { .. } => Kind::Other,
        };
        if matches!(kind, Kind::LoadScene | Kind::PrepareScene | Kind::Probe | Kind::Look | Kind::Measure) {
            queue.messages.retain(|queued| queued.kind != kind);
        }
        queue.messages.push_back(Encoded { kind, bytes });
        drop(queue);
        self.changed.notify_one();
        n_bytes
    }

    /// Forgets a frame that is complete: it needs no [`ToServer::Cancel`].
    pub(super) fn forget(&self, frame: FrameId) {
        self.lock().begun.remove(&frame);
    }

    /// Ends the connection when all messages are sent.
    pub(super) fn close(&self) {
        self.lock().is_closed = true;
        self.changed.notify_one();
    }

    /// Waits for messages and takes them all; `None` if the outbox is closed and empty.
    pub(super) async fn take(&self) -> Option<Vec<u8>> {
        loop {
            {
                let Queue { messages, begun, is_closed } = &mut *self.lock();
                if !messages.is_empty() {
                    let mut bytes = Vec::new();
                    for message in messages.drain(..) {
                        if let Kind::Render(frame) = message.kind {
                            begun.insert(frame);
                        }
                        bytes.extend(message.bytes);
                    }
                    return Some(bytes);
                }
                if *is_closed {
                    return None;
                }
            }
            self.changed.notified().await;
        }
    }
}

#[cfg(test)]
mod tests {
    use shared::{
        division::Division,
        protocol::{Encoding, TaskId},
        scene::SceneId,
    };

    use super::*;
    use crate::farm::scheduler::tests::spec;

    fn render(frame: u64) -> ToServer {
        ToServer::RenderFrame {
            frame: FrameId(frame),
            task_id: TaskId(frame as u32),
            spec: spec(0.0, 1000),
            task: Division::Tiled.task(0, 1),
            encoding: Encoding::Raw,
        }
    }

    fn load_scene(triangles: u32) -> ToServer {
        ToServer::LoadScene {
            scene: SceneId::Statue { triangles, treatment: Default::default() },
            path: Some(vec![b'x'; 200_000]),
            structure: None,
            sky: None,
        }
    }

    fn encoded(messages: &[ToServer]) -> Vec<u8> {
        let mut bytes = Vec::new();
        messages.iter().for_each(|message| codec::encode(message, &mut bytes).unwrap());
        bytes
    }

    #[tokio::test]
    async fn what_is_needless_is_not_sent_however_long_the_peer_does_not_read() {
        let outbox = Outbox::default();
        outbox.push(&render(1));
        assert_eq!(outbox.take().await, Some(encoded(&[render(1)])));
        for frame in 2..10_000 {
            outbox.push(&load_scene(frame as u32));
            outbox.push(&render(frame));
            outbox.push(&ToServer::Cancel { frame: FrameId(frame) });
        }
        outbox.push(&ToServer::Cancel { frame: FrameId(1) });
        outbox.push(&ToServer::Cancel { frame: FrameId(1) });
        outbox.close();
        let cancel = ToServer::Cancel { frame: FrameId(1) };
        assert_eq!(
            outbox.take().await,
            Some(encoded(&[load_scene(9999), cancel])),
            "only a sent task is cancelled, once"
        );
        assert_eq!(outbox.take().await, None);
    }

    #[tokio::test]
    async fn a_frame_that_is_complete_is_not_cancelled() {
        let outbox = Outbox::default();
        outbox.push(&render(1));
        outbox.take().await;
        outbox.forget(FrameId(1));
        assert_eq!(outbox.push(&ToServer::Cancel { frame: FrameId(1) }), 0);
    }
}
