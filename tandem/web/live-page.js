// The page: what comes over the socket, in plots, figures, processes and events.

const $ = (id) => document.getElementById(id);
const SERIES = ["plant/state", "controller/result", "controller/tick", "controller/timing", "targets", "bounds"];
const HEALTH = /^(router|plant|controller|trainer|recorder)\/health$/;
const VIEW = "view/";
const SILENT_S = 2;
const EVENTS = 200;
const LEVELS = {2: "note", 3: "warning", 4: "error", 5: "error"};

const streams = Object.fromEntries(["state", "result", "targets", "timing"].map((name) => [name, new Stream()]));
const shared = {marks: [], pause: () => setPaused(true)};
const latest = {};          // newest message of each channel, by its topic below view/
const schemas = {};
const health = new Map();   // by process: {message, at}
const runs = {};            // by topic: the run that is followed, and when it spoke last
const plots = [];
let metadata = {}, connected = false, paused = false, fit = false;
let newest = null, arrived = 0, built = "", ticks = [];

const link = new Socket(`ws://${location.host}/`, wanted, {
  info: (info) => { metadata = info.metadata ?? {}; showTitle(info.name); },
  channel: (channel) => { schemas[below(channel)] = channel.schema; build(); },
  message: take,
  link: (up) => { connected = up; showLink(); },
});

function below({topic}) { return topic.startsWith(VIEW) ? topic.slice(VIEW.length) : topic; }

function wanted(channel) {
  const name = below(channel);
  return SERIES.includes(name) || HEALTH.test(name) || channel.schemaName === "foxglove.Log";
}

// -- messages ----------------------------------------------------------

function take(channel, t, message) {
  const name = below(channel);
  if (channel.schemaName === "foxglove.Log") { addEvent(message); return; }
  if (newest === null || t > newest || t < newest - CLOCK_SET_S) { newest = t; arrived = performance.now() / 1000; }
  if (HEALTH.test(name)) { health.set(message.process, {message, at: t}); return; }
  if (!follow(name, t, message.run_id)) return;
  latest[name] = message;
  if (name === "plant/state") streams.state.push(t, {...under("x", message.x), ...under("applied", message.applied)});
  if (name === "controller/timing") {
    streams.timing.push(t, {solve: message.solve_ms, tick: message.tick_ms, lateness: message.lateness_ms});
  }
  if (name === "targets") streams.targets.push(t, {...under("x", message.x), ...under("u", message.u)});
  if (name === "controller/tick") countTick(t, message);
  if (name === "controller/result") {
    const {u, h, h_hat, set_margin: margin, prediction_error: error} = message;
    streams.result.push(t, {...under("u", u), ...under("h", h), ...under("h_hat", h_hat), margin, error});
    if (margin !== undefined && !("margin" in shared)) { shared.margin = true; build(); }
  }
}

const under = (name, values) =>
  Object.fromEntries(Object.entries(values ?? {}).map(([key, value]) => [`${name}.${key}`, value]));

// As all of Tandem does: one run is followed, and another one only after a silence.
function follow(name, t, run) {
  if (run === undefined) return true;
  const known = runs[name];
  if (known && known.run !== run && Math.abs(t - known.t) < 1) return false;
  if (known && known.run !== run && ["plant/state", "controller/result"].includes(name)) {
    shared.marks.push({t, text: `${name.split("/")[0]} restarted`});
  }
  runs[name] = {run, t};
  return true;
}

function countTick(t, {seq, slot}) {
  if (ticks.length && seq < ticks[ticks.length - 1].seq) ticks = [];
  ticks.push({t, seq, slot});
  while (ticks[0].t < t - 5 && ticks.length > 2) ticks.shift();
}

// -- plots ---------------------------------------------------------------

function entries(topic, field) { return schemas[topic]?.properties?.[field]?.properties ?? {}; }

