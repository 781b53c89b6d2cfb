// SPDX-License-Identifier: Apache-2.0
// Commands of the panel; each answer stands at its command.
async function tell(place, name, question) {
  const slow = setTimeout(() => answer(place, "sent; no answer yet"), SILENT * 1000);
  try {
    const found = await ask(name, question);
    clearTimeout(slow);
    answer(place, found.text ? `asked for: ${found.text}` : "");
    return found;
  } catch (error) {
    clearTimeout(slow);
    answer(place, error instanceof TypeError ? "no answer: has lathe panel ended?" : error.message, true);
    return null;
  }
}
function answer(place, text, refused = false) { // one for each row of commands
  const row = place.closest(".bar, .actions, .row, .time");
  row.querySelectorAll(".answer").forEach(each => each.remove());
  if (!text) return;
  const said = Object.assign(document.createElement("p"), { className: refused ? "answer refused" : "answer", textContent: text });
  said.setAttribute("role", refused ? "alert" : "status");
  row.append(said);
  setTimeout(() => said.remove(), 15000);
}

const SURE = 8000; // [ms] in which a second click confirms
function confirmed(button, warning, command) { // asks for a second click while a warning holds
  let asked = -SURE;
  const words = button.textContent;
  button.addEventListener("click", () => {
    const sure = performance.now() - asked < SURE, why = warning();
    if (why && !sure) {
      asked = performance.now();
      button.textContent = `${words}: sure?`;
      answer(button, `${why} Click again to ${words}.`, true);
      setTimeout(() => { button.textContent = words; }, SURE);
      return;
    }
    [asked, button.textContent] = [-SURE, words];
    command();
  });
}
function cutting() { // why a cleared memory would trip the supervisor; empty: it would not
  const { safety } = SHOWN.now;
  if (!safety || ["retracting", "safe"].includes(safety.state)) return "";
  return "The tool is in the part: without what was learned, the error exceeds the supervisor's limits, and it may retract the tool.";
}

function options(select, names) {
  const before = select.value;
  select.replaceChildren(...names.map(name => new Option(name)));
  if (names.includes(before)) select.value = before;
}

const supervisor = () => ABOUT.nodes.find(node => node.actions.includes("reset"));

function describe() { // fills the commands from what the cell tells of itself
  document.title = `${ABOUT.name}: panel`;
  $("name").textContent = ABOUT.name;
  $("commands").hidden = !can("command");
  for (const id of ["change", "repeat", "restart"]) $(id).hidden = !can("change");
  $("record").hidden = !can("record");
  $("why").hidden = !can("causes") || !ABOUT.part;
  for (const [id, why] of Object.entries(cannot())) $(id).title = why;
  for (const id of ["go", "step", "pacing"]) $(id).hidden = !can("run");
  for (const id of ["retract", "reset"]) $(id).hidden = !can("command") || !supervisor();
  for (const place of document.querySelectorAll(".of-part")) place.hidden = !ABOUT.part;
  if (!can("command")) return;
  $("actions").replaceChildren(...ABOUT.nodes.filter(node => node != supervisor() && (node.actions.length || node.knobs.length)).map(node => {
    const row = document.createElement("div"), name = document.createElement("b");
    row.className = "actions";
    name.textContent = node.name;
    row.append(name);
    if (node.learning.length) {
      const state = Object.assign(document.createElement("span"), { className: "note" });
      state.dataset.learning = JSON.stringify(node.learning);
      row.append(state);
    }
    for (const action of node.actions) {
      const button = Object.assign(document.createElement("button"), { type: "button", textContent: action, title: DOES[action] || "" });
      confirmed(button, action == "clear" && node.memory ? cutting : () => "", () => tell(button, "act", { node: node.name, action }));
      row.append(button);
    }
    for (const knob of node.knobs) {
      const label = document.createElement("label"), input = Object.assign(document.createElement("input"), { size: 8, value: knob.value, title: knob.doc });
      input.addEventListener("change", async () => {
        if (!await tell(input, "act", { node: node.name, action: `set ${knob.name} ${input.value}` })) input.value = knob.value; else knob.value = input.value;
      });
      label.append(`${knob.name} `, input, knob.unit == "1" ? "" : ` ${knob.unit}`);
      row.append(label);
    }
    return row;
  }));
  const form = $("fault").elements, breakable = ABOUT.nodes.filter(node => Object.keys(node.targets).length);
  $("fault").hidden = !breakable.length;
  $("fault-note").textContent = breakable.length ? "" : "No faults can be injected: allow_faults is false in this cell.";
  options(form.node, breakable.map(node => node.name));
  offerFaults();
  $("parameters").replaceChildren(...ABOUT.parameters.map(name => new Option(name)));
}

function offerFaults() {
  const form = $("fault").elements, node = ABOUT.nodes.find(each => each.name == form.node.value);
  if (!node) return;
  options(form.target, [...new Set(Object.values(node.targets).flat())].sort());
  options(form.kind, Object.keys(node.targets).filter(kind => node.targets[kind].includes(form.target.value)));
  const kind = ABOUT.faults[form.kind.value];
  if (!kind || form.values.dataset.of == form.kind.value) return;
  form.values.dataset.of = form.kind.value;
  form.values.value = Object.entries(kind.values).map(([name, value]) => `${name}=${value ?? ""}`).join(" ");
  $("fault-note").textContent = kind.doc;
}
let offered = "";
function offerRepair(faults) { // chooses a fault that has come into force, once, for its repair
  const newest = faults.at(-1) || "", [node, target, kind, ...values] = newest.split(/:? /), form = $("fault").elements;
  if (newest == offered) return;
  offered = newest;
  if (!ABOUT.nodes.some(each => each.name == node)) return;
  for (const [field, value] of Object.entries({ node, target, kind })) { form[field].value = value; offerFaults(); }
  form.values.value = values.join(" ");
}
for (const name of ["node", "target", "kind"]) $("fault").elements[name].addEventListener("change", offerFaults);
$("fault").addEventListener("submit", event => {
  event.preventDefault();
  const { node, target, kind, values } = event.target.elements;
  tell(event.target, "act", { node: node.value, action: `fault ${target.value} ${kind.value} ${values.value}`.trim() });
});
$("repair").addEventListener("click", () => {
  const { node, target } = $("fault").elements;
  tell($("repair"), "act", { node: node.value, action: `repair ${target.value}` });
});
$("change").addEventListener("submit", event => {
  event.preventDefault();
  const { name, value } = event.target.elements;
  tell(event.target, "change", { values: name.value ? { [name.value.trim()]: value.value } : {}, here: event.submitter.value == "here" });
});
$("record").addEventListener("submit", event => {
  event.preventDefault();
  tell(event.target, "record", { bag: SHOWN.now.bag ? "" : event.target.elements.bag.value });
});
$("go").addEventListener("click", () => tell($("go"), SHOWN.now.state == "running" ? "pause" : "start"));
$("step").addEventListener("click", () => tell($("step"), "step"));
$("restart").addEventListener("click", () => tell($("restart"), "change", { values: {}, here: false }));
for (const id of ["retract", "reset"]) {
  $(id).addEventListener("click", () => tell($(id), "act", { node: supervisor().name, action: id }));
}
$("more").addEventListener("click", () => { // on narrow screens: the other commands, above the bar
  $("more").setAttribute("aria-expanded", document.body.classList.toggle("sheet"));
});
new ResizeObserver(() => document.body.style.setProperty("--bar", `${$("bar").offsetHeight}px`)).observe($("bar"));
$("pace").addEventListener("change", () => { tell($("pace"), "pace", { factor: Number($("pace").value) }); $("pace").blur(); });
