// SPDX-License-Identifier: Apache-2.0
// Timeline of the panel: bands of the smallest and largest values, marks, cursors; the server has the revolutions.
const TIME = { told: null, run: 0, sample: -1, range: null, cursors: [null, null], hover: null, drag: null, cells: 0, asked: 0, asking: false, again: false };
const ROWS = { alarm: 0, state: 0, fault: 1, lost: 1, command: 2, parameter: 2, limit: 2 }, ROW = 14; // of marks
const ROW_NAMES = ["supervisor", "faults, lost", "commands"];
const GLYPHS = { alarm: "▲", state: "■", fault: "✖", lost: "░", command: "●", parameter: "◆", limit: "▽" };
const STATES = ["nominal", "degraded", "retracting", "safe"]; // by number
const LANE = 52, TITLE = 14, LEFT = 74, RIGHT = 12, TOP = 4, AXIS = 18, NEAR = 6, CALM_TIMELINE = 2000;
const LANES = { // heading, unit and limits of the scale, given the extremes; the other lanes are drives
  error: { title: "form error (below 0: material left)", unit: "µm" },
  force: { title: "force, measured", unit: "N", ends: (low, high) => [Math.min(0, low), Math.max(ABOUT.force || 0, ABOUT.force_limit || 0, high, 0) * 1.05 || 1] },
  speed: { title: "speed", unit: "1/min", ends: (low, high) => { const more = Math.max((high - low) / 8, high * 0.002); return [low - more, high + more]; } },
};
const laneOf = name => LANES[name] || { title: name.replace("following", "following error of"), unit: "µm", ends: (low, high) => { const end = Math.max(-low, high) || 1; return [-end, end]; } };
const lanes = () => TIME.told ? Object.keys(TIME.told.bands).filter(name => !["sample", "state", "out"].includes(name)) : []; // out: drawn with the error
const place = () => $("timeline").clientWidth - LEFT - RIGHT;
const wantedCells = () => Math.max(16, Math.min(1024, Math.floor(place() / 2)));
function span() { // first and last angle in the drawing [revolution]
  const [first, last] = TIME.told ? TIME.told.whole : [0, 1], whole = [first, Math.max(Math.floor(last) + 1, first + 1)];
  return TIME.range || whole;
}
const atX = turn => { const [first, last] = span(); return LEFT + (turn - first) / (last - first) * place(); };
const atTurn = x => { const [first, last] = span(); return first + (x - LEFT) / place() * (last - first); };

async function loadTimeline() {
  if (TIME.asking) { TIME.again = true; return; }
  $("time").hidden = false; // has a width
  Object.assign(TIME, { asking: true, again: false, asked: performance.now(), cells: wantedCells() });
  try {
    const [first, last] = TIME.range || [null, null], run = HAVE.run, sample = SHOWN.now.sample;
    const told = await ask("timeline", { first, last, cells: TIME.cells });
    Object.assign(TIME, { told, run, sample });
    drawTimeline();
  } catch { TIME.sample = -1; } // the header says that there is no answer
  TIME.asking = false;
  if (TIME.again) loadTimeline();
}
function followTimeline(now, moving) { // a bag is there as a whole; of a run that goes on, the newest revolutions are asked for
  if (TIME.run != HAVE.run && !can("seek")) Object.assign(TIME, { told: null, range: null, cursors: [null, null], sample: -1 });
  const grows = !can("seek") && now.sample != TIME.sample && (!TIME.range || !TIME.told || TIME.range[1] > TIME.told.whole[1]);
  const wider = TIME.told && !moving && wantedCells() != TIME.cells;
  if (!TIME.told || wider || grows && (performance.now() - TIME.asked > CALM_TIMELINE || now.state != "running")) loadTimeline();
  else if (can("seek") || !moving) drawTimeline();
}

// ---- drawing -------------------------------------------------------------------------------------------------------

