// The operator's page: newest state in, drawn once a frame, and said back when it was drawn; wishes out.
import { AlarmList } from "./alarms.js";
import { InsertionView } from "./insertion.js";
import { LeverView } from "./levers.js";
import { Overlay } from "./overlay.js";
import { Signals } from "./signals.js";
import { Socket } from "./socket.js";
import { Timeline } from "./timeline.js";
import { LANGUAGES, preferred, words } from "./words.js";

const $ = id => document.getElementById(id);
const setup = await (await fetch("setup.json")).json();
let language = preferred(setup.language);
let say = words(language);
const token = new URLSearchParams(location.hash.slice(1)).get("token") ?? sessionStorage.getItem("token");
if (token) sessionStorage.setItem("token", token);
history.replaceState(null, "", location.pathname + location.search);  // the key stays out of the history and of screenshots

const views = { left: new LeverView($("left"), "left", setup), right: new LeverView($("right"), "right", setup) };
const insertion = new InsertionView($("insertion")), overlay = new Overlay($("overlay")), alarms = new AlarmList($("alarms"));
const measured = window.measured = { drawn: 0, number: 0, fps: 0, points: 0, frames: 0, frame_ms: 0, allowed: null, signals: [] };
const signals = new Signals(name => measured.signals.push(name));
const opened = performance.now(), PATIENCE_MS = 2000;
let newest = null, came = 0, heard = 0, asked = false, video = null;

// ---- state in, drawn back
const painted = new MessageChannel();
painted.port1.onmessage = ({ data }) => state.send(String(data));
const state = new Socket("/state", {
  opened: () => { heard = 0; },
  heard: text => {
    came = performance.now();
    newest = JSON.parse(text);
    heard += 1;
    if (!asked) { asked = true; requestAnimationFrame(frame); }
  },
});

function frame() {
  asked = false;
  draw();
  measured.drawn += 1;
  measured.number = newest.number;
  painted.port2.postMessage(heard);  // runs once the frame is through layout and paint
  scene?.postMessage({ state: newest.shown });
}

function put(node, text, kind) {
  if (node.textContent !== text) node.textContent = text;
  if (kind !== undefined) for (const one of ["good", "bad", "careful", "idle"]) node.classList.toggle(one, one === kind);
}

function fresh(shown, name, since_s) {
  const stream = shown.streams.find(one => one.name === name);
  return Boolean(stream && stream.age_s !== null && stream.age_s + since_s <= stream.limit_s);
}

const nameOf = joint => (setup.parts[joint] ? say(setup.parts[joint]) : joint);

// An alarm in words; `joint 2` is the second joint.
function tell({ name, detail }) {
  const about = detail.replace(/^joint (\d+)/, (_, number) => nameOf(setup.joints[number - 1] ?? number));
  return detail ? `${say(name)}: ${say(about)}` : say(name);
}

// What is given once when it begins.
const lasting = new Set();
function notice(name, is) {
  if (is && !lasting.has(name)) signals.give(name);
  if (is) lasting.add(name); else lasting.delete(name);
}

const CALM_MS = 90;  // what is read, not followed, changes no faster
let calm = 0;
function draw() {
  const since_s = (performance.now() - came) / 1000;
  const lost = newest === null || since_s > setup.stale_s;
  document.body.classList.toggle("lost", lost);
  const now = performance.now(), calmly = now - calm >= CALM_MS || lost;
  if (calmly) drawAlarms(lost, now);
  if (lost) { drawUnknown(); return; }
  const shown = newest.shown;
  if (shown.replay) put($("connection"), say("replay"), "careful");
  else put($("connection"), say(shown.alive ? "connected" : "dead"), shown.alive ? "good" : "bad");
  const good = name => shown.alive && fresh(shown, name, since_s);
  drawLevers(shown, { own: good("levers"), advised: good("advice") && good("positions") && Boolean(shown.advice?.valid) });
  if (!calmly) return;
  calm = now;
  const chosen = shown.targets.find(one => one.chosen), known = good("positions") && good("borehole");
  insertion.draw(chosen ? shown.insertion : null, chosen, known, say);
  notice("inserted", known && Boolean(shown.insertion?.inserted));
  overlay.draw(shown);
  timeline.draw(shown.replay, say);
  document.body.classList.toggle("replay", Boolean(shown.replay));
  drawSafety(shown, good("levers"));
  drawStreams(shown, since_s);
  $("camera").hidden = !shown.streams.some(one => one.name === "camera");
  $("camera").classList.toggle("stale", !good("camera"));
  drawView(shown.view, shown.streams.find(one => one.name === "camera"));
  drawTargets(shown);
  put($("start").querySelector("b"), say(byMode(shown, "start")));
  $("start").setAttribute("aria-pressed", shown.guiding);
  $("record").setAttribute("aria-pressed", shown.recording.on);
}

