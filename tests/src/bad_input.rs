//! Users' mistakes end in a failure with one clear line that names the cure, never in a panic.

use std::{net::TcpListener, process::Command};

use shared::protocol::DEFAULT_PORT;

use crate::process::{Program, generate_statue};

/// Runs a program that must fail; returns its line of error.
fn fails(command: Command) -> String {
    let shown = format!("{command:?}");
    let (status, said) = Program::start(command).wait();
    assert!(status.code().is_some_and(|code| code != 0), "{shown} ends with {status}\n{said}");
    assert!(!said.contains("panicked"), "{shown}\n{said}");
    let lines: Vec<&str> = said.lines().filter(|line| line.starts_with("error: ")).collect();
    let [line] = lines[..] else { panic!("{shown} prints no single line of error\n{said}") };
    line.to_owned()
}

fn compositor(args: &[&str]) -> Command {
    let mut command = Program::command("compositor");
    command.args(["--headless", "--listen", "127.0.0.1:0", "--local", "1", "--triangles", "1000", "--frames", "1"]);
    command.args(args);
    command
}

fn renderer(args: &[&str]) -> Command {
    let mut command = Program::command("renderer");
    command.args(args);
    command
}

#[test]
fn files_that_are_missing_or_wrong_are_named_with_the_cure() {
    let folder = tempfile::tempdir().unwrap();
    let bad = folder.path().join("bad");
    std::fs::write(&bad, "neither PLY nor TOML\n").unwrap();
    let bad = bad.to_str().unwrap();
    let mut model = Program::command("compositor");
    model.args(["--headless", "--listen", "127.0.0.1:0", "--local", "1", "--model", "no/such.ply"]);
    assert!(fails(model).contains("no/such.ply: cannot be read"));
    let mut model = Program::command("compositor");
    model.args(["--headless", "--listen", "127.0.0.1:0", "--local", "1", "--model", bad]);
    assert!(fails(model).contains(bad));
    assert!(fails(compositor(&["--wall", "no/such.toml"])).contains("no/such.toml"));
    assert!(fails(compositor(&["--wall", bad])).contains(&format!("{bad}:1: ")));
    assert!(fails(compositor(&["--camera", "no/such.toml"])).contains("no/such.toml"));
    let line = fails(compositor(&["--camera", bad]));
    assert!(line.contains("eye, ll, u and v"), "{line}");
    assert!(fails(renderer(&["trace", "--image", "none.png", "--model", bad])).contains(bad));
    let line = fails(renderer(&["trace", "--image", "none.png", "--triangles", "1000", "--camera", bad]));
    assert!(line.contains("eye, ll, u and v"), "{line}");
}

#[test]
fn values_out_of_range_name_the_range() {
    assert!(fails(compositor(&["--size", "0x512"])).contains("from 1 to 65536"));
    assert!(fails(compositor(&["--size", "wide"])).contains("1024x512"));
    assert!(fails(compositor(&["--division", "random"])).contains("interleaved, tiled, dynamic"));
    assert!(fails(renderer(&["connect", "127.0.0.1:1", "--threads", "0"])).contains("0 is not between 1 and 1024"));
    assert!(fails(renderer(&["trace", "--size", "-5x5"])).contains("1024x512"));
    assert!(fails(renderer(&["trace", "--threads", "-1"])).contains("-1 is not between 1 and 1024"));
}

#[test]
fn an_impossible_experiment_is_refused() {
    let bench = |args: &[&str]| {
        let mut command = Program::command("lab");
        command.arg("bench").args(args);
        fails(command)
    };
    assert!(bench(&["--out", "x", "--nodes", "0..65"]).contains("from 0 to 64"));
    assert!(bench(&["--out", "x", "--nodes", "twelve"]).contains("0..12"));
    assert!(bench(&["--out", "x", "--predict", "9999"]).contains("from 0 to 1024"));
    assert!(bench(&["--out", "x", "--seconds", "0"]).contains("from 0.01 to 3600"));
    assert!(bench(&["--out", "x", "--predict-size", "0x1"]).contains("from 1 to 65536"));
    assert!(bench(&["--out", "/proc/no/such", "--nodes", "none"]).contains("cannot make the folder /proc/no/such"));
}

