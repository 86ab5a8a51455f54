//! The real programs as child processes, with what they say.

use std::{
    io::{BufRead, BufReader, Read},
    path::PathBuf,
    process::{Child, Command, ExitStatus, Stdio},
    sync::{Arc, Mutex},
    thread,
    time::{Duration, Instant},
};

/// Longer than anything takes on a busy machine: what lasts longer hangs.
pub(crate) const GENEROUS: Duration = Duration::from_secs(60);

/// A program that was started, and killed at the end if it still runs.
pub(crate) struct Program {
    child: Child,
    said: Arc<Mutex<String>>,
}

impl Program {
    /// The command for one of the project's programs, built with the tests.
    pub(crate) fn command(name: &str) -> Command {
        let tests = std::env::current_exe().expect("tests know where they lie");
        let folder: PathBuf = tests.ancestors().nth(2).expect("target/release/deps").to_owned();
        let path = folder.join(name);
        assert!(
            path.is_file(),
            "{} is not built: cargo build --release builds it, as `make test` does",
            path.display()
        );
        Command::new(path)
    }

    /// Starts it and listens to all that it says.
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
        for stream in streams {
            let said = Arc::clone(&said);
            thread::spawn(move || {
                for line in BufReader::new(stream).lines().map_while(Result::ok) {
                    let mut said = said.lock().expect("nobody panics with it");
                    said.push_str(&line);
                    said.push('\n');
                }
            });
        }
        Self { child, said }
    }

    /// The process's number.
    pub(crate) fn id(&self) -> u32 {
        self.child.id()
    }

    /// Sends it a signal, by name: KILL, STOP, CONT, TERM.
    pub(crate) fn signal(&self, name: &str) {
        let status = Command::new("kill").args([&format!("-{name}"), &self.id().to_string()]).status();
        assert!(status.is_ok_and(|status| status.success()), "the program cannot be signalled");
    }

    /// All that it said so far.
    pub(crate) fn said(&self) -> String {
        self.said.lock().expect("nobody panics with it").clone()
    }

    /// How often it said something.
    pub(crate) fn count(&self, what: &str) -> usize {
        self.said().matches(what).count()
    }

    /// Waits until it says something.
    pub(crate) fn wait_for(&mut self, what: &str) {
        self.wait_for_count(what, 1);
    }

    /// Waits until it has said something so often.
    pub(crate) fn wait_for_count(&mut self, what: &str, times: usize) {
        let start = Instant::now();
        while self.count(what) < times {
            let ended = self.child.try_wait().expect("a child can be asked");
            let is_late = start.elapsed() > GENEROUS;
            assert!(ended.is_none() && !is_late, "waited for \"{what}\" × {times}; ended: {ended:?}\n{}", self.said());
            thread::sleep(Duration::from_millis(20));
        }
    }

    /// Waits for its end, and gives back all that it said.
    pub(crate) fn wait(mut self) -> (ExitStatus, String) {
        let start = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().expect("a child can be asked") {
                // What it said last is still on its way.
                thread::sleep(Duration::from_millis(100));
                return (status, self.said());
            }
            assert!(start.elapsed() < GENEROUS, "it does not end\n{}", self.said());
            thread::sleep(Duration::from_millis(20));
        }
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // One that has ended by itself is only waited for.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Asks again and again, until it holds or surely never will.
pub(crate) fn wait_until(what: &str, mut holds: impl FnMut() -> bool) {
    let start = Instant::now();
    while !holds() {
        assert!(start.elapsed() < GENEROUS, "waited in vain until {what}");
        thread::sleep(Duration::from_millis(50));
    }
}
