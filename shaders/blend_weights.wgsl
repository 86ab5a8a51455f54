// Blend weight and black of each pixel of a wall, which do not change from frame to frame: drawn once, and read by
// optics.wgsl for each frame.
//
// Paired with compositor/src/gpu/blend_weights.rs; its twin on the CPU is `blend_weight` in tests/src/present_cpu.rs.
// keys.wgsl comes before it.

@group(0) @binding(0) var<storage, read> projectors: array<Projector>;
@group(0) @binding(1) var<storage, read> neighbours: array<Neighbour>;
// Points of images on lattices over their projectors' rectangles, row by row from the upper left: the way back through
// meshes.
@group(0) @binding(2) var<storage, read> image_points: array<vec2f>;
// Each pixel's place in its projector's rectangle, if that projector has a mesh, drawn by places.wgsl.
@group(0) @binding(3) var places: texture_2d<f32>;
// Projectors' light over that at their darkest point, on lattices over their pixels, row by row from the upper left, in a
// border of points that continue it.
@group(0) @binding(4) var<storage, read> excesses: array<f32>;

// One projector on the target. Matches `ProjectorRecord` in blend_weights.rs.
struct Projector {
    // Homography from pixels right and down of `origin_px` to its image: (0, 0) is the image's upper-left corner as seen on
    // the wall, (1, 1) its lower-right corner.
    image_from_px: mat3x3f,
    // The quad's left, bottom, right and top in clip coordinates.
    clip: vec4f,
    // The pixel in the quad's middle, in the target's pixels.
    origin_px: vec2f,
    // Its neighbours in `neighbours`, itself first.
    first_neighbour: u32,
    n_neighbours: u32,
    // The columns and rows of its first and its last pixel.
    pixels: vec4i,
    // 1 if it has a mesh; if not, its image is its rectangle.
    has_mesh: u32,
}

