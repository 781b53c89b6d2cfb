// SPDX-License-Identifier: Apache-2.0
// Draws the figures of a page in its own colours, light or dark, and as wide as the page is.
// A figure with a parameter "box" is enlarged by dragging across it; a double click or the button shows the whole figure again.
let SPECS, DATA, CHOSEN, LOOK;
const READY = (async () => {
  const packed = Uint8Array.from(atob(document.getElementById("figures").textContent), each => each.charCodeAt(0));
  const whole = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  ({ specs: SPECS, data: DATA, chosen: CHOSEN, look: LOOK } = await new Response(whole).json());
})();
const DARK = matchMedia("(prefers-color-scheme: dark)"), ENLARGED = {}, LEAST = 8, MARGIN = 5; // [px]
// Inputs of the page that set a parameter of the figures which have it; their parameters are named in usermeta.signals.
const STEERS = [...document.querySelectorAll("input[data-signal]")], STEERED = {};
function steer([view, signals]) {
  for (const each of STEERS) {
    if (signals.includes(each.dataset.signal) && each.validity.valid && each.value) view.signal(each.dataset.signal, Number(each.value));
  }
  return view.runAsync();
}
function steerAll() {
  for (const each of STEERS) document.querySelectorAll(`output[data-signal="${each.dataset.signal}"]`).forEach(told => { told.value = each.value; });
  Object.values(STEERED).forEach(steer);
}
function config(width) {
  const style = getComputedStyle(document.documentElement);
  const found = JSON.parse(JSON.stringify(LOOK), (_, value) => {
    if (typeof value != "string" || !value.startsWith("--")) return value;
    const colours = style.getPropertyValue(value).trim().split(" ");
    return colours.length > 1 ? colours : colours[0];
  });
  found.legend.columns = width < 560 ? 1 : 0; // 0: as many columns as names
  return found;
}
async function draw(name) {
  const place = document.getElementById(name), spec = structuredClone(SPECS[name][CHOSEN[name]]);
  place.closest("figure")?.classList.add("drawn"); // hides the picture for printing
  if (!spec) { place.textContent = "Choose two different parameters."; return; }
  if (spec.padding) spec.width = place.clientWidth - spec.padding.left - spec.padding.right;
  else { spec.width = place.clientWidth; spec.datasets = DATA; }
  const own = spec.usermeta || {};
  if (own.square) {
    spec.width = spec.height = Math.min(place.clientWidth, own.square) - 2 * MARGIN - (own.axes || 0);
    spec.autosize = "pad"; // otherwise the margins would reduce the width, but not the height
  }
  for (const [channel, ends] of Object.entries(ENLARGED[name] || {})) {
    const encoding = spec.encoding[channel];
    encoding.scale = { ...encoding.scale, domain: ends, nice: false, ...(encoding.scale?.type == "log" ? {} : { zero: false }) };
  }
  const options = { actions: false, ast: true, defaultStyle: false, tooltip: { disableDefaultStyle: true }, config: config(place.clientWidth), renderer: own.renderer || (name == "parallel-coordinates" ? "canvas" : "svg") };
  const { view } = await vegaEmbed(place, spec, options);
  if (own.box) boxed(name, place, view, own.square);
  if (own.signals) await steer(STEERED[name] = [view, own.signals]);
}
function boxed(name, place, view, square) {
  const enlarge = ends => { if (ends) ENLARGED[name] = ends; else delete ENLARGED[name]; draw(name); };
  if (ENLARGED[name]) {
    const button = place.appendChild(document.createElement("button"));
    button.className = "whole";
    button.textContent = "whole figure";
    button.addEventListener("click", () => enlarge());
  }
  const drawn = place.querySelector("canvas, svg");
  drawn.addEventListener("dblclick", () => enlarge());
  // A touch begins without a movement, and on a canvas Vega finds the mark under the pointer only by movements.
  drawn.addEventListener("pointerdown", event => drawn.dispatchEvent(new PointerEvent("pointermove", event)), true);
  drawn.addEventListener("pointerdown", () => addEventListener("pointerup", async () => {
    await view.runAsync();
    let [across, up] = ["box_x", "box_y"].map(signal => (view.signal(signal) || []).slice().sort((a, b) => a - b));
    const wide = across.length && across[1] - across[0] >= LEAST, tall = up.length && up[1] - up[0] >= LEAST;
    if (!wide && !tall) return;
    if (square) {
      const half = Math.max(across[1] - across[0], up[1] - up[0]) / 2;
      [across, up] = [across, up].map(([low, high]) => [(low + high) / 2 - half, (low + high) / 2 + half]);
    }
    const ends = (channel, pixels) => pixels.map(pixel => view.scale(channel).invert(pixel)).sort((a, b) => a - b);
    enlarge({ ...ENLARGED[name], ...(wide || square ? { x: ends("x", across) } : {}), ...(tall || square ? { y: ends("y", up) } : {}) });
  }, { once: true }));
}
function drawAll() { Object.keys(SPECS).forEach(draw); }
document.querySelectorAll("select[data-figure]").forEach(each => each.addEventListener("change", () => {
  const name = each.dataset.figure, some = [...document.querySelectorAll(`select[data-figure="${name}"]`)];
  CHOSEN[name] = some.map(one => one.value).join("-") + (name == "lines" && some.length == 1 ? "-" : "");
  draw(name);
}));
let waiting, width = innerWidth;
addEventListener("resize", () => { if (innerWidth != width) { width = innerWidth; clearTimeout(waiting); waiting = setTimeout(drawAll, 150); } });
DARK.addEventListener("change", drawAll);
STEERS.forEach(each => each.addEventListener("input", steerAll));
READY.then(drawAll);
