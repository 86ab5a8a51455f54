//! Dynamic division: computes the shares of the next frame from the costs of tiles in the last one and the speeds of nodes.
//!
//! The tiles lie along a curve ([`shared::curve`]), and their costs are a density along it. The shares are runs of the
//! curve, cut so that the sum of costs in each is proportional to its node's speed.
//!
//! A measured time is the product of two unknowns, a tile's cost and its node's slowness. They can be separated because
//! tiles change hands: a node's slowness is the time that its tiles took over the time that other nodes needed for them in
//! the last frame. For tiles that stay with one node only the product matters, and that is measured.
//!
//! Times are CPU times: shares follow from the speed of a node, not from the load that other programs put on its machine
//! during one frame. A node that is late for that reason loses tasks to idle ones.

use std::{borrow::Cow, collections::BTreeMap, ops::Range};

use shared::{
    camera::Camera,
    curve,
    division::{Division, FrameSize, Part, Selection, Share, Task, TileRun},
    protocol::{FrameSpec, RunCosts},
    scene::SceneId,
};

use crate::farm::stats::NodeId;

/// Weight of the newest measurement of a known node's speed.
const LEARNING_RATE: f64 = 0.25;

/// A node is an outlier if it took more than this many times the expected time, or less than the expected time over this.
const OUTLIER: f64 = 2.0;

/// One measurement changes a slowness by at most this factor.
const LARGEST_STEP: f64 = 16.0;

/// Slowness stays within this factor of 1, even if a render server lies.
const LARGEST_SLOWNESS: f64 = 1e3;

/// A node's slowness grows by this factor with each frame, after the first in a row, that others completed for it.
const UNFINISHED_SLOWDOWN: f64 = 1.25;

/// The part of a trend that is extrapolated: all of it would double the noise of measurements.
const TREND: f64 = 0.8;

/// Runs are cut only between squares if they have at least this many on average. For shorter runs, the imbalance of whole
/// squares costs more than it costs to split one.
const FEWEST_SQUARES: usize = 64;

/// Added to every tile's cost, where 1 is the mean: samples of an empty tile must still be sent.
const LEAST_TILE_COST: f64 = 0.01;

/// The costs of tiles and the speeds of nodes, as learned so far.
#[derive(Debug, Default)]
pub(super) struct Balance {
    costs: Option<TileCosts>,
    node_speeds: BTreeMap<NodeId, NodeSpeed>,
}

/// The cost of each tile of the last frame.
#[derive(Debug)]
struct TileCosts {
    scene: SceneId,
    size: FrameSize,
    /// The frame's camera.
    camera: Camera,
    /// By index along the curve; the mean is 1.
    cost_of_tile: Vec<f64>,
    /// The change of each cost from the frame before, if the camera moved between the two.
    trend: Option<Vec<f64>>,
}

/// A node's speed.
#[derive(Clone, Copy, Debug)]
struct NodeSpeed {
    /// CPU time for a cost of 1; always positive. Relative: only ratios between nodes matter.
    slowness: f64,
    /// The number of frames it was learned from.
    n_frames: u32,
    /// Whether its last frame was ignored: it was an outlier, or others finished the node's task.
    is_suspect: bool,
}

/// The outcome of a task.
#[derive(Clone, Debug)]
pub(super) struct TaskResult<'a> {
    pub(super) node: NodeId,
    pub(super) share: Share,
    /// The measured costs of its tiles; `None` if others were faster.
    pub(super) costs: Option<&'a RunCosts>,
}

/// A node's CPU time for a frame, and the expected cost of its tiles.
#[derive(Clone, Copy, Debug, Default)]
struct NodeCost {
    nanoseconds: f64,
    expected: f64,
}

impl Balance {
    pub(super) fn mark_lost(&mut self, node: NodeId) {
        self.node_speeds.remove(&node);
    }

    /// Forgets the costs of tiles: after frames with another division they are too old.
    pub(super) fn forget_costs(&mut self) {
        self.costs = None;
    }