// A projector that lights a part of the same rectangle. Matches `NeighbourRecord` in blend_weights.rs.
struct Neighbour {
    // Homography from the neighbour's image to its pixels, which run from (0, 0) upper left as seen on the wall to (1, 1).
    upright_from_image: mat3x3f,
    // From the projector's rectangle to the neighbour's: origin, scale.
    neighbour_rect_from_rect: vec4f,
    // The part of the projector's rectangle that the neighbour can change: left, upper, right, lower.
    reach: vec4f,
    // The edges of its image towards which its light fades, 1 or 0: left, upper, right, lower.
    image_edges: vec4f,
    // The edges of its pixels that cut its image: the inverse of the distance over which its light fades towards them; 0
    // for the others.
    raster_fades: vec4f,
    // The columns and rows of those pixels.
    upright_size: vec2f,
    black_level: f32,
    // 1 if it has a blend weight here, 0 if only its black counts.
    blends: f32,
    // The first of its mesh's points in `image_points`, and their columns and rows; 0 without a mesh.
    first_point: u32,
    mesh_columns: u32,
    mesh_rows: u32,
    // The number of its lattice in `excesses`, from 1; 0 if its light does not fall off.
    fall_off: u32,
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

// `LEAST_DISTANCE` and `MESH_TOLERANCE` in compositor/src/wall/blend.rs.
const LEAST_DISTANCE: f32 = 1e-5;
const MESH_TOLERANCE: f32 = 1e-3;

// The product of the distances from the four edges of a neighbour's light; 0 outside of it by more than a tolerance. Of
// the image's edge and the pixels' edge on the same side, the nearer one counts.
fn distances(image: vec2f, upright: vec2f, image_edges: vec4f, raster_fades: vec4f, tolerance: f32) -> f32 {
    let from_image = vec4f(image, 1.0 - image);
    let from_pixels = vec4f(upright, 1.0 - upright);
    let by_image = select(vec4f(1.0), from_image, image_edges > vec4f(0.0));
    let by_pixels = select(vec4f(1.0), from_pixels * raster_fades, raster_fades > vec4f(0.0));
    let nearest = max(min(by_image, by_pixels), vec4f(LEAST_DISTANCE));
    let is_lit = all(min(from_image, from_pixels) >= vec4f(-tolerance));
    return select(0.0, nearest.x * nearest.y * nearest.z * nearest.w, is_lit);
}

// The part of a pixel that lies inside the unit square, for each axis, by the size of the pixel there.
fn inside(point: vec2f, pixel: vec2f) -> vec2f {
    return clamp(min(point, 1.0 - point) / pixel + 0.5, vec2f(0.0), vec2f(1.0));
}

// The size of a pixel in units of the projector's rectangle, from the places of the pixels around it.
fn pixel_in_rect(px: vec2i, pixels: vec4i) -> vec2f {
    let first = max(px - 1, pixels.xy);
    let last = min(px + 1, pixels.zw);
    let across = textureLoad(places, vec2i(last.x, px.y), 0).rg - textureLoad(places, vec2i(first.x, px.y), 0).rg;
    let down = textureLoad(places, vec2i(px.x, last.y), 0).rg - textureLoad(places, vec2i(px.x, first.y), 0).rg;
    let steps = max(vec2f(last - first), vec2f(1.0));
    let per_column = across / steps.x;
    let per_row = down / steps.y;
    return max(sqrt(per_column * per_column + per_row * per_row), vec2f(1e-9));
}

// The point of a neighbour's image at a point of its rectangle, between the four nearest points of its lattice.
fn image_at(first_point: u32, mesh_columns: u32, mesh_rows: u32, rect_point: vec2f) -> vec2f {
    let n_cells = vec2f(vec2u(mesh_columns, mesh_rows)) - 1.0;
    let at = rect_point * n_cells;
    let cell = clamp(floor(at), vec2f(0.0), n_cells - 1.0);
    let part = at - cell;
    let upper = first_point + u32(cell.y) * mesh_columns + u32(cell.x);
    let lower = upper + mesh_columns;
    return mix(
        mix(image_points[upper], image_points[upper + 1u], part.x),
        mix(image_points[lower], image_points[lower + 1u], part.x),
        part.y,
    );
}

// `FallOff::SIDE` in compositor/src/wall/fall_off.rs.
const FALL_OFF_SIDE: u32 = 5u;

// A projector's light at a point of its pixels over that at its darkest point.
fn excess_at(fall_off: u32, upright: vec2f) -> f32 {
    if (fall_off == 0u) {
        return 1.0;
    }
    let stride = FALL_OFF_SIDE + 2u;
    let at = clamp(upright, vec2f(0.0), vec2f(1.0)) * f32(FALL_OFF_SIDE - 1u);
    let cell = min(floor(at), vec2f(f32(FALL_OFF_SIDE - 2u)));
    let across = keys_weights(at.x - cell.x);
    let down = keys_weights(at.y - cell.y);
    var excess = 0.0;
    var first = (fall_off - 1u) * stride * stride + u32(cell.y) * stride + u32(cell.x);
    for (var row = 0; row < 4; row++) {
        let points = vec4f(excesses[first], excesses[first + 1u], excesses[first + 2u], excesses[first + 3u]);
        excess += dot(points, across) * down[row];
        first += stride;
    }
    return excess;
}

// Red is the pixel's blend weight, dimmed by the fall-off, green the light of all projectors' black there.
@fragment
fn fragment(quad: Quad) -> @location(0) vec4f {
    let index = quad.projector_idx;
    let map = projectors[index].image_from_px;
    let image = map * vec3f(quad.position.xy - projectors[index].origin_px, 1.0);
    // Where the pixel's centre is in the projector's image; at and behind the horizon there is no wall.
    let depth = max(image.z, 1e-9);
    let image_point = image.xy / depth;

    // Antialias the image's edges: the part of the pixel inside, by the pixel's own size there.
    let per_column = (map[0].xy - image_point * map[0].z) / depth;
    let per_row = (map[1].xy - image_point * map[1].z) / depth;
    var covered = inside(image_point, sqrt(per_column * per_column + per_row * per_row));

    // The same place in the projector's rectangle. The edges of the canvas cut a mesh.
    var rect_point = image_point;
    if (projectors[index].has_mesh != 0u) {
        let px = vec2i(quad.position.xy);
        rect_point = textureLoad(places, px, 0).rg;
        covered *= inside(rect_point, pixel_in_rect(px, projectors[index].pixels));
    }
    let within = clamp(rect_point, vec2f(0.0), vec2f(1.0));

    // Add up the weights and the black of all projectors that light this point.
    var own = 0.0;
    var own_excess = 1.0;
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
        let shift = (*neighbour).neighbour_rect_from_rect;
        var image_within = shift.xy + shift.zw * within;
        var image_beyond = shift.xy + shift.zw * rect_point;
        var tolerance = LEAST_DISTANCE;
        let mesh_columns = (*neighbour).mesh_columns;
        if (mesh_columns > 0u) {
            let first_point = (*neighbour).first_point;
            image_within = image_at(first_point, mesh_columns, (*neighbour).mesh_rows, image_within);
            image_beyond = image_at(first_point, mesh_columns, (*neighbour).mesh_rows, image_beyond);
            tolerance = MESH_TOLERANCE;
        }
        let upright_within = (*neighbour).upright_from_image * vec3f(image_within, 1.0);
        var weight = 0.0;
        if (upright_within.z > 1e-9) {
            let upright = upright_within.xy / upright_within.z;
            weight = (*neighbour).blends
                * distances(image_within, upright, (*neighbour).image_edges, (*neighbour).raster_fades, tolerance);
        }
        all_weights += weight;
        let beyond = (*neighbour).upright_from_image * vec3f(image_beyond, 1.0);
        // A pixel at the edge gives its light on both sides of it.
        let edge = min(beyond.xy, beyond.zz - beyond.xy) / max(beyond.z, 1e-9);
        let lit = clamp(edge * (*neighbour).upright_size + 0.5, vec2f(0.0), vec2f(1.0));
        let excess = excess_at((*neighbour).fall_off, beyond.xy / max(beyond.z, 1e-9));
        leak += select(0.0, (*neighbour).black_level * excess * lit.x * lit.y, beyond.z > 1e-9);
        if (n == 0u) {
            own = weight;
            own_excess = excess;
        }
    }
    var blend_weight = covered.x * covered.y * own / max(all_weights, 1e-37) / own_excess;
    if (image.z <= 1e-9) {
        blend_weight = 0.0;
    }

    return vec4f(blend_weight, leak, 0.0, 0.0);
}
