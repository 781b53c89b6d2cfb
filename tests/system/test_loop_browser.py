# SPDX-License-Identifier: Apache-2.0
"""The loop page in a real browser: dragged settings answer with the digits of a run, and become a scenario."""

import html
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from bags import lathe
from test_report_browser import Visit

from lathe_live.loop_page import LoopPage
from lathe_live.page_server import serving
from lathe_live.varied_loop import VariedLoop
from lathe_rc import harness
from lathe_rc.cell.scenario import load

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]
# Drags the lead to a value that is accepted and to one that is refused, and writes the scenario with the first.
_DRAG = """
addEventListener("load", async () => {
  const settled = async () => {
    for (;;) {
      const before = document.body.dataset.settled;
      await new Promise(done => setTimeout(done, 300));
      if (before && before == document.body.dataset.settled && !document.querySelector("tbody.stale")) return;
    }
  };
  const input = document.querySelector('input[type=range][data-target="learning_controller.lead_time"]'), told = [];
  const drag = async value => {
    delete document.body.dataset.settled;
    input.value = value;
    input.dispatchEvent(new Event("input"));
    await settled();
    const texts = row => [...row.cells].map(cell => cell.title || cell.textContent);
    const cells = [...document.querySelectorAll(".answers tr")].map(texts);
    const title = document.querySelector("#figure-0-1 svg").textContent;
    const refused = document.getElementById("refusal").textContent;
    told.push({ value: input.value, answers: Object.fromEntries(cells), refused, title });
  };
  await settled();
  for (const value of VALUES) await drag(value);
  document.getElementById("write").click();
  await new Promise(done => setTimeout(done, 500));
  const shaded = document.querySelectorAll(".strip rect.refused").length;
  told.push({ shaded, beyond: document.documentElement.scrollWidth - innerWidth });
  document.title = JSON.stringify(told);
});
"""


@pytest.mark.parametrize(("width", "dark"), [(1440, False), (500, True)])
def test_a_dragged_setting_shows_the_margins_and_errors_of_a_run_to_the_last_digit(tmp_path, width, dark):
    """And a refused one the refusal; the scenario that the page writes has the values of the page."""
    site = LoopPage(VariedLoop(load("piston"), 20.0), tmp_path / "dragged.yaml").site()
    script = _DRAG.replace("VALUES", "[0.003, 0.00139]")
    pages = {"": replace(site.pages[""], scripts=[*site.pages[""].scripts, script])}
    with serving(replace(site, pages=pages)) as address:
        visit = Visit(
            address, tmp_path, f"--window-size={width},900", f"--blink-settings=preferredColorScheme={int(not dark)}"
        )
    assert visit.console == []
    assert visit.requests == []
    refused, accepted, end = json.loads(html.unescape(re.search(r"<title>(.*)</title>", visit.document)[1]))
    assert "learning diverges" in refused["refused"]
    assert "no run" in refused["answers"]["form error"]
    assert accepted["refused"] == ""
    assert end["shaded"] > 10
    assert end["beyond"] <= 0

    run = harness.run(load(tmp_path / "dragged.yaml", ["spindle_encoder.revolutions=20"]))
    assert run.scenario.nodes["learning_controller"].lead_time == float(accepted["value"]) == 0.00139
    told = accepted["answers"]
    assert float(told["stability margin, learning_controller"]) == run.margins["learning_controller"]
    assert float(told["drive margin, learning_controller"]) == run.drive_margins["learning_controller"].error
    assert float(told["form error, largest in the last 10 of 20 revolutions"]) == run.errors.largest[-10:].max()
    assert str(run.drive_margins["learning_controller"]) in accepted["title"]


@pytest.mark.parametrize("name", ["full_cell", "force_turning"])
def test_the_page_as_a_file_is_quiet_and_small(name, tmp_path):
    """Also of a scenario without a learning controller, which has a diagram alone."""
    done = lathe("loop", name, "--html", tmp_path / "loop.html")
    assert done.exit_code == 0, done.output
    visit = Visit(tmp_path / "loop.html", tmp_path)
    assert visit.console == []
    assert visit.requests == []
    assert (tmp_path / "loop.html").stat().st_size < 4_000_000
    assert "<svg" in visit.document