#[test]
fn a_wall_whose_name_is_unknown_is_told_once_and_tried_again() {
    let mut program = Program::start(renderer(&["connect", "no-such-wall.invalid"]));
    program.wait_for("no-such-wall.invalid:7117: no machine of this name is known: check the name");
    // By then it has tried again several times.
    std::thread::sleep(std::time::Duration::from_secs(2));
    program.signal("TERM");
    let (status, said) = program.wait();
    assert_eq!((status.code(), said.matches("no machine").count()), (Some(0), 1), "{said}");
}

#[test]
fn an_up_axis_that_nothing_would_follow_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let camera = folder.path().join("camera.toml");
    std::fs::write(&camera, "eye = [0, 0, 1]\nll = [-1, -1, 0]\nu = [2, 0, 0]\nv = [0, 2, 0]\n").unwrap();
    let line = fails(compositor(&["--up", "z", "--camera", camera.to_str().unwrap()]));
    assert!(line.contains("--up has no effect on a --camera"), "{line}");
}

#[test]
fn a_port_in_use_is_reported() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let line = fails(compositor(&["--listen", &taken.local_addr().unwrap().to_string()]));
    assert!(line.contains("is another wall running?") && line.contains("--listen 127.0.0.1:0"), "{line}");
    let line = fails(compositor(&["--listen", "192.0.2.1:7117", "--insecure"]));
    assert!(line.contains("does not have that address") && line.contains("--listen 0.0.0.0:7117"), "{line}");
}

#[test]
fn a_wall_that_serves_itself_takes_a_free_port() {
    // It is taken even if this fails.
    let _taken = TcpListener::bind(("127.0.0.1", DEFAULT_PORT));
    let mut wall = Program::command("compositor");
    wall.args(["--headless", "--local", "1", "--triangles", "1000", "--frames", "1", "--size", "64x32"]);
    let said = Program::succeed(wall);
    assert!(
        said.contains(&format!("127.0.0.1:{DEFAULT_PORT} is taken, as by another wall: this one takes a free port")),
        "{said}"
    );
    let mut wall = Program::command("compositor");
    wall.args(["--headless", "--local", "0", "--frames", "1"]);
    assert!(fails(wall).contains("is another wall running?"));
}

#[test]
fn the_open_network_needs_a_key_or_insecure() {
    for line in [fails(compositor(&["--listen", "0.0.0.0:0"])), fails(renderer(&["connect", "192.0.2.1:7117"]))] {
        assert!(line.contains("--insecure"), "{line}");
        // The command that the line shows works.
        let folder = tempfile::tempdir().unwrap();
        let words: Vec<&str> = line.split('`').nth(1).unwrap().split(' ').collect();
        let made = Command::new(words[0]).args(&words[1..]).current_dir(folder.path()).output().unwrap();
        assert!(made.status.success(), "{line}\n{made:?}");
        let key = folder.path().join("wall.key");
        let key = key.to_str().unwrap();
        assert!(fails(renderer(&["key", key])).contains("never overwritten"));
        assert!(fails(compositor(&["--key", key, "--camera", "no/such.toml"])).contains("no/such.toml"));
    }
    assert!(fails(renderer(&["connect", "no port:here"])).contains("HOST:PORT"));
    assert!(fails(renderer(&["connect", "wall.example:0"])).contains("port \"0\": write it as HOST or HOST:PORT"));
}