function scaleOf(name, height) { // the place of a value in a lane, and the values beside it
  const { bands } = TIME.told, [lows, highs] = name == "error" && bands.error[0].every(low => low === null) ? bands.out : bands[name];
  const there = lows.map((_, k) => k).filter(k => lows[k] !== null);
  if (!there.length) return null;
  const [low, high] = there.reduce(([low, high], k) => [Math.min(low, lows[k]), Math.max(high, highs[k])], [Infinity, -Infinity]);
  if (name != "error") {
    const [least, most] = laneOf(name).ends(low, high);
    return { at: value => height * (most - value) / (most - least), ticks: [least, most] };
  }
  // Linear up to the tolerance, which has half of the height, and logarithmic beyond; without one, up to the quietest cells.
  const sizes = there.map(k => Math.max(-lows[k], highs[k])).filter(size => size > 0).sort((a, b) => a - b);
  const bend = ABOUT.tolerance || sizes[sizes.length >> 2] || 1, end = Math.max(-low, high, 2 * bend);
  const share = value => { const size = Math.abs(value); return Math.sign(value) * (size <= bend ? size / bend / 2 : Math.min(1, 0.5 + 0.5 * Math.log(size / bend) / Math.log(end / bend))); };
  return { at: value => height * (1 - share(value)) / 2, ticks: [-end, end] };
}

function drawTimeline() {
  const { told } = TIME, shown = lanes();
  $("time").hidden = !shown.length;
  if (!shown.length) return;
  const head = TOP + 3 * ROW + 4;
  $("timeline").setAttribute("data-height", head + shown.length * LANE + AXIS);
  const { pen, width, height, ink, soft, line, good, bad } = canvas("timeline");
  const right = width - RIGHT, edges = k => [k, k + 1].map(each => Math.round(Math.max(LEFT, Math.min(right, atX(told.first + each * told.every)))));
  const bar = (k, y, tall, colour) => { const [from, to] = edges(k); pen.fillStyle = colour; pen.fillRect(from, y, Math.max(to - from, 1), tall); };
  ROW_NAMES.forEach((name, row) => label(pen, name, LEFT - 6, TOP + (row + 1) * ROW - 3, soft, "right"));
  pen.globalAlpha = 0.55; // the worst state in each cell
  told.bands.state[1].forEach((state, k) => { if (state !== null) bar(k, TOP, ROW - 1, COLOURS[STATES[state]] || LATE); });
  pen.globalAlpha = 1;
  shown.forEach((name, lane) => drawLane(name, head + lane * LANE + TITLE));
  for (const mark of told.marks) {
    const x = atX(mark.turn);
    if (x < LEFT - 1 || x > right + 1) continue;
    label(pen, GLYPHS[mark.kind], x, TOP + (ROWS[mark.kind] + 1) * ROW - 3, ["alarm", "fault", "lost"].includes(mark.kind) ? bad : ink, "center");
  }
  const [first, last] = span(), step = nice(Math.max((last - first) / (width / 90), 1));
  for (let number = Math.ceil((first + 1) / step) * step; number <= last; number += step) label(pen, String(number), atX(number - 0.5), height - 4, soft, "center");
  label(pen, "revolution", 2, height - 4, soft);
  const upright = (turn, colour, dash) => { // lines of cursors and of the sample that is shown
    const x = atX(turn);
    if (x < LEFT - 1 || x > right + 1) return;
    Object.assign(pen, { strokeStyle: colour, lineWidth: 1.2 });
    pen.setLineDash(dash);
    pen.beginPath(); pen.moveTo(x, TOP); pen.lineTo(x, height - AXIS); pen.stroke();
    pen.setLineDash([]);
  };
  if (can("seek")) upright((SHOWN.now.angle || 0) / (2 * Math.PI), good, []);
  TIME.cursors.forEach((cell, k) => { if (cell) upright(cell.first + cell.every / 2, ink, k ? [5, 3] : []); });
  if (TIME.drag && TIME.drag.to !== null) { pen.globalAlpha = 0.25; pen.fillStyle = soft; pen.fillRect(TIME.drag.from, TOP, TIME.drag.to - TIME.drag.from, height - AXIS - TOP); pen.globalAlpha = 1; }
  read();

  function drawLane(name, top) {
    const tall = LANE - TITLE - 4, scale = scaleOf(name, tall), { title, unit } = laneOf(name);
    Object.assign(pen, { strokeStyle: line, lineWidth: 1 });
    pen.strokeRect(LEFT, top, right - LEFT, tall);
    const lines = [[ABOUT.force, ink, "dashed: set point"], [ABOUT.force_limit, bad, "red: limit"]].filter(([value]) => name == "force" && value);
    label(pen, [`${title} [${unit}]`, ...lines.map(([, , told]) => told)].join("; "), LEFT, top - 3, soft);
    if (!scale) return;
    const y = value => top + Math.max(0, Math.min(tall, scale.at(value)));
    const tolerance = name == "error" && ABOUT.tolerance;
    for (const [[lows, highs], colour] of name == "error" ? [[told.bands.out, LATE], [told.bands.error, good]] : [[told.bands[name], good]]) {
      lows.forEach((low, k) => {
        if (low === null) return; // a gap
        const [upper, lower] = [y(highs[k]), y(low)];
        bar(k, Math.min(upper, top + tall - 1.5), Math.max(lower - upper, 1.5), colour);
        if (!tolerance || colour == LATE) return;
        if (highs[k] > tolerance) bar(k, Math.min(upper, y(tolerance) - 3), Math.max(y(tolerance) - upper, 3), bad);
        if (low < -tolerance) bar(k, y(-tolerance), Math.max(lower - y(-tolerance), 3), bad);
      });
    }
    for (const [limit, colour] of tolerance ? [[-tolerance, ink], [tolerance, ink]] : lines) {
      Object.assign(pen, { strokeStyle: colour, lineWidth: 1 });
      pen.setLineDash([4, 4]);
      pen.beginPath(); pen.moveTo(LEFT, y(limit)); pen.lineTo(right, y(limit)); pen.stroke();
      pen.setLineDash([]);
    }
    label(pen, digits(scale.ticks[1], 3), LEFT - 6, top + 9, soft, "right");
    label(pen, digits(scale.ticks[0], 3), LEFT - 6, top + tall, soft, "right");
    if (tolerance) label(pen, `±${digits(tolerance, 3)}`, LEFT - 6, top + tall / 2 + 4, ink, "right");
  }
}

