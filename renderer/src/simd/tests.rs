use super::*;

/// Moves, widens and compresses lanes as [`Simd`] says, for any mask, and compares with loops over numbers.
struct MovesLanes;

impl Kernel for MovesLanes {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self) {
        // Numbers that are no f32 keep their bits.
        let numbers: [u32; 16] = std::array::from_fn(|lane| 0x7fa0_0000 + lane as u32);
        for flip in 0..S::LANES as u32 {
            let mut moved = [0; 16];
            let n = S::load_bits(&numbers).reflect(flip).compress_bits_to(u32::MAX, &mut moved);
            assert_eq!(n, S::LANES);
            for lane in 0..S::LANES {
                assert_eq!(moved[lane ^ flip as usize], numbers[lane]);
            }
        }
        let places = [3, 15, 0, 8, 7, 7, 24, 9, 1, 14, 31, 2, 6, 5, 12, 11];
        for first in (0..16).step_by(S::LANES) {
            let mut picked = [0; 16];
            S::pick_bits(&numbers, &places[first..]).store_bits(&mut picked);
            let expected = places[first..].iter().map(|&place| numbers[place as usize % 16]);
            assert!(expected.take(S::LANES).eq(picked[..S::LANES].iter().copied()));
        }
        let thirds: [f32; 16] = std::array::from_fn(|lane| lane as f32 / 3.0);
        for first in (0..S::LANES).step_by(S::Double::LANES) {
            let mut wide = [0.0; 8];
            S::load(&thirds).widen(first).store(&mut wide);
            let expected = thirds[first..].iter().map(|&third| f64::from(third));
            assert!(expected.take(S::Double::LANES).eq(wide[..S::Double::LANES].iter().copied()), "{first}");
        }
        for mask in 0..1u32 << S::LANES {
            let mut kept = [0; 16];
            let n = S::load_bits(&numbers).compress_bits_to(mask, &mut kept);
            let expected = (0..S::LANES).filter(|lane| mask >> lane & 1 == 1).map(|lane| numbers[lane]);
            assert!(expected.eq(kept[..n].iter().copied()), "{mask:b}");
        }
    }
}

/// Indices within and beyond twenty items.
const SCATTERED: [u32; 16] = [3, 0, 19, 7, u32::MAX, 1 << 31, 20, 5, 19, 2, 11, 4, 1 << 30, 0, 18, 6];

/// Gathers the columns of rows at indices within and beyond a slice.
struct GathersColumns;

impl Kernel for GathersColumns {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self) {
        let rows: [[f32; 8]; 20] = std::array::from_fn(|row| std::array::from_fn(|column| (8 * row + column) as f32));
        for (n, indices) in (1..=rows.len()).flat_map(|n| [(n, consecutive(0)), (n, SCATTERED)]) {
            let mut lanes = [0.0; 16];
            for (column, of_column) in S::gather_columns(&rows[..n], &indices).into_iter().enumerate() {
                of_column.store(&mut lanes);
                let expected = |lane: usize| rows[(n - 1).min(indices[lane] as usize)][column];
                assert!((0..S::LANES).all(|lane| lanes[lane] == expected(lane)), "{n} {column}");
            }
        }
    }
}

#[test]
fn columns_are_gathered_alike_on_every_instruction_set() {
    for instructions in InstructionSet::available() {
        // SAFETY: they are available.
        unsafe { instructions.call(GathersColumns) };
    }
}

/// Loads every byte, whole and in halves, and compares with conversions of numbers.
struct LoadsBytes;

impl Kernel for LoadsBytes {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self) {
        let bytes: [u8; 256] = std::array::from_fn(|byte| byte as u8);
        let mut lanes = [0.0; 16];
        for of_vector in bytes.chunks_exact(S::LANES) {
            // SAFETY: a chunk has as many bytes as a vector has lanes.
            let whole = unsafe { S::load_bytes_at(of_vector.as_ptr()) };
            whole.store(&mut lanes);
            assert!((0..S::LANES).all(|lane| lanes[lane] == f32::from(of_vector[lane])));
            for shift in [0, 4] {
                // SAFETY: as above.
                let halves = unsafe { S::load_halves_at(of_vector.as_ptr(), shift) };
                for (half, from) in halves.into_iter().zip([shift, 4 - shift]) {
                    half.store(&mut lanes);
                    assert!((0..S::LANES).all(|lane| lanes[lane] == f32::from(of_vector[lane] >> from & 15)));
                }
            }
        }
    }
}

/// Gathers numbers at indices within and beyond a slice.
struct GathersBits;

impl Kernel for GathersBits {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self) {
        // Numbers that are no f32 keep their bits.
        let numbers: [u32; 20] = std::array::from_fn(|index| 0x7fa0_0000 + index as u32);
        let indices = SCATTERED;
        for n in 1..=numbers.len() {
            let mut gathered = [0; 16];
            S::gather_bits(&numbers[..n], &indices).store_bits(&mut gathered);
            for lane in 0..S::LANES {
                assert_eq!(gathered[lane], numbers[(n - 1).min(indices[lane] as usize)]);
            }
        }
    }
}

#[test]
fn bits_are_gathered_alike_on_every_instruction_set() {
    for instructions in InstructionSet::available() {
        // SAFETY: they are available.
        unsafe { instructions.call(GathersBits) };
    }
}

#[test]
fn bytes_load_alike_on_every_instruction_set() {
    for instructions in InstructionSet::available() {
        // SAFETY: they are available.
        unsafe { instructions.call(LoadsBytes) };
    }
}

#[test]
fn lanes_move_alike_on_every_instruction_set() {
    for instructions in InstructionSet::available() {
        // SAFETY: they are available.
        unsafe { instructions.call(MovesLanes) };
    }
}
