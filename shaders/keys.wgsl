// Before the shaders that interpolate on lattices, places.wgsl and blend_weights.wgsl: the weights of four points at a part
// of the way from the second to the third (Keys 1981).
fn keys_weights(t: f32) -> vec4f {
    let t2 = t * t;
    let t3 = t2 * t;
    return vec4f(2.0 * t2 - t - t3, 2.0 - 5.0 * t2 + 3.0 * t3, t + 4.0 * t2 - 3.0 * t3, t3 - t2) * 0.5;
}