// Without a connection nothing is known: the style sheet hides the rest.
function drawUnknown() {
  put($("connection"), say("lost"), "bad");
  for (const name of ["safety", "deadman", "recording"]) put($(name), say("unknown"), "bad");
  $("start").setAttribute("aria-pressed", false);
  $("record").setAttribute("aria-pressed", false);
}

// Words differ where the machine moves by itself and no person follows an advice.
function byMode(shown, name) { return shown.safety?.commands ? `${name} auto` : name; }

function drawAlarms(lost, now) {
  const grave = unconfirmed ? [{ level: "alarm", name: "refused unconfirmed", detail: "" }] : [];
  const isNew = newest === null && now - opened < PATIENCE_MS;  // the page has only just been opened
  if (lost && !isNew) grave.push({ level: "alarm", name: "lost", detail: "" });
  if (!lost) grave.push(...video?.listAlarms(now) ?? [], ...newest.shown.alarms);
  if (alarms.draw(grave, tell, now)) signals.give("alarm");
}

function drawSafety(shown, known) {
  const { safety, recording } = shown;
  const held = known && safety?.deadman && !safety.estop;
  put($("deadman"), say(held ? "dead-man held" : "dead-man released"), held ? "good" : "careful");
  if (safety) {
    const state = safety.state === "SILENT" && !safety.commands ? "listens only" : safety.state;
    const wrong = safety.estop ? "emergency stop" : safety.trip;
    const calm = safety.commands ? wrong === "nothing" : !safety.estop && safety.bus_up;
    const why = safety.commands || safety.estop || !safety.bus_up ? ` – ${wrong.startsWith("a joint ") && safety.observed_joint ? `${nameOf(setup.joints[safety.observed_joint - 1])}: ` : ""}${say(safety.bus_up ? wrong : "bus down")}` : "";
    const kind = safety.estop || safety.state === "LATCHED" || !safety.bus_up ? "bad" : safety.state === "ACTIVE" ? "careful" : calm ? "good" : "careful";
    put($("safety"), say(state) + why, kind);
  } else put($("safety"), say("nothing from the bus"), "bad");
  const minutes = `${Math.floor(recording.seconds / 60)}:${String(Math.floor(recording.seconds % 60)).padStart(2, "0")}`;
  const gaps = recording.dropped ? `, ${recording.dropped} ${say("gaps")}` : "";
  if (recording.failed && !recording.on) put($("recording"), say("recording failed"), "bad");
  else put($("recording"), recording.on ? `${say("recording")} ${minutes}${gaps}` : say("not recording"), recording.dropped ? "bad" : recording.on ? "good" : "idle");
}

