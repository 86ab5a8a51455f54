//! `lab stability`: intersection methods in difficult cases.
//!
//! The truth never comes from a method under test: it is computed in integers ([`exact`]), from the shape of a closed surface
//! ([`closed`], [`shadows`]), in `f64` triangle by triangle ([`cameras`]), or by transformations that must change nothing
//! ([`invariance`]).

mod batches;
mod cameras;
mod closed;
mod contenders;
mod exact;
mod hostile;
mod invariance;
mod lattice;
mod replay;
mod shadows;
mod solids;
mod stadium;
#[cfg(test)]
mod strategies;

use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::Args;
use closed::Aim;
use contenders::{Contender, Tally};
use renderer::cli::{picture_args::read_camera, progress::Progress, say};

/// The extent of the trial, or a failure to replay.
#[derive(Args, Debug)]
pub struct StabilityArgs {
    /// Rays of each case
    #[arg(long, value_name = "N", default_value_t = 10_000_000,
        value_parser = renderer::cli::between(10_000_u64..=1_000_000_000_000))]
    rays: u64,

    /// Try only the cases whose names contain this text
    #[arg(long, value_name = "TEXT")]
    case: Option<String>,

    /// Try a mesh (PLY) and a camera instead, as a failed test wrote them
    #[arg(long, num_args = 2, value_names = ["MESH", "CAMERA"])]
    replay: Option<Vec<PathBuf>>,
}

