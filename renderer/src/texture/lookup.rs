//! Many lookups in a texture at once: loops over arrays, which the compiler turns into vector instructions.

use glam::Vec2;

use crate::{
    model::material::Wrap,
    simd::{Kernel, Simd},
    texture::{
        footprint::{self, FootprintLanes, Footprints, MOST_SQUARES},
        level::{blocks_per_row, column_offset, halved, neighbours, row_offset},
        mip_map::MipMap,
        packed_rgb::{PackedRgb, UNITS},
    },
};

/// Samples whose lookups are done at once.
const N: usize = 16;

/// [`N`] samples each.
const N_CHUNKS: usize = 64 / N;

/// Levels that are used, as many as a vector can choose from: all of an image of 32768×32768.
const MOST_LEVELS: usize = 16;

/// Multiplies numbers by a factor, and by the means of a texture over footprints of samples.
pub(super) struct MultiplyByMeans<'a> {
    pub(super) map: &'a MipMap,
    pub(super) wrap: [Wrap; 2],
    /// From texture coordinates of the mesh to those of the texture.
    pub(super) transform: &'a [[f32; 3]; 2],
    pub(super) footprints: &'a Footprints,
    /// By channel.
    pub(super) factor: [f32; 3],
    /// By channel; those beyond the footprints become undefined.
    pub(super) numbers: &'a mut [[f32; 64]; 3],
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

/// Sorting takes about as long as so many steps.
const STEPS_OF_SORTING: u32 = 3;

/// Most lookups of a sample: all squares on two levels.
const MOST_LOOKUPS: u32 = 2 * MOST_SQUARES;

impl Kernel for MultiplyByMeans<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        if let Some(lights) = self.lights_of_small::<S>() {
            self.multiply(&lights);
            return;
        }
        let mut plans = self.plans();
        let n = self.footprints.n;
        let order = if plans.would_save_steps() { Some(plans.order::<S>()) } else { None };
        if let Some(order) = &order {
            plans.sort(&order[..n]);
        }
        let mut lights = plans.lights::<S>(self.map, self.wrap);
        if let Some(order) = &order {
            for lights in &mut lights {
                let sorted = *lights;
                for (&sample, light) in order[..n].iter().zip(sorted) {
                    lights[sample as usize % 64] = light;
                }
            }
        }
        self.multiply(&lights);
    }
}

