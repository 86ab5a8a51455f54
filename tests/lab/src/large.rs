//! `lab large`: very large models, from their files to frames, with the memory and the time that each step takes.
//!
//! Sizes are measured one after the other: `renderer generate` makes a statue, `renderer build` its scene file, and `renderer
//! trace` starts from that; [`frames`] are traced in this process, and [`process`] watches the memory of the others.

mod frames;
mod process;

use std::{
    fs, io,
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

use anyhow::{Context, Result, ensure};
use clap::Args;
use renderer::{
    cli::{
        between,
        free_memory::{FreeMemory, free_disk},
        say,
        stop::Task,
    },
    grid::{MemoryBudget, Storage},
    model::statue,
};
use serde::Serialize;
use shared::{
    printable::{bytes, counted},
    scene::Crease,
};

pub(crate) use self::frames::{MappedScenes, views};
use self::{frames::FrameFigures, process::Watched};
use crate::{farm::renderer_program, statistics::median};

/// Bytes of memory that building takes for each triangle, with some room: in scenes with a hierarchy over triangles, and in
/// larger ones.
const MEMORY_BYTES: [u64; 2] = [160, 48];

/// Bytes of a binary PLY file for each triangle: half a vertex, and a face.
const MODEL_BYTES: u64 = 19;

/// Bytes of a scene file for each triangle, as those of memory; the larger ones have stand-ins.
const SCENE_BYTES: [u64; 2] = [68, 36];

/// Fewest triangles of a scene that has no hierarchy over them.
const FEWEST_OF_LARGE: u32 = 4_000_000;

/// Bytes of memory and disk that small models take too.
const FEWEST_BYTES: u64 = 64_000_000;

/// Starts from a scene file that is sealed; their median counts.
const N_STARTS: usize = 5;

/// The sizes, and where the files go.
#[derive(Args, Debug)]
pub struct LargeArgs {
    /// Approximate numbers of triangles of the statues
    #[arg(long, value_name = "N,…", value_delimiter = ',', default_value = "10000000,100000000",
        value_parser = between(1000..=statue::MOST_TRIANGLES))]
    triangles: Vec<u32>,

    /// The folder for the files, which are removed after use, but stay if you stop the program; created if missing
    #[arg(long, value_name = "DIR", default_value = "target/large")]
    folder: PathBuf,

    /// Build within so much memory, with temporary files for what takes more; without it, in memory alone
    #[arg(long, value_name = "SIZE")]
    memory_budget: Option<MemoryBudget>,

    /// Storage of the grid: masks or compact
    #[arg(long, value_name = "HOW", default_value_t = Storage::default())]
    storage: Storage,

    /// Angle up to which surfaces are smooth, as of `renderer build`; 0 measures triangles without normals
    #[arg(long, value_name = "DEGREES", default_value_t = Crease::default(), allow_hyphen_values = true)]
    crease: Crease,

    /// Keep the files, and use a statue that is there in place of a new one
    #[arg(long)]
    keep: bool,

    /// Print the figures as JSON, without a table
    #[arg(long)]
    json: bool,
}

/// The figures of one size. Times are in seconds.
#[derive(Clone, Debug, Serialize)]
struct Row {
    triangles: usize,
    /// Of the scene file.
    scene_bytes: u64,
    scene_bytes_per_triangle: f64,
    /// From the PLY file to the scene file, on all cores.
    build_s: f64,
    /// The peak memory of that; `None` where the system does not tell.
    build_peak_bytes: Option<u64>,
    /// From exec to the end of a picture of 8×8 samples: all of a new file is checked first.
    first_start_s: f64,
    /// The same of later starts, with the file in the page cache.
    second_start_s: f64,
    #[serde(flatten)]
    frames: FrameFigures,
    /// Memory of one render server and of two together, each page divided among those that map it; `None` where the system
    /// does not tell.
    pss_bytes: Option<[u64; 2]>,
}

/// Measures all sizes, and prints the table after each.
///
/// # Errors
/// A size does not fit this machine, which is said before anything is generated; or a program fails.
pub(crate) fn run(args: &LargeArgs) -> Result<()> {
    fs::create_dir_all(&args.folder).with_context(|| format!("{}: cannot be made", args.folder.display()))?;
    for &triangles in &args.triangles {
        let need = Need::within(args.memory_budget, triangles);
        let FreeMemory { shared, own } = FreeMemory::now();
        // A statue that is used again has its place already.
        let n_kept =
            if args.keep { n_bytes(&Files::new(&args.folder, triangles, true)?.model).unwrap_or(0) } else { 0 };
        let disk = free_disk(&args.folder).map(|free| free + n_kept);
        let free = Need { memory: shared.into_iter().chain(own).min(), disk, triangles };
        if !args.json {
            say(need.line(&args.folder, &free))?;
        }
        ensure!(
            need.fits(&free),
            "{}; this machine lacks that: ask for fewer triangles (make large LARGE_TRIANGLES=1000000), or free some",
            need.line(&args.folder, &free)
        );
    }
    let mut rows = Vec::new();
    for &triangles in &args.triangles {
        let files = Files::new(&args.folder, triangles, args.keep)?;
        rows.push(measure(&files, args, triangles)?);
        if !args.json {
            say(table(&rows))?;
        }
    }
    if args.json { say(serde_json::to_string(&rows)?) } else { Ok(()) }
}

