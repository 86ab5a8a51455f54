//! Makes a wall file of an MPCDI file, which other tools for projectors write.

use std::{
    fs::{self, File},
    path::{Path, PathBuf},
};

use anyhow::{Context, bail, ensure};
use channel::files;
use renderer::cli::say;
use shared::printable::{counted, printable_line};

use super::ensure_new;
use crate::{
    mpcdi::{archive::Archive, convert, document::Mpcdi},
    wall::{CANVAS_SIDES_M, Gamma, Projector, Wall},
};

/// Makes a wall file, and a mesh file for each projector, of an MPCDI file
#[derive(Clone, Debug, clap::Args)]
pub struct ImportArgs {
    /// The MPCDI file, of profile 2d
    pub file: PathBuf,
    /// The wall file to write; mesh files are written beside it
    pub wall: PathBuf,
    /// Width of the canvas in metres, which MPCDI does not say
    #[arg(long, value_name = "M", default_value_t = 4.0)]
    pub width: f64,
    /// Its height in metres [default: by the shape of the picture in the file]
    #[arg(long, value_name = "M")]
    pub height: Option<f64>,
}

/// Reads all of the file, then writes. Existing files stay, and an error leaves none that is half of a wall.
pub fn run(args: &ImportArgs) -> anyhow::Result<()> {
    let ImportArgs { file, wall: wall_file, .. } = args;
    let fault = |problem: String| anyhow::anyhow!("{}: {}", file.display(), printable_line(&problem));
    ensure_new(wall_file, "name another wall file")?;
    let open = || files::open(file).with_context(|| file.display().to_string());
    let mut archive = Archive::open(open()?).map_err(fault)?;
    let document = archive.document().map_err(fault)?;
    let canvas_m = canvas_m(args, &document)?;
    let projectors = projectors(&mut archive, &document, wall_file).map_err(fault)?;
    let wall = Wall::new(canvas_m, Wall::paper().frame_size(), projectors).map_err(|it| fault(it.to_string()))?;
    let mut written = Written::default();
    for mesh in wall.projectors().iter().filter_map(|projector| projector.mesh.as_ref()) {
        let path = wall_file.with_file_name(mesh.file());
        ensure_new(&path, "mesh files are named after the wall file, so name another one")?;
        written.write(path, &mesh.to_pfm(canvas_m))?;
    }
    // Checked as a file, which numbers and meshes must pass: the next program reads it.
    let text = wall.to_toml();
    Wall::from_toml(&wall_file.display().to_string(), &text)?;
    written.write(wall_file.clone(), text.as_bytes())?;
    written.keep();
    say(format_args!(
        "wrote {} with {} on a canvas of {} m × {} m (--width and --height set others); their places are the file's, and \
         shares of light follow from overlaps; {}; black_level and gain are to be set",
        wall_file.display(),
        counted(wall.projectors().len(), "projector"),
        canvas_m[0],
        canvas_m[1],
        gammas(&wall)
    ))
}

/// Files that were written; removed when it is dropped, unless they are kept.
#[derive(Default)]
struct Written(Vec<PathBuf>);

impl Written {
    fn write(&mut self, path: PathBuf, bytes: &[u8]) -> anyhow::Result<()> {
        files::write(&path, |out| out.write_all(bytes)).with_context(|| format!("cannot write {}", path.display()))?;
        self.0.push(path);
        Ok(())
    }

    fn keep(mut self) {
        self.0.clear();
    }
}

impl Drop for Written {
    fn drop(&mut self) {
        for path in &self.0 {
            // The error that ends the program says more than this one would.
            let _ = fs::remove_file(path);
        }
    }
}

/// The gammas of a wall's projectors, which MPCDI says as powers.
fn gammas(wall: &Wall) -> String {
    let mut all: Vec<String> = Vec::new();
    for projector in wall.projectors() {
        let gamma = match projector.gamma {
            Gamma::Power(exponent) => exponent.to_string(),
            Gamma::Srgb => "\"srgb\"".to_owned(),
        };
        if !all.contains(&gamma) {
            all.push(gamma);
        }
    }
    format!("gamma is {}: set \"srgb\" for those that have sRGB's curve, which MPCDI cannot say", all.join(" and "))
}

fn canvas_m(args: &ImportArgs, document: &Mpcdi) -> anyhow::Result<[f64; 2]> {
    check_side("--width", args.width)?;
    let by_shape = document.buffer_size.map(|[columns, rows]| args.width * f64::from(rows) / f64::from(columns));
    let Some(height) = args.height.or(by_shape) else {
        bail!("{} does not say the shape of its picture: give --height", args.file.display());
    };
    let what = if args.height.is_some() { "--height" } else { "the height that follows from --width" };
    check_side(what, height)?;
    Ok([args.width, height])
}

fn check_side(what: &str, side_m: f64) -> anyhow::Result<()> {
    let (least, most) = (CANVAS_SIDES_M.start(), CANVAS_SIDES_M.end());
    ensure!(CANVAS_SIDES_M.contains(&side_m), "{what} is {side_m}: give metres from {least} to {most}");
    Ok(())
}

/// The projectors of all regions, their pixels side by side.
fn projectors(archive: &mut Archive<File>, document: &Mpcdi, wall_file: &Path) -> Result<Vec<Projector>, String> {
    let stem = wall_file.file_stem().unwrap_or_default().to_string_lossy();
    let mut x = 0;
    let mut projectors = Vec::new();
    for (index, region) in document.regions.iter().enumerate() {
        let warp = archive.warp(&region.warp)?;
        let projector = convert::projector(region, &warp, [x, 0], &format!("{stem}.{}.pfm", index + 1))?;
        x += region.size[0];
        // The map's gamma is the projector's, if the map is not linear.
        let gamma = region.alpha.as_ref().map(|(_, gamma)| *gamma).filter(|gamma| (1.2..=4.0).contains(gamma));
        projectors.push(Projector { gamma: gamma.map_or(projector.gamma, Gamma::Power), ..projector });
    }
    Ok(projectors)
}
