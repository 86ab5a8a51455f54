//! A real browser: Chromium without a screen, driven over WebDriver.

use std::{
    io::{self, BufRead, BufReader},
    process::{Child, Command, Stdio},
};

use serde_json::{Value, json};

use crate::{http, process::wait_until};

/// A browser with one page; dropping it ends it.
pub(crate) struct Browser {
    driver: Child,
    address: String,
    session: String,
}

/// The screen that a browser pretends to have.
pub(crate) struct Screen {
    pub(crate) size: [u32; 2],
    pub(crate) is_touched: bool,
    pub(crate) is_dark: bool,
}

/// Starts a driver; returns the port that it says, if it says one.
fn start_driver() -> io::Result<(Child, Option<u16>)> {
    let mut command = Command::new("chromedriver");
    let mut driver = command.arg("--port=0").stdout(Stdio::piped()).stderr(Stdio::null()).spawn()?;
    let mut said = BufReader::new(driver.stdout.take().expect("piped"));
    let (mut port, mut line) = (None, String::new());
    while port.is_none() && said.read_line(&mut line).is_ok_and(|n_bytes| n_bytes > 0) {
        let number = line.trim().trim_end_matches('.').rsplit_once("on port ");
        port = number.and_then(|(_, number)| number.parse::<u16>().ok()).filter(|&port| port > 0);
        line.clear();
    }
    // The driver must not wait for a reader.
    std::thread::spawn(move || io::copy(&mut said, &mut io::sink()));
    Ok((driver, port))
}

impl Browser {
    /// Starts a browser; `None`, and a line, where there is none.
    pub(crate) fn start(screen: &Screen) -> Option<Self> {
        // It ends if another program takes the port that it has just chosen.
        let mut started = (0..5).map(|_| start_driver());
        let (driver, port) = match started.find(|started| !matches!(started, Ok((_, None)))) {
            Some(Ok((driver, port))) => (driver, port.expect("found")),
            Some(Err(error)) => {
                println!("skipped: no chromedriver: {error}");
                return None;
            }
            None => panic!("chromedriver says no port"),
        };
        let address = format!("127.0.0.1:{port}");
        let [width, height] = screen.size;
        let mut options = json!({ "args": ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
            format!("--window-size={width},{height}")] });
        if screen.is_touched {
            options["mobileEmulation"] =
                json!({ "deviceMetrics": { "width": width, "height": height, "pixelRatio": 2, "touch": true } });
        }
        let mut browser = Self { driver, address, session: String::new() };
        let capabilities = json!({ "capabilities": { "alwaysMatch": { "browserName": "chrome", "acceptInsecureCerts": true,
                "goog:chromeOptions": options } } });
        let session = browser.command("POST", "/session", &capabilities);
        browser.session = session["sessionId"].as_str().expect("a session").to_owned();
        let theme = json!({ "name": "prefers-color-scheme", "value": if screen.is_dark { "dark" } else { "light" } });
        browser.devtools("Emulation.setEmulatedMedia", &json!({ "features": [theme] }));
        Some(browser)
    }

    pub(crate) fn open(&self, url: &str) {
        self.ask("/url", &json!({ "url": url }));
    }

    /// Runs a script in the page; returns its value.
    pub(crate) fn run(&self, script: &str) -> Value {
        self.ask("/execute/sync", &json!({ "script": script, "args": [] }))
    }

    /// Runs a script that gives its value to its last argument, a function.
    pub(crate) fn run_later(&self, script: &str) -> Value {
        self.ask("/execute/async", &json!({ "script": script, "args": [] }))
    }

    /// Waits until a script's value is true.
    pub(crate) fn wait_for(&self, what: &str, script: &str) {
        wait_until(what, || self.run(&format!("return Boolean({script})")) == true);
    }

    /// Performs actions of fingers, mouse or keys, as WebDriver describes them.
    pub(crate) fn perform(&self, actions: &Value) {
        self.ask("/actions", &json!({ "actions": actions }));
    }

    /// Asks the browser's own tools.
    pub(crate) fn devtools(&self, command: &str, parameters: &Value) -> Value {
        self.ask("/goog/cdp/execute", &json!({ "cmd": command, "params": parameters }))
    }

    fn ask(&self, path: &str, body: &Value) -> Value {
        self.command("POST", &format!("/session/{}{path}", self.session), body)
    }

    fn command(&self, method: &str, path: &str, body: &Value) -> Value {
        let body = body.to_string();
        let headers = "Content-Type: application/json\r\nConnection: close\r\n";
        let answer = http::request(&self.address, method, path, headers, body.as_bytes());
        assert_eq!(answer.status, 200, "{path}: {}", answer.text());
        answer.json()["value"].take()
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // The driver ends the browser; without an answer, there is nobody to ask.
        let request = format!("DELETE /session/{} HTTP/1.1\r\nHost: {}\r\n\r\n", self.session, self.address);
        let _ = http::raw(&self.address, request.as_bytes());
        // Fails if it has ended already.
        let _ = self.driver.kill();
        let _ = self.driver.wait();
    }
}
