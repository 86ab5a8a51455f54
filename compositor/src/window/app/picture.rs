//! How the model is rendered: shading, lighting, appearance, resolution.

use shared::{
    appearance::{Appearance, Background, Clip, ClipSide, Light},
    camera::{Camera, Look, UpAxis},
    detail::Detail,
    protocol::{FrameSpec, LightingMode, ShadingMode},
    scene::SceneId,
    sky::SkyId,
};
use strum::VariantArray;

use crate::{
    cli::args::WallArgs,
    control::refinement::{Refinement, RefinementOptions},
    wall::Wall,
    window::effect::Effect,
};

/// The parts of a [`FrameSpec`] that commands change, except for the camera.
#[derive(Debug)]
pub(super) struct PictureControl {
    pub(super) shading: ShadingMode,
    /// `None`: primary rays in motion, all at rest.
    pub(super) rays: Option<LightingMode>,
    pub(super) appearance: Appearance,
    pub(super) refinement: Refinement,
    /// The image that lights path-traced pictures, if there is one.
    sky: Option<SkyId>,
    options: RefinementOptions,
}

impl PictureControl {
    pub(super) fn new(args: &WallArgs, wall: &Wall, sky: Option<SkyId>) -> Self {
        let options = args.refinement(wall);
        Self {
            shading: args.view,
            rays: args.rays,
            appearance: args.appearance.appearance(),
            refinement: Refinement::new(options),
            sky,
            options,
        }
    }

    /// The frame to ask for, of a scene whose axis `up` points up; [`Refinement::change`] sets its size and samples.
    pub(super) fn spec(&self, scene: SceneId, camera: Camera, up: UpAxis) -> FrameSpec {
        FrameSpec {
            scene,
            camera,
            size: self.options.fixed_size,
            view: self.shading,
            rays: self.rays.unwrap_or_default(),
            samples: self.options.fixed_samples,
            detail: Detail::FULL,
            appearance: self.appearance_around(up),
        }
    }

    /// The appearance around a model whose axis `up` points up.
    pub(super) fn appearance_around(&self, up: UpAxis) -> Appearance {
        Appearance { sky: self.sky, up, ..self.appearance }
    }

    pub(super) fn change(&mut self, change: impl FnOnce(&mut Self)) -> Effect {
        change(self);
        Effect::picture()
    }

    pub(super) fn choose_rays(&mut self, rays: Option<LightingMode>) -> Effect {
        self.rays = rays;
        self.refinement.set_lights_at_rest(rays.is_none());
        Effect::picture()
    }

    /// The parts that a kept view includes.
    pub(super) fn look(&self) -> Look {
        let Appearance { light, clip, path, .. } = self.appearance;
        Look { light, clip, rays: self.rays, path: Some(path) }
    }

    /// Shows another model uncut: the old one's clip plane would cut it anywhere. Light, background and rays stay as the
    /// operator chose them.
    pub(super) fn begin_model(&mut self) {
        self.appearance.clip = None;
    }

    /// Looks as a kept view did; its camera asks for the picture.
    pub(super) fn set_look(&mut self, Look { light, clip, rays, path }: Look) {
        let path = path.unwrap_or(self.appearance.path);
        self.appearance = Appearance { light, clip, path, ..self.appearance };
        let _ = self.choose_rays(rays);
    }

    pub(super) fn next_light(&mut self) -> Effect {
        let (name, light) = next_named(&Light::PRESETS, self.appearance.light);
        self.appearance.light = light;
        Effect::picture().with_note(format!("Light: {name}"))
    }

    /// Brightens pictures of paths by tenths of a stop.
    pub(super) fn change_exposure(&mut self, deci_ev: i16) -> Effect {
        let path = self.appearance.path.brightened_by(deci_ev);
        self.appearance.path = path;
        Effect::picture().with_note(format!("Exposure at rest: {:+.1} stops", path.exposure_ev()))
    }

    pub(super) fn toggle_ground(&mut self) -> Effect {
        let has_ground = !self.appearance.path.has_ground();
        self.appearance.path = self.appearance.path.with_ground(has_ground);
        let note = if has_ground { "Pictures at rest show the shadow on a ground" } else { "No ground" };
        Effect::picture().with_note(note)
    }

    pub(super) fn next_background(&mut self) -> Effect {
        let (name, background) = next_named(&Background::PRESETS, self.appearance.background);
        self.appearance.background = background;
        Effect::picture().with_note(format!("Background: {name}"))
    }

    /// Clips from the next side, and from none after the last.
    pub(super) fn next_clip(&mut self) -> Effect {
        let clip = self.appearance.clip;
        let next =
            clip.map_or(0, |clip| 1 + ClipSide::VARIANTS.iter().position(|&side| side == clip.side()).unwrap_or(0));
        let side = ClipSide::VARIANTS.get(next).copied();
        let note = side.map_or("Whole again".to_owned(), |side| format!("Cut open from {side}"));
        self.appearance.clip = side.map(|side| Clip::with_side(side, clip));
        Effect::picture().with_note(note)
    }

    pub(super) fn toggle_refinement(&mut self) -> Effect {
        let is_on = !self.refinement.is_on();
        self.refinement.set_on(is_on);
        let note = if is_on { "The resolution follows the motion" } else { "All frames have the same resolution" };
        Effect::picture().with_note(note)
    }
}

/// The choice after `current`; the first after the last.
pub(super) fn next<T: Copy + PartialEq>(all: &[T], current: T) -> T {
    let index = all.iter().position(|&one| one == current).map_or(0, |index| index + 1);
    all[index % all.len()]
}

/// The named choice after `current`; the first after the last, or where `current` has no name.
fn next_named<T: Copy + PartialEq>(all: &[(&'static str, T)], current: T) -> (&'static str, T) {
    let named = all.iter().copied().find(|&(_, one)| one == current);
    named.map_or(all[0], |named| next(all, named))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_steps_through_all_choices() {
        assert_eq!(next(&[1, 2, 3], 1), 2);
        assert_eq!(next(&[1, 2, 3], 3), 1);
        assert_eq!(next_named(&[("a", 1), ("b", 2)], 1), ("b", 2));
        assert_eq!(next_named(&[("a", 1), ("b", 2)], 7), ("a", 1));
    }
}