/// Bytes of memory and disk: those that a size needs, or those that are free. `None` where the system does not tell.
#[derive(Clone, Copy, Debug)]
struct Need {
    memory: Option<u64>,
    disk: Option<u64>,
    triangles: u32,
}

impl Need {
    fn of(triangles: u32) -> Self {
        let is_large = usize::from(triangles >= FEWEST_OF_LARGE);
        let all = |each: u64| Some(FEWEST_BYTES + u64::from(triangles) * each);
        Self { memory: all(MEMORY_BYTES[is_large]), disk: all(MODEL_BYTES + SCENE_BYTES[is_large]), triangles }
    }

    /// The need of a size that is built within a memory budget. The disk holds what takes more, until the scene file is
    /// written.
    fn within(budget: Option<MemoryBudget>, triangles: u32) -> Self {
        let whole = Self::of(triangles);
        match (budget.map(MemoryBudget::n_bytes), whole.memory) {
            (Some(budget), Some(memory)) if budget < memory => {
                let on_disk = FEWEST_BYTES + u64::from(triangles) * MODEL_BYTES + memory;
                Self { memory: Some(budget), disk: whole.disk.max(Some(on_disk)), triangles }
            }
            _ => whole,
        }
    }

    fn fits(&self, free: &Self) -> bool {
        let fits = |need: Option<u64>, free: Option<u64>| free.is_none_or(|free| need <= Some(free));
        fits(self.memory, free.memory) && fits(self.disk, free.disk)
    }

    fn line(&self, folder: &Path, free: &Self) -> String {
        let told = |n_bytes: Option<u64>| n_bytes.map_or("an unknown amount".to_owned(), bytes);
        format!(
            "{} need {} of memory and {} of disk in {}; {} and {} are free",
            counted(self.triangles, "triangle"),
            told(self.memory),
            told(self.disk),
            folder.display(),
            told(free.memory),
            told(free.disk)
        )
    }
}

/// The files of one size; removed with this value, unless they are kept.
struct Files {
    model: PathBuf,
    scene: PathBuf,
    picture: PathBuf,
    folder: PathBuf,
    is_kept: bool,
}

impl Files {
    fn new(folder: &Path, triangles: u32, is_kept: bool) -> Result<Self> {
        // Programs that are started elsewhere find them too.
        let folder = std::path::absolute(folder)?;
        let named = |ending: &str| folder.join(format!("statue-{triangles}.{ending}"));
        let [model, scene, picture] = ["ply", "raywall", "png"].map(named);
        Ok(Self { model, scene, picture, folder, is_kept })
    }

    /// The command of the program `renderer` with this folder's cache.
    fn renderer(&self) -> Result<Command> {
        let mut command = Command::new(renderer_program()?);
        command.env("XDG_CACHE_HOME", MappedScenes::caches_in(&self.folder)).env("RUST_LOG", "error");
        Ok(command)
    }
}

impl Drop for Files {
    fn drop(&mut self) {
        let own: &[&Path] = if self.is_kept { &[] } else { &[&self.model, &self.scene] };
        // Those that were not made yet are not there.
        own.iter().chain([&&*self.picture]).for_each(|path| drop(fs::remove_file(path)));
        let _ = fs::remove_dir_all(MappedScenes::caches_in(&self.folder));
    }
}

