//! How much of the next frame each render server gets: by what each tile cost in the last one, and by how fast each is.
//!
//! The tiles lie along a curve ([`shared::curve`]), and what they cost is a density along it. The next frame's shares are
//! runs of the curve, cut where the summed cost reaches the part that a render server's speed makes its own.
//!
//! A measurement is the product of two unknowns: what a tile costs, and how slow its render server is. They come apart
//! because tiles change hands: a render server is slow as far as its tiles took longer than others needed for them in the
//! frame before. Where tiles do not change hands the product is all that matters, and that is measured.
//!
//! Time is CPU time: a render server's share follows from what it can do, not from what else its machine does in one
//! frame. Whoever is late for such reasons loses work to those who idle.

use std::{borrow::Cow, collections::BTreeMap, ops::Range};

use shared::{
    camera::Camera,
    curve,
    division::{Division, FrameSize, Part, Selection, Share, Task, TileRun},
    protocol::{FrameSpec, RunCosts},
    scene::SceneId,
};

use crate::farm::stats::NodeId;

/// How much of what the newest frame says about a speed is believed, once a render server is known.
const LEARNING_RATE: f64 = 0.25;

/// A render server that took this many times as long as expected, or as little, is an outlier.
const OUTLIER: f64 = 2.0;

/// Speeds differ by no more than this from what was thought before, or the measurement is wrong.
const LARGEST_STEP: f64 = 16.0;

/// Slowness stays within this factor of 1, whatever a render server claims.
const LARGEST_SLOWNESS: f64 = 1e3;

/// How much slower a render server counts after the second frame in a row that became whole without it.
const UNFINISHED_SLOWDOWN: f64 = 1.25;

/// How much of a trend is believed to go on: all of it would double what measurements waver.
const TREND: f64 = 0.8;

/// How many squares a run has on average where it is cut between them only: with fewer, what a square costs more than it
/// should is more than what parting its tiles costs.
const FEWEST_SQUARES: usize = 64;

/// What every tile counts in addition, in parts of the mean tile: one that no ray took long for must still be sent.
const LEAST_TILE_COST: f64 = 0.01;

/// What is known about the costs of tiles and the speeds of render servers.
#[derive(Debug, Default)]
pub(super) struct Balance {
    costs: Option<TileCosts>,
    node_speeds: BTreeMap<NodeId, NodeSpeed>,
}

/// What each tile of the last frame cost.
#[derive(Debug)]
struct TileCosts {
    scene: SceneId,
    size: FrameSize,
    /// From where it was seen.
    camera: Camera,
    /// Along the curve; 1 is the mean.
    cost_of_tile: Vec<f64>,
    /// How much more that is than in the frame before, if the camera moved between the two.
    trend: Option<Vec<f64>>,
}

/// How fast a render server is.
#[derive(Clone, Copy, Debug)]
struct NodeSpeed {
    /// CPU time for what takes 1 on a usual one; always positive.
    slowness: f64,
    /// Frames that it was learned from.
    n_frames: u32,
    /// Whether its last frame was an outlier or became whole without it, and so believed in nothing.
    is_suspect: bool,
}

/// What became of a work.
#[derive(Clone, Debug)]
pub(super) struct TaskResult<'a> {
    pub(super) node: NodeId,
    pub(super) share: Share<'a>,
    /// What its tiles cost; `None` if others were faster.
    pub(super) costs: Option<&'a RunCosts>,
}

/// A render server's frame: what it took, and what was expected of a usual one.
#[derive(Clone, Copy, Debug, Default)]
struct NodeCost {
    nanoseconds: f64,
    expected: f64,
}

impl Balance {
    pub(super) fn mark_lost(&mut self, node: NodeId) {
        self.node_speeds.remove(&node);
    }

    /// A frame is divided otherwise: what tiles cost before it says little about those after it.
    pub(super) fn forget_costs(&mut self) {
        self.costs = None;
    }

