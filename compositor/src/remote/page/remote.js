"use strict";
// The page's only state: the conversation with the wall, what the wall has said, and the hands on the surface.

const $ = (id) => document.getElementById(id);
const surface = $("surface"), picture = $("picture");
const token = location.hash.slice(1);
let socket = null, wall = null, turn = { may_steer: true, before: 0, waiting: 0, seconds: null };
let delay = 500, retry = 0, tag = 0, shownUrl = null;
const sentAt = new Map(), renderTimes = [];

// The conversation.

function connect() {
  clearTimeout(retry);
  const place = (location.protocol === "https:" ? "wss://" : "ws://") + location.host + "/api/socket";
  let wasOpen = false;
  const mine = socket = new WebSocket(place, token ? ["raywall", token] : ["raywall"]);
  mine.binaryType = "blob";
  mine.onopen = () => {
    wasOpen = true;
    delay = 500;
    tell("found", "Connected");
    delete surface.dataset.lost;
    tellTurn();
    watch();
  };
  mine.onmessage = ({ data }) => typeof data === "string" ? hear(JSON.parse(data)) : show(data);
  mine.onclose = async () => {
    if (mine !== socket) return;
    const isKnown = wasOpen || await isLetIn();
    const stranger = token ? ["Lost the wall", "This link has ended: scan the code on the wall again"]
      : ["Not connected", "Scan the code on the wall to steer it"];
    const [link, hint] = isKnown ? ["Lost the wall", "Looking for the wall"] : stranger;
    tell("lost", link);
    $("turn").textContent = hint;
    $("leave").hidden = true;
    surface.dataset.lost = "";
    hands.clear();
    // Without a token the wall will never let it in.
    if (!isKnown && !token) return;
    retry = setTimeout(connect, delay);
    delay = Math.min(delay * 2, 4000);
  };
}

// A browser does not say why a conversation cannot begin.
async function isLetIn() {
  try {
    const answer = await fetch("health", { headers: token ? { Authorization: "Bearer " + token } : {} });
    return answer.status !== 401;
  } catch {
    return true;
  }
}

function send(message) {
  if (socket?.readyState !== WebSocket.OPEN) return false;
  socket.send(JSON.stringify(message));
  return true;
}

function steer(message) {
  tag = (tag + 1) % 0xffffffff;
  if (sentAt.size > 200) sentAt.clear();
  sentAt.set(tag, performance.now());
  send({ ...message, tag });
}

// Pictures are made only while somebody looks.
function watch() {
  send({ do: "watch", pictures: document.visibilityState === "visible" });
}

function hear(message) {
  if (message.state) update(message.state);
  if (message.turn) { turn = message.turn; turnHeardAt = Date.now(); tellTurn(); }
  if (message.shown !== undefined && sentAt.has(message.shown)) {
    latency = performance.now() - sentAt.get(message.shown);
    sentAt.delete(message.shown);
  }
  if (message.refused) tellFor(message.refused);
}

function tell(state, text) {
  $("link").dataset.state = state;
  if ($("link").textContent !== text) $("link").textContent = text;
}

let latency = null, turnHeardAt = 0, noteTimer = 0, isListed = false, sceneShown = null;

function tellFor(text) {
  if (wall?.role === "visitor" && !turn.may_steer) return;
  $("turn").textContent = text[0].toUpperCase() + text.slice(1);
  clearTimeout(noteTimer);
  noteTimer = setTimeout(tellTurn, 4000);
}

function tellTurn() {
  const left = turn.seconds === null ? null : Math.max(0, turn.seconds - Math.round((Date.now() - turnHeardAt) / 1000));
  const others = turn.waiting === 1 ? "One other waits" : `${turn.waiting} others wait`;
  let text = "";
  if (turn.before === 1) text = `You are next, in ${left} s at the latest`;
  else if (turn.before > 1) text = `${turn.before} visitors steer before you`;
  else if (!turn.may_steer) text = "Somebody steers: touch the picture to wait for your turn";
  else if (turn.waiting > 0) text = `You steer. ${others}: ${left} s left at most`;
  if (wall?.role !== "visitor") text = "";
  if ($("turn").textContent !== text) $("turn").textContent = text;
  surface.toggleAttribute("data-waits", wall?.role === "visitor" && !turn.may_steer);
  $("leave").textContent = turn.before > 0 ? "Stop waiting" : "Let the next one steer";
  $("leave").hidden = !(wall?.role === "visitor" && (turn.before > 0 || turn.waiting > 0 && turn.may_steer));
}
// A screen reader hears each change: it hears every ten seconds of a countdown.
setInterval(() => { if (turn.seconds !== null && socket?.readyState === WebSocket.OPEN && (Date.now() - turnHeardAt) % 10000 < 1000) tellTurn(); }, 1000);

