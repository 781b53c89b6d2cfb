// SPDX-License-Identifier: Apache-2.0
// Drawings of the panel: section of the machine, dials, canvases; and all of them as one picture.
function drawMachine(now) {
  const ink = style("--ink"), soft = style("--soft"), line = style("--line"), field = style("--field"), bad = style("--bad"), good = style("--good");
  const [cx, cy, radius] = [170, 165, 50 * MM], scale = (now.exaggeration || 1) * 1e-3 * MM; // [px/µm]
  const limited = um => Math.max(-40, Math.min(40, um * scale));
  const at = (r, angle) => `${(cx + r * Math.cos(angle)).toFixed(1)},${(cy - r * Math.sin(angle)).toFixed(1)}`;
  const turn = now.angle || 0, parts = [];
  const size = 13 * Math.max(1, 560 / ($("machine").getBoundingClientRect().width || 640)); // readable on a telephone as well
  const text = (x, y, words, more = "") => parts.push(`<text x="${x}" y="${y}" fill="${ink}" font-size="${size}" font-family="system-ui, sans-serif" stroke="${style("--paper")}" stroke-width="3" paint-order="stroke" ${more}>${escaped(words)}</text>`);
  parts.push(`<circle cx="${cx}" cy="${cy}" r="${radius + 42}" fill="${field}" stroke="${line}"/>`);
  for (let jaw = 0; jaw < 3; jaw++) {
    const angle = jaw * 2 * Math.PI / 3 - turn;
    parts.push(`<polygon points="${at(radius - 4, angle - 0.12)} ${at(radius + 38, angle - 0.09)} ${at(radius + 38, angle + 0.09)} ${at(radius - 4, angle + 0.12)}" fill="${soft}" opacity="0.45"/>`);
  }
  const shape = SHOWN.shape || new Array(90).fill(0), points = [];
  shape.forEach((um, k) => {
    const angle = 2 * Math.PI * (k + 0.5) / shape.length;
    const open = ABOUT.gaps.some(([start, width]) => (angle - start + 20 * Math.PI) % (2 * Math.PI) < width);
    points.push(at(radius + limited(um) - (open ? 12 : 0), angle - turn));
  });
  parts.push(`<polygon points="${points.join(" ")}" fill="${style("--paper")}" stroke="${good}" stroke-width="2"/>`);
  parts.push(`<line x1="${cx}" y1="${cy}" x2="${at(radius * 0.8, -turn).replace(",", '" y2="')}" stroke="${soft}" stroke-dasharray="5 4"/>`);
  parts.push(`<circle cx="${cx}" cy="${cy}" r="3" fill="${soft}"/>`);
  // The tip is where the part is cut. The coarse drive spans from the others to the slide; each of these has its own scale.
  const tip = cx + radius + limited((now.reference || 0) - (now.error || 0));
  parts.push(`<polygon points="${tip},${cy} ${tip + 22},${cy - 9} ${tip + 22},${cy + 9}" fill="${style("--warn")}"/>`);
  let left = tip + 22;
  const drives = Object.entries(now.drives || {}).reverse();
  const base = cx + radius + 30 + 74 * drives.length;
  drives.forEach(([name, um], k) => {
    const coarse = k == drives.length - 1, shown = coarse ? scale : 12 / nice(seen(name, um, 0.01)); // [px/µm]
    const width = coarse ? base - left : 70 - um * shown;
    parts.push(`<rect x="${left}" y="${cy - 20}" width="${width}" height="40" rx="3" fill="${field}" stroke="${ink}"/>`);
    parts.push(`<line x1="${left + width / 2}" y1="${cy - 20}" x2="${left + width / 2}" y2="${24 + 22 * k}" stroke="${line}"/>`);
    const words = `${name} ${digits(Math.abs(um) < 1e-4 ? 0 : um)} µm (drawn ×${digits(shown / MM * 1e3, 1)})`;
    text(Math.min(left + 4, 636 - 0.6 * size * words.length), 20 + 22 * k, words);
    left += width;
  });
  parts.push(`<rect x="${left}" y="${cy - 34}" width="${Math.max(40, 560 - left)}" height="68" fill="${line}" stroke="${soft}"/>`);
  if (now.measured_force !== undefined) {
    const force = now.measured_force, length = 70 * force / nice(seen("force", force, Math.max(ABOUT.force, 1)));
    parts.push(`<line x1="${tip}" y1="${cy}" x2="${tip}" y2="${cy + length}" stroke="${bad}" stroke-width="3"/>`);
    parts.push(`<polygon points="${tip},${cy + length + 8} ${tip - 5},${cy + length} ${tip + 5},${cy + length}" fill="${bad}"/>`);
    text(tip + 9, cy + Math.max(length + 12, 40), `${newton(force, 3)} N`);
  }
  const bar = nice(40 / scale / 2);
  if (ABOUT.part) parts.push(`<path d="M16 344 v8 h${(bar * scale).toFixed(1)} v-8" fill="none" stroke="${ink}"/>`);
  if (ABOUT.part) text(24 + bar * scale, 352, `${digits(bar)} µm of radius (×${digits(now.exaggeration || 1)})`);
  const slides = Object.entries(now.slides || {});
  slides.forEach(([name, mm], k) => {
    const x = 340, y = 268 + 66 * k, half = nice(seen(name, mm, 0.001)), place = x + 130 + 120 * mm / half;
    parts.push(`<line x1="${x + 10}" y1="${y}" x2="${x + 250}" y2="${y}" stroke="${soft}"/><rect x="${place - 9}" y="${y - 8}" width="18" height="16" rx="2" fill="${good}"/>`);
    text(x + 10, y - 12, `${name} slide ${digits(mm)} mm`);
    text(x + 250, y + 8 + size, `±${digits(half)} mm`, 'text-anchor="end"');
  });
  if (!slides.length && ABOUT.fed) text(340, 300, `height along the part ${digits(now.height || 0)} mm`);
  $("machine-note").textContent = [ABOUT.gaps.length ? `keyways: ${ABOUT.gaps.length}` : "", ABOUT.part ? "" : "no tool in this cell"].filter(Boolean).join(", ");
  $("machine").innerHTML = parts.join("");
}