    /// Divides a frame among render servers with so many threads each: a run of tiles for each, as they are given.
    ///
    /// `None` when no frame of this scene has been learned from yet.
    pub(super) fn divide(&mut self, spec: &FrameSpec, nodes: &[(NodeId, u32)]) -> Option<Vec<Task>> {
        let median_slowness = self.median_slowness();
        let costs = self.costs.as_mut().filter(|costs| costs.scene == spec.scene)?;
        if costs.size != spec.size {
            *costs = costs.resized(spec.size);
        }
        let expected = costs.expected(spec);
        let speed = |&(node, threads): &(NodeId, u32)| {
            f64::from(threads) / self.node_speeds.get(&node).map_or(median_slowness, |node_speed| node_speed.slowness)
        };
        let speeds: Vec<f64> = nodes.iter().map(speed).collect();
        let run = |run| Task { selection: Selection::CurveRun(run), part: Part::WHOLE };
        Some(cut_curve(&expected, &speeds).into_iter().map(run).collect())
    }

    /// Learns from a frame that was divided along the curve.
    pub(super) fn learn(&mut self, spec: &FrameSpec, tasks: &[TaskResult<'_>]) {
        let unfinished = tasks.iter().filter(|result| result.costs.is_none());
        unfinished.for_each(|result| self.slow_down(result.node));
        let n_tiles = Division::Dynamic.units(spec.size).count() as usize;
        let before = self.costs.take().filter(|costs| costs.matches(spec));
        let mut cost_of_tile = before.as_ref().map_or_else(|| vec![1.0; n_tiles], |before| before.cost_of_tile.clone());
        let node_costs = match &before {
            Some(before) => node_costs(&before.expected(spec), tasks),
            None => node_costs(&cost_of_tile, tasks),
        };
        let median_slowness = self.median_slowness();
        // How much more all of the picture costs than it did, in nanoseconds for what cost 1.
        let cost_ratio = |(node, node_cost): (&NodeId, &NodeCost)| {
            node_cost.nanoseconds
                / node_cost.expected
                / self.node_speeds.get(node).map_or(median_slowness, |node_speed| node_speed.slowness)
        };
        let cost_ratios: BTreeMap<_, _> =
            node_costs.iter().map(|node_cost| (*node_cost.0, cost_ratio(node_cost))).collect();
        let median_ratio = median(cost_ratios.values().copied()).unwrap_or(1.0);
        let trusted_nodes = self.learn_speeds(&cost_ratios, median_ratio, median_slowness);
        for result in tasks.iter().filter(|result| trusted_nodes.contains(&result.node)) {
            let scale = 1.0 / (median_ratio * self.node_speeds[&result.node].slowness);
            for (tiles, nanoseconds) in measured_runs(result) {
                let cost = nanoseconds * scale / f64::from(tiles.len() as u32);
                tiles.for_each(|k| cost_of_tile[result.share.unit(k) as usize] = cost);
            }
        }
        let mean = cost_of_tile.iter().sum::<f64>() / n_tiles as f64;
        if mean > 0.0 {
            cost_of_tile.iter_mut().for_each(|cost| *cost /= mean);
        } else {
            cost_of_tile.fill(1.0);
        }
        let moved = before.filter(|before| before.camera != spec.camera);
        let trend = moved
            .map(|before| cost_of_tile.iter().zip(before.cost_of_tile).map(|(now, before)| now - before).collect());
        let FrameSpec { scene, size, camera, .. } = *spec;
        self.costs = Some(TileCosts { scene, size, camera, cost_of_tile, trend });
    }

    /// Learns how fast render servers are from how much longer than expected they took, and says whose measurements are to
    /// be believed.
    ///
    /// One or few outliers are believed only when they are so again in the next frame: a page fault or a debugger moves
    /// nothing. When many are, the picture has changed, not they.
    fn learn_speeds(
        &mut self,
        cost_ratios: &BTreeMap<NodeId, f64>,
        median_ratio: f64,
        median_slowness: f64,
    ) -> Vec<NodeId> {
        let is_outlier = |cost_ratio: f64| !(1.0 / OUTLIER..=OUTLIER).contains(&(cost_ratio / median_ratio));
        let n_outliers = cost_ratios.values().filter(|&&cost_ratio| is_outlier(cost_ratio)).count();
        let mut trusted_nodes = Vec::new();
        for (&node, &cost_ratio) in cost_ratios {
            let node_speed = self.node_speeds.entry(node).or_insert(NodeSpeed {
                slowness: median_slowness,
                n_frames: 0,
                is_suspect: false,
            });
            let is_known = node_speed.n_frames > 0;
            node_speed.is_suspect =
                is_known && !node_speed.is_suspect && is_outlier(cost_ratio) && 4 * n_outliers <= cost_ratios.len();
            if node_speed.is_suspect {
                continue;
            }
            node_speed.n_frames = node_speed.n_frames.saturating_add(1);
            let gain = LEARNING_RATE.max(1.0 / f64::from(node_speed.n_frames));
            node_speed.scale((cost_ratio / median_ratio).clamp(1.0 / LARGEST_STEP, LARGEST_STEP).powf(gain));
            trusted_nodes.push(node);
        }
        trusted_nodes
    }

    /// A frame became whole without a render server. One that never finished is believed to be slow as well, or it would
    /// be late for ever and nothing be learned of it.
    fn slow_down(&mut self, node: NodeId) {
        let node_speed = NodeSpeed { slowness: self.median_slowness(), n_frames: 0, is_suspect: false };
        let node_speed = self.node_speeds.entry(node).or_insert(node_speed);
        if std::mem::replace(&mut node_speed.is_suspect, true) {
            node_speed.scale(UNFINISHED_SLOWDOWN);
        }
    }

    /// What is expected of a render server that has not shown how fast it is.
    fn median_slowness(&self) -> f64 {
        median(self.node_speeds.values().map(|node_speed| node_speed.slowness)).unwrap_or(1.0)
    }
}

impl TileCosts {
    fn matches(&self, spec: &FrameSpec) -> bool {
        (self.scene, self.size) == (spec.scene, spec.size)
    }

