//! Many lookups in a texture at once: loops over arrays, which the compiler turns into vector instructions.

use std::array::from_fn;

use glam::Vec2;

use crate::{
    model::material::Wrap,
    simd::{Kernel, Simd},
    texture::{
        footprint::{self, FootprintLanes, Footprints, MOST_SQUARES},
        level::{Level, blocks_per_row, column_offset, halved, neighbours, row_offset},
        mip_map::MipMap,
        texel::{Texel, UNITS},
    },
};

/// Samples whose lookups are done at once: two vectors of the widest kind, so that one is computed while the other waits for
/// memory.
const N: usize = 32;

/// Computes the means of a texture over footprints of samples.
pub(super) struct Means<'a> {
    pub(super) map: &'a MipMap,
    pub(super) wrap: [Wrap; 2],
    /// From texture coordinates of the mesh to those of the texture.
    pub(super) transform: &'a [[f32; 3]; 2],
    pub(super) footprints: &'a Footprints,
    /// By channel; those beyond the footprints become undefined.
    pub(super) means: &'a mut [[f32; 64]; 3],
}

/// The lookups of up to 64 samples: squares on a level, then the same on the next, if that has a part of the light.
struct Plans {
    first: [[f32; 64]; 2],
    step: [[f32; 64]; 2],
    n_squares: [u32; 64],
    level: [u32; 64],
    /// 0 beyond the samples.
    n_lookups: [u32; 64],
    /// The part that a lookup has of the light, on the level and on the next.
    weights: [[f32; 64]; 2],
}

/// The numbers of samples, in their order, with room for a vector after the last.
const SAMPLES: [u32; 64 + 16] = {
    let mut samples = [0; 64 + 16];
    let mut sample = 0;
    while sample < 64 {
        samples[sample] = sample as u32;
        sample += 1;
    }
    samples
};

/// Most lookups of a sample: all squares on two levels.
const MOST_LOOKUPS: u32 = 2 * MOST_SQUARES;

impl Kernel for Means<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let mut plans = self.plans();
        let n = self.footprints.n;
        let order = if plans.would_save_steps() { Some(plans.order::<S>()) } else { None };
        if let Some(order) = &order {
            plans.sort(&order[..n]);
        }
        for first in (0..n).step_by(N) {
            let lights = plans.lanes(first, &self.map.levels).lights::<S>(self.map, self.wrap);
            for (means, lights) in self.means.iter_mut().zip(&lights) {
                let Some(order) = &order else {
                    means[first..first + N].copy_from_slice(lights);
                    continue;
                };
                for (&sample, &light) in order[first..n].iter().zip(lights) {
                    means[sample as usize % 64] = light;
                }
            }
        }
    }
}

impl Means<'_> {
    /// Covers each footprint by squares, and blends two levels for each.
    #[inline(always)]
    fn plans(&self) -> Plans {
        let Self { map, transform, footprints, .. } = self;
        let [width, height] = map.levels[0].size;
        let size = Vec2::new(width as i32 as f32, height as i32 as f32);
        let last = map.levels.len() as u32 - 1;
        let mut plans = Plans {
            first: [[0.0; 64]; 2],
            step: [[0.0; 64]; 2],
            n_squares: [0; 64],
            level: [0; 64],
            n_lookups: [0; 64],
            weights: [[0.0; 64]; 2],
        };
        let chunks = footprints.lanes.iter().take(footprints.n.div_ceil(footprint::N));
        for (chunk, footprints) in chunks.enumerate() {
            plans.set(chunk, footprints, transform, size, last);
        }
        plans.n_lookups[footprints.n..].fill(0);
        plans
    }
}

