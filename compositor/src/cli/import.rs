//! Makes a wall file of an MPCDI file, which other tools for projectors write.

use std::{
    fs::File,
    path::{Path, PathBuf},
};

use anyhow::{Context, bail, ensure};
use channel::files::{self, NewFiles};
use renderer::cli::{cannot_write, say};
use shared::printable::{counted, printable_line};

use super::ensure_new;
use crate::{
    mpcdi::{
        archive::Archive,
        canvas::{self, Places, Rect, Rough},
        convert::{self, Source},
        document::{Mpcdi, Profile},
        points::{self, Shape},
        view,
    },
    wall::{CANVAS_SIDES_M, Gamma, Projector, Surface, Unrolling, Wall},
};

/// Makes a wall file, and a mesh file for each projector, of an MPCDI file
#[derive(Clone, Debug, clap::Args)]
pub struct ImportArgs {
    /// The MPCDI file
    pub file: PathBuf,
    /// The wall file to write; mesh files are written beside it
    pub wall: PathBuf,
    /// Width of the canvas in metres, along the wall [default: that of points in space, else 4]
    #[arg(long, value_name = "M")]
    pub width: Option<f64>,
    /// Its height in metres, for a file of profile 2d [default: by the shape of the picture in the file]
    #[arg(long, value_name = "M")]
    pub height: Option<f64>,
    /// Shape of the wall, for files of the profiles 3d, a3 and sl, which show directions or points in space [default: flat]
    #[arg(long, value_enum)]
    pub shape: Option<Shape>,
    /// Angle between the planes of a fold in degrees, for a file of profile 3d, whose eye stands before the edge
    #[arg(long, value_name = "DEGREES")]
    pub angle: Option<f64>,
}

impl clap::ValueEnum for Shape {
    fn value_variants<'a>() -> &'a [Self] {
        &[Self::Flat, Self::Cylinder, Self::Fold, Self::Dome]
    }

    fn to_possible_value(&self) -> Option<clap::builder::PossibleValue> {
        let (name, help) = match self {
            Self::Flat => ("flat", "A plane"),
            Self::Cylinder => ("cylinder", "An upright cylinder with the audience inside"),
            Self::Fold => ("fold", "Two planes that meet at an upright edge"),
            Self::Dome => ("dome", "A part of a sphere, unrolled around its middle"),
        };
        Some(clap::builder::PossibleValue::new(name).help(help))
    }
}

/// The width of a canvas of which nothing is known.
const USUAL_WIDTH_M: f64 = 4.0;

/// A canvas on the wall that the file shows.
struct Laid {
    places: Places,
    rect: Rect,
    canvas_m: [f64; 2],
    surface: Option<Surface>,
    /// How it was found.
    line: String,
}