    /// The same picture in another resolution: each tile costs what the one does in which its middle lies.
    fn resized(&self, size: FrameSize) -> Self {
        let tiles = |size: FrameSize| [size.x_tiles(), size.y_tiles()];
        let ([columns, rows], [old_columns, old_rows]) = (tiles(size), tiles(self.size));
        let scaled = |at: u32, n: u32, n_old: u32| (2 * at + 1) * n_old / (2 * n);
        let old_tile = |tile| {
            let (column, row) = curve::tile_at(tile, columns, rows);
            let (column, row) = (scaled(column, columns, old_columns), scaled(row, rows, old_rows));
            curve::index_at(column, row, old_columns, old_rows) as usize
        };
        let old_indices: Vec<usize> = (0..columns * rows).map(old_tile).collect();
        let resized = |old_tile: &Vec<f64>| old_indices.iter().map(|&old_index| old_tile[old_index]).collect();
        Self { size, cost_of_tile: resized(&self.cost_of_tile), trend: self.trend.as_ref().map(resized), ..*self }
    }

    /// What tiles will cost in the next frame: a camera that moved moves on.
    fn expected(&self, spec: &FrameSpec) -> Cow<'_, [f64]> {
        match &self.trend {
            Some(trend) if self.camera != spec.camera => {
                self.cost_of_tile.iter().zip(trend).map(|(cost, trend)| cost + TREND * trend).collect()
            }
            _ => Cow::Borrowed(&self.cost_of_tile),
        }
    }
}