function drawDials(now) {
  const dials = [["speed", "1/min", now.rpm, nice((ABOUT.rpm || now.rpm || 1) * 1.25), ABOUT.rpm]];
  if (now.measured_force !== undefined) dials.push(["force", "N", now.measured_force, nice(Math.max(seen("force", now.measured_force, 1), ABOUT.force, ABOUT.force_limit) * 1.2), ABOUT.force, ABOUT.force_limit]);
  if (Number.isFinite(now.margin)) dials.push(["stability margin", "", now.margin, nice(Math.max(now.margin || 0, 0.05) * 1.2), 0, ABOUT.margin]);
  const ink = style("--ink"), soft = style("--soft"), line = style("--line"), good = style("--good"), bad = style("--bad");
  const small = $("dials").getBoundingClientRect().width < 450 ? 12.5 : 10; // readable on a telephone as well
  $("dials").innerHTML = dials.map(([name, unit, value, most, wanted, limit], k) => {
    const cx = 80 + 160 * k, cy = 88, angle = share => Math.PI * (1.2 - 1.4 * Math.max(0, Math.min(1, share)));
    const at = (r, share) => `${(cx + r * Math.cos(angle(share))).toFixed(1)} ${(cy - r * Math.sin(angle(share))).toFixed(1)}`;
    const mark = (place, colour) => place ? `<path d="M${at(50, place / most)} L${at(66, place / most)}" stroke="${colour}" stroke-width="2"/>` : "";
    const below = name == "stability margin" ? "below 0: learning diverges" : name == "force" && wanted ? `set point ${digits(wanted)}` : "";
    const told = [below, limit ? `limit ${digits(limit)} (red)` : ""].filter(Boolean);
    const known = Number.isFinite(value);
    const needle = known ? `<path d="M${cx} ${cy} L${at(56, value / most)}" stroke="${value < 0 ? bad : good}" stroke-width="4" stroke-linecap="round"/>` : "";
    const words = (y, text, size, colour) => `<text x="${cx}" y="${y}" text-anchor="middle" font-size="${size}" fill="${colour}" font-family="system-ui, sans-serif">${escaped(text)}</text>`;
    return `<path d="M${at(58, 0)} A58 58 0 1 1 ${at(58, 1)}" fill="none" stroke="${line}" stroke-width="10"/>${mark(wanted, ink)}${mark(limit, bad)}${needle}`
      + words(118, known ? `${unit == "N" ? newton(value, 4) : digits(value)} ${unit}` : "unknown", 15, ink) + words(137, name, small + 2, soft)
      + told.map((text, line) => words(153 + 16 * line, text, small, soft)).join("")
      + `<text x="${cx + 56}" y="${cy + 40}" font-size="${small}" fill="${soft}" font-family="system-ui, sans-serif">${digits(most)}</text>`;
  }).join("");
}

