// SPDX-License-Identifier: Apache-2.0
// Sends the settings of the page to lathe loop, and draws what it answers: the newest values first, older ones never.
{
const GIVEN = {}, VALUES = {}; // by target: of the scenario; those that were changed
const INPUTS = [...document.querySelectorAll("input[data-target]")], $ = id => document.getElementById(id);
let wanted = 0, busy = false;
for (const each of INPUTS) if (each.type == "number") GIVEN[each.dataset.target] = each.value;
function unit(target) { return document.querySelector(`label[for="${document.querySelector(`input[type=range][data-target="${target}"]`).id}"]`).textContent.match(/\[(.*)\]$/)?.[1] || ""; }
function told(value, name) {
  if (name != "s") return `${Number(value.toPrecision(4))} ${name == "1" ? "" : name}`;
  const [by, small] = value < 1e-3 ? [1e6, "µs"] : value < 1 ? [1e3, "ms"] : [1, "s"];
  return `${Number((value * by).toPrecision(4))} ${small}`;
}
function show(target, from) {
  const value = target in VALUES ? VALUES[target] : Number(GIVEN[target]);
  for (const each of INPUTS) if (each.dataset.target == target && each != from) each.value = value;
  document.querySelector(`output[data-target="${target}"]`).textContent = `= ${told(value, unit(target))}`;
}
function rows(place, answers) {
  $(place).replaceChildren();
  $(place).classList.remove("stale");
  for (const [name, value, exact] of answers) {
    const row = $(place).insertRow();
    row.insertCell().textContent = name;
    Object.assign(row.insertCell(), { textContent: value, title: exact });
  }
}
async function update() {
  wanted += 1;
  if (busy) return;
  busy = true;
  for (let now = 0; now != wanted;) {
    now = wanted;
    try { await follow(now); } catch (error) { $("refusal").textContent = error.message; }
  }
  busy = false;
}
async function follow(now) {
  const values = { ...VALUES };
  const state = await ask("state", { values });
  $("refusal").textContent = state.refused;
  rows("margins", state.answers);
  $("errors").classList.add("stale");
  const fresh = Object.entries(state.figures);
  $("curves").classList.toggle("stale", !fresh.length);
  for (const [name, spec] of fresh) {
    SPECS[name][CHOSEN[name]] = spec;
    await draw(name);
  }
  if (now != wanted) return;
  rows("errors", (await ask("errors", { values })).answers);
  for (const place of document.querySelectorAll("[data-strip]")) {
    if (now != wanted) return;
    place.innerHTML = (await ask("along", { values, setting: place.dataset.strip })).strip;
  }
  document.body.dataset.settled = now; // for tests
}
for (const each of INPUTS) {
  each.addEventListener("input", () => {
    if (each.value === "" || !each.validity.valid && each.type == "range") return;
    VALUES[each.dataset.target] = Number(each.value);
    show(each.dataset.target, each);
    update();
  });
  show(each.dataset.target);
}
$("back")?.addEventListener("click", () => {
  for (const target of Object.keys(VALUES)) { delete VALUES[target]; show(target); }
  update();
});
$("write")?.addEventListener("click", async () => {
  try { $("written").textContent = (await ask("write", { values: { ...VALUES } })).written; } catch (error) { $("written").textContent = error.message; }
});
if (INPUTS.length) READY.then(update);
}
