//! The remote over real sockets: friends steer, strangers learn nothing, and nobody disturbs the wall.

use std::{
    fs,
    io::{Read, Write},
    net::TcpStream,
    path::Path,
    process::Command,
    thread,
    time::{Duration, Instant},
};

use serde_json::{Value, json};
use tempfile::TempDir;
use tungstenite::{Message, WebSocket, client::IntoClientRequest, handshake::client::Request};

use crate::{
    http::{self, Answer},
    process::{GENEROUS, Program, generate_statue, wait_until},
    random::Random,
    x_session::{SHOWN, Screenshot, XSession},
};

const SCREEN: [usize; 2] = [640, 360];
/// Every route but those of the page.
const GUARDED: [&str; 6] = ["/api/state", "/api/action", "/api/picture", "/api/socket", "/metrics", "/health"];

/// A wall with a remote, in a folder with a model.
pub(crate) struct RemoteWall {
    pub(crate) program: Program,
    /// Of the remote.
    pub(crate) address: String,
    pub(crate) folder: TempDir,
    pub(crate) session: XSession,
}

impl RemoteWall {
    /// Starts one that trusts its own machine.
    pub(crate) fn start(arguments: &[&str]) -> Self {
        Self::start_in(tempfile::tempdir().expect("a folder"), &[arguments, &["--remote", "127.0.0.1:0"]].concat())
    }

    /// Starts one that knows the tokens in a file; returns them: an operator's and a visitor's.
    pub(crate) fn with_tokens(arguments: &[&str]) -> (Self, [String; 2]) {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("remote.toml");
        let tokens = [("desk", "operator"), ("hall", "visitor")].map(|(name, role)| make_token(&file, name, role));
        let remote = ["--remote", "127.0.0.1:0", "--remote-tokens", "remote.toml"];
        (Self::start_in(folder, &[arguments, &remote].concat()), tokens)
    }

    pub(crate) fn start_in(folder: TempDir, arguments: &[&str]) -> Self {
        Self::start_on(XSession::start(SCREEN), folder, arguments)
    }

    /// Starts one on a screen.
    pub(crate) fn start_on(session: XSession, folder: TempDir, arguments: &[&str]) -> Self {
        Self::start_with(session, folder, &[], arguments)
    }

    /// Starts one in an environment.
    pub(crate) fn start_with(
        session: XSession,
        folder: TempDir,
        environment: &[(&str, &str)],
        arguments: &[&str],
    ) -> Self {
        generate_statue(2000, &folder.path().join("a statue.ply"));
        let mut command = session.wall(&["a statue.ply", "--local", "2", "--size", "256x144", "--fullscreen"]);
        command.current_dir(folder.path()).args(arguments).envs(environment.iter().copied());
        let mut program = Program::start(command);
        program.wait_for("remote at http");
        program.wait_for(SHOWN);
        let said = program.said();
        let place = said.split("remote at http").nth(1).and_then(|rest| rest.split("://").nth(1));
        let address = place.and_then(|rest| rest.split('/').next());
        let address = address.expect("an address").to_owned();
        let wall = Self { program, address, folder, session };
        wall.session.wait_for_window("Raywall");
        wall
    }

    /// Asks with a token, or without any.
    pub(crate) fn get(&self, path: &str, token: Option<&str>) -> Answer {
        http::request(&self.address, "GET", path, &bearer(token), b"")
    }

    pub(crate) fn act(&self, action: &Value) -> Answer {
        http::request(&self.address, "POST", "/api/action", "", action.to_string().as_bytes())
    }

    /// The state that operators see of a wall without tokens.
    pub(crate) fn state(&self) -> Value {
        self.get("/api/state", None).json()["state"].take()
    }

    fn connect(&self, token: Option<&str>) -> Remote {
        Remote::connect(&self.address, token).unwrap_or_else(|fault| panic!("{fault}\n{}", self.program.said()))
    }
}

fn bearer(token: Option<&str>) -> String {
    token.map_or(String::new(), |token| format!("Authorization: Bearer {token}\r\n"))
}

/// Makes a token with the program; returns its text.
fn make_token(file: &Path, name: &str, role: &str) -> String {
    let said = Program::succeed(token_command(file, &[name, "--role", role]));
    said.lines().next().expect("a token").to_owned()
}

fn token_command(file: &Path, arguments: &[&str]) -> Command {
    let mut command = Program::command("compositor");
    command.arg("remote-token").arg(file).args(arguments);
    command
}

/// A remote's conversation.
struct Remote(WebSocket<TcpStream>);

