//! The GPU's part: one texture holds the frame's samples, and every projector of the wall shows its part of it.
//!
//! In reading order: [`context`] finds the GPU, `frame` is that texture, `quad` has the stages' shared types, [`present`]
//! draws the frame on a target; `optics` corrects warped and blended projectors, by `blend_weights`, and `places` of meshes,
//! that are drawn once. [`offscreen`] and [`surface`] are targets, and [`timer`] measures.

mod blend_weights;
mod context;
mod frame;
mod offscreen;
mod optics;
mod picture;
mod places;
mod present;
mod quad;
mod surface;
mod timer;

pub use context::{Gpu, GpuError};
pub(crate) use frame::FrameTexture;
pub use offscreen::{Offscreen, OffscreenWall};
pub use picture::RgbImage;
pub use present::Present;
pub(crate) use quad::Quad;
pub use quad::Target;
pub(crate) use surface::{SurfaceFrame, WallSurface};

#[cfg(test)]
mod tests {
    use naga::valid::{Capabilities, ValidationFlags, Validator};

    use super::frame::FrameLayouts;

    #[test]
    fn every_shader_is_valid() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../shaders");
        let mut n_shaders = 0;
        for entry in std::fs::read_dir(folder).expect(folder) {
            let path = entry.expect(folder).path();
            if path.extension().is_some_and(|extension| extension == "wgsl") {
                n_shaders += 1;
                let mut source = std::fs::read_to_string(&path).expect("a shader is UTF-8");
                if source.contains("keys_weights(") && !source.contains("fn keys_weights(") {
                    source.insert_str(0, include_str!("../../shaders/keys.wgsl"));
                }
                let is_stage = source.contains("frame_at(") && !source.contains("fn frame_at(");
                let sources = if is_stage { FrameLayouts::sources(&source).to_vec() } else { vec![source] };
                for source in sources {
                    let module = naga::front::wgsl::parse_str(&source).unwrap_or_else(|error| {
                        panic!("{}", error.emit_to_string_with_path(&source, &path.to_string_lossy()))
                    });
                    Validator::new(ValidationFlags::all(), Capabilities::default())
                        .validate(&module)
                        .unwrap_or_else(|error| panic!("{}: {}", path.display(), error.emit_to_string(&source)));
                }
            }
        }
        assert!(n_shaders > 0, "no shaders in {folder}");
    }
}
