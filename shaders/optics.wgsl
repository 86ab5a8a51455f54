// Shows the frame through projectors that are warped, overlap, or need their light corrected: one quad for each, in the
// same pass as those of present.wgsl.
//
// Paired with compositor/src/gpu/optics.rs; its twin on the CPU is tests/src/present_cpu.rs. `frame_at` is in frame.wgsl or
// frame_pieces.wgsl.

// Each pixel's blend weight, and the light of all projectors' black there, drawn by blend_weights.wgsl.
@group(1) @binding(0) var blend_weights: texture_2d<f32>;
// Each pixel's place in its projector's rectangle, if that projector has a mesh: sixteen bits across, sixteen down, drawn by
// places.wgsl.
@group(1) @binding(1) var places: texture_2d<u32>;

// One projector on the target. Matches `ProjectorInstance` in optics.rs.
struct Projector {
    // Columns of the homography from pixels right and down of `origin_px` to its image: (0, 0) is the image's upper-left
    // corner as seen on the wall, (1, 1) its lower-right corner.
    @location(0) image_per_column: vec3f,
    @location(1) image_per_row: vec3f,
    @location(2) image_at_origin: vec3f,
    // The quad's left, bottom, right and top in clip coordinates.
    @location(3) clip: vec4f,
    // The rectangle's upper-left corner in the frame, and its extent to the right and down.
    @location(4) frame_from_rect: vec4f,
    // Factors that correct for its gain and black level: red, green, blue.
    @location(5) drive_per_light: vec3f,
    // The exponent of its light curve, 0 for sRGB.
    @location(6) gamma: f32,
    // The pixel in the quad's middle, in the target's pixels.
    @location(7) origin_px: vec2f,
    // The light of black everywhere on the wall: the most that projectors' black levels add up to.
    @location(8) wall_black: f32,
    // 1 if it has a mesh; if not, its image is its rectangle.
    @location(9) has_mesh: u32,
}

// Flat values cost less than a buffer that each pixel reads.
struct Quad {
    @builtin(position) position: vec4f,
    @location(0) @interpolate(flat) image_per_column: vec3f,
    @location(1) @interpolate(flat) image_per_row: vec3f,
    @location(2) @interpolate(flat) image_at_origin: vec3f,
    @location(3) @interpolate(flat) frame_from_rect: vec4f,
    @location(4) @interpolate(flat) drive_per_light: vec3f,
    @location(5) @interpolate(flat) gamma: f32,
    @location(6) @interpolate(flat) origin_px: vec2f,
    @location(7) @interpolate(flat) wall_black: f32,
    @location(8) @interpolate(flat) has_mesh: u32,
}

@vertex
fn vertex(@builtin(vertex_index) corner: u32, projector: Projector) -> Quad {
    // A strip: lower left, lower right, upper left, upper right.
    let x = select(projector.clip.x, projector.clip.z, (corner & 1u) == 1u);
    let y = select(projector.clip.y, projector.clip.w, corner >= 2u);
    return Quad(
        vec4f(x, y, 0.0, 1.0),
        projector.image_per_column,
        projector.image_per_row,
        projector.image_at_origin,
        projector.frame_from_rect,
        projector.drive_per_light,
        projector.gamma,
        projector.origin_px,
        projector.wall_black,
        projector.has_mesh,
    );
}

// The projector's light at the pixel, as a part of its white.
fn drive_at(quad: Quad) -> vec3f {
    // Red is the blend weight, green the black that leaks in.
    let blended = textureLoad(blend_weights, vec2i(quad.position.xy), 0);
    let px = quad.position.xy - quad.origin_px;
    let image = quad.image_per_column * px.x + quad.image_per_row * px.y + quad.image_at_origin;
    // At and behind the horizon there is no wall, and the weight is 0.
    var within = clamp(image.xy / max(image.z, 1e-9), vec2f(0.0), vec2f(1.0));
    if (quad.has_mesh != 0u) {
        within = unpack2x16unorm(textureLoad(places, vec2i(quad.position.xy), 0).r);
    }
    let at = quad.frame_from_rect.xy + within * quad.frame_from_rect.zw;
    let linear = frame_at(at);
    let light = blended.r * max(quad.wall_black + (1.0 - quad.wall_black) * linear - blended.g, vec3f(0.0));
    return clamp(light * quad.drive_per_light, vec3f(0.0), vec3f(1.0));
}

// The pixel value, from 0 to 1, for which a projector of this gamma gives the light `drive`.
fn value_of(drive: vec3f, gamma: f32) -> vec3f {
    // pow of 0 is not defined everywhere.
    return select(pow(drive, vec3f(1.0 / gamma)), vec3f(0.0), drive <= vec3f(0.0));
}

fn srgb_encode(linear: vec3f) -> vec3f {
    let curve = 1.055 * pow(max(linear, vec3f(1e-9)), vec3f(1.0 / 2.4)) - 0.055;
    return select(curve, linear * 12.92, linear <= vec3f(0.0031308));
}

fn srgb_decode(value: vec3f) -> vec3f {
    let curve = pow((value + 0.055) / 1.055, vec3f(2.4));
    return select(curve, value / 12.92, value <= vec3f(0.04045));
}

// For targets that encode sRGB themselves, whichever gamma the projector has.
@fragment
fn fragment_linear(quad: Quad) -> @location(0) vec4f {
    let drive = drive_at(quad);
    if (quad.gamma == 0.0) {
        return vec4f(drive, 1.0);
    }
    return vec4f(srgb_decode(value_of(drive, quad.gamma)), 1.0);
}

// For surfaces without an sRGB view.
@fragment
fn fragment_encoded(quad: Quad) -> @location(0) vec4f {
    let drive = drive_at(quad);
    if (quad.gamma == 0.0) {
        return vec4f(srgb_encode(drive), 1.0);
    }
    return vec4f(value_of(drive, quad.gamma), 1.0);
}
