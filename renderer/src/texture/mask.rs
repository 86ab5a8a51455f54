//! The coverage of a surface: where it is less than a cutoff, rays pass.

use serde::{Deserialize, Serialize};

use crate::{
    model::material::{Image, Wrap},
    scene_file::section::Section,
    texture::level::{Level, column_offset, is_indexable, neighbours, row_offset},
};

/// The coverage channel of an image, of its full size: a mask is the same for all rays, however wide they are.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Mask {
    level: Level,
    #[serde(skip)]
    pub(super) coverage: Section<u8>,
}

impl Mask {
    /// Bytes of the mask of an image.
    pub(super) fn n_bytes_of(image: &Image) -> u64 {
        u64::from(Level::new([image.width, image.height], 0).n_texels())
    }

    pub(super) fn new(image: &Image) -> Self {
        let level = Level::new([image.width, image.height], 0);
        let mut coverage = vec![0; level.n_texels() as usize];
        level.fill(&mut coverage, |x, y| image.texels[y as usize * image.width as usize + x as usize][3]);
        Self { level, coverage: coverage.into() }
    }

    pub(super) fn n_bytes(&self) -> usize {
        size_of_val(&*self.coverage)
    }

    /// Whether lookups find all texels that they look for.
    pub(super) fn is_whole(&self) -> bool {
        let size = self.level.size;
        size.iter().all(|&side| side > 0)
            && is_indexable(size)
            && self.level == Level::new(size, 0)
            && self.coverage.len() == self.level.n_texels() as usize
    }

    /// Coverage at a point, 0 to 1, blended from the four texels around it.
    pub(super) fn at(&self, [u, v]: [f32; 2], [wrap_u, wrap_v]: [Wrap; 2]) -> f32 {
        let (columns, x) = neighbours(u, self.level.size[0], wrap_u);
        let (rows, y) = neighbours(v, self.level.size[1], wrap_v);
        let [above, below] = rows.map(|row| {
            let row = row_offset(row, self.level.blocks_per_row);
            let [left, right] = columns.map(|column| f32::from(self.coverage[(row + column_offset(column)) as usize]));
            left + (right - left) * x
        });
        (above + (below - above) * y) / 255.0
    }
}