function show(blob) {
  const url = URL.createObjectURL(blob);
  picture.onload = () => {
    if (shownUrl) URL.revokeObjectURL(shownUrl);
    shownUrl = url;
    picture.hidden = false;
    $("empty").hidden = true;
  };
  picture.src = url;
}

// The state.

function element(name, text, attributes = {}) {
  const it = document.createElement(name);
  it.textContent = text;
  for (const [key, value] of Object.entries(attributes)) it.setAttribute(key, value);
  return it;
}

function update(state) {
  wall = state;
  const { show } = state;
  const reading = show.loading && `Reading ${show.loading[0]}: ${Math.round(show.loading[1] * 100)} %`;
  $("model").textContent = show.model || "Raywall";
  $("triangles").textContent = reading || (show.n_triangles ? `${show.n_triangles.toLocaleString("en")} triangles` : "");
  document.title = show.model ? `${show.model} – Raywall` : "Raywall";
  $("play").hidden = !show.has_path;
  $("play").setAttribute("aria-pressed", show.is_playing);
  $("play").textContent = show.is_playing ? "Stop path" : "Play path";
  const shown = [...document.querySelectorAll("#views [data-view]")].map((it) => +it.dataset.view);
  if (shown.join() !== show.views.join()) {
    document.querySelectorAll("#views [data-view]").forEach((it) => it.remove());
    show.views.forEach((number) => $("views").append(element("button", `View ${number}`, { type: "button", "data-view": number })));
  }
  updateAnnotations(show, state.role === "operator");
  $("seal").hidden = location.protocol !== "https:" || !show.own_certificate;
  const seal = `This connection is encrypted, but nobody vouches for the wall's own certificate: its SHA-256 is ${show.own_certificate}, as the wall's first lines say.`;
  if ($("seal").textContent !== seal) $("seal").textContent = seal;
  $("show").hidden = show.n_scenes === null;
  const scene = show.scene === null ? "" : `Scene ${show.scene} of ${show.n_scenes}${show.caption ? `: ${show.caption}` : ""}`;
  if ($("scene").textContent !== scene) $("scene").textContent = scene;
  $("playing").textContent = show.is_show_playing ? "Hold show" : "Play show";
  $("playing").setAttribute("aria-pressed", show.is_show_playing);
  $("playing").dataset.order = show.is_show_playing ? "pause-show" : "play-show";
  for (const id of ["operator", "programs", "orders", "keeping"]) $(id).hidden = state.role !== "operator";
  $("editing").hidden = state.role !== "operator" || show.scene === null;
  // Texts that are being typed stay, until another scene is shown.
  const written = JSON.stringify([show.scene, show.caption, show.scene_seconds]);
  if (written !== $("editing").dataset.scene) {
    $("editing").dataset.scene = written;
    $("scene-caption").value = show.caption ?? "";
    $("scene-seconds").value = show.scene_seconds ?? "";
  }
  $("scene-earlier").disabled = !(show.scene > 1);
  $("scene-later").disabled = !(show.scene < show.n_scenes);
  sceneShown = show.scene;
  surface.parentElement.style.setProperty("--aspect", show.aspect || 1.78);
  if (state.role === "operator") {
    if (!isListed) isListed = send({ do: "list-models" });
    updateOperator(state);
  }
  tellTurn();
}

function updateAnnotations({ annotations, annotation }, isOperator) {
  const labels = JSON.stringify(annotations);
  if ($("labels").dataset.shown !== labels) {
    $("labels").dataset.shown = labels;
    $("labels").replaceChildren(...annotations.map(({ number, label }) => element("button", label, { type: "button", "data-annotation": number })));
  }
  for (const it of $("labels").children) it.setAttribute("aria-pressed", +it.dataset.annotation === annotation?.number);
  const text = annotation ? annotation.text || annotation.label : "";
  if ($("annotation").textContent !== text) $("annotation").textContent = text;
  $("annotations").hidden = annotations.length === 0 && !isOperator;
  $("annotating").hidden = !isOperator;
  $("deleting").hidden = !isOperator || !annotation;
}