/// Reads all of the file, then writes. Existing files stay, and an error leaves none that is half of a wall.
pub fn run(args: &ImportArgs) -> anyhow::Result<()> {
    let ImportArgs { file, wall: wall_file, .. } = args;
    let fault = |problem: String| anyhow::anyhow!("{}: {}", file.display(), printable_line(&problem));
    ensure_new(wall_file, "name another wall file")?;
    let open = || files::open(file).with_context(|| file.display().to_string());
    let mut archive = Archive::open(open()?).map_err(fault)?;
    let document = archive.document().map_err(fault)?;
    let laid = match document.profile {
        Profile::Picture => {
            ensure!(
                args.shape.is_none_or(|shape| shape == Shape::Flat) && args.angle.is_none(),
                "{} has a picture, whatever the wall's shape: leave out --shape and --angle, and add [surface] to the wall file",
                file.display()
            );
            None
        }
        Profile::View | Profile::Space => Some(laid(args, &mut archive, &document)?),
    };
    let canvas_m = laid.as_ref().map_or_else(|| canvas_m(args, &document), |laid| Ok(laid.canvas_m))?;
    let projectors = projectors(&mut archive, &document, wall_file, laid.as_ref()).map_err(fault)?;
    let wall = Wall::new(canvas_m, Wall::paper().frame_size(), projectors).map_err(|it| fault(it.to_string()))?;
    let wall = wall.with_surface(laid.as_ref().and_then(|laid| laid.surface));
    let mut new = NewFiles::default();
    let mut write = |path: &Path, bytes: &[u8]| new.write(path, bytes).map_err(|error| cannot_write(path, &error));
    for mesh in wall.projectors().iter().filter_map(|projector| projector.mesh.as_ref()) {
        let path = wall_file.with_file_name(mesh.file());
        ensure_new(&path, "mesh files are named after the wall file, so name another one")?;
        write(&path, &mesh.to_pfm(canvas_m))?;
    }
    // Checked as a file, which numbers and meshes must pass: the next program reads it.
    let text = wall.to_toml();
    Wall::from_toml(&wall_file.display().to_string(), &text)?;
    write(wall_file, text.as_bytes())?;
    new.keep();
    // Directions fit any shape.
    let shape = if args.shape.is_none() && document.profile == Profile::View {
        "; the wall counts as flat, and --shape names another"
    } else {
        ""
    };
    let how = laid.map_or("--width and --height set others".to_owned(), |laid| laid.line) + shape;
    say(format_args!(
        "wrote {} with {} on a canvas of {:.4} m × {:.4} m ({how}); their places are the file's, and shares of light follow \
         from overlaps; {}; black_level and gain are to be set",
        wall_file.display(),
        counted(wall.projectors().len(), "projector"),
        canvas_m[0],
        canvas_m[1],
        gammas(&wall)
    ))
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
    match &all[..] {
        [only] if only == "\"srgb\"" => "gamma is \"srgb\", as the file says none".to_owned(),
        _ => format!(
            "gamma is {}: set \"srgb\" for those that have sRGB's curve, which MPCDI cannot say",
            all.join(" and ")
        ),
    }
}

fn canvas_m(args: &ImportArgs, document: &Mpcdi) -> anyhow::Result<[f64; 2]> {
    let width = args.width.unwrap_or(USUAL_WIDTH_M);
    check_side("--width", width)?;
    let by_shape = document.buffer_size.map(|[columns, rows]| width * f64::from(rows) / f64::from(columns));
    let Some(height) = args.height.or(by_shape) else {
        bail!("{} does not say the shape of its picture: give --height", args.file.display());
    };
    let what = if args.height.is_some() { "--height" } else { "the height that follows from --width" };
    check_side(what, height)?;
    Ok([width, height])
}

/// Lays the canvas onto a wall that is seen from an eye, or known by points in space: the largest rectangle that is lit.
fn laid(args: &ImportArgs, archive: &mut Archive<File>, document: &Mpcdi) -> anyhow::Result<Laid> {
    let fault = |problem: String| anyhow::anyhow!("{}: {}", args.file.display(), printable_line(&problem));
    args.width.map_or(Ok(()), |width| check_side("--width", width))?;
    ensure!(args.height.is_none(), "--height follows from --width in a file of this profile: leave it out");
    let (mut warps, mut maps) = (Vec::new(), Vec::new());
    for region in &document.regions {
        let warp = archive.warp(&region.warp).map_err(fault)?;
        convert::check(region, &warp).map_err(fault)?;
        warps.push(canvas::thin(region, &warp));
        let map = region.alpha.as_ref().filter(|(path, _)| !path.is_empty());
        maps.push(map.map(|(path, gamma)| archive.light(path, *gamma)).transpose().map_err(fault)?);
    }
    let rough = Rough { regions: &document.regions, warps: &warps, maps: &maps };
    let (places, shape, metres, line) = if document.profile == Profile::Space {
        ensure!(args.angle.is_none(), "--angle follows from the points in a file of this profile: leave it out");
        let (places, fitted) = points::places(args.shape.unwrap_or(Shape::Flat), &rough).map_err(fault)?;
        let has_unit = document.regions.iter().any(|region| region.unit_m.is_some());
        let size = if has_unit || args.width.is_some() {
            ""
        } else {
            "; the file names no unit that is known, so its width is a guess, and --width sets it"
        };
        (places, fitted.surface, has_unit.then_some(1.0), format!("it lies where points in space do{size}"))
    } else {
        let surface = unit_surface(args)?;
        let (places, line) = view::places(surface, &rough).map_err(fault)?;
        (places, surface, None, line)
    };
    let none = || fault("no part of the wall is lit all over: give --shape, as the wall is".to_owned());
    let rect @ [least, greatest] = rough.lit(&places).ok_or_else(none)?;
    let size = greatest - least;
    let scale = match (args.width, metres) {
        (None, Some(metres)) => metres,
        (width, _) => width.unwrap_or(USUAL_WIDTH_M) / size.x,
    };
    let canvas_m = (scale * size).to_array();
    canvas_m.iter().try_for_each(|side| check_side("a side of the canvas", *side))?;
    let surface = shape.map(|surface| surface.scaled(scale, -scale * least));
    Ok(Laid { places, rect, canvas_m, surface, line })
}

