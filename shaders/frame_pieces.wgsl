// A frame that is larger than the GPU's textures, in pieces; prepended to present.wgsl and optics.wgsl.
//
// Paired with compositor/src/gpu/frame.rs.

// Each layer is a piece of the frame, row by row from the lower left; row 0 at the bottom. The view is sRGB, so the filter
// mixes linear light.
@group(0) @binding(0) var frame: texture_2d_array<f32>;
// Clamped to the edge. Bilinear; nearest where the pixels' centres are those of samples.
@group(0) @binding(1) var filtered: sampler;
@group(0) @binding(2) var<uniform> pieces: Pieces;

// Matches `PiecesRecord` in frame.rs.
struct Pieces {
    // Columns and rows of the frame.
    frame_size: vec2f,
    // Columns and rows of pieces.
    n_pieces: vec2f,
}

// Neighbours share this many samples, so each sample that a point mixes is in one piece, however its piece is rounded.
const SHARED_SAMPLES: f32 = 2.0;

// Linear light at a point of the frame, whose lower-left corner is (0, 0) and whose upper-right corner is (1, 1).
//
// Where a frame is cut, pieces have a power of two of samples, so no step from the point in samples rounds: weights have
// the bits that one texture would give. The last piece is not full, so the frame's edge is clamped here.
fn frame_at(at: vec2f) -> vec3f {
    let piece_size = vec2f(textureDimensions(frame));
    let stride = piece_size - SHARED_SAMPLES;
    let point = clamp(at * pieces.frame_size, vec2f(0.5), pieces.frame_size - 0.5);
    let piece = clamp(floor((point - SHARED_SAMPLES / 2.0) / stride), vec2f(0.0), pieces.n_pieces - 1.0);
    let within = select((point - piece * stride) / piece_size, at, pieces.n_pieces == vec2f(1.0));
    let layer = i32(piece.y * pieces.n_pieces.x + piece.x);
    return textureSampleLevel(frame, filtered, within, layer, 0.0).rgb;
}