impl MultiplyByMeans<'_> {
    /// The light of samples whose footprints are all small, in units of [`UNITS`], which needs one lookup for each. `None` if
    /// some are not.
    ///
    /// Close to a surface most samples are such; they get by without plans, which take as long as their lookups.
    #[inline(always)]
    fn lights_of_small<S: Simd>(&self) -> Option<[[f32; 64]; 3]> {
        let size = self.map.levels[0].size;
        let [width, height] = size.map(|side| side as i32 as f32);
        let n_chunks = self.footprints.n.div_ceil(N);
        let mut points = [Points::NONE; N_CHUNKS];
        for (points, footprints) in points.iter_mut().zip(&self.footprints.lanes[..n_chunks]) {
            let (mut u, mut v, mut n_small) = ([0.0; N], [0.0; N], 0);
            for lane in 0..N {
                let footprint = footprints.get(lane).transformed(self.transform);
                (u[lane], v[lane]) = (footprint.centre.x, footprint.centre.y);
                n_small += u32::from(footprint.is_small(Vec2::new(width, height)));
            }
            if n_small < N as u32 {
                return None;
            }
            points.weights = [1.0; N];
            points.find_texels(&u, &v, &size.map(|side| [side; N]), &[0; N], self.wrap);
        }
        let mut lights = [[0.0; 64]; 3];
        for (chunk, points) in points.iter().enumerate().take(n_chunks) {
            points.blend::<S>(self.map, chunk, &mut lights);
        }
        Some(lights)
    }

    /// Multiplies the numbers by lights in units of [`UNITS`].
    #[inline(always)]
    fn multiply(self, lights: &[[f32; 64]; 3]) {
        for (channel, (numbers, lights)) in self.numbers.iter_mut().zip(lights).enumerate() {
            let factor = UNITS[channel] * self.factor[channel];
            numbers.iter_mut().zip(lights).for_each(|(number, light)| *number *= light * factor);
        }
    }

    /// Covers each footprint by squares, and blends two levels for each.
    #[inline(always)]
    fn plans(&self) -> Plans {
        let Self { map, transform, footprints, .. } = self;
        let [width, height] = map.levels[0].size;
        let size = Vec2::new(width as i32 as f32, height as i32 as f32);
        let last = map.levels.len().min(MOST_LEVELS) as u32 - 1;
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

    /// Whether sorted samples would need fewer steps, in each of which [`N`] do a lookup. Where a surface is flat, all samples of
    /// a tile need about as many.
    #[inline(always)]
    fn would_save_steps(&self) -> bool {
        let (chunks, _) = self.n_lookups.as_chunks::<N>();
        let n_steps: u32 = chunks.iter().map(|chunk| chunk.iter().copied().max().unwrap_or(0)).sum();
        // Full steps are the fewest, and mostly show that sorting is not worth it.
        let n_full_steps = self.n_lookups.iter().sum::<u32>().div_ceil(N as u32);
        if n_steps < n_full_steps + STEPS_OF_SORTING {
            return false;
        }
        let n_with = |least: u32| self.n_lookups.iter().map(|&n_lookups| u32::from(n_lookups >= least)).sum::<u32>();
        let n_sorted_steps: u32 = (1..=MOST_LOOKUPS).map(|least| n_with(least).div_ceil(N as u32)).sum();
        n_steps >= n_sorted_steps + STEPS_OF_SORTING
    }

    #[inline(always)]
    fn sort(&mut self, order: &[u32]) {
        let Self { first, step, n_squares, level, n_lookups, weights, .. } = self;
        for numbers in [first, step, weights] {
            sort(&mut numbers[0], order);
            sort(&mut numbers[1], order);
        }
        for numbers in [n_squares, level, n_lookups] {
            sort(numbers, order);
        }
    }

    /// The mean light of each sample, in units of [`UNITS`].
    #[inline(always)]
    fn lights<S: Simd>(&self, map: &MipMap, wrap: [Wrap; 2]) -> [[f32; 64]; 3] {
        let mut lights = [[0.0; 64]; 3];
        let mut points = [[Points::NONE; N_CHUNKS]; 2];
        let mut first_texels = [0; MOST_LEVELS];
        first_texels.iter_mut().zip(&map.levels).for_each(|(first, level)| *first = level.first);
        let levels = (map, &first_texels);
        let n_lookups = self.n_lookups.iter().copied().max().unwrap_or(0);
        // Find the texels of the next lookups before the present ones are read: memory delivers them meanwhile.
        let mut present = self.chunks_with(0);
        for &chunk in present.as_slice() {
            points[0][chunk].find::<S, true>(self, chunk, 0, levels, wrap);
        }
        for number in 1..=n_lookups {
            let [even, odd] = &mut points;
            let (of_present, of_next) = if number % 2 == 1 { (even, odd) } else { (odd, even) };
            let next = self.chunks_with(number);
            for &chunk in next.as_slice() {
                of_next[chunk].find::<S, false>(self, chunk, number, levels, wrap);
            }
            for &chunk in present.as_slice() {
                of_present[chunk].blend::<S>(map, chunk, &mut lights);
            }
            present = next;
        }
        lights
    }

    /// The chunks of which some samples have a lookup of this number.
    #[inline(always)]
    fn chunks_with(&self, number: u32) -> Chunks {
        let mut chunks = Chunks { chunks: [0; N_CHUNKS], n: 0 };
        for chunk in 0..N_CHUNKS {
            chunks.chunks[chunks.n] = chunk;
            chunks.n += usize::from(lanes(&self.n_lookups, chunk).iter().any(|&n_lookups| number < n_lookups));
        }
        chunks
    }
}

/// Some of the chunks.
struct Chunks {
    chunks: [usize; N_CHUNKS],
    n: usize,
}

impl Chunks {
    #[inline(always)]
    fn as_slice(&self) -> &[usize] {
        &self.chunks[..self.n]
    }
}

