//! Measures the cost of reading models of any format: CPU time and elapsed time of each, in turns.
//!
//!     cargo run --release -p lab --example load_cost -- scan.obj scan.glb

use std::{path::PathBuf, time::Instant};

use clap::Parser;
use cpu_time::ProcessTime;
use lab::statistics::{median, milliseconds};
use renderer::{formats::file, memory::EndingAllocator};

/// That of all programs.
#[global_allocator]
static ALLOCATOR: EndingAllocator = EndingAllocator;

/// The models, and the measurement.
#[derive(Parser)]
struct Args {
    /// Models of any format
    #[arg(required = true)]
    models: Vec<PathBuf>,

    /// Times that each is read; the median counts
    #[arg(long, default_value_t = 5)]
    rounds: u32,
}

fn main() -> anyhow::Result<()> {
    let Args { models, rounds } = Args::parse();
    let mut times = vec![(0, Vec::new(), Vec::new()); models.len()];
    for _ in 0..rounds {
        for (model, (n_triangles, cpu, elapsed)) in models.iter().zip(&mut times) {
            let (cpu_start, start) = (ProcessTime::now(), Instant::now());
            let reading = file::read(model, &|_| ())?;
            cpu.push(milliseconds(cpu_start.elapsed()));
            elapsed.push(milliseconds(start.elapsed()));
            *n_triangles = reading.mesh.triangles.len();
        }
    }
    for (model, (n_triangles, cpu, elapsed)) in models.iter().zip(times) {
        let (cpu, elapsed) = (median(cpu), median(elapsed));
        println!("{}: {n_triangles} triangles, CPU {cpu:.0} ms, elapsed {elapsed:.0} ms", model.display());
    }
    Ok(())
}
