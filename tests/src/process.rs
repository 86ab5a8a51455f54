//! The real programs as child processes, and their output.

use std::{
    io::{BufRead, BufReader, Read},
    path::{Path, PathBuf},
    process::{Child, Command, ExitStatus, Stdio},
    sync::{Arc, Mutex},
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

/// Time limit of every wait: nothing takes so long unless it hangs.
pub(crate) const GENEROUS: Duration = Duration::from_secs(60);

/// A running program; dropping it kills it.
pub(crate) struct Program {
    child: Child,
    said: Arc<Mutex<String>>,
    /// They end with its output.
    readers: Vec<JoinHandle<()>>,
}

impl Program {
    /// The command for one of the project's programs, built with the tests.
    pub(crate) fn command(name: &str) -> Command {
        let tests = std::env::current_exe().expect("a test binary has a path");
        let folder: PathBuf = tests.ancestors().nth(2).expect("target/release/deps").to_owned();
        let path = folder.join(name);
        assert!(
            path.is_file(),
            "{} is not built: `make test` builds every program; so does cargo build --release --workspace --bins",
            path.display()
        );
        let mut command = Command::new(path);
        // No cache: a scene that one test leaves must not serve another.
        command.env("XDG_CACHE_HOME", "/dev/null");
        command
    }

    /// Starts it and collects its output.
    pub(crate) fn start(mut command: Command) -> Self {
        let mut child = command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the program starts");
        let said = Arc::new(Mutex::new(String::new()));
        let streams: [Box<dyn Read + Send>; 2] =
            [Box::new(child.stdout.take().expect("piped")), Box::new(child.stderr.take().expect("piped"))];
        let read = |stream| {
            let said = Arc::clone(&said);
            thread::spawn(move || {
                for line in BufReader::new(stream).lines().map_while(Result::ok) {
                    let mut said = said.lock().expect("no thread panics while it holds the lock");
                    said.push_str(&line);
                    said.push('\n');
                }
            })
        };
        let readers = streams.map(read).into();
        Self { child, said, readers }
    }

    /// Runs a program that must succeed; returns its output.
    pub(crate) fn succeed(command: Command) -> String {
        let (status, said) = Self::start(command).wait();
        assert!(status.success(), "{said}");
        said
    }

    /// Waits until it listens; returns its address.
    pub(crate) fn wait_for_address(&mut self) -> String {
        self.wait_for("listening on ");
        let said = self.said();
        said.split("listening on ")
            .nth(1)
            .and_then(|rest| rest.split_whitespace().next())
            .expect("an address")
            .to_owned()
    }

    /// CPU time of all its threads, in hundredths of a second.
    #[cfg(target_os = "linux")]
    pub(crate) fn ticks(&self) -> u64 {
        ticks(&format!("/proc/{}/stat", self.id()))
    }

    /// CPU time of its main thread, in hundredths of a second.
    #[cfg(target_os = "linux")]
    pub(crate) fn main_thread_ticks(&self) -> u64 {
        ticks(&format!("/proc/{0}/task/{0}/stat", self.id()))
    }

    /// Its process identifier.
    pub(crate) fn id(&self) -> u32 {
        self.child.id()
    }

    /// Sends it a signal, by name: KILL, STOP, CONT, TERM, INT.
    pub(crate) fn signal(&self, name: &str) {
        let status = Command::new("kill").args([&format!("-{name}"), &self.id().to_string()]).status();
        assert!(status.is_ok_and(|status| status.success()), "the program cannot be signalled");
    }

    /// Its output so far.
    pub(crate) fn said(&self) -> String {
        self.said.lock().expect("no thread panics while it holds the lock").clone()
    }

    /// How often its output contains a text.
    pub(crate) fn count(&self, what: &str) -> usize {
        self.said().matches(what).count()
    }

    /// Waits until its output contains a text.
    pub(crate) fn wait_for(&mut self, what: &str) {
        self.wait_for_count(what, 1);
    }

    /// Waits until its output contains a text `times` times.
    pub(crate) fn wait_for_count(&mut self, what: &str, times: usize) {
        let start = Instant::now();
        while self.count(what) < times {
            let ended = self.child.try_wait().expect("a child can be asked");
            let is_late = start.elapsed() > GENEROUS;
            assert!(ended.is_none() && !is_late, "waited for \"{what}\" × {times}; ended: {ended:?}\n{}", self.said());
            thread::sleep(Duration::from_millis(20));
        }
    }

    /// Waits for its end; returns its status and output.
    pub(crate) fn wait(mut self) -> (ExitStatus, String) {
        let start = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().expect("a child can be asked") {
                // A process that it has started may have its output open.
                while start.elapsed() < GENEROUS && !self.readers.iter().all(JoinHandle::is_finished) {
                    thread::sleep(Duration::from_millis(1));
                }
                return (status, self.said());
            }
            assert!(start.elapsed() < GENEROUS, "it does not end\n{}", self.said());
            thread::sleep(Duration::from_millis(20));
        }
    }
}

#[cfg(target_os = "linux")]
fn ticks(path: &str) -> u64 {
    let stat = std::fs::read_to_string(path).expect("the program runs");
    // After the name in parentheses, utime and stime are the 12th and 13th.
    let (_, fields) = stat.rsplit_once(')').expect("a name in parentheses");
    fields.split_whitespace().skip(11).take(2).map(|ticks| ticks.parse::<u64>().expect("a number")).sum()
}

impl Drop for Program {
    fn drop(&mut self) {
        // Fails if it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Writes the built-in statue to a file.
pub(crate) fn generate_statue(n_triangles: u32, path: &Path) {
    let mut command = Program::command("renderer");
    command.args(["generate", "statue", "--triangles", &n_triangles.to_string()]).arg(path);
    Program::succeed(command);
}

/// The folder of reference data, if this machine has one.
pub(crate) fn shared_folder() -> Option<PathBuf> {
    let folder = std::env::var_os("RAYWALL_SHARED").map(PathBuf::from);
    if folder.is_none() {
        println!("skipped: RAYWALL_SHARED does not name a folder of reference data");
    }
    folder
}

/// Checks a condition until it holds; panics when it never does.
pub(crate) fn wait_until(what: &str, mut holds: impl FnMut() -> bool) {
    let start = Instant::now();
    while !holds() {
        assert!(start.elapsed() < GENEROUS, "timed out waiting until {what}");
        thread::sleep(Duration::from_millis(50));
    }
}