function drawLevers(shown, sure) {
  const advice = shown.guiding ? shown.advice : null;
  const button = Boolean(advice?.levers.button_right);
  for (const view of Object.values(views)) view.draw(shown.own, advice?.levers ?? null, sure, button, nameOf);
  put($("advice"), !shown.guiding ? say(byMode(shown, "stopped")) : shown.advice?.valid ? say(byMode(shown, "guiding")) : say(shown.advice?.reason ?? "nothing from the bus"));
  $("advice").classList.toggle("none", shown.guiding && !shown.advice?.valid);
  const due = advice && sure.advised ? advice.button_due_s : null;
  const now = sure.advised && button, soon = !now && due !== null && due > 0;
  const box = $("button").classList;
  box.toggle("now", now); box.toggle("due", soon); box.toggle("stale", !sure.advised && Boolean(advice)); box.toggle("held", sure.own && Boolean(shown.own?.button_right));
  notice("button now", now); notice("button due", soon);
  const wrong = sure.advised && sure.own && !now && !soon && Boolean(shown.own?.button_right);
  box.toggle("wrong", wrong);
  notice("button off", wrong);
  const joint = setup.exclusive.map(nameOf).join(" ");
  put($("button").lastElementChild, now ? `${joint}: ${say("button now")}` : soon ? `${joint}: ${say("button due")} ${due.toFixed(1)} s` : wrong ? `${joint}: ${say("button off")}` : "");
  if (soon) $("button").querySelector(".left").setAttribute("stroke-dasharray", `${Math.min(1, due / 1.5).toFixed(3)} 1`);
}

function drawStreams(shown, since_s) {
  const list = $("streams");
  while (list.children.length < shown.streams.length) list.append(document.createElement("li"));
  while (list.children.length > shown.streams.length) list.lastChild.remove();
  shown.streams.forEach((stream, index) => {
    const age_s = stream.age_s === null ? null : stream.age_s + since_s, item = list.children[index];
    const text = age_s === null ? say("never") : age_s < 1 ? `${Math.ceil(age_s * 20) * 50} ms` : age_s < 100 ? `${age_s.toFixed(0)} s` : `${(age_s / 60).toFixed(0)} min`;
    put(item, `${say(stream.name)} ${age_s !== null && age_s < stream.limit_s && age_s < 0.1 ? "✓" : text}`);
    item.dataset.stream = stream.name;
    item.classList.toggle("stale", age_s === null || age_s > stream.limit_s);
  });
}

// Where a moving camera looks, and why.
function drawView(view, camera) {
  const text = $("camera").querySelector("#why"), seconds = value => value.toFixed(1), mm = value => (1000 * value).toFixed(1);
  text.hidden = !view || !camera;
  if (!view) return;
  const seen = say(view.seen_s > 0 ? "hole in sight for" : "no view of the hole").replace("{seen}", seconds(view.seen_s)).replace("{of}", view.horizon_s.toFixed(0));
  const instead = view.is_moving ? `, ${say("instead of")} ${seconds(view.seen_before_s)} s · ${mm(view.std_before_m)} → ${mm(view.std_m)} mm` : "";
  put(text, `${say(view.is_moving ? "camera moves" : "camera stays")}: ${view.name}. ${seen}${instead}`);
  text.classList.toggle("busy", view.is_moving || view.seen_s === 0);
}

let listed = "";
function drawTargets(shown) {
  const seen = shown.streams.some(one => one.name === "camera"), key = JSON.stringify([shown.targets, language, seen]);
  if (key === listed) return;
  listed = key;
  const focused = document.activeElement?.dataset?.target;
  $("targets").replaceChildren(...shown.targets.map((target, index) => {
    const button = document.createElement("button"), sure = document.createElement("small"), spread = document.createElement("small");
    button.type = "button";
    button.dataset.target = target.name;
    button.setAttribute("role", "radio");
    button.setAttribute("aria-checked", target.chosen);
    button.setAttribute("aria-keyshortcuts", index + 1);
    sure.textContent = target.confidence === null ? say("unsure") : `${Math.round(100 * target.confidence)} %`;
    spread.textContent = target.std_m === null ? "" : `± ${(1000 * target.std_m).toFixed(0)} mm`;
    button.append(target.name, sure, spread);
    button.onclick = () => wish("target", target.name);
    return button;
  }));
  if (focused) [...$("targets").children].find(one => one.dataset.target === focused)?.focus();
  put($("boreholes"), say((shown.targets.length ? "boreholes" : "no borehole") + (seen ? " seen" : "")));
}

