// Shows the frame on the wall: one quad for each projector, which samples its part of the frame.
//
// Paired with compositor/src/gpu/present.rs; its twin on the CPU is tests/src/present_cpu.rs. `frame_at` is in frame.wgsl or
// frame_pieces.wgsl.

// One projector on the target. Matches `ProjectorInstance` in present.rs.
struct Projector {
    // The quad's left, bottom, right and top in clip coordinates.
    @location(0) clip: vec4f,
    // A point at the quad's upper-left corner, in whole pixels of the target.
    @location(1) origin_px: vec2f,
    // The same point in the frame, whose lower-left corner is (0, 0) and whose upper-right corner is (1, 1).
    @location(2) origin_frame: vec2f,
    // The step in the frame for one pixel to the right, and for one pixel down.
    @location(3) frame_per_px: vec2f,
}

struct Quad {
    @builtin(position) position: vec4f,
    @location(0) @interpolate(flat) origin_px: vec2f,
    @location(1) @interpolate(flat) origin_frame: vec2f,
    @location(2) @interpolate(flat) frame_per_px: vec2f,
}

@vertex
fn vertex(@builtin(vertex_index) corner: u32, projector: Projector) -> Quad {
    // A strip: lower left, lower right, upper left, upper right.
    let x = select(projector.clip.x, projector.clip.z, (corner & 1u) == 1u);
    let y = select(projector.clip.y, projector.clip.w, corner >= 2u);
    return Quad(vec4f(x, y, 0.0, 1.0), projector.origin_px, projector.origin_frame, projector.frame_per_px);
}

// Computed from the pixel's centre instead of interpolated: rasterizers shift the corners of scaled walls by up to 1/512
// of a pixel, which beside black is several steps of 8 bits.
fn shown_at(quad: Quad) -> vec3f {
    let at = quad.origin_frame + (quad.position.xy - quad.origin_px) * quad.frame_per_px;
    return frame_at(at);
}

// For targets that encode sRGB themselves.
@fragment
fn fragment_linear(quad: Quad) -> @location(0) vec4f {
    return vec4f(shown_at(quad), 1.0);
}

// For surfaces without an sRGB view.
@fragment
fn fragment_encoded(quad: Quad) -> @location(0) vec4f {
    let linear = shown_at(quad);
    let curve = 1.055 * pow(linear, vec3f(1.0 / 2.4)) - 0.055;
    return vec4f(select(curve, linear * 12.92, linear <= vec3f(0.0031308)), 1.0);
}