impl NodeSpeed {
    fn scale(&mut self, factor: f64) {
        self.slowness = (self.slowness * factor).clamp(1.0 / LARGEST_SLOWNESS, LARGEST_SLOWNESS);
    }
}

/// The blocks of tiles that a work was measured in, as places in its share, and their nanoseconds.
fn measured_runs<'a>(result: &'a TaskResult<'_>) -> impl Iterator<Item = (Range<u32>, f64)> + 'a {
    let blocks = result.costs.into_iter().flat_map(|costs| costs.runs(result.share.count()));
    blocks.map(|(tiles, nanoseconds)| (tiles, f64::from(nanoseconds)))
}

/// What each render server took in all, and what was expected; without those of whom nothing can be learned.
fn node_costs(cost_of_tile: &[f64], tasks: &[TaskResult<'_>]) -> BTreeMap<NodeId, NodeCost> {
    let mut node_costs = BTreeMap::<NodeId, NodeCost>::new();
    for result in tasks {
        let node_cost = node_costs.entry(result.node).or_default();
        for (tiles, nanoseconds) in measured_runs(result) {
            node_cost.nanoseconds += nanoseconds;
            node_cost.expected += tiles.map(|k| cost_of_tile[result.share.unit(k) as usize]).sum::<f64>();
        }
    }
    node_costs.retain(|_, node_cost| node_cost.nanoseconds > 0.0 && node_cost.expected > 0.0);
    node_costs
}

/// Cuts the curve into one run for each speed, so that costs are in proportion to speeds as well as whole tiles allow, or
/// whole squares of them where each run has many.
///
/// Every run has a tile if there are enough.
fn cut_curve(cost_of_tile: &[f64], speeds: &[f64]) -> Vec<TileRun> {
    let costs: Vec<f64> = cost_of_tile.iter().map(|cost| cost + LEAST_TILE_COST).collect();
    let n_together = curve::TILES_PER_SQUARE as usize;
    let size = if costs.len() < FEWEST_SQUARES * n_together * speeds.len() { 1 } else { n_together };
    let piece_costs: Vec<f64> = costs.chunks(size).map(|tiles| tiles.iter().sum()).collect();
    let tiles = |pieces: Range<usize>| {
        let (first, end) = (pieces.start * size, (pieces.end * size).min(costs.len()));
        TileRun { first: first as u32, count: (end - first) as u32 }
    };
    cut_between(&piece_costs, speeds).into_iter().map(tiles).collect()
}

/// The same between pieces of the curve that have these costs.
fn cut_between(piece_costs: &[f64], speeds: &[f64]) -> Vec<Range<usize>> {
    let (n_pieces, n_runs) = (piece_costs.len(), speeds.len());
    let per_speed = piece_costs.iter().sum::<f64>() / speeds.iter().sum::<f64>();
    let (mut end, mut sum, mut wanted) = (0, 0.0, 0.0);
    let mut runs = Vec::with_capacity(n_runs);
    for (index, speed) in speeds.iter().enumerate() {
        let first = end;
        wanted += speed * per_speed;
        let n_after = n_runs - index - 1;
        // The last run ends with the frame, whatever rounding says.
        let latest = n_pieces.saturating_sub(n_after).max(first);
        let earliest = if n_after == 0 { n_pieces } else { (first + 1).min(latest) };
        // A piece belongs to the run in which its middle lies.
        while end < earliest || end < latest && sum + piece_costs[end] / 2.0 < wanted {
            sum += piece_costs[end];
            end += 1;
        }
        runs.push(first..end);
    }
    runs
}

/// The middle value, or between the middle two the geometric mean; of positive values.
fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut sorted: Vec<_> = values.collect();
    sorted.sort_by(f64::total_cmp);
    let upper = *sorted.get(sorted.len() / 2)?;
    let lower = sorted[(sorted.len() - 1) / 2];
    Some((lower * upper).sqrt())
}

#[cfg(test)]
mod tests;