// ---- wishes out
const control = token ? new Socket("/control", {
  opened: socket => socket.send(JSON.stringify({ token })),
  heard: text => answered(JSON.parse(text)),
  closed: event => {
    if (event.reason === "token") { measured.allowed = false; control.end(); answer("refused token"); } else measured.allowed = null;
  },
}) : null;

// The browser times each wish itself: a dead server says nothing.
const ANSWER_MS = 1000, STOP_MS = 300;
const waiting = new Map();  // by kind of wish: its timer
let unconfirmed = false;

function answered(said) {
  clearTimeout(waiting.get(said.kind));
  if (said.kind === "stop") unconfirmed = Boolean(said.refused);
  if (said.ready) { measured.allowed = true; answer(""); } else answer(said.refused ? `refused ${said.refused}` : "");
}

let answerKey = "";
function answer(key) { answerKey = key; put($("answer"), key ? say(key) : ""); }

function wish(kind, value = "") {
  const isStop = kind === "stop", refuse = refused => answered({ kind, refused: isStop ? "unconfirmed" : refused });
  if (!control || measured.allowed === false) { refuse("token"); return; }
  if (!measured.allowed || !control.ready) { refuse("lost"); return; }
  clearTimeout(waiting.get(kind));
  waiting.set(kind, setTimeout(() => refuse("lost"), isStop ? STOP_MS : ANSWER_MS));
  control.send(JSON.stringify({ kind, value }));
}

// Whoever touches the page while it asks is there.
for (const name of ["pointerdown", "keydown"]) addEventListener(name, () => { if (newest?.shown.safety?.prompt) wish("present"); }, true);

const timeline = new Timeline($("timeline"), wish);
$("start").onclick = () => wish("start");
$("stop").onclick = () => wish("stop");
$("record").onclick = () => wish("record", newest?.shown.recording.on ? "off" : "on");
$("picture").onclick = event => {  // a place in the picture, whatever size it is shown in
  const { width, height } = $("picture").getBoundingClientRect(), inside = part => Math.min(0.9999, Math.max(0.0001, part)).toFixed(4);
  wish("point", `${inside(event.offsetX / width)},${inside(event.offsetY / height)}`);
};
// a page of its own for the dark, and silence on request
function choose(name, on, act) {
  $(name).setAttribute("aria-pressed", on);
  sessionStorage.setItem(name, on);
  act(on);
}
const chosenBefore = (name, otherwise) => (new URLSearchParams(location.search).get(name) ?? sessionStorage.getItem(name) ?? String(otherwise)) === "true";
const tools = {
  sound: on => { signals.on = on; },
  night: on => { document.documentElement.classList.toggle("night", on); scene?.postMessage({ night: on }); },
  along: on => { scene?.postMessage({ along: on }); },
};
for (const [name, act] of Object.entries(tools)) $(name).onclick = () => choose(name, $(name).getAttribute("aria-pressed") !== "true", act);

$("language").onclick = () => {
  language = LANGUAGES[(LANGUAGES.indexOf(language) + 1) % LANGUAGES.length];
  sessionStorage.setItem("language", language);
  speak();
};
addEventListener("keydown", event => {
  if (event.ctrlKey || event.altKey || event.metaKey || event.repeat) return;
  const act = { Escape: () => wish("stop"), " ": () => (newest?.shown.replay ? (event.preventDefault(), $("play").click()) : null), g: () => $("start").click(), r: () => $("record").click(), l: () => $("language").click(), n: () => $("night").click(), t: () => $("sound").click(), v: () => $("along").click(), c: () => video?.enlargeNext() }[event.key];
  if (act) act();
  else if (/^[1-9]$/.test(event.key)) $("targets").children[event.key - 1]?.click();
});

