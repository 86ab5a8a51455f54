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
    division::{Division, FrameSize, Part, Picked, Share, TileRun, Work},
    protocol::{BlockCosts, Picture},
    scene::SceneId,
};

use crate::farm::stats::NodeId;

/// How much of what the newest frame says about a speed is believed, once a render server is known.
const GAIN: f64 = 0.25;

/// A render server that took this many times as long as expected, or as little, is an outlier.
const OUTLIER: f64 = 2.0;

/// Speeds differ by no more than this from what was thought before, or the measurement is wrong.
const LARGEST_STEP: f64 = 16.0;

/// Slowness stays within this factor of 1, whatever a render server claims.
const LARGEST_SLOWNESS: f64 = 1e3;

/// How much slower a render server counts after the second frame in a row that became whole without it.
const UNFINISHED: f64 = 1.25;

/// How much of a trend is believed to go on: all of it would double what measurements waver.
const TREND: f64 = 0.8;

/// How many squares a run has on average where it is cut between them only: with fewer, what a square costs more than it
/// should is more than what parting its tiles costs.
const FEWEST_SQUARES: usize = 64;

/// What every tile counts in addition, in parts of the mean tile: one that no ray took long for must still be sent.
const FLOOR: f64 = 0.01;

/// What is known about the costs of tiles and the speeds of render servers.
#[derive(Debug, Default)]
pub(super) struct Balance {
    costs: Option<TileCosts>,
    paces: BTreeMap<NodeId, Pace>,
}

/// What each tile of the last frame cost.
#[derive(Debug)]
struct TileCosts {
    scene: SceneId,
    size: FrameSize,
    /// From where it was seen.
    camera: Camera,
    /// Along the curve; 1 is the mean.
    of_tile: Vec<f64>,
    /// How much more that is than in the frame before, if the camera moved between the two.
    trend: Option<Vec<f64>>,
}

/// How fast a render server is.
#[derive(Clone, Copy, Debug)]
struct Pace {
    /// CPU time for what takes 1 on a usual one; always positive.
    slowness: f64,
    /// Frames that it was learned from.
    n_frames: u32,
    /// Whether its last frame was an outlier or became whole without it, and so believed in nothing.
    is_suspect: bool,
}

/// What became of a work.
#[derive(Clone, Debug)]
pub(super) struct Measured<'a> {
    pub(super) node: NodeId,
    pub(super) share: Share<'a>,
    /// What its tiles cost; `None` if others were faster.
    pub(super) costs: Option<&'a BlockCosts>,
}

/// A render server's frame: what it took, and what was expected of a usual one.
#[derive(Clone, Copy, Debug, Default)]
struct Effort {
    nanoseconds: f64,
    expected: f64,
}

impl Balance {
    pub(super) fn lose(&mut self, node: NodeId) {
        self.paces.remove(&node);
    }

    /// A frame is divided otherwise: what tiles cost before it says little about those after it.
    pub(super) fn forget_costs(&mut self) {
        self.costs = None;
    }

    /// Divides a frame among render servers with so many threads each: a run of tiles for each, as they are given.
    ///
    /// `None` when no frame of this scene has been learned from yet.
    pub(super) fn divide(&mut self, picture: &Picture, nodes: &[(NodeId, u32)]) -> Option<Vec<Work>> {
        let usual = self.usual_slowness();
        let costs = self.costs.as_mut().filter(|costs| costs.scene == picture.scene)?;
        if costs.size != picture.size {
            *costs = costs.resized(picture.size);
        }
        let expected = costs.expected(picture);
        let speed = |&(node, threads): &(NodeId, u32)| {
            f64::from(threads) / self.paces.get(&node).map_or(usual, |pace| pace.slowness)
        };
        let speeds: Vec<f64> = nodes.iter().map(speed).collect();
        let run = |run| Work { picked: Picked::CurveRun(run), part: Part::WHOLE };
        Some(cut(&expected, &speeds).into_iter().map(run).collect())
    }