impl Plans {
    /// Plans the lookups of a chunk of footprints for an image of `size` texels with a `last` level.
    #[inline(always)]
    fn set(&mut self, chunk: usize, footprints: &FootprintLanes, transform: &[[f32; 3]; 2], size: Vec2, last: u32) {
        let all = chunk * footprint::N..(chunk + 1) * footprint::N;
        let [first_u, first_v] = self.first.each_mut().map(|lanes| &mut lanes[all.clone()]);
        let [step_u, step_v] = self.step.each_mut().map(|lanes| &mut lanes[all.clone()]);
        let [weights, weights_of_next] = self.weights.each_mut().map(|lanes| &mut lanes[all.clone()]);
        let (n_squares, levels) = (&mut self.n_squares[all.clone()], &mut self.level[all.clone()]);
        let n_lookups = &mut self.n_lookups[all];
        for lane in 0..footprint::N {
            let squares = footprints.get(lane).transformed(transform).squares(size);
            (first_u[lane], first_v[lane]) = (squares.first.x, squares.first.y);
            (step_u[lane], step_v[lane]) = (squares.step.x, squares.step.y);
            let (level, part_of_next) = level_of(squares.width);
            let (level, part_of_next) = if level < last { (level, part_of_next) } else { (last, 0.0) };
            // A width just below the next level's needs that level alone.
            let (level, part_of_next) = if part_of_next < 1.0 { (level, part_of_next) } else { (level + 1, 0.0) };
            (levels[lane], n_squares[lane]) = (level, squares.n);
            n_lookups[lane] = if part_of_next > 0.0 { 2 * squares.n } else { squares.n };
            weights[lane] = squares.part * (1.0 - part_of_next);
            weights_of_next[lane] = squares.part * part_of_next;
        }
    }

    /// The samples by their number of lookups, the most first: lanes that are done together have about as many.
    #[inline(always)]
    fn order<S: Simd>(&self) -> [u32; 64 + 16] {
        let (mut order, mut n) = (SAMPLES, 0);
        for n_lookups in (1..=MOST_LOOKUPS).rev() {
            for first in (0..64).step_by(S::LANES) {
                let mask = S::eq_mask(&self.n_lookups[first..], n_lookups);
                n += S::load_bits(&SAMPLES[first..]).compress_bits_to(mask, &mut order[n..]);
            }
        }
        order
    }

    /// Whether sorted samples would need fewer steps, in each of which [`N`] do a lookup: those that need as many lookups as both
    /// halves do would fill one half. Where a surface is flat, all samples of a tile need about as many.
    #[inline(always)]
    fn would_save_steps(&self) -> bool {
        let (first, second) = self.n_lookups.split_at(N);
        let most = |half: &[u32]| half.iter().copied().max().unwrap_or(0);
        let of_both = most(first).min(most(second));
        self.n_lookups.iter().map(|&n_lookups| u32::from(n_lookups >= of_both)).sum::<u32>() <= N as u32
    }

    #[inline(always)]
    fn sort(&mut self, order: &[u32]) {
        let Self { first, step, n_squares, level, n_lookups, weights } = self;
        for numbers in [first, step, weights] {
            sort(&mut numbers[0], order);
            sort(&mut numbers[1], order);
        }
        for numbers in [n_squares, level, n_lookups] {
            sort(numbers, order);
        }
    }

    /// The plans of [`N`] samples.
    #[inline(always)]
    fn lanes(&self, first: usize, of_map: &[Level]) -> PlanLanes {
        let levels: [u32; N] = lanes(&self.level, first);
        let mut plans = PlanLanes {
            first: [lanes(&self.first[0], first), lanes(&self.first[1], first)],
            step: [lanes(&self.step[0], first), lanes(&self.step[1], first)],
            n_squares: lanes(&self.n_squares, first),
            n_lookups: lanes(&self.n_lookups, first),
            weights: [lanes(&self.weights[0], first), lanes(&self.weights[1], first)],
            sizes: [[[0; N]; 2]; 2],
            firsts: [[0; N]; 2],
        };
        // Most samples of a tile show one or two levels, and a comparison for each of these is faster than a search by sample.
        let [finest, coarsest] = [levels.into_iter().min(), levels.into_iter().max()].map(|level| level.unwrap_or(0));
        for level in finest..=coarsest {
            let pair = [level, level + 1].map(|level| of_map.get(level as usize).map_or(0, |level| level.first));
            for (firsts, of_level) in plans.firsts.iter_mut().zip(pair) {
                for lane in 0..N {
                    firsts[lane] = select(levels[lane] == level, firsts[lane], of_level);
                }
            }
        }
        let size = of_map[0].size;
        for (next, sizes) in plans.sizes.iter_mut().enumerate() {
            for lane in 0..N {
                let level = levels[lane] + next as u32;
                (sizes[0][lane], sizes[1][lane]) = (halved(size[0], level), halved(size[1], level));
            }
        }
        plans
    }
}

