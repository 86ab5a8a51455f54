// A frame that one texture holds; prepended to present.wgsl and optics.wgsl.
//
// Paired with compositor/src/gpu/frame.rs.

// The frame's samples, row 0 at the bottom. The view is sRGB, so the filter mixes linear light.
@group(0) @binding(0) var frame: texture_2d<f32>;
// Clamped to the edge. Bilinear; nearest where the pixels' centres are those of samples.
@group(0) @binding(1) var filtered: sampler;

// Linear light at a point of the frame, whose lower-left corner is (0, 0) and whose upper-right corner is (1, 1).
fn frame_at(at: vec2f) -> vec3f {
    return textureSampleLevel(frame, filtered, at, 0.0).rgb;
}
