// The study's pages over the operator's page: what comes next in a sitting in, what a person answers out. Nothing is kept here: the
// server says where things stand, so a page that was closed, or another one, goes on at the same place.
import { Socket } from "./socket.js";
import { scales, words } from "./study_words.js";

const token = new URLSearchParams(location.hash.slice(1)).get("token") ?? sessionStorage.getItem("token");
const root = document.createElement("section");
root.id = "study";
root.tabIndex = -1;
document.body.append(root);
document.body.classList.add("study");

const BAR = ["starting", "countdown", "running", "settling"];  // the operator's page is seen then
const SURE_MS = 4000;
let study = null, drawn = "", primary = null, sure = 0, refused = "";
let language = "en", say = words(language);

const socket = token ? new Socket("/study", {
  opened: one => one.send(JSON.stringify({ token })),
  heard: text => {
    const said = JSON.parse(text);
    if (said.ready) return;
    refused = said.refused ?? refused;
    if ("refused" in said && !said.refused) refused = "";
    study = said.study;
    hold();
    draw();
  },
  closed: event => { if (event.reason === "token") { socket.end(); study = { kind: "locked" }; draw(); } else root.classList.add("lost"); },
}) : null;

// keys come faster than answers: what was rated here counts until the server says the same
let rated = null;
function hold() {
  const screen = rated !== null && study.kind === "questionnaire" && rated.scale === study.scales[study.at];
  if (!screen || study.ratings[rated.scale] === rated.value) rated = null;
  else study.ratings = { ...study.ratings, [rated.scale]: rated.value };
}

function rateAs(scale, value) {
  rated = { scale, value };
  hold();
  tell("rate", rated);
  draw();
}

const tell = (what, more = {}) => socket?.send(JSON.stringify({ do: what, ...more }));

function element(tag, text = "", kind = "") {
  const node = document.createElement(tag);
  node.textContent = text;
  if (kind) node.className = kind;
  return node;
}

function button(text, act, kind = "") {
  const node = element("button", text, kind);
  node.type = "button";
  node.onclick = act;
  if (kind.includes("primary")) primary = node;
  return node;
}

function row(kind, ...nodes) {
  const node = element("div", "", kind);
  node.append(...nodes);
  return node;
}

// ---- screens
const screens = {
  locked: () => [element("h1", say("locked"))],
  choose: () => [element("h1", say("choose")), row("people", ...study.participants.map(one => {
    const made = button(one.name, () => tell("choose", { who: one.name }), one.state);
    made.append(element("small", `${say(`state ${one.state}`)} ${one.done}/${one.of}`));
    made.disabled = one.state === "erased";
    return made;
  }))],
  consent: () => [
    element("h1", say("consent")), ...(study.text[language] ?? study.text.en).map(text => element("p", text)),
    row("answers", button(say("decline"), () => tell("consent", { agreed: false, language })), button(say("agree"), () => tell("consent", { agreed: true, language }), "primary")),
  ],
  trial: () => study.phase === "over" ? over() : ready(),
  questionnaire: () => study.at < study.scales.length ? rate() : review(),
  done: () => [element("h1", say("done")), element("p", say("thanks")), row("answers", button(say("list"), () => tell("leave"), "primary"))],
  stopped: () => [
    element("h1", say("stopped")), element("p", say("kept")),
    row("answers", button(say("go on"), () => tell("go_on")), button(say("list"), () => tell("leave"), "primary")),
  ],
};

function where() {
  const part = study.period ? `${say("period")} ${study.period}` : say("practice");
  return `${study.who} · ${part} · ${say("trial")} ${study.done + 1}/${study.of}`;
}

function ready() {
  const begin = button(say("begin"), () => tell("begin"), "primary");
  begin.id = "begin";
  const more = study.period ? [] : [button(say("end practice"), () => tell("end_practice"))];
  return [
    element("h2", where()), element("h1", say(study.condition), study.condition), element("p", say(`task ${study.condition}`)),
    element("p", `${say("hole")} ${study.hole}, ${say("start")} ${study.start}`), element("p", say("drive")), row("joints"),
    element("p", "", "waiting"), row("answers", ...more, begin),
  ];
}

function over() {
  const took = study.outcome === "inserted" ? `: ${study.seconds.toFixed(1)} s` : "";
  const again = study.outcome === "aborted" ? [element("p", `${say("again")} (${study.reason})`)] : [];
  return [element("h2", where()), element("h1", say(`outcome ${study.outcome}`) + took), ...again, row("answers", button(say("next"), () => tell("next"), "primary"))];
}

const go = to => tell("to", { to });
const back = () => button(say("back"), () => go(study.at - 1), "back");

