// SPDX-License-Identifier: Apache-2.0
// The panel: takes snapshots of a run from the server and draws them; sends commands.
const $ = id => document.getElementById(id);
const HAVE = { number: 0, run: 0, epoch: 0, rows: 0, log: 0, latest: 0 }; // see Have in panel_view.py
const SHOWN = { now: {}, rows: [], open: null, latest: [], log: [], shape: null, ranges: {}, at: null };
let ABOUT = { tolerance: 0, gaps: [], rpm: 0, force: 0, nodes: [], can: [], name: "" }, version = -1;
const WATERFALL = 12, MOST_LOG = 300, MOST_KEPT = 8192, MM = 105 / 50; // [px/mm]: the drawn radius of 50 mm
const COLOURS = { nominal: "#2e7d4f", degraded: "#b8860b", retracting: "#d2622a", safe: "#b3262e" }; // as in Rerun
const LATE = "#8a8a8a", OUT_OF_ORDER = ["degraded", "retracting", "safe"];
const SAID = { safe: "safe (feeds stopped, tool out of the part)" };
const DOES = { freeze: "stops learning, keeps what is learned", learn: "learns on", clear: "forgets what is learned" }; // tool tips
const style = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const can = what => ABOUT.can.includes(what);
const cannot = () => ABOUT.cannot || {}; // why a button is of no use
const escaped = text => String(text).replace(/[&<>"]/g, letter => `&#${letter.charCodeAt(0)};`);
const digits = (value, count = 4) => Number.isFinite(value) ? String(Number(value.toPrecision(count))).replace("-", "−") : "–";
const newton = (force, count) => digits(Math.abs(force) < 1e-3 ? 0 : force, count);
const nice = value => { // the next 1, 2 or 5 times a power of ten
  const decade = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].map(step => step * decade).find(step => step >= value * 0.9999);
};
const seen = (name, value, least) => { // the largest magnitude so far, for scales that do not jump
  return SHOWN.ranges[name] = Math.max(SHOWN.ranges[name] || least, Math.abs(value) || 0);
};

// ---- snapshots -----------------------------------------------------------------------------------------------------

function merge(told) {
  if (told.run != HAVE.run) {
    Object.assign(SHOWN, { rows: [], latest: [], log: [], shape: null, ranges: {}, at: null });
    $("shown").hidden = true;
    openCauses(false);
    HAVE.epoch = told.epoch;
  }
  for (; HAVE.epoch < told.epoch; HAVE.epoch++) SHOWN.rows = SHOWN.rows.flatMap((row, k) => k % 2 ? [joined(SHOWN.rows[k - 1], row)] : []);
  SHOWN.now = told.now;
  SHOWN.open = told.open;
  SHOWN.rows.push(...told.rows);
  SHOWN.latest = [...SHOWN.latest, ...told.latest].slice(-WATERFALL);
  if (told.log.length) SHOWN.log = [...SHOWN.log, ...told.log].slice(-MOST_KEPT);
  SHOWN.shape = told.shape || SHOWN.shape;
  const changed = told.run != HAVE.run || told.rows.length || told.latest.length;
  Object.assign(HAVE, { number: told.number, run: told.run, rows: SHOWN.rows.length, log: told.logged });
  HAVE.latest = SHOWN.latest.length ? SHOWN.latest[SHOWN.latest.length - 1].revolution : 0;
  return changed;
}

function joined(one, other) { // as Row.merged in panel_view.py
  const cells = one.out != other.out ? (one.out ? other : one).cells : one.cells.map((um, k) => Math.abs(other.cells[k]) > Math.abs(um) ? other.cells[k] : um);
  return { ...other, since: one.since, cells, out: one.out && other.out };
}

async function follow() {
  for (;;) {
    if (document.hidden) await new Promise(done => document.addEventListener("visibilitychange", done, { once: true }));
    try {
      const asked = performance.now(), told = await ask("frame", HAVE);
      heard = asked;
      if (told.now.version !== version) {
        ABOUT = await ask("about");
        version = told.now.version;
        describe();
      }
      const changed = merge(told);
      // The next snapshot is asked for once this one is drawn: a slow browser asks less often.
      await new Promise(done => requestAnimationFrame(() => { draw(changed); done(); }));
      trouble("");
      if (told.more) HAVE.number = 0;
    } catch (error) {
      trouble(error instanceof TypeError ? "no answer: has lathe panel ended?" : error.message);
      await new Promise(done => setTimeout(done, 1000));
    }
  }
}

function trouble(text) {
  if (!text) text = SHOWN.now.failure || "";
  $("trouble").textContent = text;
  $("trouble").hidden = !text;
}

let changedSince = false, drawnAt = 0;
const CALM = 1000; // [ms] between drawings of revolutions, which take the browser longest
function draw(changed, moving = true) {
  const now = SHOWN.now, revolution = (now.angle || 0) / (2 * Math.PI);
  $("state").textContent = `${now.state}, revolution ${revolution.toFixed(2)}${ABOUT.revolutions ? ` of ${digits(ABOUT.revolutions, 6)}` : ""}, ${(now.time || 0).toFixed(3)} s, sample ${now.sample || 0}` + (now.samples ? ` of ${now.samples}` : "")
    + (now.factor ? `, ${digits(now.factor, 2)} × real time` : "") + (now.bag ? `, recording ${now.bag}` : "");
  $("go").textContent = now.state == "running" ? "pause" : "start";
  for (const id of ["go", "step"]) $(id).disabled = id in cannot() || ["ended", "failed"].includes(now.state) && can("change");
  if (document.activeElement != $("pace")) $("pace").value = String(now.pace);
  $("record").querySelector("button").textContent = now.bag ? "end the recording" : "record from here on";
  $("again").textContent = (now.begun ? `from a checkpoint at sample ${now.begun}: ` : "") + (now.events || "no events or changed parameters yet");
  drawHeader(now);
  for (const id of ["limits", "loops"]) $(id).textContent = (now[id] || []).join("\n");
  for (const place of document.querySelectorAll("[data-learning]")) {
    const found = JSON.parse(place.dataset.learning).map(topic => (now.learning || {})[topic]).filter(value => value !== undefined);
    place.textContent = [...new Set(found)].map(value => value ? "learning" : "frozen").join(", ");
  }
  drawMachine(now);
  drawDials(now);
  changedSince ||= changed;
  if (ABOUT.part && changedSince && (!moving || performance.now() - drawnAt > CALM)) {
    drawMap(); drawWaterfall();
    [changedSince, drawnAt] = [false, performance.now()];
  }
  followTimeline(now, moving);
  drawLog();
}

// ---- header: state, verdict and age, at every width and scroll -------------------------------------------------------

// The newest answer is at least as new as its question, however slow the link: its age counts from there.
const SILENT = 5, BEHIND = 1, STILL = 3; // [s] from which on values are old
let heard = performance.now();

function ages({ age, safety, state, live }) { // what is old, and why, in words
  const silent = (performance.now() - heard) / 1000, lost = silent > SILENT, still = state == "running" && age && age.still + silent > STILL;
  const behind = live && age && (age.behind === null || age.behind > BEHIND);
  const words = lost ? `lathe panel was not heard for ${Math.round(silent)} s: everything below is old`
    : !age || state == "waiting" ? "no run heard yet" : age.behind === null ? "shows an earlier run; another one has begun"
    : behind ? `shows the run as it was ${digits(age.behind, 3)} s before its newest sample`
    : still ? `no new sample for ${Math.round(age.still + silent)} s` : "up to date";
  const heardOf = safety ? safety.age + silent : 0; // the supervisor, at the end of the link [s]
  return { lost, words, heardOf, samples: lost || behind || live && still, safety: lost || safety && (safety.late || live && safety.state != "unknown" && heardOf > STILL) };
}

function drawHeader(now) {
  const { safety, part, failure } = now, old = ages(now), unknown = !safety || safety.state == "unknown";
  document.body.classList.toggle("lost", Boolean(old.samples));
  $("age").textContent = old.words;
  $("age").className = old.samples ? "age late" : "age";
  $("lamp").style.background = old.safety ? LATE : failure ? COLOURS.safe : unknown ? "none" : COLOURS[safety.state] || "none";
  const since = safety && safety.cause ? ` since ${(safety.since * (ABOUT.step || 0)).toFixed(3)} s` : "";
  const told = !safety ? "no supervisor" : unknown ? "unknown: the supervisor was not heard yet"
    : old.safety ? safety.state : (SAID[safety.state] || safety.state) + since;
  $("safety").textContent = told + (old.lost ? ", no answer from lathe panel" : old.safety ? `, last heard ${Math.round(old.heardOf)} s ago` : "");
  $("safety").parentNode.classList.toggle("old", Boolean(old.safety));
  $("alarm").textContent = !safety ? "" : safety.cause || (OUT_OF_ORDER.includes(safety.state) ? "(cause not heard)" : "");
  $("verdict").textContent = part ? part.title + (old.samples ? " (old)" : "") : "";
  $("ground").textContent = part ? part.text : "";
  $("part").className = `part ${old.samples ? "old" : part ? part.mood : ""}`;
  const { retract, reset } = now.next || {};
  const next = [reset && reset.due ? reset.text : "", now.advice].filter(Boolean);
  $("next").textContent = can("command") && next.length ? `next: ${next.join("; ")}` : "";
  for (const [id, step] of [["retract", retract], ["reset", reset]]) {
    $(id).disabled = Boolean(step) && !step.allowed && !old.safety;
    $(id).title = step ? step.text : "";
  }
  offerRepair(now.faults || []);
  $("in-force").textContent = (now.faults || []).map(fault => `fault in force: ${fault}`).join("\n");
  $("newest").textContent = safety && safety.alarm ? `newest: ${safety.alarm}` : "";
}
setInterval(() => { if (performance.now() - heard > 1000) drawHeader(SHOWN.now); }, 250);
document.addEventListener("visibilitychange", () => drawHeader(SHOWN.now)); // a hidden page asks for nothing

let logged = 0, loggedOf = "";
function drawLog() { // up to the instant that is shown
  const { at } = SHOWN, of = `${HAVE.run} ${at ? at.sample : ""}`, lines = at ? SHOWN.log.filter(line => line.sample < at.sample) : SHOWN.log;
  if (loggedOf != of) { $("log").replaceChildren(); logged = 0; loggedOf = of; }
  const end = at ? lines.length : HAVE.log; // with those that are no longer kept
  for (const line of lines.slice(Math.max(lines.length - Math.min(end - logged, MOST_LOG), 0))) {
    const item = document.createElement("li"), time = document.createElement("time");
    time.textContent = `${(line.sample * (ABOUT.step || 0)).toFixed(3)} s`;
    item.append(time, `${line.source}: ${line.text}`);
    $("log").prepend(item);
  }
  logged = end;
  while ($("log").children.length > MOST_LOG) $("log").lastChild.remove();
  $("left-out").textContent = SHOWN.now.left_out || "";
}

addEventListener("load", follow);