impl Remote {
    fn connect(address: &str, token: Option<&str>) -> Result<Self, String> {
        let stream = TcpStream::connect(address).map_err(|error| error.to_string())?;
        stream.set_read_timeout(Some(GENEROUS)).expect("a limit");
        let mut request: Request = format!("ws://{address}/api/socket").into_client_request().expect("an address");
        let offers = token.map_or("raywall".to_owned(), |token| format!("raywall, {token}"));
        request.headers_mut().insert("Sec-WebSocket-Protocol", offers.parse().expect("a header"));
        let (socket, answer) = tungstenite::client(request, stream).map_err(|error| error.to_string())?;
        assert_eq!(answer.headers()["Sec-WebSocket-Protocol"], "raywall", "the token is repeated");
        Ok(Self(socket))
    }

    fn send(&mut self, message: &Value) {
        self.0.send(Message::text(message.to_string())).expect("the wall listens");
    }

    /// The next message for which `take` has a value.
    fn wait_for<T>(&mut self, what: &str, mut take: impl FnMut(&Message) -> Option<T>) -> T {
        let start = Instant::now();
        loop {
            assert!(start.elapsed() < GENEROUS, "waited for {what}");
            let message = self.0.read().unwrap_or_else(|error| panic!("{what}: {error}"));
            if let Some(value) = take(&message) {
                return value;
            }
        }
    }

    /// The next message with this member.
    fn wait_for_member(&mut self, member: &str) -> Value {
        self.wait_for(member, |message| {
            let value: Value = serde_json::from_str(message.to_text().ok()?).ok()?;
            value.get(member).cloned()
        })
    }

    fn wait_for_picture(&mut self) -> Vec<u8> {
        self.wait_for("a picture", |message| match message {
            Message::Binary(jpeg) => Some(jpeg.to_vec()),
            _ => None,
        })
    }

    fn is_closed(&mut self) -> bool {
        let start = Instant::now();
        while start.elapsed() < GENEROUS {
            if self.0.read().is_err() {
                return true;
            }
        }
        false
    }
}

