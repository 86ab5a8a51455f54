// Blend weight and black of each pixel of a wall, which do not change from frame to frame: drawn once, and read by
// optics.wgsl for each frame.
//
// Paired with compositor/src/gpu/blend_weights.rs; its twin on the CPU is `blend_weight` in tests/src/present_cpu.rs.

@group(0) @binding(0) var<storage, read> projectors: array<Projector>;
@group(0) @binding(1) var<storage, read> neighbours: array<Neighbour>;

// One projector on the target. Matches `ProjectorRecord` in blend_weights.rs.
struct Projector {
    // Homography from pixels right and down of `origin_px` to its rectangle of the canvas: (0, 0) is the rectangle's
    // upper-left corner as seen on the wall, (1, 1) its lower-right corner.
    rect_from_px: mat3x3f,
    // The quad's left, bottom, right and top in clip coordinates.
    clip: vec4f,
    // The pixel in the quad's middle, in the target's pixels.
    origin_px: vec2f,
    // Its neighbours in `neighbours`, itself first.
    first_neighbour: u32,
    n_neighbours: u32,
}

// A projector that lights a part of the same rectangle. Matches `NeighbourRecord` in blend_weights.rs.
struct Neighbour {
    // Homography from the projector's rectangle to the neighbour's pixels, which run from (0, 0) to (1, 1).
    raster_from_rect: mat3x3f,
    // From the projector's rectangle to the neighbour's: origin, scale.
    neighbour_rect_from_rect: vec4f,
    // The part of the projector's rectangle that the neighbour can change: left, upper, right, lower.
    reach: vec4f,
    // The edges of its rectangle, and of its pixels, towards which its light fades, 1 or 0: left, upper, right, lower.
    rect_edges: vec4f,
    raster_edges: vec4f,
    // The columns and rows of those pixels.
    raster_size: vec2f,
    black_level: f32,
    // 1 if it has a blend weight here, 0 if only its black counts.
    blends: f32,
}

struct Quad {
    @builtin(position) position: vec4f,
    @location(0) @interpolate(flat) projector_idx: u32,
}

@vertex
fn vertex(@builtin(vertex_index) corner: u32, @builtin(instance_index) projector_idx: u32) -> Quad {
    // A strip: lower left, lower right, upper left, upper right.
    let clip = projectors[projector_idx].clip;
    let x = select(clip.x, clip.z, (corner & 1u) == 1u);
    let y = select(clip.y, clip.w, corner >= 2u);
    return Quad(vec4f(x, y, 0.0, 1.0), projector_idx);
}

// `LEAST_DISTANCE` in compositor/src/wall/blend.rs.
const LEAST_DISTANCE: f32 = 1e-5;

// The product of a point's distances from the chosen edges of the unit square; 0 outside of the square.
fn distances(point: vec2f, edges: vec4f) -> f32 {
    let d = vec4f(point, 1.0 - point);
    let counted = 1.0 + edges * (max(d, vec4f(LEAST_DISTANCE)) - 1.0);
    return select(0.0, counted.x * counted.y * counted.z * counted.w, all(d >= vec4f(-LEAST_DISTANCE)));
}

// Red is the pixel's blend weight, green the light of all projectors' black there.
@fragment
fn fragment(quad: Quad) -> @location(0) vec4f {
    let index = quad.projector_idx;
    let map = projectors[index].rect_from_px;
    let image = map * vec3f(quad.position.xy - projectors[index].origin_px, 1.0);
    // Where the pixel's centre is in the projector's rectangle; at and behind the horizon there is no wall.
    let depth = max(image.z, 1e-9);
    let rect_point = image.xy / depth;
    let within = clamp(rect_point, vec2f(0.0), vec2f(1.0));

    // Antialias the rectangle's edges: the part of the pixel inside, by the pixel's own size there.
    let per_column = (map[0].xy - rect_point * map[0].z) / depth;
    let per_row = (map[1].xy - rect_point * map[1].z) / depth;
    let pixel = sqrt(per_column * per_column + per_row * per_row);
    let covered = clamp(min(rect_point, 1.0 - rect_point) / pixel + 0.5, vec2f(0.0), vec2f(1.0));

    // Add up the weights and the black of all projectors that light this point.
    var own = 0.0;
    var all_weights = 0.0;
    var leak = 0.0;
    let first = projectors[index].first_neighbour;
    let n_neighbours = projectors[index].n_neighbours;
    for (var n = 0u; n < n_neighbours; n++) {
        let neighbour = &neighbours[first + n];
        let reach = (*neighbour).reach;
        if (n > 0u && (any(within < reach.xy) || any(within > reach.zw))) {
            continue;
        }
        let raster_within = (*neighbour).raster_from_rect * vec3f(within, 1.0);
        let shift = (*neighbour).neighbour_rect_from_rect;
        var weight = 0.0;
        if (raster_within.z > 1e-9) {
            weight = (*neighbour).blends * distances(shift.xy + shift.zw * within, (*neighbour).rect_edges)
                * distances(raster_within.xy / raster_within.z, (*neighbour).raster_edges);
        }
        own = select(own, weight, n == 0u);
        all_weights += weight;
        let raster = (*neighbour).raster_from_rect * vec3f(rect_point, 1.0);
        // A pixel at the edge gives its light on both sides of it.
        let edge = min(raster.xy, raster.zz - raster.xy) / max(raster.z, 1e-9);
        let lit = clamp(edge * (*neighbour).raster_size + 0.5, vec2f(0.0), vec2f(1.0));
        leak += select(0.0, (*neighbour).black_level * lit.x * lit.y, raster.z > 1e-9);
    }
    var blend_weight = covered.x * covered.y * own / max(all_weights, 1e-37);
    if (image.z <= 1e-9) {
        blend_weight = 0.0;
    }

    return vec4f(blend_weight, leak, 0.0, 0.0);
}
