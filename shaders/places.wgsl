// Where each pixel of a projector with a mesh shows the picture, which does not change from frame to frame: drawn once, and
// read by blend_weights.wgsl, and by optics.wgsl for each frame.
//
// Paired with compositor/src/gpu/places.rs; its twin on the CPU is `Mesh::canvas_at` in compositor/src/wall/mesh.rs, which
// tests compare with another program. keys.wgsl comes before it.

@group(0) @binding(0) var<storage, read> projectors: array<Projector>;
// Control points in units of their projector's rectangle of the canvas, in a border of points that continue them.
@group(0) @binding(1) var<storage, read> points: array<vec2f>;

// One projector on the target. Matches `ProjectorRecord` in places.rs.
struct Projector {
    // Homography from pixels right and down of `origin_px` to its image: (0, 0) is the image's upper-left corner as seen
    // on the wall, (1, 1) its lower-right corner.
    image_from_px: mat3x3f,
    // The quad's left, bottom, right and top in clip coordinates.
    clip: vec4f,
    // The pixel in the quad's middle, in the target's pixels.
    origin_px: vec2f,
    // Its points in `points`, with their border: the first, columns, and cells between control points.
    first_point: u32,
    n_columns: u32,
    n_cells: vec2f,
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

// The place in units of the projector's rectangle.
// In units of the projector's rectangle.
struct Place {
    @location(0) exact: vec4f,
    // The nearest in the rectangle: sixteen bits across, sixteen down.
    @location(1) within: u32,
}

@fragment
fn fragment(quad: Quad) -> Place {
    let projector = &projectors[quad.projector_idx];
    let image = (*projector).image_from_px * vec3f(quad.position.xy - (*projector).origin_px, 1.0);
    // At and behind the horizon there is no wall, and the blend weight is 0.
    let within = clamp(image.xy / max(image.z, 1e-9), vec2f(0.0), vec2f(1.0));
    let at = within * (*projector).n_cells;
    let cell = min(floor(at), (*projector).n_cells - 1.0);
    let across = keys_weights(at.x - cell.x);
    let down = keys_weights(at.y - cell.y);
    var place = vec2f(0.0);
    var first = (*projector).first_point + u32(cell.y) * (*projector).n_columns + u32(cell.x);
    for (var row = 0; row < 4; row++) {
        let mixed = points[first] * across.x + points[first + 1u] * across.y + points[first + 2u] * across.z
            + points[first + 3u] * across.w;
        place += mixed * down[row];
        first += (*projector).n_columns;
    }
    return Place(vec4f(place, 0.0, 0.0), pack2x16unorm(place));
}