#[test]
fn strangers_get_401_and_nothing_else() {
    let (wall, [operator, visitor]) = RemoteWall::with_tokens(&[]);
    for path in GUARDED {
        for token in [None, Some("0"), Some(&operator[1..]), Some("bearer")] {
            let answer = wall.get(path, token);
            assert_eq!(answer.status, 401, "{path} with {token:?}");
            let reason = if token.is_some() { "not known or was revoked" } else { "a token is needed" };
            assert!(answer.text().contains(reason), "{path} with {token:?}: {}", answer.text());
            assert!(!answer.text().contains("statue") && answer.body.len() < 200, "{path}: {}", answer.text());
        }
    }
    for token in [None, Some("0000")] {
        assert!(Remote::connect(&wall.address, token).err().unwrap().contains("401"));
    }
    let page = wall.get("/", None);
    assert_eq!(page.status, 200);
    for header in [
        "default-src 'none'",
        "nosniff",
        "no-referrer",
        "no-store",
        "connection: close",
        "cross-origin-resource-policy: same-origin",
    ] {
        assert!(page.headers.contains(header), "{header} is missing in\n{}", page.headers);
    }
    assert!(!page.headers.contains("set-cookie") && !page.text().contains("a statue"));
    // Under a name that is not the wall's, and from pages of others, a token opens nothing.
    let ask = |headers: &str| {
        http::request(&wall.address, "GET", "/health", &(bearer(Some(&operator)) + headers), b"").status
    };
    assert_eq!(ask(""), 200);
    assert_eq!([ask("Host: evil.example\r\n"), ask("Origin: http://evil.example\r\n")], [421, 403]);
    assert_eq!(ask(&format!("Origin: http://{}\r\n", wall.address)), 200);
    // Visitors see the show, and steer only in turns.
    let state = wall.get("/api/state", Some(&visitor)).json();
    assert_eq!(state["state"]["show"]["model"], "a statue.ply");
    assert!(state["state"].get("farm").is_none() && state["state"].get("controls").is_none());
    let act = |token: &str| {
        http::request(&wall.address, "POST", "/api/action", &bearer(Some(token)), br#"{"do":"view-all"}"#).status
    };
    assert_eq!([act(&visitor), act(&operator), wall.get("/metrics", Some(&visitor)).status], [403, 204, 403]);
    assert!(wall.get("/metrics", Some(&operator)).text().contains("\nraywall_nodes{state=\"ready\"} 2\n"));
    // Neither log nor file has a token.
    let file = fs::read_to_string(wall.folder.path().join("remote.toml")).unwrap();
    for token in [&operator, &visitor] {
        assert!(!file.contains(token) && !wall.program.said().contains(token));
    }
}

#[test]
fn a_revoked_token_ends_its_conversation() {
    let (wall, [_, visitor]) = RemoteWall::with_tokens(&[]);
    let mut remote = wall.connect(Some(&visitor));
    assert_eq!(remote.wait_for_member("state")["role"], "visitor");
    let file = wall.folder.path().join("remote.toml");
    assert!(Program::succeed(token_command(&file, &[])).contains("visitor  hall"));
    Program::succeed(token_command(&file, &["--revoke", "hall"]));
    remote.send(&json!({ "do": "orbit", "x": 0.1, "y": 0 }));
    assert!(remote.is_closed());
    assert_eq!(wall.get("/health", Some(&visitor)).status, 401);
}

/// The text of the code on a screen, as a phone reads it.
fn read_code(screen: &Screenshot) -> Option<String> {
    let [width, height] = screen.size;
    let green = |x: usize, y: usize| screen.rgb[3 * (y * width + x) + 1];
    let mut image = rqrr::PreparedImage::prepare_from_greyscale(width, height, green);
    image.detect_grids().first().and_then(|grid| grid.decode().ok()).map(|(_, text)| text)
}

#[test]
fn the_code_on_the_wall_lets_a_visitor_in() {
    let (wall, _) = RemoteWall::with_tokens(&["--kiosk"]);
    let mut link = None;
    wait_until("a phone reads the code", || {
        link = read_code(&wall.session.screenshot());
        link.is_some()
    });
    let link = link.unwrap();
    let token = link.strip_prefix(&format!("http://{}/#", wall.address)).unwrap_or_else(|| panic!("{link}"));
    assert_eq!(wall.connect(Some(token)).wait_for_member("state")["role"], "visitor");
    assert!(!wall.program.said().contains(token));
    wall.session.key("ctrl+r");
    wait_until("the code is gone", || read_code(&wall.session.screenshot()).is_none());
}

#[test]
fn nobody_serves_the_network_without_tokens() {
    let mut command = Program::command("compositor");
    command.args(["--remote", "0.0.0.0:0", "--listen", "127.0.0.1:0"]);
    let session = XSession::start([64, 64]);
    let (status, said) = Program::start({
        command.env("DISPLAY", session.display()).env_remove("WAYLAND_DISPLAY");
        command
    })
    .wait();
    assert!(!status.success() && said.contains("compositor remote-token remote.toml NAME"), "{said}");
}

#[test]
fn a_remote_steers_and_sees_what_others_do() {
    let wall = RemoteWall::start(&[]);
    wall.session.key("o");
    let front = wall.session.steady_screenshot();
    let [mut one, mut two] = [wall.connect(None), wall.connect(None)];
    two.send(&json!({ "do": "watch", "pictures": true }));
    let before = two.wait_for_picture();
    assert!(before.starts_with(&[0xff, 0xd8, 0xff]) && before.len() < 60_000, "{} bytes", before.len());
    one.send(&json!({ "do": "orbit", "x": 0.2, "y": 0, "tag": 7 }));
    assert_eq!(one.wait_for_member("shown"), 7);
    two.wait_for("a picture of the motion", |message| match message {
        Message::Binary(jpeg) if **jpeg != before[..] => Some(()),
        _ => None,
    });
    wait_until("the model has turned", || front.difference(&wall.session.screenshot(), 16) > 0.02);
    for back in [
        json!({ "do": "orbit", "x": -0.2, "y": 0 }),
        json!({ "do": "pan", "x": 0.1, "y": 0.1 }),
        json!({ "do": "roll", "degrees": 20 }),
        json!({ "do": "dolly", "factor": 0.7 }),
    ] {
        one.send(&back);
    }
    one.send(&json!({ "do": "view-all" }));
    wait_until("all is seen as at the start", || wall.session.screenshot() == front);
    one.send(&json!({ "do": "go-to", "x": 0.5, "y": 0.5 }));
    wait_until("the statue is nearer", || front.difference(&wall.session.screenshot(), 16) > 0.1);
    one.send(&json!({ "do": "view-all" }));
    // As operators do.
    assert_eq!(wall.act(&json!({ "do": "division", "division": "dynamic" })).status, 204);
    assert_eq!(wall.act(&json!({ "do": "cut", "side": "y", "permille": 400 })).status, 204);
    assert_eq!(wall.act(&json!({ "do": "keep-view", "number": 3 })).status, 204);
    wait_until("the state tells of it", || {
        let state = wall.state();
        state["controls"]["division"] == "dynamic"
            && state["controls"]["cut"] == json!(["y", 400])
            && state["show"]["views"] == json!([3])
    });
    wait_until("the view is kept", || wall.folder.path().join("a statue.ply.views.toml").is_file());
    let picture = wall.get("/api/picture", None);
    assert!(picture.status == 200 && picture.body.starts_with(&[0xff, 0xd8]) && picture.headers.contains("image/jpeg"));
}

#[test]
fn a_remote_opens_a_model_beside_the_present_one_and_no_other() {
    let mut wall = RemoteWall::start(&[]);
    fs::write(wall.folder.path().join("box.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n").unwrap();
    fs::write(wall.folder.path().join("notes.txt"), "no model").unwrap();
    let mut remote = wall.connect(None);
    remote.send(&json!({ "do": "list-models" }));
    wait_until("the models are listed", || wall.state()["controls"]["models"] == json!(["a statue.ply", "box.obj"]));
    for refused in ["notes.txt", "missing.ply", "<script>.ply"] {
        remote.send(&json!({ "do": "open", "model": refused }));
        wall.program.wait_for(&format!("There is no model {refused} here"));
    }
    remote.send(&json!({ "do": "open", "model": "box.obj" }));
    wait_until("it is on the wall", || wall.state()["show"]["model"] == "box.obj");
}

#[test]
fn visitors_take_turns_and_one_that_goes_away_ends_its_own() {
    let (wall, [operator, visitor]) = RemoteWall::with_tokens(&[]);
    let [mut one, mut two] = [wall.connect(Some(&visitor)), wall.connect(Some(&visitor))];
    let orbit = json!({ "do": "orbit", "x": 0.05, "y": 0, "tag": 1 });
    one.send(&orbit);
    assert_eq!(one.wait_for_member("shown"), 1);
    two.send(&orbit);
    assert_eq!(two.wait_for_member("refused"), "others steer now");
    one.wait_for("a visitor who waits", |message| message.to_text().ok()?.contains(r#""waiting":1"#).then_some(()));
    // Operators need no turn, and have what visitors have not.
    let mut desk = wall.connect(Some(&operator));
    desk.send(&orbit);
    assert_eq!(desk.wait_for_member("shown"), 1);
    one.send(&json!({ "do": "division", "division": "tiled" }));
    assert_eq!(one.wait_for_member("refused"), "this is for operators");
    // In the middle of its drag.
    drop(one);
    two.wait_for("its turn", |message| message.to_text().ok()?.contains(r#""may_steer":true"#).then_some(()));
    two.send(&orbit);
    assert_eq!(two.wait_for_member("shown"), 1);
}

#[test]
fn malformed_huge_and_slow_remotes_leave_the_wall_as_it_is() {
    let wall = RemoteWall::start(&[]);
    let memory = || {
        let status = fs::read_to_string(format!("/proc/{}/status", wall.program.id())).unwrap();
        let kilobytes = status.split("VmRSS:").nth(1).and_then(|rest| rest.split_whitespace().next());
        kilobytes.unwrap().parse::<u64>().unwrap()
    };
    let mut remotes: Vec<_> = (0..100).map(|_| wall.connect(None)).collect();
    let before = memory();
    // Messages that are none are refused, and the conversation goes on.
    let remote = &mut remotes[0];
    for message in ["", "{", "[1]", r#"{"do":"orbit","x":1e999,"y":0}"#, r#"{"do":"open","model":"../../etc/x.ply"}"#] {
        remote.0.send(Message::text(message)).unwrap();
        remote.wait_for_member("refused");
    }
    remote.0.send(Message::binary(vec![0; 100])).unwrap();
    remote.wait_for_member("refused");
    // A message of a megabyte ends it.
    let mut huge = wall.connect(None);
    let _ = huge.0.send(Message::text("x".repeat(1 << 20)));
    assert!(huge.is_closed());
    // Remotes that ask for pictures and never read.
    let mut slow: Vec<_> = (0..20).map(|_| wall.connect(None)).collect();
    slow.iter_mut().for_each(|remote| remote.send(&json!({ "do": "watch", "pictures": true })));
    // One that sends pings and never reads.
    let mut pinging = wall.connect(None);
    let ping: Vec<_> = [0x89, 0x80 | 125, 0, 0, 0, 0].into_iter().chain([7; 125]).collect();
    let (stream, pings) = (pinging.0.get_mut(), ping.repeat(1000));
    stream.set_write_timeout(Some(Duration::from_millis(500))).unwrap();
    let n_taken = (0..1000).take_while(|_| stream.write_all(&pings).is_ok()).count();
    assert!(n_taken < 500, "{n_taken} thousand pings are taken at once");
    // Requests that never end, or are none.
    let mut random = Random::new(5);
    let mut open = Vec::new();
    for index in 0..300 {
        let mut stream = TcpStream::connect(&wall.address).unwrap();
        let mut bytes = b"GET /api/state HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Long: aaaaaaaa\r\n\r\n".to_vec();
        (0..random.below(4)).for_each(|_| {
            let at = random.below(bytes.len());
            bytes[at] = random.below(256) as u8;
        });
        bytes.truncate(random.below(bytes.len() + 1));
        let _ = stream.write_all(&bytes);
        if index % 2 == 0 {
            open.push(stream);
        }
    }
    let huge_head = format!("GET / HTTP/1.1\r\nX: {}\r\n\r\n", "a".repeat(1 << 20));
    let refused = http::raw(&wall.address, huge_head.as_bytes());
    assert!(refused.is_none_or(|answer| answer.status == 431), "a head of a megabyte is accepted");
    assert_eq!(http::request(&wall.address, "POST", "/api/action", "", &vec![b' '; 1 << 20]).status, 413);
    // Everybody else is served as before.
    remotes[99].send(&json!({ "do": "orbit", "x": 0.1, "y": 0, "tag": 3 }));
    assert_eq!(remotes[99].wait_for_member("shown"), 3);
    assert!(wall.get("/metrics", None).text().contains("raywall_remotes 1"), "the remotes are not counted");
    let grown = memory().saturating_sub(before);
    assert!(grown < 40_000, "{grown} KB more");
    drop((remotes, slow, pinging, open));
    wait_until("they are gone", || wall.get("/metrics", None).text().contains("\nraywall_remotes 0\n"));
    assert!(!wall.program.said().contains("panicked"), "{}", wall.program.said());
}

#[test]
fn a_resting_wall_does_nothing_for_a_remote_that_only_looks() {
    let wall = RemoteWall::start(&[]);
    wall.session.key("o");
    let mut remote = wall.connect(None);
    remote.send(&json!({ "do": "watch", "pictures": true }));
    remote.send(&json!({ "do": "orbit", "x": 0.1, "y": 0.1, "tag": 1 }));
    assert_eq!(remote.wait_for_member("shown"), 1);
    // Until frames are refined and the rate is no longer told.
    wait_until("the wall rests", || wall.state()["farm"]["frames_per_second"].is_null());
    thread::sleep(Duration::from_secs(1));
    let (n_shown, ticks) = (wall.program.count(SHOWN), wall.program.ticks());
    remote.0.get_mut().set_read_timeout(Some(Duration::from_millis(50))).unwrap();
    while remote.0.read().is_ok() {}
    thread::sleep(Duration::from_secs(2));
    let spent = wall.program.ticks() - ticks;
    assert!(spent <= 4, "{spent} of 200 ticks of CPU time at rest");
    assert_eq!(wall.program.count(SHOWN), n_shown, "a resting wall renders no frame");
    let mut nothing = [0];
    assert!(remote.0.get_mut().read(&mut nothing).is_err(), "the wall talks at rest");
}

#[test]
fn whoever_comes_without_encryption_is_sent_to_the_encrypted_page() {
    let (wall, [operator, _]) = RemoteWall::with_tokens(&["--remote-certificate", "wall.pem"]);
    assert!(wall.program.said().contains(", with the certificate of SHA-256 "), "{}", wall.program.said());
    for (path, token) in [("/", None), ("/api/state?x=1", Some(&*operator)), ("/nowhere", None)] {
        let answer = wall.get(path, token);
        let place = format!("location: https://{}{path}\r\n", wall.address);
        assert!(answer.status == 308 && answer.headers.contains(&place), "{}", answer.headers);
        assert!(answer.body.is_empty());
    }
    let other = http::request(&wall.address, "GET", "/", "Host: evil.example\r\n", b"");
    assert_eq!(other.status, 421);
    // What begins as a handshake and is none ends alone.
    let mut random = Random::new(5);
    for length in [1, 2, 5, 6, 100, 20_000] {
        let mut bytes: Vec<u8> = (0..length).map(|_| random.bits() as u8).collect();
        bytes[0] = 22;
        assert!(http::raw(&wall.address, &bytes).is_none());
    }
    assert_eq!(wall.get("/", None).status, 308);
}