function set(id, value) {
  const it = $(id);
  // A hand on a control knows better than the wall.
  if (held === it) return;
  if (it.tagName === "SELECT" && ![...it.options].some((option) => option.value === value)) {
    it.append(element("option", id === "background" ? "another" : value, { value }));
  }
  if (it.value !== value) it.value = value;
  tellOutput(it);
}

function tellOutput(it) {
  const output = it.parentElement.querySelector("output");
  if (!output) return;
  const texts = { depth: `${it.value / 10} %`, exposure: `${it.value} stops` };
  output.textContent = texts[it.id] ?? `${it.value}°`;
}

function updateOperator({ controls, farm, log, show }) {
  const models = controls.models.includes(show.model) || !show.model ? controls.models : [show.model, ...controls.models];
  const select = $("models");
  if (held !== select) {
    if ([...select.options].map((it) => it.value).join("/") !== models.join("/")) {
      select.replaceChildren(...models.map((name) => element("option", name, { value: name })));
    }
    select.value = show.model;
  }
  set("rays", controls.rays ?? "");
  set("azimuth", String(controls.light_deg[0]));
  set("elevation", String(controls.light_deg[1]));
  set("sun", String(controls.sun_deg));
  set("exposure", String(controls.exposure_stops));
  set("ground", controls.has_ground ? "on" : "");
  set("side", controls.cut?.[0] ?? "");
  if (controls.cut) set("depth", String(controls.cut[1]));
  $("depth").disabled = !controls.cut;
  tellOutput($("depth"));
  set("background", controls.background);
  set("shading", controls.shading);
  set("division", controls.division);

  $("alerts").replaceChildren(...farm.alerts.map((text) => element("p", text)));
  const ms = (value) => `${value < 10 ? value.toFixed(1) : Math.round(value)} ms`;
  const figures = {
    "frames a second": farm.frames_per_second === null ? "at rest" : farm.frames_per_second.toFixed(1),
    "render": ms(farm.render_ms), "place": ms(farm.place_ms), "upload": ms(farm.upload_ms), "draw": ms(farm.draw_ms),
    "camera to picture": ms(farm.latency_ms), "touch to picture": latency === null ? "–" : ms(latency),
    "imbalance": `×${farm.imbalance.toFixed(2)}`, "resolution": farm.resolution.replace("x", "×") || "–",
    "rays a sample": farm.samples, "lost": farm.nodes_lost, "healed frames": farm.frames_healed,
  };
  $("figures").replaceChildren(...Object.entries(figures).map(([name, value]) => {
    const pair = element("div", "");
    pair.append(element("dt", name), element("dd", value));
    return pair;
  }));
  renderTimes.push(farm.render_ms);
  if (renderTimes.length > 60) renderTimes.shift();
  $("history").toggleAttribute("hidden", renderTimes.length < 2);
  const most = Math.max(1, ...renderTimes);
  const point = (value, index) => `${(index + 60 - renderTimes.length) * 4},${46 - value / most * 42}`;
  document.querySelector("#history polyline").setAttribute("points", renderTimes.map(point).join(" "));

  const levels = { ready: "good", loading: "busy", joining: "busy", silent: "bad", missing: "bad" };
  $("nodes").replaceChildren(...farm.nodes.map((node) => {
    const row = element("tr", "");
    const name = element("th", node.name, { scope: "row" });
    const condition = element("td", node.state, { "data-level": levels[node.state] });
    if (node.detail) condition.append(element("small", node.detail));
    const number = (text) => element("td", text, { class: "number" });
    row.append(name, condition, number(node.threads), number(`${Math.round(node.share * 100)} %`), number(ms(node.busy_ms)),
      number(node.round_trip_ms === null ? "–" : ms(node.round_trip_ms)), number(node.losses));
    return row;
  }));
  $("log").replaceChildren(...log.toReversed().map(({ time_s, level, text }) => {
    const line = element("li", "", { "data-level": { ERROR: "bad", WARN: "busy" }[level] ?? "" });
    line.append(element("time", new Date(time_s * 1000).toLocaleTimeString("en-GB")), text);
    return line;
  }));
}

// Hands on the surface.

const hands = new Map();
const TAP_MS = 350, TAP_PIXELS = 10, TWIST_DEGREES = 8;
let pressed = null, twist = 0, isTwisting = false;

// The picture's place in the surface: it keeps the wall's shape.
function frame() {
  const box = surface.getBoundingClientRect();
  const aspect = wall?.show.aspect || box.width / box.height;
  const width = Math.min(box.width, box.height * aspect), height = width / aspect;
  return { left: box.left + (box.width - width) / 2, top: box.top + (box.height - height) / 2, width, height };
}

