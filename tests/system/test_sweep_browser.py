# SPDX-License-Identifier: Apache-2.0
"""The page of a sweep in a real browser: every figure is drawn, chosen and brushed, without a request."""

import re

import pytest
from test_report_browser import Visit, by_hand
from test_sweep_page import GRID, bowl, shown_page, swept

pytestmark = pytest.mark.system

# Runs in the page once its figures are drawn: chooses another pair, drags along the first axis, and writes the results
# into the title, which the test reads.
_HAND = """<script>
const VIEWS = {}, embed = vegaEmbed;
vegaEmbed = async (place, ...rest) => (VIEWS[place.id] = await embed(place, ...rest));
addEventListener("load", async () => {
  const rest = () => new Promise(done => setTimeout(done, 400));
  await rest();
  const tell = text => document.title += " | " + text;
  document.title = "told";
  for (const name of Object.keys(SPECS)) {
    const drawn = document.querySelector(`#${name} canvas, #${name} svg`);
    tell(`${name} ${drawn ? drawn.clientWidth : 0}`);
  }
  const choice = document.querySelectorAll('select[data-figure="heat-map"]');
  choice[0].value = "1"; choice[0].dispatchEvent(new Event("change")); await rest();
  tell("same: " + document.getElementById("heat-map").textContent.trim());
  choice[1].value = "0"; choice[1].dispatchEvent(new Event("change")); await rest();
  tell("chosen: " + CHOSEN["heat-map"] + " " + !!document.querySelector("#heat-map svg"));
  const view = VIEWS["parallel-coordinates"].view, canvas = document.querySelector("#parallel-coordinates canvas");
  const box = canvas.getBoundingClientRect(), { left, top } = view.padding();
  const at = (kind, target, share) => target.dispatchEvent(new PointerEvent(kind, {
    bubbles: true, clientX: box.left + left + share * view.width(), clientY: box.top + top + 1 }));
  const kept = () => (view.data("inside")[0] || { count: 0 }).count;
  tell("all: " + kept());
  at("pointerdown", canvas, 0.02); at("pointermove", canvas, 0.2); at("pointerup", canvas, 0.2);
  await view.runAsync();
  tell("brushed: " + kept());
});
</script>"""


def test_figures_are_drawn_chosen_and_brushed(tmp_path):
    """Each of the seven leads with a result has 14 cells; the brush lies over the second lead."""
    shown = shown_page(swept(tmp_path / "sweep", GRID, bowl))
    visit = Visit(by_hand(shown.source, _HAND, tmp_path), tmp_path, "--window-size=900,900")
    assert visit.console == []
    assert visit.requests == []
    told = re.search(r"<title>(.*)</title>", visit.document)[1]
    for name in shown.specs:
        assert int(re.search(rf"\| {name} (\d+)", told)[1]) > 500, told
    assert "same: Choose two different parameters. | chosen: 1-0 true" in told
    assert "all: 98 | brushed: 14" in told