// ---- canvases ------------------------------------------------------------------------------------------------------

function canvas(id) { // in pixels of the page, sharp on every screen
  const place = $(id), ratio = devicePixelRatio || 1, width = place.clientWidth, height = Number(place.getAttribute("data-height") || place.height);
  place.setAttribute("data-height", height);
  Object.assign(place, { width: width * ratio, height: height * ratio });
  place.style.height = `${height}px`;
  const pen = place.getContext("2d");
  pen.scale(ratio, ratio);
  pen.fillStyle = style("--paper");
  pen.fillRect(0, 0, width, height);
  pen.font = "11px system-ui, sans-serif";
  return { pen, width, height, ink: style("--ink"), soft: style("--soft"), line: style("--line"), good: style("--good"), bad: style("--bad") };
}
function label(pen, words, x, y, colour, align = "left") {
  Object.assign(pen, { fillStyle: colour, textAlign: align });
  pen.fillText(words, x, y);
}
function diverging() { // the signed colours of all figures (page.css), as a function of -1 to 1
  const stops = style("--below-zero-above").split(" ").map(code => [1, 3, 5].map(k => parseInt(code.slice(k, k + 2), 16)));
  return share => {
    const place = (Math.max(-1, Math.min(1, share)) + 1) / 2 * (stops.length - 1), k = Math.min(Math.floor(place), stops.length - 2);
    return stops[k].map((from, channel) => Math.round(from + (stops[k + 1][channel] - from) * (place - k)));
  };
}
function angles(pen, left, right, y, colour) {
  for (let degrees = 0; degrees <= 360; degrees += 90) label(pen, `${degrees}°`, left + (right - left) * degrees / 360, y, colour, "center");
}

function cut(rows) { // the rows that determine a scale: those in which the tool was in the part, if there are any
  const found = rows.filter(row => !row.out);
  return found.length ? found : rows;
}

function shares(rows) { // the place of an error in the colours, and the errors beside them
  const largest = cut(rows).map(row => row.cells.reduce((most, um) => Math.max(most, Math.abs(um)), 0)).sort((a, b) => a - b);
  const tolerance = ABOUT.tolerance, end = Math.max(largest[largest.length - 1], 1e-6);
  // By the tolerance: white within a tenth of it, full colour from it on. Without one as in the report (colour_range):
  // linear up to the quietest quarter of the rows, logarithmic beyond.
  if (tolerance) return { share: um => Math.sign(um) * Math.max(0, Math.min(1, (Math.abs(um) / tolerance - 0.1) / 0.9)), ticks: [-tolerance, 0, tolerance] };
  const bend = Math.min(Math.max(largest[(largest.length - 1) >> 2], end * 1e-4), end) / 8;
  return { share: um => Math.sign(um) * Math.log1p(Math.abs(um) / bend) / Math.log1p(end / bend), ticks: end > 24 * bend ? [-end, -8 * bend, 8 * bend, end] : [-end, 0, end] };
}
const mapRows = () => SHOWN.open ? [...SHOWN.rows, SHOWN.open] : SHOWN.rows;
const rowNumber = row => row.since == row.revolution ? String(row.revolution) : `${row.since}–${row.revolution}`;

