//! Walls that render servers find without an address, in a network of their own: a namespace with two joined interfaces.

use std::process::{Child, Command, Stdio};

use channel::key::Key;
use tempfile::TempDir;

use crate::process::{Program, wait_until};

/// An address for documents (RFC 5737), which nobody outside the namespace has.
const ADDRESS: &str = "192.0.2.10";

/// A network that ends with its holder.
struct Network(Child);

impl Network {
    /// `None` where this user may not make one.
    fn new() -> Option<Self> {
        let script = format!(
            "ip link set lo up && ip link add wall0 type veth peer name wall1 && ip addr add {ADDRESS}/24 dev wall0 \
             && ip link set wall0 up && ip link set wall1 up && exec sleep 600"
        );
        let holder = Command::new("unshare")
            .args(["--net", "sh", "-c", &script])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn();
        let mut network = Self(holder.ok()?);
        let mut is_there = false;
        wait_until("the network is there, or cannot be", || {
            let ended = network.0.try_wait().is_ok_and(|ended| ended.is_some());
            let shown = network.inside("ip").args(["-4", "addr", "show", "wall0", "up"]).output();
            is_there = shown.is_ok_and(|output| String::from_utf8_lossy(&output.stdout).contains(ADDRESS));
            ended || is_there
        });
        if !is_there {
            println!("skipped: this user may not make network namespaces");
        }
        is_there.then_some(network)
    }

    /// A command that runs in the network.
    fn inside(&self, program: impl AsRef<std::ffi::OsStr>) -> Command {
        let mut command = Command::new("nsenter");
        command.args(["--target", &self.0.id().to_string(), "--net", "--"]).arg(program);
        command
    }

    fn program(&self, name: &str, arguments: &[&str]) -> Program {
        let program = Program::command(name);
        let mut command = self.inside(program.get_program());
        command.args(arguments).env("XDG_CACHE_HOME", "/dev/null");
        Program::start(command)
    }

    /// A wall that waits for more render servers than come.
    fn wall(&self, arguments: &[&str]) -> (Program, String) {
        let always = ["--headless", "--triangles", "300", "--size", "64x32", "--min-renderers", "9"];
        let mut wall = self.program("compositor", &[&always, arguments].concat());
        let address = wall.wait_for_address();
        (wall, address.rsplit_once(':').expect("a port").1.to_owned())
    }

    fn server(&self, arguments: &[&str]) -> Program {
        self.program("renderer", &[&["connect"], arguments].concat())
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn keys() -> (TempDir, [String; 3]) {
    let folder = tempfile::tempdir().expect("a folder");
    let paths = ["wall.key", "other.key", "third.key"].map(|name| {
        let path = folder.path().join(name);
        Key::random().expect("random numbers").write(&path).expect("a new file");
        path.to_string_lossy().into_owned()
    });
    (folder, paths)
}

#[test]
fn a_render_server_without_an_address_finds_the_wall_that_has_its_key() {
    let Some(network) = Network::new() else { return };
    let (_folder, [key, other, third]) = keys();
    let mut server = network.server(&["--key", &key]);
    server.wait_for("no wall is found in this network yet");
    let (_stranger, _) = network.wall(&["--listen", "0.0.0.0:0", "--key", &other]);
    server.wait_for("has another key: give --key a copy of its key file");
    let (wall, port) = network.wall(&["--listen", "0.0.0.0:0", "--key", &key]);
    server.wait_for(&format!("connected to the wall at {ADDRESS}:{port}, with a key"));
    // Others learn why they find none.
    let mut without = network.server(&[]);
    without.wait_for("has a key: give --key a copy of its key file");
    network.server(&["--key", &third]).wait_for("has another key");
    // It waits for its wall, and finds it at another address.
    drop(wall);
    server.wait_for("has closed the connection");
    let (_wall, port) = network.wall(&["--listen", &format!("{ADDRESS}:0"), "--key", &key]);
    server.wait_for(&format!("connected to the wall at {ADDRESS}:{port}, with a key"));
}

#[test]
fn of_several_walls_all_are_told_and_silent_ones_are_not_found() {
    let Some(network) = Network::new() else { return };
    let (_folder, [key, ..]) = keys();
    let (_local, local) = network.wall(&["--listen", "127.0.0.1:0", "--insecure"]);
    let (_silent, silent) = network.wall(&["--listen", "0.0.0.0:0", "--insecure", "--no-announce"]);
    let mut server = network.server(&["--insecure"]);
    server.wait_for("no wall is found in this network yet");
    drop(server);
    let walls = [(); 2].map(|()| network.wall(&["--listen", "0.0.0.0:0", "--key", &key]));
    let mut server = network.server(&["--key", &key]);
    server.wait_for("connected to the wall at");
    let said = server.said();
    // The second may be found only after the first was joined.
    if said.contains("2 walls in this network fit") {
        assert!(walls.iter().all(|(_, port)| said.contains(&format!("{ADDRESS}:{port}"))), "{said}");
    }
    assert!(!said.contains(&local) && !said.contains(&silent), "{said}");
}

#[test]
fn a_wall_shows_who_waits_outside_until_it_has_joined() {
    let (_folder, [key, other, _]) = keys();
    let mut command = Program::command("compositor");
    command.args(["--headless", "--triangles", "300", "--size", "64x32", "--listen", "127.0.0.1:0", "--key", &key]);
    let mut wall = Program::start(command);
    let address = wall.wait_for_address();
    let connect = |key: &str| {
        let mut command = Program::command("renderer");
        command.args(["connect", &address, "--key", key]);
        Program::start(command)
    };
    let outside = connect(&other);
    wall.wait_for("A render server at 127.0.0.1 waits outside: it has another key");
    drop(outside);
    let _inside = connect(&key);
    let (status, said) = wall.wait();
    assert!(status.success(), "{said}");
}
