// SPDX-License-Identifier: Apache-2.0
// Shares of the causes in the form error, beside the verdict.
const LEAST_SHARE = 0.005; // smaller ones are added up
function drawCauses(found) {
  const parts = [...found.causes, { ...found.interactions, cause: "interactions" }, { ...found.rest, cause: "rest" }];
  const large = parts.filter(part => Math.abs(part.share) >= LEAST_SHARE).sort((one, other) => other.share - one.share);
  const others = parts.filter(part => !large.includes(part)), sum = others.reduce((total, part) => total + part.share, 0);
  const percent = share => `${digits(Math.round(share * 1000) / 10)} %`, first = found.last - found.revolutions + 1;
  const names = [...large.map(part => `${part.cause} ${percent(part.share)}`), ...(others.length ? [`${others.map(part => part.cause).join(", ")} together ${percent(sum)}`] : [])];
  $("causes-of").textContent = found.warning || `Form error of revolutions ${first} to ${found.last}, ${digits(found.rms, 3)} µm RMS, by lathe budget: shares in its power of ${names.join("; ")}`
    + Object.entries(found.left_out).map(([cause, why]) => `\nnot switched off: ${cause}: ${why}`).join("");
  const colours = style("--marks").split(" ");
  $("shares").replaceChildren(...large.filter(part => part.share > 0 && !found.warning).map((part, k) => {
    const bar = Object.assign(document.createElement("span"), { textContent: part.cause, title: `${part.cause} ${percent(part.share)}, ${digits(part.rms, 3)} µm RMS` });
    bar.style.flex = `${part.share} 1 0`;
    bar.style.background = colours[k % colours.length];
    return bar;
  }));
}
function openCauses(open) {
  $("causes").hidden = !open;
  $("why").setAttribute("aria-expanded", open);
}
$("why").addEventListener("click", async () => {
  if (!$("causes").hidden) { openCauses(false); return; }
  const run = HAVE.run;
  $("shares").replaceChildren();
  $("causes-of").textContent = "determining the causes by some 10 to 30 runs up to here…";
  openCauses(true);
  const found = await tell($("bar"), "causes");
  if (found && run == HAVE.run) { drawCauses(found); return; }
  openCauses(false);
  if (found) answer($("bar"), "no causes: another run has begun", true);
});
