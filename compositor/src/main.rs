//! The `compositor` program.

fn main() {}
