//! Traced meshes in scene files.

use crate::{
    grid::traced::TracedMesh,
    intersect::ray::Hit,
    model::mesh::Aabb,
    scene_file::{
        fault::{Damage, Fault},
        sections::{SectionVisitor, expect},
    },
};

impl TracedMesh {
    pub(in crate::grid) fn visit_sections<'a>(
        &'a mut self,
        visitor: &mut impl SectionVisitor<'a>,
    ) -> Result<(), Fault> {
        self.positions.visit_sections(visitor)?;
        self.corners.visit_sections(visitor)?;
        self.file_indices.visit_sections(visitor)?;
        visitor.visit("colours", &mut self.colors)?;
        visitor.visit("normals", &mut self.normals)?;
        visitor.visit("texture coordinates", &mut self.texture_coordinates)?;
        self.materials.visit_sections(visitor)
    }

    pub(in crate::grid) fn check_sizes(&self) -> Result<(), Damage> {
        self.positions.check_sizes()?;
        let n_vertices = self.positions.len();
        let n_triangles = self.n_triangles();
        let is_whole = |n_items: usize| n_items == 0 || n_items == n_vertices;
        expect(n_triangles < Hit::CAP as usize, "triangles")?;
        self.corners.check_sizes(n_triangles)?;
        self.file_indices.check_sizes()?;
        expect(is_whole(self.colors.len()), "colours")?;
        expect(is_whole(self.normals.len()), "normals")?;
        expect(is_whole(self.texture_coordinates.len()), "texture coordinates")?;
        let is_box = |bounds: &Aabb| {
            let [min, max] = bounds.corners();
            min.is_finite() && max.is_finite() && min.cmple(max).all()
        };
        expect(is_box(&self.bounds) && is_box(&self.bulk_bounds) && self.origin.is_finite(), "bounds")?;
        self.materials.check(n_triangles)
    }

    pub(in crate::grid) fn check_contents(&self) -> Result<(), Damage> {
        self.corners.check_contents(self.positions.len())?;
        self.file_indices.check_contents()?;
        self.positions.check_contents(&self.bounds)
    }
}
