//! Every decoder on the kept corpus of `make fuzz`, and on mutations of it.

use std::path::Path;

use crate::{decoders::ALL, random::Random};

/// Mutations of each kept input; all of them take a few seconds.
const N_MUTATIONS: usize = 150;

/// Changes an input in a few places, sometimes to parts of another input.
fn mutate(input: &[u8], other: &[u8], random: &mut Random) -> Vec<u8> {
    let mut bytes = input.to_vec();
    for _ in 0..=random.below(4) {
        let at = random.below(bytes.len() + 1);
        let end = (at + random.below(9)).min(bytes.len());
        match random.below(6) {
            0 if at < bytes.len() => bytes[at] ^= 1 << random.below(8),
            1 if at < bytes.len() => bytes[at] = [0, 1, 0x7f, 0x80, 0xff][random.below(5)],
            2 => drop(bytes.drain(at..end)),
            3 => bytes.insert(at, random.below(256) as u8),
            4 => bytes.truncate(at),
            _ => {
                let from = random.below(other.len() + 1);
                let part = other[from..(from + random.below(17)).min(other.len())].to_vec();
                bytes.splice(at..end, part);
            }
        }
    }
    bytes
}

#[test]
fn decoders_survive_the_kept_corpus_and_mutations_of_it() {
    let corpus = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/corpus"));
    for (name, decode) in ALL {
        let mut paths: Vec<_> =
            std::fs::read_dir(corpus.join(name)).unwrap().map(|entry| entry.unwrap().path()).collect();
        paths.sort();
        let inputs: Vec<_> = paths.iter().map(|path| std::fs::read(path).unwrap()).collect();
        assert!(!inputs.is_empty(), "{name} has no corpus");
        let mut random = Random::new(1);
        for (input, path) in inputs.iter().zip(&paths) {
            // Shown only if the test fails.
            println!("{}", path.display());
            decode(input);
            for _ in 0..N_MUTATIONS {
                let mutated = mutate(input, &inputs[random.below(inputs.len())], &mut random);
                println!("{mutated:02x?}");
                decode(&mutated);
            }
        }
    }
}
