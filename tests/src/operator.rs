//! Texts for an operator: notices of the farm, warnings of a model, lines that name the cure.

use std::{fs, time::Instant};

use compositor::{
    cli::run::network_threads,
    farm::{Farm, RenderGoal},
};
use glam::DVec3;
use shared::{
    camera::Camera,
    detail::Detail,
    division::{Division, FrameSize},
    protocol::{FrameSpec, LightingMode, SampleRange, ShadingMode},
    scene::SceneId,
};

use crate::{
    farm::{Files, RunningWall},
    process::{Program, wait_until},
};

fn small_statue() -> RenderGoal {
    let spec = FrameSpec {
        scene: SceneId::Statue { triangles: 1000, treatment: Default::default() },
        camera: Camera::look_at(DVec3::splat(3.0), DVec3::ZERO, DVec3::Y, 0.7, 2.0).unwrap(),
        size: FrameSize::new(64, 32).unwrap(),
        view: ShadingMode::default(),
        rays: LightingMode::default(),
        samples: SampleRange::CENTRE,
        detail: Detail::FULL,
        appearance: Default::default(),
    };
    RenderGoal {
        spec: Some(spec),
        scene_path: None,
        next_scene: None,
        change: 0,
        sky_path: None,
        is_refinement: false,
        division: Division::Tiled,
        min_renderers: 1,
        repeat: false,
        in_flight: 1,
        encoding: None,
        moved_at: Instant::now(),
    }
}

#[test]
fn the_notice_of_a_lost_render_server_says_who_starts_it_again_and_goes_when_it_is_back() {
    let runtime = network_threads().unwrap();
    let listener = runtime.block_on(tokio::net::TcpListener::bind("127.0.0.1:0")).unwrap();
    let farm = {
        let _guard = runtime.enter();
        Farm::start(listener, None, small_statue(), || ()).unwrap()
    };
    let address = farm.address().to_string();
    let ready = |name: &str| {
        let server = RunningWall::join_at(&address, name, &[]);
        wait_until("it is ready", || farm.status().nodes.iter().any(|node| node.name == name && node.is_ready()));
        server
    };
    let message = || farm.status().notices.message();
    let wait_for = |what: &str| wait_until(what, || message().is_some_and(|message| message.contains(what)));
    let _one = ready("one");
    let two = ready("two");
    assert_eq!(message(), None);
    drop(two);
    wait_for("two lost: ");
    assert!(
        message()
            .unwrap()
            .ends_with("The others render its share; if it does not come back by itself, start it again.")
    );
    let _two = ready("two");
    wait_until("the notice is gone", || message().is_none());

    let wall = farm.local_reporter();
    wall.started("ours");
    drop(ready("ours"));
    wait_for("ours lost: ");
    assert!(!message().unwrap().contains("start it again"), "{:?}", message());
    wall.ended("ours", "ours was killed. It starts again in 1 s.".to_owned());
    wait_for("starts again in 1 s");
    wall.started("ours");
    wait_for("ours was started again, and loads the model");
    let _ours = ready("ours");
    wait_until("the notice is gone", || message().is_none());
}

#[test]
fn warnings_of_a_model_come_once_however_many_local_render_servers_read_it() {
    let files = Files::new();
    fs::write(files.path("a.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nl 1 2\nf 1 2 9\n").unwrap();
    let run = |arguments: &[&str]| {
        let mut command = Program::command("compositor");
        command.args(["--headless", "--listen", "127.0.0.1:0", "--frames", "1", "--size", "64x32"]).args(arguments);
        command.arg("--wall").arg(files.path("wall.toml")).arg(files.path("a.obj"));
        command
    };
    let said = Program::succeed(run(&["--local", "2"]));
    for warning in ["points, lines and curved surfaces", "triangles with a corner"] {
        assert_eq!(said.matches(warning).count(), 1, "{warning}\n{said}");
    }
    // One that somebody else started tells what it found on its own machine.
    let mut wall = Program::start(run(&["--local", "0"]));
    let address = wall.wait_for_address();
    wall.wait_for(&format!("waiting for 1 render server; start one with: renderer connect {address} --model "));
    let mut server = RunningWall::join_at(&address, "one", &[]);
    server.wait_for("triangles with a corner that is missing or not finite are left out: 1 of 2");
    assert!(wall.wait().0.success());
}

#[test]
fn a_wall_without_a_session_says_nothing_of_it() {
    let files = Files::new();
    let mut command = files.wall("64x32");
    command.args(["--local", "1", "--frames", "1"]).env_remove("XDG_RUNTIME_DIR");
    let said = Program::succeed(command);
    assert!(!said.contains("XDG_RUNTIME_DIR"), "{said}");
}

#[test]
fn files_of_another_kind_and_numbers_without_a_digit_are_told_in_plain_words() {
    let files = Files::new();
    let (model, camera) = (files.path("a.obj"), files.path("short.toml"));
    fs::write(&model, "v 0 0 0\n").unwrap();
    fs::write(&camera, "eye = [0, 0, 3]\nll = [-1, -1, 2]\nu = [2, 0, 0]\nv = [0, 0, .9]\n").unwrap();
    let fails = |option: &str, path: &std::path::Path| {
        let mut command = Program::command("compositor");
        command.args(["--headless", "--listen", "127.0.0.1:0", option]).arg(path);
        let (status, said) = Program::start(command).wait();
        assert!(!status.success(), "{said}");
        said
    };
    let (model_name, camera_name) = (model.display(), camera.display());
    assert_eq!(
        fails("--wall", &model),
        format!(
            "error: {model_name} is a model by its name, and a wall file is TOML, like those in wall-config/: --model \
             {model_name} shows it\n"
        )
    );
    assert_eq!(
        fails("--camera", &model),
        format!(
            "error: {model_name} is a model by its name, and a camera file is TOML: --model {model_name} shows it\n"
        )
    );
    let said = fails("--camera", &camera);
    let plain = "line 4: a number needs a digit before and after its point, unlike .9";
    assert!(said.contains(plain), "{said}");
    assert!(fails("--wall", &camera).contains(&format!("{camera_name}:4: a number needs a digit")));
}