function rate() {
  const scale = study.scales[study.at], [title, question, low, high] = scales(language)[scale];
  const cells = row("scale");
  cells.setAttribute("role", "radiogroup");
  cells.setAttribute("aria-label", title);
  for (let value = 0; value <= 100; value += study.step) {
    const cell = button(value % 25 ? "" : value, () => rateAs(scale, value));
    cell.setAttribute("role", "radio");
    cell.setAttribute("aria-checked", study.ratings[scale] === value);
    cell.setAttribute("aria-label", `${title} ${value}`);
    cell.dataset.value = value;
    cell.tabIndex = value === (study.ratings[scale] ?? 50) ? 0 : -1;
    cells.append(cell);
  }
  const answered = study.ratings[scale] !== undefined;
  const next = button(say(answered ? "next" : "skip"), () => go(study.at + 1), answered ? "primary" : "");
  return [
    element("h2", `${study.at + 1}/${study.scales.length} · ${say("period")} ${study.period}, ${say(study.condition)}`), element("h1", title),
    element("p", question), cells, row("ends", element("span", `◀ ${low}`), element("span", `${high} ▶`)),
    row("answers", ...(study.at ? [back()] : []), next),
  ];
}

function review() {
  const lacking = study.missing.length;
  const text = lacking ? `${lacking} ${say("missing")}` : say("complete");
  const first = lacking ? [button(say("to missing"), () => go(study.missing[0]), "primary")] : [];
  return [element("h1", text), row("answers", back(), ...first, button(say(lacking ? "finish half" : "finish"), () => tell("finish"), lacking ? "" : "primary"))];
}

// ---- the bar in a trial
function bar() {
  const stop = button(say("end trial"), () => tell("stop_trial")), fault = button(say("fault"), () => tell("abort"), "small");
  return [element("b", `${say(study.condition)} · ${where()}`), element("output"), ...(study.phase === "running" ? [stop, fault] : study.phase === "settling" ? [] : [fault])];
}

function draw() {
  root.classList.remove("lost");
  if (!study) return;
  const small = study.kind === "trial" && BAR.includes(study.phase);
  const { joints, left_s, seconds, advised, ...steady } = study;
  const key = JSON.stringify([steady, language, study.phase === "over" ? seconds : 0]);
  root.className = small ? "bar" : "full";
  if (key !== drawn) {
    drawn = key;
    primary = null;
    sure = 0;
    const made = small ? bar() : [row("screen", ...screens[study.kind]()), footer()];
    root.replaceChildren(...made);
    root.dataset.kind = study.kind;
    root.dataset.phase = study.phase ?? "";
    if (!small) root.focus();
  }
  if (study.kind === "trial") moving();
  const problem = root.querySelector(".problem");
  if (problem) problem.textContent = [study.problem, refused && say(`refused ${refused}`)].filter(Boolean).join(" · ");
}

function moving() {
  const output = root.querySelector("output"), list = root.querySelector(".joints"), waiting = root.querySelector(".waiting");
  const texts = { countdown: Math.ceil(study.left_s), running: `${Math.ceil(study.left_s)} s`, starting: say("starting"), settling: say("saving") };
  if (output) output.textContent = texts[study.phase] ?? "";
  if (!list) return;
  list.replaceChildren(...study.joints.map(one => element("span", `${one.joint} ${one.there ? "✓" : `${one.away > 0 ? "+" : ""}${one.away.toFixed(2)}`}`, one.there ? "there" : "away")));
  const known = study.joints.length > 0, there = known && study.joints.every(one => one.there);
  const unsaid = study.condition === "guided" && study.advised !== "valid" ? `${say("no advice")}: ${study.advised}` : "";
  waiting.textContent = !known ? say("no positions") : !there ? say("not there") : unsaid;
  document.getElementById("begin").disabled = !known;
}

function footer() {
  const nodes = [element("p", "", "problem")];
  nodes[0].setAttribute("role", "alert");
  if (["consent", "trial", "questionnaire"].includes(study.kind)) {
    const stop = button(say("stop taking part"), () => {
      if (performance.now() - sure < SURE_MS && sure) tell("stop_sitting", { reason: "" });
      else { sure = performance.now(); stop.textContent = say("really stop"); }
    }, "leave");
    nodes.push(stop, button(say("list"), () => tell("leave"), "list"));
  }
  const other = button(language === "en" ? "DE" : "EN", () => document.getElementById("language").click(), "language");
  other.setAttribute("aria-label", language === "en" ? "Deutsch" : "English");
  return row("foot", ...nodes, other);
}

// ---- keys: what the operator's page would take is kept from it while a screen covers it; Escape always stops
addEventListener("keydown", event => {
  if (!root.classList.contains("full") || event.key === "Escape" || event.ctrlKey || event.altKey || event.metaKey) return;
  event.stopPropagation();
  const way = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
  const rating = study?.kind === "questionnaire" && study.at < study.scales.length;
  if (rating && (way || event.key === "Home" || event.key === "End")) {
    event.preventDefault();
    const scale = study.scales[study.at], now = study.ratings[scale];
    const value = event.key === "Home" ? 0 : event.key === "End" ? 100 : now === undefined ? 50 : Math.min(100, Math.max(0, now + way * study.step));
    rateAs(scale, value);
  } else if (event.key === "Backspace") root.querySelector(".back")?.click();
  else if (event.key === "Enter" && !event.repeat && !document.activeElement?.closest("#study button")) { event.preventDefault(); primary?.click(); }
}, true);

function speak() {
  language = document.documentElement.lang === "de" ? "de" : "en";
  say = words(language);
  draw();
}
new MutationObserver(speak).observe(document.documentElement, { attributes: true, attributeFilter: ["lang"] });
speak();
if (!token) { study = { kind: "locked" }; draw(); }
window.sitting = () => study;
