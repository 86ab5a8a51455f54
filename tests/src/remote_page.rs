//! The remote's page in a real browser: touched, steered by keys, read by machines, and left alone by the wall.

use std::{fs, path::Path};

use serde_json::{Value, json};

use crate::{
    browser::{Browser, Screen},
    process::wait_until,
    remote::RemoteWall,
};

const PHONE: Screen = Screen { size: [390, 844], is_touched: true, is_dark: false };
const PHONE_ACROSS: Screen = Screen { size: [844, 390], is_touched: true, is_dark: true };
const NARROWEST: Screen = Screen { size: [320, 640], is_touched: true, is_dark: false };
const LAPTOP: Screen = Screen { size: [1440, 900], is_touched: false, is_dark: false };
const LAPTOP_AT_NIGHT: Screen = Screen { size: [1440, 900], is_touched: false, is_dark: true };

/// Opens a wall's page, and waits until it shows the wall's picture.
fn open(screen: &Screen, wall: &RemoteWall, token: &str) -> Option<Browser> {
    let browser = Browser::start(screen)?;
    browser.open(&format!("http://{}/#{token}", wall.address));
    browser.wait_for("the picture is there", "!document.getElementById('picture').hidden");
    Some(browser)
}

/// A finger's way over the surface, from a point of the page, in pixels.
fn finger(id: &str, from: [i32; 2], by: [i32; 2]) -> Value {
    let at = |part: i32| {
        let [x, y] = [0, 1].map(|axis: usize| from[axis] + by[axis] * part / 5);
        json!({ "type": "pointerMove", "duration": 20, "x": x, "y": y, "origin": "viewport" })
    };
    let mut actions = vec![at(0), json!({ "type": "pointerDown", "button": 0 })];
    actions.extend((1..=5).map(at));
    actions.push(json!({ "type": "pointerUp", "button": 0 }));
    json!({ "type": "pointer", "id": id, "parameters": { "pointerType": "touch" }, "actions": actions })
}

/// The middle of the surface in the page's pixels.
fn middle(browser: &Browser) -> [i32; 2] {
    let at = browser.run(
        "const box = document.getElementById('surface').getBoundingClientRect(); \
         return [box.left + box.width / 2, box.top + box.height / 2].map(Math.round)",
    );
    [0, 1].map(|axis: usize| at[axis].as_i64().expect("a number") as i32)
}

#[test]
fn fingers_on_a_phone_move_the_wall_and_a_second_phone_sees_it() {
    let (wall, [_, visitor]) = RemoteWall::with_tokens(&[]);
    wall.session.key("o");
    let Some(phone) = open(&PHONE, &wall, &visitor) else { return };
    let Some(other) = open(&PHONE_ACROSS, &wall, &visitor) else { return };
    let seen = |browser: &Browser| browser.run("return document.getElementById('picture').src");
    let before = seen(&other);
    let front = wall.session.steady_screenshot();
    let difference = || front.difference(&wall.session.screenshot(), 16);
    let [x, y] = middle(&phone);
    phone.perform(&json!([finger("one", [x - 40, y], [80, 20])]));
    wait_until("one finger has turned the model", || difference() > 0.02);
    wait_until("the other phone shows it", || seen(&other) != before);
    phone.run("document.querySelector('[data-action=view-all]').click()");
    wait_until("all is seen again", || wall.session.screenshot() == front);
    phone.perform(&json!([finger("one", [x - 20, y], [-60, 0]), finger("two", [x + 20, y], [60, 0])]));
    wait_until("two fingers have come nearer", || difference() > 0.05);
    phone.run("document.querySelector('[data-action=view-all]').click()");
    wait_until("all is seen once more", || wall.session.screenshot() == front);
    // The other waits for its turn, and the first is told.
    let [x, y] = middle(&other);
    other.perform(&json!([finger("one", [x - 40, y], [80, 0])]));
    other.wait_for("it waits", "document.getElementById('turn').textContent.startsWith('You are next')");
    assert_eq!(other.run("return document.getElementById('leave').textContent"), "Stop waiting");
    phone.wait_for("the first knows", "document.getElementById('turn').textContent.includes('One other waits')");
    phone.run("document.getElementById('leave').click()");
    other.wait_for("its turn has come", "!document.getElementById('surface').hasAttribute('data-waits')");
    // A visitor has no operator's controls.
    assert_eq!(phone.run("return document.getElementById('operator').hidden"), true);
    // Somebody without a link learns where to find one.
    drop(other);
    let Some(stranger) = Browser::start(&PHONE) else { return };
    stranger.open(&format!("http://{}/", wall.address));
    stranger
        .wait_for("a hint", "document.getElementById('turn').textContent === 'Scan the code on the wall to steer it'");
}

