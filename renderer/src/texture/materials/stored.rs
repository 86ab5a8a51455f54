//! Materials in scene files.

use crate::{
    scene_file::{
        fault::{Damage, Fault},
        sections::{SectionVisitor, expect},
    },
    texture::{
        mask::Mask,
        materials::{Finish, PointMaterial, Texture, TracedMaterial, TracedMaterials},
        mip_map::MipMap,
    },
};

impl TracedMaterials {
    pub(crate) fn visit_sections<'a>(&'a mut self, visitor: &mut impl SectionVisitor<'a>) -> Result<(), Fault> {
        visitor.visit("materials", &mut self.of_triangles)?;
        self.maps.iter_mut().try_for_each(|map| visitor.visit("texels", &mut map.texels))?;
        self.masks.iter_mut().try_for_each(|mask| visitor.visit("coverage", &mut mask.coverage))
    }

    /// Checks all but the contents of the arrays, of which every one can be used.
    pub(crate) fn check(&self, n_triangles: usize) -> Result<(), Damage> {
        let has_gaps = self.materials.iter().any(|material| material.gaps.is_some());
        let n_of_triangles = self.of_triangles.len();
        expect(n_of_triangles == 0 || n_of_triangles == n_triangles, "materials")?;
        expect(self.has_masks == has_gaps && self.materials.iter().all(|it| self.is_sound(it)), "materials")?;
        expect(self.maps.iter().all(MipMap::is_whole), "texels")?;
        expect(self.masks.iter().all(Mask::is_whole), "coverage")
    }

    fn is_sound(&self, material: &TracedMaterial) -> bool {
        let TracedMaterial { base_color, plain: PointMaterial { finish, emissive }, gaps, .. } = material;
        let is_part = |x: f32| (0.0..=1.0).contains(&x);
        let is_finish = match *finish {
            Finish::Matte | Finish::Unlit => true,
            Finish::Glossy { roughness, metallic } => is_part(roughness) && is_part(metallic),
        };
        let exists = |texture: Option<&Texture>, n: usize| texture.is_none_or(|texture| texture.index < n);
        is_finish
            && base_color.is_finite()
            && emissive.is_finite()
            && material.textures().into_iter().all(|texture| exists(texture, self.maps.len()))
            && gaps.as_ref().is_none_or(|gaps| exists(gaps.texture.as_ref(), self.masks.len()))
    }
}
