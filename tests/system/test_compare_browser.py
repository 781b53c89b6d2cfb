# SPDX-License-Identifier: Apache-2.0
"""The comparison of runs in a real browser: one revolution and one tolerance for all figures."""

import html
import json
import re
from pathlib import Path

import pytest
from bags import lathe
from test_report_browser import Visit, by_hand

from lathe_rc import harness
from lathe_rc.cell.scenario import load

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]
# Chooses a revolution and a tolerance once the figures stand, and tells what they show.
_CHOOSE = """<script>
const SHOWN = {}, embed = vegaEmbed;
vegaEmbed = async (place, ...rest) => (SHOWN[place.id] = await embed(place, ...rest));
addEventListener("load", async () => {
  const rest = () => new Promise(done => setTimeout(done, 600)), told = [];
  const choose = (name, value) => {
    const input = document.querySelector(`input[data-signal=${name}]`);
    input.value = value;
    input.dispatchEvent(new Event("input"));
  };
  const texts = () => [...document.querySelectorAll("#figure-0-0 text")].map(text => text.textContent);
  await rest();
  for (const [revolution, tolerance] of [[5, 3], [2, 300]]) {
    choose("revolution", revolution); choose("tolerance", tolerance);
    await rest();
    const steered = Object.keys(SHOWN).filter(name => name < "figure-6").map(name => SHOWN[name].view);
    const signals = steered.map(view => [view.signal("revolution"), view.signal("tolerance")]);
    told.push({ texts: texts().filter(text => text.includes(":")), signals });
  }
  document.title = JSON.stringify(told);
});
</script>"""


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compare")
    for name, gain in (("fast", 1.0), ("slow", 0.4)):
        overrides = ["spindle_encoder.revolutions=12", f"learning_controller.learning_gain={gain}"]
        harness.run(load(ROOT / "config" / "piston.yaml", overrides), bag=folder / name)
    done = lathe("compare", folder / "fast", folder / "slow", "-o", folder / "page.html")
    assert done.exit_code == 0, done.output
    return folder / "page.html"


def test_the_comparison_is_quiet_and_small(page, tmp_path):
    visit = Visit(page, tmp_path)
    assert visit.console == []
    assert visit.requests == []
    assert visit.document.count('class="drawn"') == 7
    assert page.stat().st_size < 3_000_000


def test_one_revolution_and_one_tolerance_steer_all_figures(page, tmp_path):
    driven = by_hand(page.read_text(encoding="utf-8"), _CHOOSE, tmp_path)
    visit = Visit(driven, tmp_path, "--window-size=1000,900")
    first, second = json.loads(html.unescape(re.search(r"<title>(.*)</title>", visit.document)[1]))
    assert first["signals"] == [[5, 3]] * 8
    assert second["signals"] == [[2, 300]] * 8
    assert [text.split(": ")[0] for text in first["texts"]] == ["fast", "slow"]
    assert second["texts"] == [f"{name}: within the tolerance from revolution 1 on" for name in ("fast", "slow")]