// The plots of these names, made anew only when the names are others.
function build() {
  const states = entries("plant/state", "x"), inputs = entries("controller/result", "u");
  const key = JSON.stringify([states, inputs, Boolean(shared.margin)]);
  if (!Object.keys(states).length || !Object.keys(inputs).length || key === built) return;
  built = key;
  plots.forEach(({u}) => u.destroy());
  plots.length = 0;
  $("plots").replaceChildren();
  const {state, result, targets, timing} = streams;
  const add = (what) => plots.push(new Plot($("plots"), what, shared));
  const bounds = (low, high, name) => () =>
    [latest.bounds?.[low]?.[name] ?? null, latest.bounds?.[high]?.[name] ?? null];
  // A description may end with the unit in brackets, which the axis has, and with the name, which is the title.
  const about = (name, {description = "", unit = ""}) => {
    const words = description.replace(/\s*\[[^\]]*\]$/, "");
    return {meaning: words.endsWith(` ${name}`) ? words.slice(0, -name.length - 1) : words, unit};
  };
  const target = {stream: targets, label: "target", color: "target", dash: [6, 4], step: true, width: 1};
  for (const [name, leaf] of Object.entries(states)) {
    add({title: name, ...about(name, leaf), bounds: bounds("x_min", "x_max", name), series: [
      {...target, column: `x.${name}`},
      {stream: state, column: `x.${name}`, label: "measured", color: "measured"}]});
  }
  for (const [name, leaf] of Object.entries(inputs)) {
    add({title: name, ...about(name, leaf), bounds: bounds("u_min", "u_max", name), series: [
      {...target, column: `u.${name}`},
      {stream: result, column: `u.${name}`, label: "command", color: "other", step: true},
      {stream: state, column: `applied.${name}`, label: "applied", color: "measured"}]});
  }
  if (shared.margin) {
    add({title: "margin", meaning: "to the certified sets, in half-widths", bounds: () => [0, null], series: [
      {stream: result, column: "margin", label: "margin", color: "measured"}]});
  }
  const period = 1000 / Number(metadata.rate);
  const late = () => [null, isNear(period) ? period : null];
  const meaning = "how long it takes, and how late it starts";
  add({title: "tick", meaning, unit: "ms", zero: true, bounds: late, series: [
    {stream: timing, column: "lateness", label: "lateness", color: "target"},
    {stream: timing, column: "solve", label: "solver", color: "other"},
    {stream: timing, column: "tick", label: "tick", color: "measured"}]});
  for (const [name, leaf] of Object.entries(entries("controller/result", "h"))) {
    add({title: `h, ${name}`, meaning: "model error, and what the oracle expects", unit: leaf.unit,
      bounds: bounds("h_min", "h_max", name), series: [
        {stream: result, column: `h_hat.${name}`, label: "ĥ", color: "other"},
        {stream: result, column: `h.${name}`, label: "h", color: "measured"}]});
  }
}

// The period is a bound of what a tick may take, shown where a tick comes near it.
function isNear(period) {
  const {timing} = streams;
  const recent = timing.columns.get("tick")?.slice(-100) ?? [];
  return period > 0 && Math.max(0, ...recent) > 0.2 * period;
}

const shownSeconds = () => Math.max(WINDOW_S, WINDOW_SAMPLES * (streams.state.interval ?? 0));

let drawn = 0;
function frame() {
  const begun = performance.now();
  // Slow drawing is done less often, and a hidden page is not drawn.
  if (begun >= drawn && newest !== null && !document.hidden && !paused) {
    const time = newest + Math.min(1, begun / 1000 - arrived);
    for (const plot of plots) if (plot.visible) plot.draw(time - shownSeconds(), time, fit);
    drawn = begun + Math.max(50, 4 * (performance.now() - begun));
  }
  requestAnimationFrame(frame);
}

function setPaused(value) {
  paused = value;
  $("pause").setAttribute("aria-pressed", value);
  $("pause").textContent = value ? "Resume" : "Pause";
}

// -- words ---------------------------------------------------------------

