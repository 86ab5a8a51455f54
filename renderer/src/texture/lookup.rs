//! Many lookups in a texture at once: loops over arrays, which the compiler turns into vector instructions.

use glam::{Vec2, Vec3A};

use crate::{
    model::material::Wrap,
    simd::{Kernel, Simd},
    texture::{
        footprint::Footprint,
        level::{column_offset, neighbours, row_offset},
        mip_map::MipMap,
        texel::{Texel, UNITS},
    },
};

/// A point of a level of a texture, and its part of a sample's light.
#[derive(Clone, Copy)]
struct Lookup {
    sample: u32,
    level: u32,
    at: Vec2,
    weight: f32,
}

/// Lookups that are done at once.
const N: usize = 32;

/// Computes the means of a texture over footprints of samples.
pub(super) struct Means<'a> {
    pub(super) map: &'a MipMap,
    pub(super) wrap: [Wrap; 2],
    pub(super) footprints: &'a [Footprint],
    /// One for each footprint.
    pub(super) means: &'a mut [Vec3A],
}

impl Kernel for Means<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let Self { map, wrap, footprints, means } = self;
        let [width, height] = map.levels[0].size;
        let size = Vec2::new(width as i32 as f32, height as i32 as f32);
        let last = map.levels.len() as u32 - 1;

        // Cover each footprint by squares, and blend two levels for each.
        let mut lookups = Vec::with_capacity(4 * footprints.len());
        for (sample, footprint) in (0..).zip(footprints) {
            let squares = footprint.squares(size);
            let (level, part_of_next) = level_of(squares.width);
            let (level, part_of_next) = if level < last { (level, part_of_next) } else { (last, 0.0) };
            let weight = 1.0 / squares.n as i32 as f32;
            for index in 0..squares.n {
                let at = squares.first + squares.step * index as i32 as f32;
                if part_of_next < 1.0 {
                    lookups.push(Lookup { sample, level, at, weight: weight * (1.0 - part_of_next) });
                }
                if part_of_next > 0.0 {
                    lookups.push(Lookup { sample, level: level + 1, at, weight: weight * part_of_next });
                }
            }
        }

        means.fill(Vec3A::ZERO);
        for lookups in lookups.chunks(N) {
            add(map, wrap, lookups, means);
        }
    }
}

/// Adds up to [`N`] lookups to the lights of their samples.
#[inline(always)]
fn add(map: &MipMap, wrap: [Wrap; 2], lookups: &[Lookup], means: &mut [Vec3A]) {
    let (mut u, mut v, mut weights) = ([0.0; N], [0.0; N], [0.0; N]);
    let (mut widths, mut heights, mut blocks_per_row, mut firsts) = ([1; N], [1; N], [1; N], [0; N]);
    for (n, lookup) in lookups.iter().enumerate().take(N) {
        let level = &map.levels[lookup.level as usize];
        (u[n], v[n], weights[n]) = (lookup.at.x, lookup.at.y, lookup.weight);
        (widths[n], heights[n]) = (level.size[0], level.size[1]);
        (blocks_per_row[n], firsts[n]) = (level.blocks_per_row, level.first);
    }
    let (lefts, rights, x) = neighbours_of_all(&u, &widths, wrap[0]);
    let (uppers, lowers, y) = neighbours_of_all(&v, &heights, wrap[1]);

    // Read the four texels around each point.
    let mut indices = [[0; N]; 4];
    for n in 0..N {
        let upper = firsts[n] + row_offset(uppers[n], blocks_per_row[n]);
        let lower = firsts[n] + row_offset(lowers[n], blocks_per_row[n]);
        let (left, right) = (column_offset(lefts[n]), column_offset(rights[n]));
        (indices[0][n], indices[1][n]) = (upper + left, upper + right);
        (indices[2][n], indices[3][n]) = (lower + left, lower + right);
    }
    let mut texels = [[Texel::default(); N]; 4];
    for n in 0..lookups.len().min(N) {
        texels[0][n] = map.texels[indices[0][n] as usize];
        texels[1][n] = map.texels[indices[1][n] as usize];
        texels[2][n] = map.texels[indices[2][n] as usize];
        texels[3][n] = map.texels[indices[3][n] as usize];
    }

    // Blend them.
    let mut lights = [[0.0; N]; 3];
    for (channel, lights) in lights.iter_mut().enumerate() {
        for n in 0..N {
            let (a, b) = (texels[0][n].scaled(channel), texels[1][n].scaled(channel));
            let (c, d) = (texels[2][n].scaled(channel), texels[3][n].scaled(channel));
            let (above, below) = (a + (b - a) * x[n], c + (d - c) * x[n]);
            lights[n] = (above + (below - above) * y[n]) * (weights[n] * UNITS[channel]);
        }
    }
    for (n, lookup) in lookups.iter().enumerate().take(N) {
        means[lookup.sample as usize] += Vec3A::new(lights[0][n], lights[1][n], lights[2][n]);
    }
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
/// A number's exponent and mantissa are its logarithm, linear between powers of two. The part changes in the middle half alone:
/// other widths need one lookup.
#[inline(always)]
fn level_of(width: f32) -> (u32, f32) {
    const MANTISSA: u32 = 0x007f_ffff;
    if width <= 1.0 {
        return (0, 0.0);
    }
    let bits = width.to_bits();
    let part = f32::from_bits(bits & MANTISSA | 1.0f32.to_bits()) - 1.0;
    ((bits >> 23 & 0xff) - 127, (2.0 * part - 0.5).clamp(0.0, 1.0))
}