// ---- cursors -------------------------------------------------------------------------------------------------------

function cellAt(turn) { // the cell of an angle in the answer, with its values by lane (smallest and largest), or null
  const { told } = TIME, k = told ? Math.floor((turn - told.first) / told.every) : -1;
  if (!told || k < 0 || k >= told.bands.sample[0].length) return null;
  const [first, values] = [told.first + k * told.every, Object.entries(told.bands).map(([name, sides]) => [name, sides.map(side => side[k])])];
  return { first, every: told.every, open: first + told.every > told.whole[1], values: Object.fromEntries(values) };
}
const current = cell => { const now = cell && cellAt(cell.first); return now && now.every == cell.every ? now : cell; };
const numbered = ({ first, every, open }) => (every == 1 ? `revolution ${first + 1}` : `revolutions ${first + 1} to ${first + every}`) + (open ? " so far" : "");
const seconds = samples => (samples * (ABOUT.step || 0)).toFixed(3);
const received = values => values.sample && values.sample[0] !== null;
function inWords({ values, ...cell }) {
  return `${numbered(cell)}: ${received(values) ? lanes().map(name => `${laneOf(name).title} ${valueOf(values, name)} ${laneOf(name).unit}`).join("; ") : "not received"}`;
}
const both = values => values && values[0] !== null ? values.map(value => digits(Math.abs(value) < 1e-6 ? 0 : value)).join(" to ") : "–"; // not 1e-16 µm
const valueOf = (values, name) => name == "error" && values.error[0] === null && values.out[0] !== null ? "tool out of the part" : both(values[name]);
function marksAt(x) { // in words
  return TIME.told.marks.filter(mark => Math.abs(atX(mark.turn) - x) <= NEAR)
    .map(mark => `${GLYPHS[mark.kind]} ${seconds(mark.sample)} s ${mark.text}${mark.count > 1 ? ` (and ${mark.count - 1} more)` : ""}`);
}
function read() { // the cell under the pointer, else that of the first cursor, else the newest in sight; and that of the second
  const [one, other] = TIME.cursors, { first, every, bands, whole } = TIME.told, hover = TIME.hover === null ? null : cellAt(atTurn(TIME.hover));
  const cell = hover || current(one) || cellAt(can("seek") ? (SHOWN.now.angle || 0) / (2 * Math.PI) : whole[1]) || cellAt(first + every * (bands.sample[0].length - 1)), second = current(other);
  $("marks").textContent = cell ? marksAt(hover ? TIME.hover : atX(cell.first + cell.every / 2)).join("\n") : "";
  if (!cell) return;
  const [a, b] = [cell.values, second && second.values], known = b && received(a) && received(b);
  const change = name => known && a[name][0] !== null && b[name][0] !== null ? both(a[name].map((value, side) => b[name][side] - value)).replace(" to ", " and ") : "–";
  const rows = [
    ["", numbered(cell), ...(b ? [numbered(second), `difference: ${second.first - cell.first} revolutions`] : [])],
    ["time [s]", ...[a, ...(b ? [b] : [])].map(each => received(each) ? `${seconds(each.sample[0])} to ${seconds(each.sample[1] + 1)}` : "not received"), ...(b ? [known ? seconds(b.sample[0] - a.sample[0]) : "–"] : [])],
    ...lanes().map(name => [`${laneOf(name).title} [${laneOf(name).unit}]`, valueOf(a, name), ...(b ? [valueOf(b, name), change(name)] : [])]),
  ];
  $("reading").replaceChildren(...rows.map((row, k) => {
    const line = document.createElement("tr");
    line.append(...row.map((words, column) => Object.assign(document.createElement(k && column ? "td" : "th"), { textContent: words })));
    return line;
  }));
  const own = current(one) || cell, [least, newest] = whole;
  for (const [name, value] of [["valuenow", own.first + 1], ["valuemin", least + 1], ["valuemax", Math.floor(newest) + 1], ["valuetext", inWords(own)]]) $("timeline").setAttribute(`aria-${name}`, value);
}