    /// Learns from a frame that was divided along the curve.
    pub(super) fn learn(&mut self, picture: &Picture, works: &[Measured<'_>]) {
        let unfinished = works.iter().filter(|measured| measured.costs.is_none());
        unfinished.for_each(|measured| self.slow_down(measured.node));
        let n_tiles = Division::Dynamic.units(picture.size).count() as usize;
        let before = self.costs.take().filter(|costs| costs.are_of(picture));
        let mut of_tile = before.as_ref().map_or_else(|| vec![1.0; n_tiles], |before| before.of_tile.clone());
        let efforts = match &before {
            Some(before) => efforts(&before.expected(picture), works),
            None => efforts(&of_tile, works),
        };
        let usual = self.usual_slowness();
        // How much more all of the picture costs than it did, in nanoseconds for what cost 1.
        let surprise = |(node, effort): (&NodeId, &Effort)| {
            effort.nanoseconds / effort.expected / self.paces.get(node).map_or(usual, |pace| pace.slowness)
        };
        let surprises: BTreeMap<_, _> = efforts.iter().map(|effort| (*effort.0, surprise(effort))).collect();
        let common = median(surprises.values().copied()).unwrap_or(1.0);
        let trusted = self.learn_paces(&surprises, common, usual);
        for measured in works.iter().filter(|measured| trusted.contains(&measured.node)) {
            let scale = 1.0 / (common * self.paces[&measured.node].slowness);
            for (tiles, nanoseconds) in tiles_of(measured) {
                let cost = nanoseconds * scale / f64::from(tiles.len() as u32);
                tiles.for_each(|k| of_tile[measured.share.unit(k) as usize] = cost);
            }
        }
        let mean = of_tile.iter().sum::<f64>() / n_tiles as f64;
        if mean > 0.0 {
            of_tile.iter_mut().for_each(|cost| *cost /= mean);
        } else {
            of_tile.fill(1.0);
        }
        let moved = before.filter(|before| before.camera != picture.camera);
        let trend = moved.map(|before| of_tile.iter().zip(before.of_tile).map(|(now, before)| now - before).collect());
        let Picture { scene, size, camera, .. } = *picture;
        self.costs = Some(TileCosts { scene, size, camera, of_tile, trend });
    }

    /// Learns how fast render servers are from how much longer than expected they took, and says whose measurements are to
    /// be believed.
    ///
    /// One or few outliers are believed only when they are so again in the next frame: a page fault or a debugger moves
    /// nothing. When many are, the picture has changed, not they.
    fn learn_paces(&mut self, surprises: &BTreeMap<NodeId, f64>, common: f64, usual: f64) -> Vec<NodeId> {
        let is_outlier = |surprise: f64| !(1.0 / OUTLIER..=OUTLIER).contains(&(surprise / common));
        let n_outliers = surprises.values().filter(|&&surprise| is_outlier(surprise)).count();
        let mut trusted = Vec::new();
        for (&node, &surprise) in surprises {
            let pace = self.paces.entry(node).or_insert(Pace { slowness: usual, n_frames: 0, is_suspect: false });
            let is_known = pace.n_frames > 0;
            pace.is_suspect = is_known && !pace.is_suspect && is_outlier(surprise) && 4 * n_outliers <= surprises.len();
            if pace.is_suspect {
                continue;
            }
            pace.n_frames = pace.n_frames.saturating_add(1);
            let gain = GAIN.max(1.0 / f64::from(pace.n_frames));
            pace.scale((surprise / common).clamp(1.0 / LARGEST_STEP, LARGEST_STEP).powf(gain));
            trusted.push(node);
        }
        trusted
    }

    /// A frame became whole without a render server. One that never finished is believed to be slow as well, or it would
    /// be late for ever and nothing be learned of it.
    fn slow_down(&mut self, node: NodeId) {
        let pace = Pace { slowness: self.usual_slowness(), n_frames: 0, is_suspect: false };
        let pace = self.paces.entry(node).or_insert(pace);
        if std::mem::replace(&mut pace.is_suspect, true) {
            pace.scale(UNFINISHED);
        }
    }

    /// What is expected of a render server that has not shown how fast it is.
    fn usual_slowness(&self) -> f64 {
        median(self.paces.values().map(|pace| pace.slowness)).unwrap_or(1.0)
    }
}

impl TileCosts {
    fn are_of(&self, picture: &Picture) -> bool {
        (self.scene, self.size) == (picture.scene, picture.size)
    }