#[test]
fn a_key_file_that_is_missing_or_wrong_is_named_with_the_cure() {
    let folder = tempfile::tempdir().unwrap();
    let short = folder.path().join("short.key");
    std::fs::write(&short, "0123\n").unwrap();
    let short = short.to_str().unwrap();
    let check = |path: &str, expected: &str| {
        for command in [compositor(&["--key", path]), renderer(&["connect", "127.0.0.1:1", "--key", path])] {
            let line = fails(command);
            assert!(line.contains(path) && line.contains(expected), "{line}");
        }
    };
    check("no/such.key", " key no/such.key` makes a key");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        std::fs::set_permissions(short, std::fs::Permissions::from_mode(0o644)).unwrap();
        check(short, "`chmod 600 ");
        std::fs::set_permissions(short, std::fs::Permissions::from_mode(0o600)).unwrap();
    }
    check(short, "64 hexadecimal digits");
}

#[test]
fn without_a_vulkan_driver_the_cure_is_named() {
    let mut command = compositor(&[]);
    command.env("VK_DRIVER_FILES", "/no/such.json").env("VK_ICD_FILENAMES", "/no/such.json");
    let line = fails(command);
    assert!(line.contains("mesa-vulkan-drivers"), "{line}");
}

#[test]
fn what_cannot_be_written_is_told_before_the_work() {
    for command in [
        compositor(&["--screenshot", "/no/such/folder/out.png"]),
        compositor(&["--stats", "/no/such/folder/out.json"]),
        renderer(&["trace", "--triangles", "80000000", "--image", "/no/such/folder/out.png"]),
        renderer(&["generate", "statue", "--triangles", "80000000", "/no/such/folder/out.ply"]),
    ] {
        let shown = format!("{command:?}");
        let (_, said) = Program::start(command).wait();
        assert_eq!(said.matches("No such file").count(), 1, "{shown}\n{said}");
        assert!(said.starts_with("error: ") && said.contains("/no/such/folder/out."), "{shown}\n{said}");
    }
    let mut check = Program::command("compositor");
    check.args(["check", "wall.toml", "--svg", "wall.toml"]);
    for (command, ending) in [
        (compositor(&["--screenshot", "a.jpg"]), "png"),
        (renderer(&["trace", "--image", "a.jpg"]), "png"),
        (compositor(&["--stats", "dragon.ply"]), "json"),
        (check, "svg"),
    ] {
        assert!(fails(command).ends_with(&format!("give a name that ends with .{ending}")));
    }
}

#[test]
fn a_scene_does_not_replace_its_model() {
    let folder = tempfile::tempdir().unwrap();
    let [model, link] = ["model.raywall", "link.raywall"].map(|name| folder.path().join(name));
    Program::succeed(renderer(&[
        "generate",
        "statue",
        "--triangles",
        "1000",
        folder.path().join("a.ply").to_str().unwrap(),
    ]));
    std::fs::rename(folder.path().join("a.ply"), &model).unwrap();
    std::os::unix::fs::symlink(&model, &link).unwrap();
    let before = std::fs::read(&model).unwrap();
    for out in [&model, &link] {
        let line = fails(renderer(&["build", model.to_str().unwrap(), out.to_str().unwrap()]));
        assert!(line.contains("is the model itself") && line.contains("name another file"), "{line}");
    }
    assert_eq!(std::fs::read(&model).unwrap(), before);
}

#[test]
fn a_file_that_may_not_grow_so_large_is_told_and_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = Command::new("sh");
    command.args(["-c", "ulimit -f 100; exec \"$@\"", "sh"]).arg(renderer(&[]).get_program());
    command.args(["generate", "statue", "--triangles", "200000"]).arg(folder.path().join("statue.ply"));
    let line = fails(command);
    assert!(line.contains("statue.ply") && line.contains("File too large"), "{line}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn other_formats_and_wrong_indices_have_their_own_cures() {
    let folder = tempfile::tempdir().unwrap();
    let trace = |name: &str, content: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, content).unwrap();
        fails(renderer(&["trace", "--image", "/dev/null", "--model", path.to_str().unwrap()]))
    };
    for (content, told) in [
        ("plain text\n", "is no model that is read (PLY, OBJ, STL, glTF, GLB)"),
        ("v 0 0 0\n", "a point cloud must be meshed first"),
        ("v 0 0 0\nf 1 2 3\n", "export the model again"),
        ("v 0 0\n", "line 1: a number is missing"),
        ("{}", "is no glTF 2.0: missing field `asset`"),
        ("glTF\u{1}\0\0\0\0\0\0\0", "convert it to 2.0"),
        ("solid a\nfacet\nvertex 0 0\n", "line 3: a vertex needs three numbers"),
    ] {
        // The name says nothing.
        let line = trace("a.ply", content);
        assert!(line.contains(told), "{line}");
    }
}