/// Sorts the numbers of samples; those beyond them are undefined.
#[inline(always)]
fn sort<T: Copy>(numbers: &mut [T; 64], order: &[u32]) {
    let unsorted = *numbers;
    numbers.iter_mut().zip(order).for_each(|(number, &sample)| *number = unsorted[sample as usize % 64]);
}

/// Some of the numbers of samples.
#[inline(always)]
fn lanes<T: Copy>(numbers: &[T; 64], first: usize) -> [T; N] {
    from_fn(|lane| numbers[(first + lane) % 64])
}

/// Some of [`Plans`], in lanes. Pairs are those of a level and of the next.
struct PlanLanes {
    first: [[f32; N]; 2],
    step: [[f32; N]; 2],
    n_squares: [u32; N],
    n_lookups: [u32; N],
    weights: [[f32; N]; 2],
    /// Columns and rows of texels.
    sizes: [[[u32; N]; 2]; 2],
    /// Indices of first texels.
    firsts: [[u32; N]; 2],
}

impl PlanLanes {
    /// The mean light of each lane.
    #[inline(always)]
    fn lights<S: Simd>(&self, map: &MipMap, wrap: [Wrap; 2]) -> [[f32; N]; 3] {
        let mut lights = [[0.0; N]; 3];
        let n_lookups = self.n_lookups.into_iter().max().unwrap_or(0);
        // Find the next texels before the last are read: memory delivers them meanwhile.
        let mut points = [Points::NONE; 2];
        points[0].find::<S, true>(self, 0, map, wrap);
        for number in 0..n_lookups {
            let [even, odd] = &mut points;
            let (points, next) = if number % 2 == 0 { (even, odd) } else { (odd, even) };
            if number + 1 < n_lookups {
                next.find::<S, false>(self, number + 1, map, wrap);
            }
            points.blend::<S>(map, &mut lights);
        }
        for (lights, unit) in lights.iter_mut().zip(UNITS) {
            lights.iter_mut().for_each(|light| *light *= unit);
        }
        lights
    }
}

/// The texels around a point in each lane.
#[derive(Clone, Copy)]
struct Points {
    /// Those above and to the left, above and to the right, and the two below.
    indices: [[u32; N]; 4],
    /// The fractions of the way to the right and down.
    x: [f32; N],
    y: [f32; N],
    weights: [f32; N],
}

impl Points {
    const NONE: Self = Self { indices: [[0; N]; 4], x: [0.0; N], y: [0.0; N], weights: [0.0; N] };

    /// Finds the texels of the lookup of a number; lanes without one have the weight 0.
    #[inline(always)]
    fn find<S: Simd, const IS_FIRST: bool>(&mut self, plans: &PlanLanes, number: u32, map: &MipMap, wrap: [Wrap; 2]) {
        let (mut u, mut v) = ([0.0; N], [0.0; N]);
        let (mut widths, mut heights, mut firsts) = ([1; N], [1; N], [0; N]);
        for n in 0..N {
            // The first lookup is on the level.
            let is_next = !IS_FIRST && number >= plans.n_squares[n];
            let square = (if is_next { number - plans.n_squares[n] } else { number }) as i32 as f32;
            u[n] = plans.first[0][n] + if IS_FIRST { 0.0 } else { plans.step[0][n] * square };
            v[n] = plans.first[1][n] + if IS_FIRST { 0.0 } else { plans.step[1][n] * square };
            let weight = select(is_next, plans.weights[0][n].to_bits(), plans.weights[1][n].to_bits());
            self.weights[n] = if number < plans.n_lookups[n] { f32::from_bits(weight) } else { 0.0 };
            widths[n] = select(is_next, plans.sizes[0][0][n], plans.sizes[1][0][n]);
            heights[n] = select(is_next, plans.sizes[0][1][n], plans.sizes[1][1][n]);
            firsts[n] = select(is_next, plans.firsts[0][n], plans.firsts[1][n]);
        }
        let (lefts, rights, x) = neighbours_of_all(&u, &widths, wrap[0]);
        let (uppers, lowers, y) = neighbours_of_all(&v, &heights, wrap[1]);
        (self.x, self.y) = (x, y);
        for n in 0..N {
            let upper = firsts[n] + row_offset(uppers[n], blocks_per_row(widths[n]));
            let lower = firsts[n] + row_offset(lowers[n], blocks_per_row(widths[n]));
            let (left, right) = (column_offset(lefts[n]), column_offset(rights[n]));
            (self.indices[0][n], self.indices[1][n]) = (upper + left, upper + right);
            (self.indices[2][n], self.indices[3][n]) = (lower + left, lower + right);
        }
        // The other three mostly lie in the same cache line.
        for n in 0..N {
            S::prefetch(&map.texels, self.indices[0][n] as usize);
        }
    }