/// The shape of a wall that is seen from an eye, in units of the eye's distance from it.
fn unit_surface(args: &ImportArgs) -> anyhow::Result<Option<Surface>> {
    let shape = args.shape.unwrap_or(Shape::Flat);
    ensure!(shape == Shape::Fold || args.angle.is_none(), "--angle is that of --shape fold: leave it out");
    Ok(match (shape, args.angle) {
        (Shape::Flat, _) => None,
        (Shape::Cylinder, _) => Some(Surface::Cylinder { radius_m: 1.0, at_m: 0.0 }),
        (Shape::Dome, _) => Some(Surface::Dome { radius_m: 1.0, at_m: [0.0; 2], unrolled: Unrolling::Azimuthal }),
        (Shape::Fold, Some(angle)) => {
            ensure!((30.0..180.0).contains(&angle), "--angle is {angle}: give degrees from 30 to less than 180");
            Some(Surface::Fold { at_m: 0.0, angle })
        }
        (Shape::Fold, None) => bail!("a fold in a file of profile 3d needs its angle: give --angle 120, or as it is"),
    })
}

fn check_side(what: &str, side_m: f64) -> anyhow::Result<()> {
    let (least, most) = (CANVAS_SIDES_M.start(), CANVAS_SIDES_M.end());
    ensure!(CANVAS_SIDES_M.contains(&side_m), "{what} is {side_m}: give metres from {least} to {most}");
    Ok(())
}

/// The projectors of all regions, their pixels side by side.
fn projectors(
    archive: &mut Archive<File>,
    document: &Mpcdi,
    wall_file: &Path,
    laid: Option<&Laid>,
) -> Result<Vec<Projector>, String> {
    let stem = wall_file.file_stem().unwrap_or_default().to_string_lossy();
    let mut x = 0;
    let mut projectors = Vec::new();
    for (index, region) in document.regions.iter().enumerate() {
        let warp = archive.warp(&region.warp)?;
        let mesh_file = format!("{stem}.{}.pfm", index + 1);
        let in_picture = convert::in_picture(region);
        let on_wall = |value| canvas::on_canvas(&laid?.places, region, laid?.rect)(value);
        let canvas_from: &dyn Fn(_) -> _ = if laid.is_some() { &on_wall } else { &in_picture };
        let projector = convert::projector(Source { region, warp: &warp, canvas_from }, [x, 0], &mesh_file)?;
        x += region.size[0];
        // The map's gamma is the projector's, if the map is not linear.
        let gamma = region.alpha.as_ref().map(|(_, gamma)| *gamma).filter(|gamma| (1.2..=4.0).contains(gamma));
        projectors.push(Projector { gamma: gamma.map_or(projector.gamma, Gamma::Power), ..projector });
    }
    Ok(projectors)
}