function element(name, text, className) {
  const made = document.createElement(name);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

function showTitle(name) {
  $("plant").textContent = metadata.plant ?? name;
  document.title = `${metadata.plant ?? name} – Tandem`;
  showAbout();
}

function showAbout() {
  const {model, oracle, rate} = metadata;
  const run = runs["controller/result"]?.run;
  const facts = [model, oracle, rate && `${rate} Hz`, run && `run ${run.replace(/^controller-/, "")}`];
  $("about").textContent = facts.filter(Boolean).join(" · ");
}

function showLink() {
  const fresh = newest !== null && performance.now() / 1000 - arrived < SILENT_S;
  $("link").className = `state ${!connected ? "bad" : fresh ? "good" : "wait"}`;
  $("link").textContent = !connected ? "no server" : fresh ? (paused ? "paused" : "live") : "nothing is published";
}

const ORDER = ["router", "plant", "controller", "trainer", "recorder"];
const CALM = ["ready", "running"];
function showProcesses() {
  const names = Object.keys(schemas).filter((name) => HEALTH.test(name)).map((name) => name.split("/")[0]);
  names.sort((a, b) => ORDER.indexOf(a) - ORDER.indexOf(b));
  const rows = names.map((name) => {
    const known = health.get(name);
    const now = newest + Math.max(0, performance.now() / 1000 - arrived);
    const silent = known && now - known.at > SILENT_S;
    const status = !known ? "no message" : silent ? "silent" : known.message.status;
    const tone = CALM.includes(status) ? "good" : status === "failed" ? "bad" : known ? "wait" : "";
    const row = element("li", undefined, `state ${tone}`);
    row.append(element("b", name), ` ${status}`);
    const note = known?.message.note;
    if (note && !CALM.includes(status)) row.append(element("span", `: ${note}`, "note"));
    const counters = Object.entries(known?.message.counters ?? {}).map(([key, count]) => `${key}: ${count}`);
    row.title = [note, ...counters].filter(Boolean).join("\n");
    return row;
  });
  $("processes").replaceChildren(...rows);
}

function percentile(values, share) {
  const known = values.filter((value) => value != null).sort((a, b) => a - b);
  return known.length ? known[Math.min(known.length - 1, Math.floor(share * known.length))] : null;
}

const ms = (value) => (value === null ? "–" : value.toFixed(value < 10 ? 2 : 1));
function spread(column) {
  const {timing} = streams;
  const values = timing.columns.get(column)?.slice(timing.after((timing.newest ?? 0) - WINDOW_S)) ?? [];
  return [ms(percentile(values, 0.5)), ` p99 ${ms(percentile(values, 0.99))} ms`];
}

function figures() {
  const {["controller/result"]: result, ["controller/tick"]: tick, ["plant/state"]: state} = latest;
  const counters = health.get("controller")?.message.counters ?? {};
  const counted = (name) => counters[name] ?? counters[name.replaceAll("_", " ")] ?? 0;
  const late = counted("late_ticks"), skipped = counted("skipped_slots");
  const first = ticks[0], last = ticks[ticks.length - 1];
  const rate = ticks.length > 1 && last.t > first.t ? (last.seq - first.seq) / (last.t - first.t) : null;
  const shown = [["Tick", tick ? String(tick.seq) : "–", rate === null ? "" : ` ${rate.toPrecision(3)} Hz`]];
  for (const [title, column] of [["Tick takes", "tick"], ["Solver takes", "solve"], ["Lateness", "lateness"]]) {
    shown.push([title, ...spread(column)]);
  }
  shown.push(["Late, skipped", `${late}, ${skipped}`, "", late || skipped ? "warn-text" : ""]);
  const tone = (bad) => (bad ? "bad-text" : "");
  shown.push(["Command from", result?.mode.replaceAll("_", " ") ?? "–", "", tone(result && result.mode !== "solver")]);
  shown.push(["Input from", state?.source ?? "–", "", tone(["safe", "plan"].includes(state?.source))]);
  const margin = result?.set_margin;
  if (margin !== undefined) shown.push(["Margin", short(margin), "", tone(margin < 0)]);
  shown.push(["Prediction error", short(result?.prediction_error)]);
  if (result) shown.push(["Weights", result.hidden_version < 0 ? "initial" : `version ${result.hidden_version}`]);
  if (result?.slack > 1e-6) shown.push(["Slack", short(result.slack), ` ${result.slack_row}`, "warn-text"]);
  return shown;
}

function showFigures() {
  $("figures").replaceChildren(...figures().map(([name, value, beside, className]) => {
    const box = element("div");
    const dd = element("dd", value, className);
    if (beside) dd.append(element("small", beside));
    box.append(element("dt", name), dd);
    return box;
  }));
}

const seen = new Set();
function addEvent({timestamp, level, message, name}) {
  const t = timestamp.sec + timestamp.nsec * 1e-9;
  // After the link was lost the server sends its latest events again.
  const key = `${timestamp.sec}.${timestamp.nsec} ${name} ${message}`;
  if (level < 2 || seen.has(key)) return;
  seen.add(key);
  const row = element("li", undefined, `level-${level}`);
  row.append(element("time", `${clock(t)} ${name}`), message);
  if (LEVELS[level]) row.title = LEVELS[level];
  const list = $("events");
  list.prepend(row);
  while (list.children.length > EVENTS) list.lastChild.remove();
}

$("pause").onclick = () => setPaused(!paused);
$("fit").onclick = () => { fit = !fit; $("fit").setAttribute("aria-pressed", fit); };
$("plots").ondblclick = () => setPaused(false);
// The legends have colours of their own.
matchMedia("(prefers-color-scheme: dark)").onchange = () => { built = ""; build(); };

setInterval(() => {
  showLink();
  showProcesses();
  if (!paused) { showFigures(); showAbout(); }
  if (newest !== null) {
    const before = newest - Math.max(paused ? PAUSED_KEPT_S : KEPT_S, 2 * shownSeconds());
    Object.values(streams).forEach((stream) => stream.trim(before));
    shared.marks = shared.marks.filter((mark) => mark.t > before);
  }
  if (seen.size > 10 * EVENTS) seen.clear();
}, 250);
requestAnimationFrame(frame);
