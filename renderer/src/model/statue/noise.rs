//! Gradient noise after Perlin, "Improving Noise" (2002), with integer hashing in place of his table.

/// Smooth noise, about −1 to 1, with a feature size of about 1.
pub(super) fn gradient(p: [f32; 3], seed: u32) -> f32 {
    let cell = p.map(f32::floor);
    let f = [p[0] - cell[0], p[1] - cell[1], p[2] - cell[2]];
    let s = f.map(|t| t * t * t * (t * (t * 6.0 - 15.0) + 10.0));
    let [x, y, z] = cell.map(|c| c as i32 as u32);
    let corner = |dx: u32, dy: u32, dz: u32| {
        let h = hash(x.wrapping_add(dx), y.wrapping_add(dy), z.wrapping_add(dz), seed);
        let g = |shift: u32| ((h >> shift) & 0x3ff) as f32 * (2.0 / 1023.0) - 1.0;
        g(0) * (f[0] - dx as f32) + g(10) * (f[1] - dy as f32) + g(20) * (f[2] - dz as f32)
    };
    let along_x = |dy, dz| lerp(corner(0, dy, dz), corner(1, dy, dz), s[0]);
    let along_y = |dz| lerp(along_x(0, dz), along_x(1, dz), s[1]);
    lerp(along_y(0), along_y(1), s[2])
}

fn lerp(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}

/// Hashes lattice coordinates with the finalizer of MurmurHash3.
fn hash(x: u32, y: u32, z: u32, seed: u32) -> u32 {
    let mut h = x.wrapping_mul(0x9e37_79b1)
        ^ y.wrapping_mul(0x85eb_ca77)
        ^ z.wrapping_mul(0xc2b2_ae3d)
        ^ seed.wrapping_mul(0x27d4_eb2f);
    h = (h ^ (h >> 16)).wrapping_mul(0x85eb_ca6b);
    h = (h ^ (h >> 13)).wrapping_mul(0xc2b2_ae35);
    h ^ (h >> 16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_zero_on_the_lattice_bounded_and_smooth() {
        assert_eq!(gradient([3.0, -7.0, 12.0], 5), 0.0);
        let mut last = gradient([-2.0, 0.3, 0.7], 1);
        for i in 1..4000 {
            let value = gradient([-2.0 + i as f32 * 0.001, 0.3, 0.7], 1);
            assert!(value.abs() < 1.5 && (value - last).abs() < 0.01, "{i}");
            last = value;
        }
    }
}
