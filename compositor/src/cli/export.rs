//! Writes a wall as an MPCDI file, which other tools for projectors read.

use std::{io::Write, path::PathBuf, time::SystemTime};

use anyhow::{Context, ensure};
use channel::files::NewFile;
use renderer::cli::{cannot_write, say};
use shared::{division::FrameSize, printable::counted};

use super::{ensure_new, headless::Headless};
use crate::{
    gpu::RgbImage,
    mpcdi::{
        archive, convert,
        document::{Frustum, Mpcdi, Profile, Region},
    },
    wall::{CanvasRect, Gamma, Projector, Wall, mesh::pfm::Pfm},
};

/// Writes a wall as an MPCDI file: warps, and maps of light
#[derive(Clone, Debug, clap::Args)]
pub struct ExportArgs {
    /// The wall file
    pub wall: PathBuf,
    /// The MPCDI file to write
    pub file: PathBuf,
    /// The values of warps: each pixel's point of the picture, its direction from an eye, or its point in space
    #[arg(long, value_enum, default_value = "2d")]
    pub profile: ExportProfile,
    /// The wall is flat, although its projectors have meshes, as those of an imported wall do
    #[arg(long)]
    pub flat: bool,
}

/// A profile of MPCDI.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum ExportProfile {
    /// A picture that is laid onto the wall unrolled
    #[value(name = "2d")]
    Picture,
    /// Views from an eye on a cylinder's axis, or before the middle or edge of another wall
    #[value(name = "3d")]
    View,
    /// Points in space: X to the left, Y up, Z ahead, in metres
    #[value(name = "a3")]
    Space,
}

/// Draws the maps of light, and writes the file.
pub fn run(args: &ExportArgs) -> anyhow::Result<()> {
    ensure_new(&args.file, "name another MPCDI file")?;
    let wall = Wall::load(&args.wall)?;
    let is_flat = args.flat || wall.projectors().iter().all(|projector| projector.mesh.is_none());
    ensure!(
        !args.flat || wall.surface().is_none(),
        "{} says with [surface] that the wall is not flat: leave out --flat, or [surface]",
        args.wall.display()
    );
    ensure!(
        args.profile == ExportProfile::Picture || wall.surface().is_some() || is_flat,
        "{} has meshes and does not say the wall's shape: add [surface] if it is not flat, or export profile 2d; if it is \
         flat, add --flat",
        args.wall.display()
    );
    let profile = match args.profile {
        ExportProfile::Picture => Profile::Picture,
        ExportProfile::View => Profile::View,
        ExportProfile::Space => Profile::Space,
    };
    let [white, black] = maps(&wall)?;
    let mut regions = Vec::new();
    for (index, projector) in wall.projectors().iter().enumerate() {
        let frustum = match profile {
            Profile::View => Some(convert::view(&wall, projector).map(|(frustum, _)| frustum).with_context(|| {
                format!("\"{}\" lights more than one view shows: export profile 2d or a3", projector.name)
            })?),
            Profile::Picture | Profile::Space => None,
        };
        regions.push(region(index, projector, profile, frustum));
    }
    let document = Mpcdi { profile, buffer_size: Some(buffer_size(&wall)), regions };
    let files = document.regions.iter().zip(wall.projectors()).flat_map(|(region, projector)| {
        let map = |whole: &RgbImage| {
            let mut bytes = Vec::new();
            // Memory takes every map.
            let _ = whole.part(projector.output).encode(&mut bytes);
            bytes
        };
        let alpha = region.alpha.iter().map(|(path, _)| (path.clone(), map(&white)));
        let beta = region.beta.iter().map(|path| (path.clone(), map(&black)));
        let warp = match profile {
            Profile::Picture => convert::warp(projector),
            Profile::View => convert::view(&wall, projector).map(|(_, warp)| warp),
            Profile::Space => convert::points(&wall, projector),
        };
        let warp = warp.map(|warp: Pfm| (region.warp.clone(), warp.write()));
        warp.into_iter().chain(alpha).chain(beta).collect::<Vec<_>>()
    });
    let cannot = |error| cannot_write(&args.file, &error);
    let out = NewFile::begin(&args.file).map_err(cannot)?;
    let bytes = archive::pack(&document.write(&date(SystemTime::now())), files)
        .with_context(|| format!("cannot write {}", args.file.display()))?;
    out.file().write_all(&bytes).map_err(cannot)?;
    out.finish().map_err(cannot)?;
    say(format_args!("wrote {} with {}", args.file.display(), counted(wall.projectors().len(), "region")))
}