    /// Divides a frame among nodes, each given with its number of threads: one run of tiles for each, in their order.
    ///
    /// `None` if no frame of this scene has been learned from yet.
    pub(super) fn divide(&mut self, spec: &FrameSpec, nodes: &[(NodeId, u32)]) -> Option<Vec<Task>> {
        let speeds: Vec<f64> = nodes.iter().map(|&(node, threads)| f64::from(threads) / self.slowness(node)).collect();
        let costs = self.costs.as_mut().filter(|costs| costs.scene == spec.scene)?;
        if costs.size != spec.size {
            *costs = costs.resized(spec.size);
        }
        let expected = costs.expected(spec);
        let run = |run| Task { selection: Selection::CurveRun(run), part: Part::WHOLE };
        Some(cut_curve(&expected, &speeds).into_iter().map(run).collect())
    }

    /// Learns from a frame that was divided along the curve.
    pub(super) fn learn(&mut self, spec: &FrameSpec, tasks: &[TaskResult<'_>]) {
        let unfinished = tasks.iter().filter(|result| result.costs.is_none());
        unfinished.for_each(|result| self.slow_down(result.node));
        let n_tiles = Division::Dynamic.units(spec.size).count() as usize;
        // Compare each node's measured time with the expected costs of its tiles.
        let before = self.costs.take().filter(|costs| costs.matches(spec));
        let mut cost_of_tile = before.as_ref().map_or_else(|| vec![1.0; n_tiles], |before| before.cost_of_tile.clone());
        let node_costs = match &before {
            Some(before) => node_costs(&before.expected(spec), tasks),
            None => node_costs(&cost_of_tile, tasks),
        };
        // Nanoseconds per expected cost of 1, as on a node of slowness 1: the median is the change of the whole frame.
        let cost_ratio = |(&node, node_cost): (&NodeId, &NodeCost)| {
            (node, node_cost.nanoseconds / node_cost.expected / self.slowness(node))
        };
        let cost_ratios: BTreeMap<_, _> = node_costs.iter().map(cost_ratio).collect();
        let median_ratio = median(cost_ratios.values().copied()).unwrap_or(1.0);
        let trusted_nodes = self.learn_speeds(&cost_ratios, median_ratio);
        // Spread the measured time of each run evenly over its tiles, as on a node of slowness 1.
        for result in tasks.iter().filter(|result| trusted_nodes.contains(&result.node)) {
            let scale = 1.0 / (median_ratio * self.node_speeds[&result.node].slowness);
            for (tiles, nanoseconds) in measured_runs(result) {
                let cost = nanoseconds * scale / f64::from(tiles.len() as u32);
                tiles.for_each(|k| cost_of_tile[result.share.unit(k) as usize] = cost);
            }
        }
        // Scale to a mean of 1.
        let mean = cost_of_tile.iter().sum::<f64>() / n_tiles as f64;
        if mean > 0.0 {
            cost_of_tile.iter_mut().for_each(|cost| *cost /= mean);
        } else {
            cost_of_tile.fill(1.0);
        }
        // A camera that moved gives each tile a trend.
        let moved = before.filter(|before| before.camera != spec.camera);
        let trend = moved
            .map(|before| cost_of_tile.iter().zip(before.cost_of_tile).map(|(now, before)| now - before).collect());
        let FrameSpec { scene, size, camera, .. } = *spec;
        self.costs = Some(TileCosts { scene, size, camera, cost_of_tile, trend });
    }

    /// Updates the nodes' slownesses by the ratios of measured to expected times, and returns the nodes whose measurements
    /// are trusted.
    ///
    /// A few outliers are trusted only if they are outliers again in the next frame: a page fault or a debugger changes
    /// nothing. Many outliers are trusted at once: then the frame has changed, not the nodes.
    fn learn_speeds(&mut self, cost_ratios: &BTreeMap<NodeId, f64>, median_ratio: f64) -> Vec<NodeId> {
        let median_slowness = self.median_slowness();
        let is_outlier = |cost_ratio: f64| !(1.0 / OUTLIER..=OUTLIER).contains(&(cost_ratio / median_ratio));
        let n_outliers = cost_ratios.values().filter(|&&cost_ratio| is_outlier(cost_ratio)).count();
        let mut trusted_nodes = Vec::new();
        for (&node, &cost_ratio) in cost_ratios {
            let node_speed = self.node_speeds.entry(node).or_insert(NodeSpeed::unknown(median_slowness));
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

    /// Counts a node as slower after others have finished its task. Otherwise a node that never finishes in time would
    /// keep its share for ever, because nothing is learned from it.
    fn slow_down(&mut self, node: NodeId) {
        let unknown = NodeSpeed::unknown(self.median_slowness());
        let node_speed = self.node_speeds.entry(node).or_insert(unknown);
        if std::mem::replace(&mut node_speed.is_suspect, true) {
            node_speed.scale(UNFINISHED_SLOWDOWN);
        }
    }

    fn slowness(&self, node: NodeId) -> f64 {
        self.node_speeds.get(&node).map_or_else(|| self.median_slowness(), |node_speed| node_speed.slowness)
    }

    /// The slowness that is assumed for an unknown node.
    fn median_slowness(&self) -> f64 {
        median(self.node_speeds.values().map(|node_speed| node_speed.slowness)).unwrap_or(1.0)
    }
}

impl TileCosts {
    fn matches(&self, spec: &FrameSpec) -> bool {
        (self.scene, self.size) == (spec.scene, spec.size)
    }

    /// The costs in another resolution: each tile gets the cost of the old tile at its centre.
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

    /// The expected costs in the next frame: a moving camera is assumed to move on.
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
    fn unknown(slowness: f64) -> Self {
        Self { slowness, n_frames: 0, is_suspect: false }
    }

    fn scale(&mut self, factor: f64) {
        self.slowness = (self.slowness * factor).clamp(1.0 / LARGEST_SLOWNESS, LARGEST_SLOWNESS);
    }
}

/// The measured runs of a task's tiles, by index in its share, and their nanoseconds.
fn measured_runs<'a>(result: &'a TaskResult<'_>) -> impl Iterator<Item = (Range<u32>, f64)> + 'a {
    let runs = result.costs.into_iter().flat_map(|costs| costs.runs(result.share.count()));
    runs.map(|(tiles, nanoseconds)| (tiles, f64::from(nanoseconds)))
}

/// The measured time and the expected cost of each node, for nodes where both are positive.
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

/// Cuts the curve into one run for each speed, with costs in proportion to speeds as closely as whole tiles allow, or whole
/// squares if runs are long. Every run has a tile if there are enough.
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

/// Cuts a sequence of pieces with these costs into one run for each speed.
fn cut_between(piece_costs: &[f64], speeds: &[f64]) -> Vec<Range<usize>> {
    let (n_pieces, n_runs) = (piece_costs.len(), speeds.len());
    let per_speed = piece_costs.iter().sum::<f64>() / speeds.iter().sum::<f64>();
    let (mut end, mut sum, mut target) = (0, 0.0, 0.0);
    let mut runs = Vec::with_capacity(n_runs);
    for (index, speed) in speeds.iter().enumerate() {
        let first = end;
        target += speed * per_speed;
        let n_after = n_runs - index - 1;
        // Rounding must not shorten the last run: it ends with the frame.
        let latest = n_pieces.saturating_sub(n_after).max(first);
        let earliest = if n_after == 0 { n_pieces } else { (first + 1).min(latest) };
        // A piece belongs to the run that its centre of cost lies in.
        while end < earliest || end < latest && sum + piece_costs[end] / 2.0 < target {
            sum += piece_costs[end];
            end += 1;
        }
        runs.push(first..end);
    }
    runs
}

/// The median of positive values: the middle one, or the geometric mean of the middle two.
fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut sorted: Vec<_> = values.collect();
    sorted.sort_by(f64::total_cmp);
    let upper = *sorted.get(sorted.len() / 2)?;
    let lower = sorted[(sorted.len() - 1) / 2];
    Some((lower * upper).sqrt())
}

#[cfg(test)]
mod tests;
