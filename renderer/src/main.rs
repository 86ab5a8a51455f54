//! The `renderer` program.

fn main() {}