#[test]
fn addresses_may_be_names() {
    let listening = Program::succeed(compositor(&["--listen", "localhost:0"]));
    assert!(listening.contains("listening on 127.0.0.1:") || listening.contains("listening on [::1]:"), "{listening}");
    let line = fails(compositor(&["--listen", "no such name:1"]));
    assert!(line.contains("--listen no such name:1") && line.contains("0.0.0.0:7117"), "{line}");
    for wall in ["", ":7117"] {
        assert!(fails(renderer(&["connect", wall])).contains("HOST:PORT"));
    }
}

#[test]
fn names_in_files_forge_no_lines_and_no_colors() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let [model, wall, camera] = ["model.ply", "wall.toml", "camera.toml"].map(path);
    let vertex = "element vertex\u{1b}[31m\u{9b}1m 1\n";
    std::fs::write(&model, format!("ply\nformat ascii 1.0\n{vertex}{vertex}end_header\n")).unwrap();
    std::fs::write(&wall, "\"a\\nerror: forged\\u001B[31m\" = 1\n").unwrap();
    std::fs::write(&camera, "\"a\\nerror: forged\\u001B[31m\" = 1\n").unwrap();
    let trace = ["trace", "--image", "/dev/null", "--triangles", "1000", "--size", "8x8"];
    for command in [
        renderer(&["trace", "--image", "/dev/null", "--model", &model]),
        compositor(&["--wall", &wall]),
        renderer(&[&trace[..], &["--camera", &camera]].concat()),
        renderer(&[&trace[..], &["--camera", "no\nerror: forged\u{1b}[31m"]].concat()),
    ] {
        let line = fails(command);
        assert!(!line.contains(char::is_control), "{line:?}");
    }
}

/// All of these are read whole, so one without an end must not be opened.
#[cfg(unix)]
#[test]
fn pipes_folders_and_devices_in_place_of_files_are_refused_alike() {
    let folder = tempfile::tempdir().unwrap();
    let pipe = folder.path().join("pipe");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let camera = folder.path().join("camera.toml");
    std::fs::write(&camera, "eye = [0, 0, 1]\nll = [-1, -1, 0]\nu = [2, 0, 0]\nv = [0, 2, 0]\n").unwrap();
    let camera = camera.to_str().unwrap();
    let lab = |args: &[&str]| {
        let mut command = Program::command("lab");
        command.args(args);
        command
    };
    let points = folder.path().join("figures");
    for file in [pipe.to_str().unwrap(), folder.path().to_str().unwrap(), "/dev/zero"] {
        for command in [
            renderer(&["trace", "--image", "/dev/null", "--model", file]),
            renderer(&["trace", "--image", "/dev/null", "--triangles", "1000", "--size", "8x8", "--camera", file]),
            renderer(&["connect", "127.0.0.1:1", "--replay", file]),
            compositor(&["--wall", file]),
            compositor(&["--camera", file]),
            compositor(&["--path", file]),
            lab(&["stability", "--replay", file, camera]),
            lab(&["stability", "--replay", camera, file]),
            lab(&["chart", "--points", file, "--out", points.to_str().unwrap()]),
        ] {
            let line = fails(command);
            assert!(line.contains(&format!("{file}: is a folder or a pipe: name an ordinary file")), "{line}");
        }
    }
}

