//! A frame in flight, as the connections need it.

use std::{collections::HashMap, sync::Arc, time::Instant};

use shared::protocol::FrameSpec;

use super::{
    Frame,
    frame_buffer::{BufferPool, FrameBuffer},
    stats::{FarmStatus, FrameStats, NodeId, NodeStatus},
};

/// A frame's buffer, and the bytes that were sent for it.
#[derive(Debug)]
pub(super) struct OpenFrame {
    pub(super) spec: FrameSpec,
    pub(super) buffer: Arc<FrameBuffer>,
    pub(super) moved_at: Instant,
    pub(super) change: u32,
    pub(super) bytes_out: HashMap<NodeId, u64>,
}

impl OpenFrame {
    /// The complete frame. Adds to its figures what only the farm knows.
    pub(super) fn finish(self, mut stats: FrameStats, farm: &FarmStatus, spare: BufferPool) -> Frame {
        (stats.n_lost, stats.n_healed) = (farm.n_lost, farm.n_healed);
        for node in &mut stats.nodes {
            node.bytes_out = self.bytes_out.get(&node.id).copied().unwrap_or(0);
            // A render server that was lost meanwhile is not listed.
            if let Some(known) = farm.nodes.iter().find(|known| known.id == node.id) {
                node.address = Some(known.address);
                (node.n_failures, node.round_trip_ms) = (known.n_failures, known.round_trip_ms);
            }
        }
        stats.fetching = farm.nodes.iter().filter_map(NodeStatus::transfer).collect();
        stats.bytes_out = self.bytes_out.values().sum();
        let Self { spec, buffer, moved_at, change, .. } = self;
        Frame { spec, rgba: buffer.into_samples(spare), stats, moved_at, change }
    }
}