/// Sorts the numbers of samples; those beyond them are undefined.
#[inline(always)]
fn sort<T: Copy>(numbers: &mut [T; 64], order: &[u32]) {
    let unsorted = *numbers;
    numbers.iter_mut().zip(order).for_each(|(number, &sample)| *number = unsorted[sample as usize % 64]);
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

    /// Finds the texels of the lookup of a number for the samples of a chunk; those without one have the weight 0.
    #[inline(always)]
    fn find<S: Simd, const IS_FIRST: bool>(
        &mut self,
        plans: &Plans,
        chunk: usize,
        number: u32,
        (map, first_texels): (&MipMap, &[u32; MOST_LEVELS]),
        wrap: [Wrap; 2],
    ) {
        let (n_squares, n_lookups) = (lanes(&plans.n_squares, chunk), lanes(&plans.n_lookups, chunk));
        let [first_u, first_v] = plans.first.each_ref().map(|numbers| lanes(numbers, chunk));
        let [step_u, step_v] = plans.step.each_ref().map(|numbers| lanes(numbers, chunk));
        let [of_level, of_next] = plans.weights.each_ref().map(|numbers| lanes(numbers, chunk));
        let (mut u, mut v) = ([0.0; N], [0.0; N]);
        let (mut sizes, mut levels, mut firsts) = ([[1; N]; 2], [0; N], [0; N]);
        let (of_plans, size) = (lanes(&plans.level, chunk), map.levels[0].size);
        for n in 0..N {
            // The first lookup is on the level. A lane without one repeats its last: other texels would be fetched for nothing.
            let own = if IS_FIRST { number } else { number.min(n_lookups[n].wrapping_sub(1)) };
            let is_next = !IS_FIRST && own >= n_squares[n];
            let square = (if is_next { own - n_squares[n] } else { own }) as i32 as f32;
            u[n] = first_u[n] + if IS_FIRST { 0.0 } else { step_u[n] * square };
            v[n] = first_v[n] + if IS_FIRST { 0.0 } else { step_v[n] * square };
            let weight = select(is_next, of_level[n].to_bits(), of_next[n].to_bits());
            self.weights[n] = if number < n_lookups[n] { f32::from_bits(weight) } else { 0.0 };
            levels[n] = of_plans[n] + u32::from(is_next);
            (sizes[0][n], sizes[1][n]) = (halved(size[0], levels[n]), halved(size[1], levels[n]));
        }
        for first in (0..N).step_by(S::LANES) {
            S::pick_bits(first_texels, &levels[first..]).store_bits(&mut firsts[first..]);
        }
        self.find_texels(&u, &v, &sizes, &firsts, wrap);
        // The other three, and those of the next lane, mostly lie in the same cache line.
        for n in (0..N).step_by(2) {
            S::prefetch(&map.texels, self.indices[0][n] as usize);
        }
    }

    /// Finds the texels around points of levels of some sizes, whose first texels are `firsts`.
    #[inline(always)]
    fn find_texels(&mut self, u: &[f32; N], v: &[f32; N], sizes: &[[u32; N]; 2], firsts: &[u32; N], wrap: [Wrap; 2]) {
        let [widths, heights] = sizes;
        let (lefts, rights, x) = neighbours_of_all(u, widths, wrap[0]);
        let (uppers, lowers, y) = neighbours_of_all(v, heights, wrap[1]);
        (self.x, self.y) = (x, y);
        for n in 0..N {
            let upper = firsts[n] + row_offset(uppers[n], blocks_per_row(widths[n]));
            let lower = firsts[n] + row_offset(lowers[n], blocks_per_row(widths[n]));
            let (left, right) = (column_offset(lefts[n]), column_offset(rights[n]));
            (self.indices[0][n], self.indices[1][n]) = (upper + left, upper + right);
            (self.indices[2][n], self.indices[3][n]) = (lower + left, lower + right);
        }
    }

    /// Adds the light of the points to that of a chunk, in units of [`UNITS`].
    #[inline(always)]
    #[expect(clippy::needless_range_loop, reason = "`map` and `zip` of these arrays made a textured frame 4 % slower")]
    fn blend<S: Simd>(&self, map: &MipMap, chunk: usize, lights: &mut [[f32; 64]; 3]) {
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
            let lights = &mut lights.as_chunks_mut::<N>().0[chunk];
            let light = |texel: u32| PackedRgb::of_bits(texel).scaled(channel);
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

/// The numbers of the samples of a chunk.
#[inline(always)]
fn lanes<T>(numbers: &[T; 64], chunk: usize) -> &[T; N] {
    &numbers.as_chunks().0[chunk]
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
/// sixth alone: other widths need one lookup. Nothing branches, so that a loop becomes vector instructions.
#[inline(always)]
fn level_of(width: f32) -> (u32, f32) {
    const MANTISSA: u32 = 0x007f_ffff;
    // Not less than a texel; NaN is one.
    let bits = (if width > 1.0 { width } else { 1.0 }).to_bits();
    let part = 6.0 * (f32::from_bits(bits & MANTISSA | 1.0f32.to_bits()) - 1.0) - 2.5;
    let part = if part > 0.0 { part } else { 0.0 };
    ((bits >> 23) - 127, if part < 1.0 { part } else { 1.0 })
}