// A point as the wall has it: fractions of the picture, (0, 0) lower left.
function onPicture(x, y) {
  const { left, top, width, height } = frame();
  return { x: (x - left) / width, y: 1 - (y - top) / height };
}
const within = ({ x, y }) => x >= 0 && x <= 1 && y >= 0 && y <= 1;
const clamped = ({ x, y }) => ({ x: Math.min(1, Math.max(0, x)), y: Math.min(1, Math.max(0, y)) });

function drag(what, dx, dy) {
  const { width, height } = frame();
  if (dx || dy) steer({ do: what, x: dx / width, y: -dy / height });
}

surface.addEventListener("pointerdown", (event) => {
  surface.setPointerCapture(event.pointerId);
  hands.set(event.pointerId, { x: event.clientX, y: event.clientY, button: event.button, shift: event.shiftKey });
  pressed = hands.size === 1 ? { x: event.clientX, y: event.clientY, at: performance.now(), button: event.button } : null;
  twist = 0;
  isTwisting = false;
});

surface.addEventListener("pointermove", (event) => {
  const hand = hands.get(event.pointerId);
  if (!hand) return;
  const [dx, dy] = [event.clientX - hand.x, event.clientY - hand.y];
  if (pressed && Math.hypot(event.clientX - pressed.x, event.clientY - pressed.y) <= TAP_PIXELS) return;
  pressed = null;
  if (hands.size === 1) {
    const moves = hand.shift || hand.button === 1 || hand.button === 2;
    if (event.altKey) steer({ do: "roll", degrees: -dx / 4 });
    else drag(moves ? "pan" : "orbit", dx, dy);
  } else if (hands.size === 2) {
    const other = [...hands.entries()].find(([id]) => id !== event.pointerId)[1];
    pinch(hand, { x: event.clientX, y: event.clientY }, other);
    drag("pan", dx / 2, dy / 2);
  }
  hand.x = event.clientX;
  hand.y = event.clientY;
});

// Two fingers: their distance comes nearer, their angle rolls.
function pinch(from, to, other) {
  const vector = (point) => [point.x - other.x, point.y - other.y];
  const [before, after] = [vector(from), vector(to)];
  const [long, longer] = [Math.hypot(...before), Math.hypot(...after)];
  if (long < 1 || longer < 1) return;
  const middle = clamped(onPicture((to.x + other.x) / 2, (to.y + other.y) / 2));
  const factor = Math.min(20, Math.max(0.05, long / longer));
  if (factor !== 1) steer({ do: "dolly", factor, ...middle });
  let degrees = (Math.atan2(before[1], before[0]) - Math.atan2(after[1], after[0])) * 180 / Math.PI;
  degrees -= 360 * Math.round(degrees / 360);
  twist += degrees;
  isTwisting ||= Math.abs(twist) > TWIST_DEGREES;
  if (isTwisting && degrees) steer({ do: "roll", degrees });
}

function lift(event) {
  hands.delete(event.pointerId);
  if (event.type !== "pointerup" || !pressed) return;
  const isTap = performance.now() - pressed.at < TAP_MS && pressed.button === 0;
  pressed = null;
  const at = onPicture(event.clientX, event.clientY);
  if (!isTap || !within(at)) return;
  steer({ do: "go-to", ...at });
  const box = surface.getBoundingClientRect(), mark = $("touched");
  mark.style.left = `${event.clientX - box.left}px`;
  mark.style.top = `${event.clientY - box.top}px`;
  mark.classList.remove("on");
  void mark.offsetWidth;
  mark.classList.add("on");
}
surface.addEventListener("pointerup", lift);
surface.addEventListener("pointercancel", lift);
surface.addEventListener("contextmenu", (event) => event.preventDefault());
surface.addEventListener("wheel", (event) => {
  event.preventDefault();
  const notches = -event.deltaY / (event.deltaMode === 0 ? 100 : 3);
  const factor = Math.min(20, Math.max(0.05, 1.15 ** -notches));
  steer({ do: "dolly", factor, ...clamped(onPicture(event.clientX, event.clientY)) });
}, { passive: false });

// Steps, for keys and buttons.

const STEP = 0.06;
function step(what, moves) {
  const by = { left: [-STEP, 0], right: [STEP, 0], up: [0, STEP], down: [0, -STEP] }[what];
  if (by) return steer({ do: moves ? "pan" : "orbit", x: by[0], y: by[1] });
  const action = {
    nearer: { do: "dolly", factor: 0.85 }, farther: { do: "dolly", factor: 1 / 0.85 },
    "roll-left": { do: "roll", degrees: 5 }, "roll-right": { do: "roll", degrees: -5 },
    middle: { do: "go-to", x: 0.5, y: 0.5 }, all: { do: "view-all" },
  }[what];
  if (action) steer(action);
}