/// A situation in which some methods fail: its name, and a function of the approximate number of rays, and of whether to
/// measure times.
type Case = (&'static str, fn(u64, bool) -> Tally);

const CASES: &[Case] = &[
    ("inside a sphere, centred at 0", |n, _| closed::sphere([0.0; 3], 2.0, Aim::Anywhere, n)),
    ("… at 10³", |n, _| closed::sphere([1e3, -1e3, 1e3], 2.0, Aim::Anywhere, n)),
    ("… at 1.5·10⁵", |n, _| closed::sphere([148_376.0, 1234.0, -223_423.0], 2.0, Aim::Anywhere, n)),
    ("… at 10⁷", |n, _| closed::sphere([1e7, 1e7, -1e7], 2.0, Aim::Anywhere, n)),
    ("… at its vertices and edge midpoints", |n, _| every_sphere(Aim::VerticesAndEdges, n)),
    ("coordinates from 10⁻⁸ to 10⁸", |n, _| coordinates(n)),
    ("along axes, with +0 and −0", |n, _| lattice::solids_and_soups(lattice::Aim::Axes, n)),
    ("within planes between cells", |n, _| closed::cell_planes(n)),
    ("along edges", |n, _| lattice::solids_and_soups(lattice::Aim::Edges, n)),
    ("through corners and edge midpoints", |n, _| lattice::solids_and_soups(lattice::Aim::Corners, n)),
    ("from vertices, edges and faces", |n, _| lattice::solids_and_soups(lattice::Aim::FromSurfaces, n)),
    ("from 10⁶ extents away", |n, _| lattice::solids_and_soups(lattice::Aim::Far, n)),
    ("wide packets from outside", |n, _| lattice::wide_packets(n)),
    ("flat scenes, on each axis", |n, _| [0, 1, 2].map(|axis| lattice::flat(&[axis], n / 3)).into_iter().sum()),
    ("a line, a point", |n, _| [&[0, 2][..], &[0, 1, 2]].map(|axes| lattice::flat(axes, n / 2)).into_iter().sum()),
    ("no triangle, one triangle", |n, _| lattice::few(n)),
    ("NaN, infinite and 10³⁰ vertices", |n, _| hostile::bad_vertices(n)),
    ("denormal coordinates", |n, _| lattice::denormal(n)),
    ("duplicates, triangles without area", |n, _| lattice::duplicates(n)),
    ("10⁵ coincident triangles", |n, _| hostile::coincident(n)),
    ("slivers of 1:10⁶", |n, _| closed::slivers(n)),
    ("scaled by 2^±20 and 2^±40", |n, _| invariance::scale(n)),
    ("translated", |n, _| invariance::translation(n)),
    ("a teapot in a stadium", stadium::teapot),
    ("shadow rays: acne", |n, _| shadows::acne(n)),
    ("shadow rays: lost contact", |n, _| shadows::contact(n)),
    ("between spheres, a billion to one", |n, _| batches::scales(n)),
    ("good rays among bad ones, in any order", |n, _| batches::mixed(n)),
    ("rays that go together", |n, _| batches::together(n)),
    ("NaN, infinite and huge rays", |n, _| hostile::odd_rays(n)),
    ("instructions, threads, divisions, storage", |n, _| invariance::one_hash(n)),
    ("camera rays against f64", |n, _| cameras::against_f64(n)),
    ("degenerate cameras", |n, _| cameras::degenerate(n)),
];

fn every_sphere(aim: Aim, n_rays: u64) -> Tally {
    let centres = [[0.0; 3], [1e3, -1e3, 1e3], [148_376.0, 1234.0, -223_423.0], [1e7, 1e7, -1e7]];
    centres.into_iter().map(|centre| closed::sphere(centre, 2.0, aim, n_rays / 4)).sum()
}

fn coordinates(n_rays: u64) -> Tally {
    let scales = (-8..=8).map(|decade| 10f64.powi(decade));
    let sphere = |scale: f64| closed::sphere([3.0, -2.0, 1.0].map(|x| x * scale), scale, Aim::Anywhere, n_rays / 17);
    scales.map(sphere).sum()
}

/// Tries the cases and prints the table. A wrong hit of the default is an error.
pub(crate) fn run(args: &StabilityArgs) -> Result<()> {
    if let Some([mesh, camera]) = args.replay.as_deref() {
        return replay::run(mesh, &read_camera(camera)?);
    }
    let wanted = args.case.as_deref().unwrap_or_default();
    let cases: Vec<_> = CASES.iter().filter(|(name, _)| name.contains(wanted)).collect();
    if cases.is_empty() {
        let names: Vec<_> = CASES.iter().map(|(name, _)| *name).collect();
        bail!("no case has {wanted:?} in its name; there are: {}", names.join("; "));
    }
    say(head())?;
    let mut failures = Vec::new();
    for (name, run) in cases {
        let tally = {
            let _progress = Progress::new(*name);
            run(args.rays, true)
        };
        say(line(name, &tally))?;
        if let Some(failure) = &tally.first_failure {
            failures.push(format!("{name}: {failure}"));
        }
    }
    if failures.is_empty() { Ok(()) } else { bail!("the default fails: {}", failures.join("; ")) }
}

fn head() -> String {
    let names = Contender::ALL.map(Contender::name).join(" | ");
    format!("| wrong of a million rays | rays | {names} |\n|---|---:{}|", "|---:".repeat(Contender::ALL.len()))
}

fn line(name: &str, tally: &Tally) -> String {
    let cells = tally.wrong.map(|wrong| match wrong {
        None => String::new(),
        Some(0) => "0".to_owned(),
        Some(wrong) => per_million(wrong as f64 * 1e6 / tally.n_rays as f64),
    });
    format!("| {name} | {} | {} |", per_million(tally.n_rays as f64), cells.join(" | "))
}

/// Two significant digits: more are not reproducible across versions.
fn per_million(x: f64) -> String {
    if x >= 9.95 {
        let unit = 10f64.powf(x.log10().floor() - 1.0);
        format!("{:.0}", (x / unit).round() * unit)
    } else {
        format!("{x:.1}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_fails_nowhere() {
        for (name, run) in CASES {
            let tally = run(100_000, false);
            assert!(tally.n_rays > 0, "{name}: nothing was tried");
            assert_eq!(tally.first_failure, None, "{name}");
        }
    }

    #[test]
    fn a_method_that_is_known_to_fail_fails() {
        let tally = every_sphere(Aim::VerticesAndEdges, 40_000);
        let of_rivals = Contender::ALL.iter().zip(tally.wrong).filter(|(contender, _)| !contender.is_default());
        let wrong: Vec<_> = of_rivals.map(|(_, wrong)| wrong).collect();
        assert!(wrong[0].is_some_and(|wrong| wrong > 100), "Möller and Trumbore's test leaks in f32: {wrong:?}");
    }
}
