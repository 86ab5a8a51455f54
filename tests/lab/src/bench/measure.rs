//! Measures the real wall: render servers on this machine, real sockets, an offscreen wall.

use std::time::{Duration, Instant};

use anyhow::ensure;
use compositor::{
    cli::{
        headless::{self, Headless, Wakeup, Wakeups},
        local::LocalServers,
    },
    farm::{
        Farm, Frame, RenderGoal,
        stats::{DisplayStats, FrameStats},
    },
};
use renderer::cli::scene_args::SceneArgs;
use shared::division::{Division, FrameSize};
use tokio::runtime::Runtime;

use super::results::MeasuredRow;
use crate::statistics::{median, milliseconds, quantile};

/// Frames after a change that do not count: caches fill, and the dynamic division balances.
const N_FIRST: usize = 4;

/// Frames of a measurement, however long they take: a median needs some.
const FEWEST_FRAMES: usize = 5;

/// The operator has stopped the experiment.
#[derive(Debug, thiserror::Error)]
#[error("stopped")]
pub(super) struct Stopped;

pub(super) struct RealWall<'a> {
    headless: &'a mut Headless,
    wakeups: &'a Wakeups,
    size: FrameSize,
    // Dropped in this order: a farm that ends before its render servers reports no loss.
    farm: Farm,
    servers: LocalServers,
    n_nodes: u32,
}

impl<'a> RealWall<'a> {
    pub(super) fn start(
        runtime: &Runtime,
        headless: &'a mut Headless,
        wakeups: &'a Wakeups,
        wanted: RenderGoal,
        scene: &SceneArgs,
        wake: impl Fn() + Send + Sync + 'static,
    ) -> anyhow::Result<Self> {
        let size = wanted.spec.map_or(FrameSize::PAPER, |spec| spec.size);
        let listener = runtime.block_on(tokio::net::TcpListener::bind(("127.0.0.1", 0)))?;
        let servers = LocalServers::empty(listener.local_addr()?, None, scene)?;
        let farm = {
            let _guard = runtime.enter();
            Farm::start(listener, None, wanted, wake)?
        };
        Ok(Self { headless, wakeups, size, farm, servers, n_nodes: 0 })
    }

    pub(super) fn grow_to(&mut self, n_nodes: u32) -> anyhow::Result<()> {
        while self.n_nodes < n_nodes {
            self.servers.add(1)?;
            self.n_nodes += 1;
        }
        self.farm.update_goal(|wanted| wanted.min_renderers = n_nodes);
        Ok(())
    }

    pub(super) fn measure(
        &mut self,
        division: Division,
        duration: Duration,
        is_shown: bool,
    ) -> anyhow::Result<MeasuredRow> {
        self.farm.update_goal(|wanted| wanted.division = division);
        let mut n_first = 0;
        let mut rows = Vec::new();
        let (mut started_at, mut ended_at) = (Instant::now(), Instant::now());
        while rows.len() < FEWEST_FRAMES || started_at.elapsed() < duration {
            let frame = self.next_frame()?;
            let display = if is_shown { self.headless.show(&frame)? } else { DisplayStats::default() };
            // Frames of the division before, or of fewer nodes, may still be in flight.
            let is_other = frame.stats.division != division || frame.stats.nodes.len() < self.n_nodes as usize;
            n_first += usize::from(!is_other);
            let frame_ms = milliseconds(ended_at.elapsed());
            ended_at = Instant::now();
            if n_first > N_FIRST {
                rows.push((frame.stats, display, frame_ms));
            } else {
                started_at = Instant::now();
            }
        }
        let median_of = |value: &dyn Fn(&(FrameStats, DisplayStats, f64)) -> f64| median(rows.iter().map(value));
        Ok(MeasuredRow {
            division: Some(division),
            n_nodes: self.n_nodes,
            size: self.size.to_string(),
            n_frames: rows.len(),
            frame_ms_median: median_of(&|row| row.2),
            frame_ms_p95: quantile(rows.iter().map(|row| row.2), 0.95),
            render_ms_median: median_of(&|row| row.0.render_ms),
            display_ms_median: median_of(&|row| row.1.upload_ms + row.1.draw_ms),
            busiest_ms_median: median_of(&|row| row.0.nodes.iter().map(|node| node.busy_ms).fold(0.0, f64::max)),
            bytes_in: median_of(&|row| row.0.bytes_in as f64),
            bytes_out: median_of(&|row| row.0.bytes_out as f64),
            imbalance_median: median_of(&|row| row.0.imbalance),
        })
    }

    fn next_frame(&mut self) -> anyhow::Result<Frame> {
        loop {
            ensure!(self.wakeups.try_recv() != Ok(Wakeup::Stop), Stopped);
            if let Some(frame) = self.farm.take_frame() {
                return Ok(frame);
            }
            ensure!(headless::wait(&self.farm, self.wakeups, None)? != Wakeup::Stop, Stopped);
        }
    }
}

/// Measures the display alone, with blank frames.
pub(super) fn measure_display(
    headless: &mut Headless,
    wakeups: &Wakeups,
    size: FrameSize,
    duration: Duration,
) -> anyhow::Result<MeasuredRow> {
    let started_at = Instant::now();
    let blank = vec![u32::from_ne_bytes([0, 0, 0, 255]); size.n_samples() as usize];
    let mut shown_ms = Vec::new();
    let mut n_first = 0;
    while shown_ms.len() < FEWEST_FRAMES || started_at.elapsed() < duration {
        ensure!(wakeups.try_recv() != Ok(Wakeup::Stop), Stopped);
        let began_at = Instant::now();
        headless.upload_and_draw(size, &blank)?;
        n_first += 1;
        if n_first > N_FIRST {
            shown_ms.push(milliseconds(began_at.elapsed()));
        }
    }
    let quantile = |part| quantile(shown_ms.iter().copied(), part);
    Ok(MeasuredRow {
        size: size.to_string(),
        n_frames: shown_ms.len(),
        frame_ms_median: quantile(0.5),
        frame_ms_p95: quantile(0.95),
        display_ms_median: quantile(0.5),
        imbalance_median: 1.0,
        ..MeasuredRow::default()
    })
}