function drawMap() {
  const rows = mapRows(), columns = 180, told = row => ABOUT.fed ? `${row.height.toFixed(2)} mm` : rowNumber(row);
  const named = [...new Set(rows.length ? [0, rows.length >> 1, rows.length - 1] : [])];
  const { pen, width, height, ink, soft } = canvas("map"), [top, right, bottom] = [8, width - 14, height - 46];
  const left = Math.max(58, ...named.map(k => pen.measureText(told(rows[k])).width + 8));
  angles(pen, left, right, bottom + 14, soft);
  if (!rows.length) { label(pen, "after the first revolution", (left + right) / 2, (top + bottom) / 2, soft, "center"); return; }
  const { share, ticks } = shares(rows), colour = diverging();
  const image = new ImageData(columns, rows.length);
  rows.forEach((row, k) => row.cells.forEach((um, column) => {
    image.data.set([...(row.out ? [150, 150, 150] : colour(share(um))), 255], 4 * (k * columns + column));
  }));
  const small = new OffscreenCanvas(columns, rows.length);
  small.getContext("2d").putImageData(image, 0, 0);
  pen.imageSmoothingEnabled = false;
  pen.drawImage(small, left, top, right - left, bottom - top);
  const wide = (right - left) / columns, tall = (bottom - top) / rows.length;
  if (ABOUT.tolerance) {
    const beyond = (k, column) => k >= 0 && k < rows.length && !rows[k].out && Math.abs(rows[k].cells[(column + columns) % columns]) > ABOUT.tolerance;
    pen.strokeStyle = ink;
    pen.beginPath();
    for (let k = 0; k <= rows.length; k++) for (let column = 0; column < columns; column++) {
      if (beyond(k, column) != beyond(k - 1, column)) { pen.moveTo(left + column * wide, top + k * tall); pen.lineTo(left + (column + 1) * wide, top + k * tall); }
      if (beyond(k, column) != beyond(k, column - 1)) { pen.moveTo(left + column * wide, top + k * tall); pen.lineTo(left + column * wide, top + (k + 1) * tall); }
    }
    pen.stroke();
  }
  pen.beginPath(); // the revolution that is shown, and a notch where some were not received
  const shown = SHOWN.at && rows.findIndex(row => row.revolution > SHOWN.at.first);
  if (SHOWN.at) pen.rect(left - 2, top + (shown < 0 ? rows.length - 1 : shown) * tall, right - left + 4, Math.max(tall, 2));
  for (let k = 1; k < rows.length; k++) if (rows[k].since > rows[k - 1].revolution + 1) { pen.moveTo(right, top + k * tall); pen.lineTo(width, top + k * tall); }
  pen.strokeStyle = ink;
  pen.stroke();
  for (const k of named) label(pen, told(rows[k]), left - 5, Math.min(top + (k + 0.7) * tall, bottom), soft, "right");
  label(pen, ABOUT.fed ? "height" : "revolution", 2, bottom + 14, soft);
  for (let x = 0; x < 160; x++) { pen.fillStyle = `rgb(${colour(x / 80 - 1)})`; pen.fillRect(left + x, bottom + 22, 1, 8); }
  for (const um of ticks) label(pen, digits(um, 2), left + 80 + 80 * share(um), bottom + 42, soft, "center");
  label(pen, ABOUT.tolerance ? `tolerance ±${digits(ABOUT.tolerance)} µm` : ABOUT.by_zone ? "tolerance by zone: see lathe run" : "no tolerance given", left + 185, bottom + 32, soft);
}