/// What all projectors show for white, and for black: their parts of the light, and what lifts their black.
fn maps(wall: &Wall) -> anyhow::Result<[RgbImage; 2]> {
    let mut headless = Headless::new(wall.clone())?;
    let size = FrameSize::new(8, 8)?;
    let mut shown = |sample: u32| -> anyhow::Result<RgbImage> {
        headless.upload_and_draw(size, &vec![sample; size.n_samples() as usize])?;
        Ok(headless.image()?)
    };
    Ok([shown(0xffff_ffff)?, shown(0xff00_0000)?])
}

/// Columns and rows of a picture of the canvas's proportions with at least as many samples as the wall can show, within
/// the limits of frames. Importers take the picture's shape from them.
fn buffer_size(wall: &Wall) -> [u32; 2] {
    let (native, canvas_m) = (wall.native_size(), wall.canvas_m());
    let per_m = (f64::from(native.xres()) / canvas_m[0]).max(f64::from(native.yres()) / canvas_m[1]);
    let largest = f64::from(FrameSize::LARGEST) / canvas_m[0].max(canvas_m[1]);
    canvas_m.map(|side_m| (side_m * per_m.min(largest)).round().max(1.0) as u32)
}

fn region(index: usize, projector: &Projector, profile: Profile, frustum: Option<Frustum>) -> Region {
    let CanvasRect { left, bottom, width, height } = match profile {
        Profile::Picture => projector.canvas,
        // A view fills its own buffer.
        Profile::View | Profile::Space => CanvasRect { left: 0.0, bottom: 0.0, width: 1.0, height: 1.0 },
    };
    let gamma = match projector.gamma {
        Gamma::Power(exponent) => exponent,
        // The curve of sRGB is close to this power.
        Gamma::Srgb => 2.2,
    };
    Region {
        id: projector.name.clone(),
        size: [projector.output.width, projector.output.height],
        at: [left, 1.0 - bottom - height],
        extent: [width, height],
        warp: format!("{}_warp.pfm", index + 1),
        alpha: Some((format!("{}_alpha.png", index + 1), gamma)),
        beta: Some(format!("{}_beta.png", index + 1)),
        frustum,
        unit_m: (profile == Profile::Space).then_some(1.0),
    }
}

/// A time as MPCDI writes it, in UTC; the calendar is Howard Hinnant's `civil_from_days` (2013).
fn date(time: SystemTime) -> String {
    let seconds = time.duration_since(SystemTime::UNIX_EPOCH).map_or(0, |since| since.as_secs());
    // Days since 1 March of the year 0, in eras of 400 years.
    let days = seconds / 86_400 + 719_468;
    let (era, day_of_era) = (days / 146_097, days % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let from_march = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * from_march + 2) / 5 + 1;
    let month = if from_march < 10 { from_march + 3 } else { from_march - 9 };
    let year = era * 400 + year_of_era + u64::from(month <= 2);
    let [hour, minute, second] = [seconds / 3600 % 24, seconds / 60 % 60, seconds % 60];
    format!("{year:04}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02}")
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn times_are_dates() {
        let at = |seconds| date(SystemTime::UNIX_EPOCH + Duration::from_secs(seconds));
        assert_eq!(at(0), "1970-01-01 00:00:00");
        assert_eq!(at(951_827_696), "2000-02-29 12:34:56");
        assert_eq!(at(4_102_444_799), "2099-12-31 23:59:59");
    }
}