/// A program that may take so much memory.
#[cfg(target_os = "linux")]
fn limited(limit_kb: u32, program: &str, args: &[&str]) -> Command {
    let mut command = Command::new("sh");
    command.args(["-c", &format!("ulimit -v {limit_kb}; exec \"$@\""), "sh"]);
    command.arg(Program::command(program).get_program()).args(args);
    command
}

#[cfg(target_os = "linux")]
#[test]
fn a_model_is_loaded_within_whatever_addresses_there_are() {
    let folder = tempfile::tempdir().unwrap();
    let [model, picture] = ["statue.ply", "statue.png"].map(|name| folder.path().join(name).display().to_string());
    generate_statue(400_000, model.as_ref());
    // Where 64 MB for each thread's own blocks are left, but not them and the model.
    for limit_kb in [160_000, 185_000, 210_000, 300_000] {
        let args = ["trace", "--no-cache", "--size", "64x32", "--model", &model, "--image", &picture];
        let mut command = limited(limit_kb, "renderer", &args);
        // Each has a stack, too.
        command.env("RAYON_NUM_THREADS", "2");
        Program::succeed(command);
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_texture_takes_its_own_memory_and_a_third_while_it_is_loaded() {
    const SIDE: u32 = 4096;
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let file = std::io::BufWriter::new(std::fs::File::create(path("stone.png")).unwrap());
    let mut encoder = png::Encoder::new(file, SIDE, SIDE);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::Fastest);
    encoder.write_header().unwrap().write_image_data(&vec![99; 3 * (SIDE * SIDE) as usize]).unwrap();
    std::fs::write(path("stone.mtl"), "newmtl stone\nmap_Kd stone.png\n").unwrap();
    let square = "v 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nusemtl stone\nf 1/1 2/2 3/3\n";
    std::fs::write(path("stone.obj"), format!("mtllib stone.mtl\n{square}")).unwrap();
    let (model, picture) = (path("stone.obj"), path("stone.png.png"));
    let args =
        ["trace", "--size", "8x8", "--threads", "1", model.to_str().unwrap(), "--image", picture.to_str().unwrap()];
    // The image and its mip map beside each other would take ten bytes a texel.
    let texels_kb = SIDE * SIDE / 1024;
    let command = limited(texels_kb * 16 / 3 + 50_000, "renderer", &args);
    let (status, said) = Program::start(command).wait();
    assert!(status.success() && !said.contains("left out"), "{said}");
}

#[cfg(target_os = "linux")]
#[test]
fn a_model_that_does_not_fit_in_memory_ends_with_the_cure() {
    for command in [
        limited(200_000, "renderer", &["trace", "--triangles", "10000000", "--size", "8x8", "--image", "none.png"]),
        limited(200_000, "lab", &["trace", "--triangles", "10000000", "--frames", "1"]),
    ] {
        let line = fails(command);
        assert!(line.contains("memory ran out") && line.contains("Lower --memory-budget"), "{line}");
    }

    // The wall's GPU driver reserves more on machines with more cores: the limit grows until a small model is shown.
    // It grows by little, so that the 600 MB of the large model's vertices never fit: shaping them takes a minute.
    let wall = |limit_kb, n_triangles| {
        let args = ["--headless", "--listen", "127.0.0.1:0", "--local", "1", "--frames", "1"];
        limited(limit_kb, "compositor", &[&args[..], &["--triangles", n_triangles]].concat())
    };
    let mut limit_kb = 300_000;
    while !Program::start(wall(limit_kb, "1000")).wait().0.success() {
        assert!(limit_kb < 16_000_000, "no wall starts with {limit_kb} KB");
        limit_kb += 100_000;
    }
    // The driver does not take the same on every start.
    limit_kb += 200_000;
    let line = fails(wall(limit_kb, "100000000"));
    assert!(line.contains("memory ran out") && line.contains("Lower --memory-budget"), "at {limit_kb} KB: {line}");
}