// ---- an instant ----------------------------------------------------------------------------------------------------

let going = false, wanted = null; // one seek at a time, and the newest one after it
async function go(sample) {
  wanted = sample;
  if (going) return;
  for (going = true; wanted !== null;) {
    const next = wanted;
    wanted = null;
    await tell($("timeline"), "seek", { sample: next });
  }
  going = false;
}
function show(at) { // the revolution up to which kept drawings are shown; null: the newest
  SHOWN.at = at;
  $("shown").hidden = !at;
  if (at) {
    const every = SHOWN.rows.length ? SHOWN.rows[0].revolution - SHOWN.rows[0].since + 1 : 1;
    $("shown-words").textContent = `Newest revolutions and log: up to ${numbered(at)}, marked in the map${every > 1 ? `; ${every} revolutions of the map are kept as one` : ""}. Machine, state and header: the newest sample.`;
  }
  draw(true, false);
}
async function choose(cell, lane, second) { // puts a cursor on the revolution of a cell in which a signal is unusual
  const found = cell && await tell($("timeline"), "extreme", { first: cell.first, last: cell.first + cell.every - 1, lane });
  if (!found) return;
  const at = { first: found.first, every: found.every, open: found.first + found.every > TIME.told.whole[1], values: found.values };
  TIME.cursors = second ? [TIME.cursors[0] || at, at] : [at, null];
  drawTimeline();
  if (second) return;
  // A revolution is complete, and so in map and curves, with the first sample after it.
  if (can("seek")) await go(Math.min(found.values.sample[1] + 2, SHOWN.now.samples));
  else show({ ...at, sample: found.values.sample[1] + 1 });
}
function laneAt(y) { return lanes()[Math.max(0, Math.min(lanes().length - 1, Math.floor((y - TOP - 3 * ROW - 4) / LANE)))]; }