#[test]
fn keys_and_controls_work_and_the_page_finds_a_wall_that_was_away() {
    let (wall, [operator, _]) = RemoteWall::with_tokens(&[]);
    wall.session.key("o");
    let Some(laptop) = open(&LAPTOP, &wall, &operator) else { return };
    let front = wall.session.steady_screenshot();
    let key = |key: &str| {
        json!({ "type": "key", "id": "keys", "actions": [
        { "type": "keyDown", "value": key }, { "type": "keyUp", "value": key } ] })
    };
    laptop.run("document.getElementById('surface').focus()");
    // Arrow right.
    (0..3).for_each(|_| laptop.perform(&json!([key("\u{e014}")])));
    wait_until("the model has turned", || front.difference(&wall.session.screenshot(), 16) > 0.02);
    // Home.
    laptop.perform(&json!([key("\u{e011}")]));
    wait_until("all is seen again", || wall.session.screenshot() == front);
    laptop.run(
        "const side = document.getElementById('side'); side.value = 'y'; side.dispatchEvent(new Event('input', \
         { bubbles: true }))",
    );
    wait_until("the model is cut", || front.difference(&wall.session.screenshot(), 16) > 0.02);
    laptop.wait_for("the farm is told", "document.querySelectorAll('#nodes tr').length === 2");
    laptop.wait_for("the log is told", "document.getElementById('log').textContent.includes('is ready')");
    // Another wall on the same address, with another folder of tokens: the old link has ended there.
    let address = wall.address.clone();
    let RemoteWall { program, folder, session, .. } = wall;
    drop(program);
    laptop.wait_for("the loss is told", "document.getElementById('link').dataset.state === 'lost'");
    let mut again = session.wall(&["a statue.ply", "--local", "1", "--size", "256x144", "--remote", &address]);
    again.args(["--remote-tokens", "remote.toml"]).current_dir(folder.path());
    let _again = crate::process::Program::start(again);
    laptop.wait_for("the wall is found", "document.getElementById('link').dataset.state === 'found'");
}

/// Texts with too little contrast to the colour behind them, after WCAG 2.2 (1.4.3).
const FAINT: &str = "
    const light = (rgb) => rgb.map((c) => c / 255).map((c) => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4)
        .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
    const numbers = (color) => color.match(/[\\d.]+/g).map(Number);
    const behind = (it) => { for (; it; it = it.parentElement) {
        const [r, g, b, a = 1] = numbers(getComputedStyle(it).backgroundColor); if (a > 0.99) return [r, g, b]; }
        return [255, 255, 255]; };
    return [...document.querySelectorAll('body *')].filter((it) => it.checkVisibility() && !it.disabled
        && [...it.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim())).filter((it) => {
            const [a, b] = [light(numbers(getComputedStyle(it).color).slice(0, 3)), light(behind(it))];
            return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05) < 4.5;
        }).map((it) => it.outerHTML.slice(0, 120))";
/// Controls that are smaller than a finger needs, after WCAG 2.2 (2.5.8).
const SMALL: &str = "
    return [...document.querySelectorAll('button, select, input, summary')].filter((it) => it.checkVisibility()).filter((it) => {
        const { width, height } = it.getBoundingClientRect(); return width < 24 || height < 24;
    }).map((it) => it.outerHTML.slice(0, 120))";
const OPEN_ALL: &str = "document.querySelectorAll('details').forEach((it) => { it.open = true; })";

