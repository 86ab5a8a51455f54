//! GPU time of a draw, where the GPU offers timestamps.

use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering},
};

use super::context::Gpu;

/// Times one draw at a time, of one or more render passes, and never waits: draws are not timed while a readback is
/// pending.
pub(super) struct DrawTimer {
    timestamps: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    readback: wgpu::Buffer,
    /// Set when the GPU has delivered.
    pending_readback: Option<Arc<AtomicBool>>,
    newest_ms: Option<f64>,
}

/// Two timestamps of 64 bits.
const N_BYTES: u64 = 16;

impl DrawTimer {
    pub(super) fn new(gpu: &Gpu) -> Option<Self> {
        let device = &gpu.device;
        if !device.features().contains(wgpu::Features::TIMESTAMP_QUERY) {
            return None;
        }
        let buffer = |label, usage| {
            device.create_buffer(&wgpu::BufferDescriptor {
                label: Some(label),
                size: N_BYTES,
                usage: usage | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            })
        };
        Some(Self {
            timestamps: device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("draw"),
                ty: wgpu::QueryType::Timestamp,
                count: 2,
            }),
            resolved: buffer("timestamps", wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC),
            readback: buffer("timestamps read back", wgpu::BufferUsages::MAP_READ),
            pending_readback: None,
            newest_ms: None,
        })
    }

    /// Timestamps of a pass: whether it is the draw's first, and whether it is the last.
    pub(super) fn pass_timestamps(
        &self,
        [is_first, is_last]: [bool; 2],
    ) -> Option<wgpu::RenderPassTimestampWrites<'_>> {
        (self.pending_readback.is_none() && (is_first || is_last)).then_some(wgpu::RenderPassTimestampWrites {
            query_set: &self.timestamps,
            beginning_of_pass_write_index: is_first.then_some(0),
            end_of_pass_write_index: is_last.then_some(1),
        })
    }

    /// Reads the timestamps back; call it right after the last pass, with the same encoder.
    pub(super) fn read_after(&mut self, encoder: &mut wgpu::CommandEncoder) {
        if self.pending_readback.is_none() {
            encoder.resolve_query_set(&self.timestamps, 0..2, &self.resolved, 0);
            encoder.copy_buffer_to_buffer(&self.resolved, 0, &self.readback, 0, N_BYTES);
            let arrived = Arc::new(AtomicBool::new(false));
            self.pending_readback = Some(Arc::clone(&arrived));
            encoder.map_buffer_on_submit(&self.readback, wgpu::MapMode::Read, .., move |_outcome| {
                arrived.store(true, Ordering::Release);
            });
        }
    }

    pub(super) fn newest_ms(&mut self, gpu: &Gpu) -> Option<f64> {
        // `Gpu::check` reports a lost device.
        let _ = gpu.device.poll(wgpu::PollType::Poll);
        if self.pending_readback.as_ref().is_some_and(|arrived| arrived.load(Ordering::Acquire)) {
            self.pending_readback = None;
            // A mapping that failed has no range to get.
            if let Ok(bytes) = self.readback.get_mapped_range(..)
                && let &[begin, end] = bytemuck::cast_slice::<u8, u64>(&bytes)
            {
                let period_ms = f64::from(gpu.queue.get_timestamp_period()) / 1e6;
                self.newest_ms = Some(end.saturating_sub(begin) as f64 * period_ms);
            }
            self.readback.unmap();
        }
        self.newest_ms
    }
}