    /// The same picture in another resolution: each tile costs what the one does in which its middle lies.
    fn resized(&self, size: FrameSize) -> Self {
        let tiles = |size: FrameSize| [size.x_tiles(), size.y_tiles()];
        let ([columns, rows], [old_columns, old_rows]) = (tiles(size), tiles(self.size));
        let scaled = |at: u32, n: u32, n_old: u32| (2 * at + 1) * n_old / (2 * n);
        let of_old = |tile| {
            let (column, row) = curve::tile_at(tile, columns, rows);
            let (column, row) = (scaled(column, columns, old_columns), scaled(row, rows, old_rows));
            curve::index_of(column, row, old_columns, old_rows) as usize
        };
        let places: Vec<usize> = (0..columns * rows).map(of_old).collect();
        let resized = |of_old: &Vec<f64>| places.iter().map(|&place| of_old[place]).collect();
        Self { size, of_tile: resized(&self.of_tile), trend: self.trend.as_ref().map(resized), ..*self }
    }

    /// What tiles will cost in the next frame: a camera that moved moves on.
    fn expected(&self, picture: &Picture) -> Cow<'_, [f64]> {
        match &self.trend {
            Some(trend) if self.camera != picture.camera => {
                self.of_tile.iter().zip(trend).map(|(cost, trend)| cost + TREND * trend).collect()
            }
            _ => Cow::Borrowed(&self.of_tile),
        }
    }
}

impl Pace {
    fn scale(&mut self, factor: f64) {
        self.slowness = (self.slowness * factor).clamp(1.0 / LARGEST_SLOWNESS, LARGEST_SLOWNESS);
    }
}

/// The blocks of tiles that a work was measured in, as places in its share, and their nanoseconds.
fn tiles_of<'a>(measured: &'a Measured<'_>) -> impl Iterator<Item = (Range<u32>, f64)> + 'a {
    let blocks = measured.costs.into_iter().flat_map(|costs| costs.blocks(measured.share.count()));
    blocks.map(|(tiles, nanoseconds)| (tiles, f64::from(nanoseconds)))
}

/// What each render server took in all, and what was expected; without those of whom nothing can be learned.
fn efforts(of_tile: &[f64], works: &[Measured<'_>]) -> BTreeMap<NodeId, Effort> {
    let mut efforts = BTreeMap::<NodeId, Effort>::new();
    for measured in works {
        let effort = efforts.entry(measured.node).or_default();
        for (tiles, nanoseconds) in tiles_of(measured) {
            effort.nanoseconds += nanoseconds;
            effort.expected += tiles.map(|k| of_tile[measured.share.unit(k) as usize]).sum::<f64>();
        }
    }
    efforts.retain(|_, effort| effort.nanoseconds > 0.0 && effort.expected > 0.0);
    efforts
}

/// Cuts the curve into one run for each speed, so that costs are in proportion to speeds as well as whole tiles allow, or
/// whole squares of them where each run has many.
///
/// Every run has a tile if there are enough.
fn cut(of_tile: &[f64], speeds: &[f64]) -> Vec<TileRun> {
    let costs: Vec<f64> = of_tile.iter().map(|cost| cost + FLOOR).collect();
    let n_together = curve::TILES_TOGETHER as usize;
    let size = if costs.len() < FEWEST_SQUARES * n_together * speeds.len() { 1 } else { n_together };
    let of_piece: Vec<f64> = costs.chunks(size).map(|tiles| tiles.iter().sum()).collect();
    let tiles = |pieces: Range<usize>| {
        let (first, end) = (pieces.start * size, (pieces.end * size).min(costs.len()));
        TileRun { first: first as u32, count: (end - first) as u32 }
    };
    cut_between(&of_piece, speeds).into_iter().map(tiles).collect()
}

/// The same between pieces of the curve that have these costs.
fn cut_between(of_piece: &[f64], speeds: &[f64]) -> Vec<Range<usize>> {
    let (n_pieces, n_runs) = (of_piece.len(), speeds.len());
    let per_speed = of_piece.iter().sum::<f64>() / speeds.iter().sum::<f64>();
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
        while end < earliest || end < latest && sum + of_piece[end] / 2.0 < wanted {
            sum += of_piece[end];
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