const KEYS = {
  ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down", "+": "nearer", "=": "nearer", "-": "farther",
  ",": "roll-left", ".": "roll-right", Home: "all", Enter: "middle",
};
surface.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const isView = /^[1-9]$/.test(event.key) && wall?.show.views.includes(+event.key);
  if (isView) steer({ do: "go-to-view", number: +event.key });
  else if (KEYS[event.key]) step(KEYS[event.key], event.shiftKey);
  else return;
  event.preventDefault();
});

document.addEventListener("click", ({ target }) => {
  const button = target.closest("button");
  if (!button) return;
  const { action, step: what, view, order, annotation } = button.dataset;
  if (action === "leave") send({ do: "leave" });
  else if (order) send({ do: order });
  else if (action) steer({ do: action });
  else if (view) steer({ do: "go-to-view", number: +view });
  else if (annotation) steer({ do: "go-to-annotation", number: +annotation });
  else if (what) step(what, $("moves").getAttribute("aria-pressed") === "true");
});
$("moves").addEventListener("click", ({ target }) => {
  target.setAttribute("aria-pressed", target.getAttribute("aria-pressed") !== "true");
});

// An operator's controls.

let held = null, letGo = 0;
function control(ids, event, message) {
  for (const id of ids) {
    $(id).addEventListener(event, ({ target }) => {
      held = target;
      clearTimeout(letGo);
      // The wall's answer may still tell of the value before.
      letGo = setTimeout(() => { held = null; }, 800);
      tellOutput(target);
      const said = message();
      if (said) send(said);
    });
  }
}
const value = (id) => $(id).value;
control(["models"], "change", () => ({ do: "open", model: value("models") }));
control(["rays"], "change", () => ({ do: "rays", rays: value("rays") || null }));
control(["azimuth", "elevation"], "input", () => ({ do: "light", azimuth_deg: +value("azimuth"), elevation_deg: +value("elevation") }));
control(["sun"], "input", () => ({ do: "sun", degrees: +value("sun") }));
control(["exposure"], "input", () => ({ do: "exposure", stops: +value("exposure") }));
control(["ground"], "change", () => ({ do: "ground", on: value("ground") === "on" }));
control(["side", "depth"], "input", () => value("side") ? { do: "cut", side: value("side"), permille: +value("depth") } : { do: "cut" });
control(["background"], "change", () => ({ do: "background", colors: value("background") }));
control(["shading"], "change", () => ({ do: "shading", shading: value("shading") }));
control(["division"], "change", () => ({ do: "division", division: value("division") }));
$("keep").addEventListener("click", () => send({ do: "keep-view", number: +value("number") }));
$("keep-scene").addEventListener("click", () => send({ do: "keep-scene", caption: value("caption"), seconds: +value("seconds") || null }));
$("edit-scene").addEventListener("click", () => send({ do: "edit-scene", scene: sceneShown, caption: value("scene-caption"), seconds: +value("scene-seconds") || null }));
$("scene-earlier").addEventListener("click", () => send({ do: "move-scene", scene: sceneShown, to: sceneShown - 1 }));
$("scene-later").addEventListener("click", () => send({ do: "move-scene", scene: sceneShown, to: sceneShown + 1 }));
$("delete-scene").addEventListener("click", () => send({ do: "delete-scene", scene: sceneShown }));
$("annotate").addEventListener("click", () => {
  if (!value("label").trim()) return $("label").focus();
  send({ do: "annotate", label: value("label"), text: value("text") });
  $("label").value = $("text").value = "";
});
$("delete-annotation").addEventListener("click", () => {
  const chosen = wall?.show.annotation;
  if (chosen && confirm(`Delete “${chosen.label}”?`)) send({ do: "delete-annotation", number: chosen.number });
});
$("models").addEventListener("focus", () => send({ do: "list-models" }));
$("models").addEventListener("pointerdown", () => send({ do: "list-models" }));

document.addEventListener("visibilitychange", watch);
window.addEventListener("online", connect);
window.addEventListener("hashchange", () => location.reload());
$("plain").hidden = location.protocol === "https:" || ["localhost", "127.0.0.1", "[::1]"].includes(location.hostname);
connect();
