//! Meshes against functions that they sample.

use super::*;

/// A quarter of a cylinder, unrolled, as a projector off its axis lights it; `f64` and no mesh. Points of the canvas.
fn cylinder(image: DVec2) -> DVec2 {
    // The projector stands 0.3 beside the axis of a cylinder of radius 1; its rays' slopes are even.
    let slope = (image.x - 0.5) * 1.1;
    let (away, forward) = (DVec2::new(0.3, 0.2), DVec2::new(slope, 1.0));
    let (a, b, c) = (forward.length_squared(), away.dot(forward), away.length_squared() - 1.0);
    let t = (-b + (b * b - a * c).sqrt()) / a;
    let at = away + t * forward;
    DVec2::new(0.5 + at.x.atan2(at.y) / std::f64::consts::FRAC_PI_2, 0.5 - (image.y - 0.5) * 0.8 * t)
}

fn mesh_of(size: [usize; 2], canvas_at: impl Fn(DVec2) -> DVec2) -> Mesh {
    let part = |n: usize, of: usize| n as f64 / (of - 1) as f64;
    let points: Vec<DVec2> = (0..size[0] * size[1])
        .map(|n| canvas_at(DVec2::new(part(n % size[0], size[0]), part(n / size[0], size[1]))))
        .collect();
    Mesh::new("a.pfm".to_owned(), size, &points).expect("a mesh")
}

/// Points all over the unit square, by Roberts' R2 sequence.
fn points(n_points: u32) -> impl Iterator<Item = DVec2> {
    (0..n_points).map(|n| {
        DVec2::new((f64::from(n) * 0.754_877_666_246_693).fract(), (f64::from(n) * 0.569_840_290_998_053).fract())
    })
}

#[test]
fn a_mesh_runs_through_its_points_and_its_error_falls_with_their_distance_cubed() {
    let error = |n: usize| {
        let mesh = mesh_of([n, n], cylinder);
        for (index, at) in mesh.points().enumerate() {
            let image = DVec2::new((index % n) as f64, (index / n) as f64) / (n - 1) as f64;
            assert!(mesh.canvas_at(image).distance(at) < 1e-12);
        }
        points(5000).map(|image| mesh.canvas_at(image).distance(cylinder(image))).fold(0.0, f64::max)
    };
    let (coarse, fine) = (error(9), error(17));
    assert!(fine < coarse / 6.0, "{coarse} {fine}");
    // A hundredth of a pixel of a thousand.
    assert!(error(33) < 1e-5, "{}", error(33));
}

#[test]
fn slopes_are_those_of_small_steps() {
    let mesh = mesh_of([7, 5], cylinder);
    for image in points(200) {
        let (_, slope) = mesh.with_slope(image);
        for (axis, step) in [DVec2::X, DVec2::Y].into_iter().enumerate() {
            let step = step * 1e-7;
            let measured = (mesh.canvas_at(image + step) - mesh.canvas_at(image - step)) / 2e-7;
            assert!(measured.distance(slope.col(axis)) < 1e-4, "{image}");
        }
    }
}

#[test]
fn the_way_back_from_the_canvas_ends_where_the_way_there_began() {
    let fold = |image: DVec2| {
        DVec2::new(if image.x < 0.55 { image.x } else { 0.55 + 0.6 * (image.x - 0.55) }, 0.9 - 0.8 * image.y)
    };
    let bent = mesh_of([17, 17], cylinder);
    let folded = mesh_of([65, 3], fold);
    for image in points(3000) {
        let away = bent.image_at(bent.canvas_at(image)).distance(image);
        assert!(away < 1e-7, "{image}: {away}");
        let away = bent.image_near(bent.canvas_at(image)).distance(image);
        assert!(away < 2e-4, "{image}: {away}");
        let away = folded.image_at(folded.canvas_at(image)).distance(image);
        assert!(away < 1e-7, "{image}: {away}");
    }
    // Beyond the image, points are beyond it on the way back too.
    for beyond in [DVec2::new(-0.02, 0.5), DVec2::new(1.03, 0.2), DVec2::new(0.4, -0.05)] {
        let back = bent.image_near(bent.canvas_at(beyond));
        assert!(back.distance(beyond) < 0.01, "{beyond}: {back}");
    }
}

#[test]
fn a_mesh_file_holds_metres_and_comes_back_as_it_was() {
    let mesh = mesh_of([5, 4], cylinder);
    let bytes = mesh.to_pfm([4.0, 2.0]);
    let pfm = Pfm::read(&bytes).expect("a PFM");
    let first = mesh.points().next().expect("points");
    assert_eq!(pfm.values[0], [(first.x * 4.0) as f32, (first.y * 2.0) as f32, 0.0]);
    let read = Mesh::from_pfm("a.pfm".to_owned(), &bytes, [4.0, 2.0]).expect("a mesh");
    assert!(read.points().zip(mesh.points()).all(|(a, b)| a.distance(b) < 1e-6));
}

#[test]
fn folded_mirrored_distant_and_empty_meshes_are_refused() {
    let new = |size: [usize; 2], points: &[[f64; 2]]| {
        let points: Vec<DVec2> = points.iter().map(|it| DVec2::from(*it)).collect();
        Mesh::new("a.pfm".to_owned(), size, &points).err()
    };
    let upright = [[0.0, 1.0], [1.0, 1.0], [0.0, 0.0], [1.0, 0.0]];
    assert_eq!(new([2, 2], &upright), None);
    let mirrored = [[1.0, 1.0], [0.0, 1.0], [1.0, 0.0], [0.0, 0.0]];
    assert_eq!(new([2, 2], &mirrored), Some(MeshError::Folded { column: 0, row: 0 }));
    let folded = [[0.0, 1.0], [0.8, 1.0], [0.6, 1.0], [0.0, 0.0], [0.8, 0.0], [0.6, 0.0]];
    assert!(matches!(new([3, 2], &folded), Some(MeshError::Folded { .. })));
    assert_eq!(new([1, 2], &[[0.0, 1.0], [0.0, 0.0]]), Some(MeshError::Size { columns: 1, rows: 2 }));
    let beside: Vec<[f64; 2]> = upright.iter().map(|[x, y]| [x + 1.5, *y]).collect();
    assert_eq!(new([2, 2], &beside), Some(MeshError::BeyondCanvas));
    let place = |at: DVec2| Some(MeshError::Flat { least: at, greatest: at });
    assert_eq!(new([2, 2], &[[0.5, 0.25]; 4]), place(DVec2::new(0.5, 0.25)));
    assert_eq!(new([2, 2], &[[0.0, 0.0]; 4]), place(DVec2::ZERO));
    assert!(
        new([2, 2], &[[0.0, 0.5], [1.0, 0.5], [0.0, 0.5], [1.0, 0.5]])
            .is_some_and(|it| it.to_string().contains("line"))
    );
    for odd in [f64::NAN, f64::INFINITY, 1e9] {
        let points = [upright[0], upright[1], upright[2], [1.0, odd]];
        assert_eq!(new([2, 2], &points), Some(MeshError::NoPlace { column: 1, row: 1 }));
    }
}