fn measure(files: &Files, args: &LargeArgs, triangles: u32) -> Result<Row> {
    let task = |name: &str| Task::named(format!("{name} {}", counted(triangles, "triangle")));
    if !(files.is_kept && files.model.is_file()) {
        let _task = task("generating");
        let count = triangles.to_string();
        Watched::run(files.renderer()?.args(["generate", "statue", "--triangles", &count]).arg(&files.model))?;
    }

    let building = task("building");
    // The default budget follows what is free, and would decide about the grid.
    let budget = args.memory_budget.map(|budget| budget.to_string());
    let budget = budget.unwrap_or_else(|| Need::of(triangles).memory.unwrap_or_default().to_string());
    let mut build = files.renderer()?;
    build.arg("build").args([&files.model, &files.scene]).args(["--memory-budget", &budget]);
    build.args(["--storage", args.storage.into()]).args(["--crease", &args.crease.to_string()]);
    let built = Watched::run(&mut build)?;
    drop(building);

    let _task = task("measuring");
    let start = || -> Result<Duration> {
        let mut command = files.renderer()?;
        command.args(["trace", "--size", "8x8", "--image"]).args([&files.picture, &files.scene]);
        Ok(Watched::run(&mut command)?.time)
    };
    let first_start = start()?;
    let starts = (0..N_STARTS).map(|_| start()).collect::<Result<Vec<_>>>()?;
    let frames = frames::measure(files)?;
    let n_triangles = frames.n_triangles;
    let scene_bytes = n_bytes(&files.scene)?;
    Ok(Row {
        triangles: n_triangles,
        scene_bytes,
        scene_bytes_per_triangle: scene_bytes as f64 / n_triangles as f64,
        build_s: built.time.as_secs_f64(),
        build_peak_bytes: built.peak_bytes,
        first_start_s: first_start.as_secs_f64(),
        second_start_s: median(starts.iter().map(Duration::as_secs_f64)),
        pss_bytes: frames::shared_memory(files, &frames)?,
        frames,
    })
}

fn n_bytes(path: &Path) -> io::Result<u64> {
    fs::metadata(path).map(|file| file.len())
}

/// A figure of a size, as the table has it.
type Value<'a> = &'a dyn Fn(&Row) -> String;

/// The figures, a column for each size.
fn table(rows: &[Row]) -> String {
    let megabytes = |bytes: u64| format!("{:.0}", bytes as f64 / 1e6);
    let unknown = || "unknown".to_owned();
    let figures: [(&str, Value<'_>); 16] = [
        ("triangles", &|row| row.triangles.to_string()),
        ("bytes a triangle, scene file", &|row| format!("{:.1}", row.scene_bytes_per_triangle)),
        ("PLY to scene file, s", &|row| format!("{:.1}", row.build_s)),
        ("its peak memory, MB", &|row| row.build_peak_bytes.map_or_else(unknown, megabytes)),
        ("the same, bytes a triangle", &|row| {
            row.build_peak_bytes.map_or_else(unknown, |peak| format!("{:.1}", peak as f64 / row.triangles as f64))
        }),
        ("first start, which checks the file, s", &|row| format!("{:.3}", row.first_start_s)),
        ("second start: exec to 8x8 samples, s", &|row| format!("{:.3}", row.second_start_s)),
        ("frame seen whole, all cores, ms", &|row| format!("{:.1}", row.frames.whole.frame_ms)),
        ("frame seen close, all cores, ms", &|row| format!("{:.1}", row.frames.close.frame_ms)),
        ("seen whole, in motion, ms", &|row| format!("{:.1}", row.frames.whole_in_motion.frame_ms)),
        ("seen close, in motion, ms", &|row| format!("{:.1}", row.frames.close_in_motion.frame_ms)),
        ("seen whole, Mpixel/s a core", &|row| format!("{:.1}", row.frames.whole.mpixel_per_core_s)),
        ("seen close, Mpixel/s a core", &|row| format!("{:.1}", row.frames.close.mpixel_per_core_s)),
        ("PSS of one render server, MB", &|row| row.pss_bytes.map_or_else(unknown, |[one, _]| megabytes(one))),
        ("PSS of two together, MB", &|row| row.pss_bytes.map_or_else(unknown, |[_, two]| megabytes(two))),
        ("two over one", &|row| {
            row.pss_bytes.map_or_else(unknown, |[one, two]| format!("{:.3}", two as f64 / one as f64))
        }),
    ];
    let line = |(name, value): &(&str, Value<'_>)| {
        let values: String = rows.iter().map(|row| format!("{:>12}", value(row))).collect();
        format!("{name:<40}{values}")
    };
    figures.iter().map(line).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_size_fits_where_memory_and_disk_are_free_or_unknown() {
        let need = Need::of(10_000_000);
        assert_eq!((need.memory, need.disk), (Some(544_000_000), Some(614_000_000)));
        let free = |memory, disk| Need { memory, disk, triangles: 0 };
        for (free, fits) in [
            (free(Some(544_000_000), Some(614_000_000)), true),
            (free(None, None), true),
            (free(Some(543_999_999), None), false),
            (free(Some(u64::MAX), Some(613_999_999)), false),
        ] {
            assert_eq!(need.fits(&free), fits, "{free:?}");
        }
        let within = Need::within(Some("200M".parse().unwrap()), 10_000_000);
        assert_eq!((within.memory, within.disk), (Some(200_000_000), Some(798_000_000)));
        let line = need.line(Path::new("there"), &free(Some(1_000_000), None));
        let told = "544 MB of memory and 614 MB of disk in there; 1.0 MB and an unknown amount are free";
        assert_eq!(line, format!("10000000 triangles need {told}"));
    }
}