    /// Adds the light of the points, in units of [`UNITS`].
    #[inline(always)]
    #[expect(clippy::needless_range_loop, reason = "`map` and `zip` of these arrays made a textured frame 4 % slower")]
    fn blend<S: Simd>(&self, map: &MipMap, lights: &mut [[f32; N]; 3]) {
        let mut texels = [[0; N]; 4];
        for (texels, indices) in texels.iter_mut().zip(&self.indices) {
            for first in (0..N).step_by(S::LANES) {
                S::gather_bits(&map.texels, &indices[first..]).store_bits(&mut texels[first..]);
            }
        }
        let mut parts = [[0.0; N]; 4];
        for n in 0..N {
            let (x, y) = (self.x[n], self.y[n]);
            let (above, below) = (self.weights[n] * (1.0 - y), self.weights[n] * y);
            (parts[0][n], parts[1][n]) = (above * (1.0 - x), above * x);
            (parts[2][n], parts[3][n]) = (below * (1.0 - x), below * x);
        }
        for (channel, lights) in lights.iter_mut().enumerate() {
            let light = |texel: u32| Texel::of_bits(texel).scaled(channel);
            for n in 0..N {
                let above = light(texels[0][n]) * parts[0][n] + light(texels[1][n]) * parts[1][n];
                let below = light(texels[2][n]) * parts[2][n] + light(texels[3][n]) * parts[3][n];
                lights[n] += above + below;
            }
        }
    }
}

/// One of two numbers, by their bits: of an `if` the compiler makes an address for each lane, and gathers from there.
#[inline(always)]
fn select(is_next: bool, of_level: u32, of_next: u32) -> u32 {
    of_level ^ (of_level ^ of_next) & u32::from(is_next).wrapping_neg()
}

/// [`neighbours`] in as many rows.
#[inline(always)]
fn neighbours_of_all(coordinates: &[f32; N], sizes: &[u32; N], wrap: Wrap) -> ([u32; N], [u32; N], [f32; N]) {
    let mut all = ([0; N], [0; N], [0.0; N]);
    // The wrap is constant in each loop.
    match wrap {
        Wrap::Repeat => neighbours_in_rows(coordinates, sizes, Wrap::Repeat, &mut all),
        Wrap::Mirror => neighbours_in_rows(coordinates, sizes, Wrap::Mirror, &mut all),
        Wrap::Clamp => neighbours_in_rows(coordinates, sizes, Wrap::Clamp, &mut all),
    }
    all
}

#[inline(always)]
fn neighbours_in_rows(
    coordinates: &[f32; N],
    sizes: &[u32; N],
    wrap: Wrap,
    (before, after, parts): &mut ([u32; N], [u32; N], [f32; N]),
) {
    for n in 0..N {
        ([before[n], after[n]], parts[n]) = neighbours(coordinates[n], sizes[n], wrap);
    }
}

/// The level whose texels are the next smaller than `width`, in texels of the image, and the part of the next level.
///
/// A number's exponent and mantissa are its logarithm, linear between powers of two. The part changes in the middle
/// quarter alone: other widths need one lookup. Nothing branches, so that a loop becomes vector instructions.
#[inline(always)]
fn level_of(width: f32) -> (u32, f32) {
    const MANTISSA: u32 = 0x007f_ffff;
    // Not less than a texel; NaN is one.
    let bits = (if width > 1.0 { width } else { 1.0 }).to_bits();
    let part = 4.0 * (f32::from_bits(bits & MANTISSA | 1.0f32.to_bits()) - 1.0) - 1.5;
    let part = if part > 0.0 { part } else { 0.0 };
    ((bits >> 23) - 127, if part < 1.0 { part } else { 1.0 })
}