function speak() {
  say = words(language);
  calm = 0;
  document.documentElement.lang = language;
  document.title = `${setup.machine} – ${say("title")}`;
  for (const id of ["stop", "record"]) put($(id).querySelector("b"), say(id));
  put($("language"), language === "en" ? "DE" : "EN");
  put($("along").querySelector("b"), say("along the tool"));
  for (const name of ["sound", "night"]) { $(name).setAttribute("aria-label", say(name)); $(name).title = say(name); }
  const numbers = $("insertion").querySelectorAll("dt");
  ["depth", "lateral", "angle"].forEach((name, index) => put(numbers[index], say(name)));
  $("insertion").querySelector(".depth").setAttribute("aria-label", say("depth"));
  $("insertion").querySelector(".along").setAttribute("aria-label", say("along the tool"));
  $("language").setAttribute("aria-label", language === "en" ? "Deutsch" : "English");
  put($("camera").querySelector("figcaption"), say("camera"));
  for (const side of ["left", "right"]) $(side).setAttribute("aria-label", say(side));
  $("scene").setAttribute("aria-label", say("scene"));
  const [advised, own] = $("legend").querySelectorAll("span");
  put(advised, say("advised")); put(own, say("own")); put($("noscene"), say("no 3D"));
  answer(answerKey);
  draw();
}

// ---- 3D scene and camera, in a thread of their own: levers never wait for them
let scene = null;
function startScene() {
  const canvas = $("scene"), picture = $("picture").getContext("bitmaprenderer");
  const worker = new Worker("scene.js", { type: "module" });
  const size = () => ({ size: [canvas.clientWidth, canvas.clientHeight] });
  const surface = canvas.transferControlToOffscreen();
  worker.postMessage({ start: { canvas: surface, geometry: setup.geometry, points: setup.points, ...size() } }, [surface]);
  worker.onmessage = ({ data }) => {
    if (data.failed) { $("noscene").hidden = false; return; }
    if (data.picture) { picture.transferFromImageBitmap(data.picture); overlay.see(data.lens); }
    if (data.measured) Object.assign(measured, data.measured);
  };
  new ResizeObserver(() => worker.postMessage(size())).observe(canvas);
  const held = new Map();
  let apart = 0;
  canvas.onpointerdown = event => { canvas.setPointerCapture(event.pointerId); held.set(event.pointerId, event); apart = 0; };
  canvas.onpointerup = canvas.onpointercancel = event => { held.delete(event.pointerId); apart = 0; };
  canvas.onpointermove = event => {
    const before = held.get(event.pointerId);
    if (!before) return;
    held.set(event.pointerId, event);
    if (held.size === 1) worker.postMessage({ turn: [event.clientX - before.clientX, event.clientY - before.clientY] });
    else {
      const [a, b] = held.values(), now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
      if (apart) worker.postMessage({ zoom: apart / now });
      apart = now;
    }
  };
  canvas.addEventListener("wheel", event => { event.preventDefault(); worker.postMessage({ zoom: Math.exp(event.deltaY / 600) }); }, { passive: false });
  canvas.addEventListener("keydown", event => {
    const turn = { ArrowLeft: [-24, 0], ArrowRight: [24, 0], ArrowUp: [0, -24], ArrowDown: [0, 24] }[event.key];
    const zoom = { "+": 0.87, "-": 1.15 }[event.key];
    if (turn) { event.preventDefault(); worker.postMessage({ turn }); }
    if (zoom) worker.postMessage({ zoom });
  });
  return worker;
}

// buttons that are seldom needed stand with the others on a wide screen, and scroll with the rest on a narrow one
const wide = matchMedia("(min-width: 1001px) and (min-height: 660px) and (min-aspect-ratio: 1/1)");
wide.onchange = () => (wide.matches ? $("actions").insertBefore($("tools"), $("answer")) : $("work").append($("tools")));
wide.onchange();
const phone = matchMedia("(max-width: 600px)");  // there is no room on the machine's picture
phone.onchange = () => (phone.matches ? $("tools") : $("view")).append($("along"));
phone.onchange();
$("button").hidden = !setup.button;
speak();
if (!token) answer("refused token");
setInterval(() => { if (performance.now() - came > 150) draw(); }, 100);  // ages grow even when nothing comes
scene = startScene();
if (token && setup.extensions.includes("/video")) {
  const { Video } = await import("./video.js");
  measured.video = video = new Video($("view"), token, key => say(key));
}
for (const [name, act] of Object.entries(tools)) choose(name, chosenBefore(name, name === "sound"), act);