function zoom(first, last) { // to a range of angles, inside the run
  const [least, newest] = TIME.told.whole, most = Math.max(Math.floor(newest) + 1, least + 1), wide = Math.max(last - first, 2);
  const begin = Math.max(least, Math.min(first, most - wide));
  TIME.range = wide >= most - least ? null : [begin, begin + wide];
  drawTimeline();
  loadTimeline();
}
function zoomBy(factor, move = 0) {
  const [first, last] = span(), one = TIME.cursors[0], wide = (last - first) * factor;
  const middle = one && one.first >= first && one.first <= last && factor < 1 ? one.first + one.every / 2 : (first + last) / 2;
  zoom(middle - wide / 2 + move * wide, middle + wide / 2 + move * wide);
}

const positioned = event => { const box = $("timeline").getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
$("timeline").addEventListener("pointerdown", event => { TIME.drag = { from: positioned(event)[0], to: null }; $("timeline").setPointerCapture(event.pointerId); });
$("timeline").addEventListener("pointermove", event => {
  const [x] = positioned(event);
  TIME.hover = x;
  if (TIME.drag && Math.abs(x - TIME.drag.from) > NEAR) TIME.drag.to = x;
  if (TIME.told) drawTimeline();
});
$("timeline").addEventListener("pointerleave", () => { TIME.hover = null; if (TIME.told) drawTimeline(); });
$("timeline").addEventListener("pointercancel", () => { TIME.drag = null; });
$("timeline").addEventListener("pointerup", event => {
  const [x, y] = positioned(event), { drag } = TIME;
  TIME.drag = null;
  if (!TIME.told || !drag) return;
  if (drag.to !== null) zoom(Math.min(atTurn(drag.from), atTurn(drag.to)), Math.max(atTurn(drag.from), atTurn(drag.to)));
  else choose(cellAt(atTurn(x)), laneAt(y), event.shiftKey);
});
$("timeline").addEventListener("keydown", event => {
  const steps = { ArrowLeft: -1, ArrowRight: 1, PageUp: 10, PageDown: -10, Home: -Infinity, End: Infinity }, { told } = TIME;
  if (!told || event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.key in steps) { // by cells, so by what is visible
    const own = TIME.cursors[event.shiftKey ? 1 : 0] || TIME.cursors[0], [first, last] = span(), [least, newest] = told.whole.map(Math.floor);
    const from = own ? own.first : can("seek") ? Math.ceil((SHOWN.now.angle || 0) / (2 * Math.PI)) - 1 : newest;
    const to = Math.max(least, Math.min(newest, from + steps[event.key] * told.every));
    if (to < first || to >= last) zoom(to - (last - first) / 2, to + (last - first) / 2);
    choose({ first: told.first + Math.floor((to - told.first) / told.every) * told.every, every: told.every }, "error" in told.bands ? "error" : "speed", event.shiftKey);
  } else if (event.key == "+") zoomBy(0.5);
  else if (event.key == "-") zoomBy(2);
  else if (event.key == "Escape") { TIME.cursors = [null, null]; show(null); } else return;
  event.preventDefault();
});
for (const [id, does] of [["whole", () => zoom(-1, Infinity)], ["wider", () => zoomBy(2)], ["closer", () => zoomBy(0.5)], ["earlier", () => zoomBy(1, -0.5)], ["later", () => zoomBy(1, 0.5)]]) $(id).addEventListener("click", () => { if (TIME.told) does(); });
$("newest-again").addEventListener("click", () => { TIME.cursors = [null, null]; show(null); });