function drawWaterfall() {
  const { at } = SHOWN, tolerance = ABOUT.tolerance, farthest = row => Math.max(...row.cells.map(Math.abs));
  const rows = at ? mapRows().filter(row => row.since <= at.first + at.every).slice(-WATERFALL) : SHOWN.latest;
  const largest = cut(rows).map(farthest).sort((a, b) => a - b);
  const most = tolerance ? 1.5 * tolerance : nice(1.3 * Math.max(largest[largest.length >> 1] || 0, 1e-6));
  const told = row => rowNumber(row) + (farthest(row) > most ? `: to ${digits(farthest(row), 2)}` : ""); // where the curve is cut off
  const { pen, width, height, ink, soft, line, good, bad } = canvas("waterfall"), [top, right, bottom] = [16, width - 70, height - 24];
  const left = Math.max(84, ...rows.map(row => pen.measureText(told(row)).width + 8)), tall = (bottom - top) / WATERFALL, scale = 0.45 * tall / most;
  angles(pen, left, right, height - 6, soft);
  if (!rows.length) { label(pen, "after the first revolution", (left + right) / 2, (top + bottom) / 2, soft, "center"); return; }
  rows.forEach((row, k) => {
    const y = top + (k + 0.5 + WATERFALL - rows.length) * tall, x = column => left + (right - left) * (column + 0.5) / row.cells.length;
    if (tolerance) { pen.globalAlpha = 0.5; pen.fillStyle = line; pen.fillRect(left, y - tolerance * scale, right - left, 2 * tolerance * scale); pen.globalAlpha = 1; }
    const place = um => y - Math.max(-0.45 * tall, Math.min(0.45 * tall, um * scale));
    for (const [colour, wide, wanted] of row.out ? [[soft, 1.2, () => true]] : [[good, 1.2, () => true], [bad, 2.2, um => tolerance && Math.abs(um) > tolerance]]) {
      Object.assign(pen, { strokeStyle: colour, lineWidth: wide });
      pen.beginPath();
      row.cells.forEach((um, column) => { if (column && wanted(um)) { pen.moveTo(x(column - 1), place(row.cells[column - 1])); pen.lineTo(x(column), place(um)); } });
      pen.stroke();
    }
    label(pen, told(row), left - 5, y + 4, soft, "right");
  });
  Object.assign(pen, { strokeStyle: ink, lineWidth: 1 });
  pen.strokeRect(right + 8, bottom - tall, 0, most * scale * 2);
  label(pen, `${digits(2 * most)} µm`, right + 14, bottom - tall + most * scale + 4, ink);
}

// ---- picture -------------------------------------------------------------------------------------------------------

function save(name, blob) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
$("picture").addEventListener("click", async () => {
  draw(true, false);
  const picture = await drawn();
  picture.toBlob(blob => save(`${ABOUT.name}.png`, blob));
});

async function drawn() { // the drawings of the page beside each other, as one picture
  const shown = ["machine", "dials", ...(ABOUT.part ? ["map", "waterfall"] : []), ...($("time").hidden ? [] : ["timeline"])];
  const boxes = shown.map(id => [$(id), $(id).getBoundingClientRect()]);
  const left = Math.min(...boxes.map(([, box]) => box.left)), top = Math.min(...boxes.map(([, box]) => box.top));
  const right = Math.max(...boxes.map(([, box]) => box.right)), bottom = Math.max(...boxes.map(([, box]) => box.bottom));
  const picture = Object.assign(document.createElement("canvas"), { width: 2 * (right - left + 20), height: 2 * (bottom - top + 50) }), pen = picture.getContext("2d");
  pen.scale(2, 2);
  pen.fillStyle = style("--paper");
  pen.fillRect(0, 0, picture.width, picture.height);
  pen.font = "14px system-ui, sans-serif";
  label(pen, `${ABOUT.name}: ${$("state").textContent}; ${$("safety").textContent} ${$("alarm").textContent}`, 10, 22, style("--ink"));
  for (const [place, box] of boxes) {
    let source = place;
    if (place.tagName == "svg") {
      const copy = place.cloneNode(true);
      copy.setAttribute("xmlns", "http://www.w3.org/2000/svg");
      copy.setAttribute("width", box.width); copy.setAttribute("height", box.height);
      source = new Image();
      source.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(new XMLSerializer().serializeToString(copy))}`;
      await source.decode();
    }
    pen.drawImage(source, box.left - left + 10, box.top - top + 40, box.width, box.height);
  }
  return picture;
}

const redraw = () => requestAnimationFrame(() => draw(true, false));
addEventListener("resize", redraw);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