#[test]
fn the_page_can_be_read_by_everybody_on_every_screen() {
    let (wall, [operator, visitor]) = RemoteWall::with_tokens(&[]);
    let page_bytes: usize = ["/", "/style.css", "/remote.js"].map(|path| wall.get(path, None).body.len()).iter().sum();
    assert!(page_bytes < 60_000, "the page has {page_bytes} bytes");
    for (index, screen) in [PHONE, PHONE_ACROSS, NARROWEST, LAPTOP, LAPTOP_AT_NIGHT].iter().enumerate() {
        let token = if index % 2 == 0 { &operator } else { &visitor };
        let Some(browser) = open(screen, &wall, token) else { return };
        browser.run(OPEN_ALL);
        let size = screen.size;
        assert_eq!(browser.run(FAINT), json!([]), "{size:?}, dark: {}", screen.is_dark);
        assert_eq!(browser.run(SMALL), json!([]), "{size:?}");
        let overflow =
            browser.run("return document.documentElement.scrollWidth - document.documentElement.clientWidth");
        assert_eq!(overflow, 0, "{size:?} scrolls sideways");
        // A screen reader finds a name for everything that can be used.
        let tree = browser.devtools("Accessibility.getFullAXTree", &json!({}));
        let nodes = tree["nodes"].as_array().unwrap();
        let is_used = |node: &&Value| {
            let role = node["role"]["value"].as_str().unwrap_or_default();
            ["button", "combobox", "slider", "link", "application", "image", "heading"].contains(&role)
                && node["ignored"] == false
        };
        let used: Vec<_> = nodes.iter().filter(is_used).collect();
        assert!(used.len() > 10, "{size:?}: {} nodes", used.len());
        for node in used {
            assert!(node["name"]["value"].as_str().is_some_and(|name| !name.is_empty()), "{size:?}: {node}");
        }
    }
}

/// axe-core, which finds what keeps people from using a page; `make setup-test` fetches it.
fn axe() -> Option<String> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/axe/node_modules/axe-core/axe.min.js");
    let text = fs::read_to_string(path);
    text.inspect_err(|error| println!("skipped: no axe-core: {error}")).ok()
}

#[test]
fn axe_finds_nothing_that_keeps_people_out() {
    let Some(axe) = axe() else { return };
    let (wall, [operator, visitor]) = RemoteWall::with_tokens(&[]);
    for (screen, token) in [
        (PHONE, &visitor),
        (PHONE_ACROSS, &operator),
        (NARROWEST, &operator),
        (LAPTOP, &operator),
        (LAPTOP_AT_NIGHT, &visitor),
    ] {
        let Some(browser) = open(&screen, &wall, token) else { return };
        browser.run(OPEN_ALL);
        browser.run(&axe);
        let check = "const done = arguments[arguments.length - 1]; axe.run().then(({ violations, passes }) => done([ \
            violations.map((it) => it.id + ': ' + it.nodes.map((node) => node.html).join(' ')), passes.length]));";
        let found = browser.run_later(check);
        assert_eq!(found[0], json!([]), "{:?}, dark: {}", screen.size, screen.is_dark);
        assert!(found[1].as_u64().is_some_and(|n_rules| n_rules > 20), "{found}");
    }
}

#[test]
fn an_encrypted_page_steers_as_any_other() {
    let (wall, [operator, _]) = RemoteWall::with_tokens(&["--remote-certificate", "wall.pem"]);
    wall.session.key("o");
    let Some(laptop) = Browser::start(&LAPTOP) else { return };
    // The plain address leads to the encrypted one, and the token stays in the browser meanwhile.
    laptop.open(&format!("http://{}/#{operator}", wall.address));
    laptop.wait_for("the picture is there", "!document.getElementById('picture').hidden");
    assert_eq!(laptop.run("return location.protocol"), "https:");
    assert_eq!(laptop.run("return document.getElementById('plain').hidden"), true);
    let seal = laptop.run("return document.getElementById('seal').textContent");
    let said = wall.program.said();
    let fingerprint = said.split("SHA-256 ").nth(1).and_then(|rest| rest.split_whitespace().next()).unwrap();
    assert!(seal.as_str().is_some_and(|seal| seal.contains(fingerprint)), "{seal}");
    let front = wall.session.steady_screenshot();
    let [x, y] = middle(&laptop);
    laptop.perform(&json!([finger("one", [x - 40, y], [80, 20])]));
    wait_until("the model has turned", || front.difference(&wall.session.screenshot(), 16) > 0.02);
    let status =
        |script: &str| laptop.run(&format!("const it = new XMLHttpRequest(); {script}; it.send(); return it.status"));
    assert_eq!(status("it.open('GET', '/health', false)"), 401);
    assert_eq!(
        status(&format!("it.open('GET', '/health', false); it.setRequestHeader('Authorization', 'Bearer {operator}')")),
        200
    );
}
