//! Grids in scene files: their arrays, and what must hold of them before rays follow them.
//!
//! Rays trust a grid: they read some arrays without checks, and end because every way does. So the contents of a file that
//! this user has not written or checked before are checked here, whatever they are: every index lies in its array, and every
//! node, leaf and triangle node is the child of exactly one, which comes before it.

use crate::{
    grid::{Grid, MemoryShortage, Structure, cells::CellSpace},
    scene_file::{
        fault::{Damage, Fault},
        sections::{SectionVisitor, expect},
    },
};

impl Grid {
    /// Whether a file can hold this grid: it holds trees. The others serve to compare.
    pub(crate) fn is_storable(&self) -> bool {
        matches!(self.structure, Structure::Tree(_))
    }

    /// Whether more memory would have given another grid.
    pub(crate) fn is_limited(&self) -> bool {
        self.is_limited
    }

    /// Visits all arrays of mesh and grid.
    ///
    /// # Errors
    /// The visitor's.
    pub(crate) fn visit_sections<'a>(&'a mut self, visitor: &mut impl SectionVisitor<'a>) -> Result<(), Fault> {
        self.mesh.visit_sections(visitor)?;
        match &mut self.structure {
            Structure::Tree(tree) => tree.visit_sections(visitor),
            Structure::Plain(_) | Structure::RowDisplacement(_) => Ok(()),
        }
    }

    /// The same grid where nothing was loaded or built.
    pub(crate) fn into_mapped(self) -> Self {
        Self { shortage: self.shortage.and_then(MemoryShortage::of_mapped), ..self }
    }

    /// Checks all that is known without reading the arrays.
    pub(crate) fn check_sizes(&self) -> Result<(), Damage> {
        let CellSpace { origin, cells_per_unit } = self.space;
        expect(origin.iter().all(|x| x.is_finite()) && cells_per_unit.is_normal() && cells_per_unit > 0.0, "cells")?;
        self.mesh.check_sizes()?;
        match &self.structure {
            Structure::Tree(tree) => tree.check_sizes(self.mesh.n_triangles()),
            Structure::Plain(_) | Structure::RowDisplacement(_) => Err(Damage::Content("cells")),
        }
    }

    /// Checks the contents of the arrays, in parallel, after [`Grid::check_sizes`].
    pub(crate) fn check_contents(&self) -> Result<(), Damage> {
        let Structure::Tree(tree) = &self.structure else { return Err(Damage::Content("cells")) };
        let (mesh, tree) = rayon::join(|| self.mesh.check_contents(), || tree.check_contents(self.mesh.n_triangles()));
        mesh.and(tree)
    }
}
