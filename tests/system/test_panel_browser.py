# SPDX-License-Identifier: Apache-2.0
"""The panel in a real browser, wide and narrow, light and dark."""

import contextlib
import random
import re
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from bags import sized
from matplotlib.image import imread
from test_panel import attached, bag, hear, retracted, scenario
from test_panel_timeline import spiked

import lathe_rc
from chromium import Chromium
from lathe_live import page_server, panel, panel_lamp, panel_player
from lathe_live.loop_page import LoopPage
from lathe_live.panel_player import Player
from lathe_live.panel_run import Driver, LiveCell
from lathe_live.varied_loop import VariedLoop
from lathe_rc import harness, messages
from lathe_rc.cell.scenario import load
from lathe_rc.cell.wiring import Cell

pytestmark = pytest.mark.system
__all__ = ["bag", "retracted"]  # fixtures

ROOT = Path(__file__).parents[2]
STATE = "SHOWN.now.safety.state"
SUPERVISED = ROOT / "config" / "supervised.yaml"


@pytest.fixture
def page(tmp_path):
    """The panel of the full cell under a supervisor, and the address that it has in the browser."""
    cell = LiveCell(load(ROOT / "config" / "supervised_full_cell.yaml", ["spindle_encoder.revolutions=60"]))
    loop = LoopPage(VariedLoop(cell.scenario), tmp_path / "loop.yaml").site()
    with (
        Driver(cell, 0.0) as driver,
        page_server.serving(panel.with_loops(panel.site(driver, cell), loop)) as address,
        Chromium(tmp_path) as browser,
    ):
        browser.look(1440, 1000)
        browser.open(address)
        browser.until("SHOWN.now.state == 'paused'")
        yield browser, cell
        own = address.partition("?")[0]
        # The browser counts refused commands as errors, and has advice on the way in which a test reads pixels.
        assert [line for line in browser.told if "400 (" not in line and "readback" not in line] == []
        assert [each for each in browser.asked if not each.startswith((own, "data:", "blob:", "about:"))] == []


def submit(browser, form, button, **values):
    for name, value in values.items():
        script = f"(field => {{ field.value = {value!r}; field.dispatchEvent(new Event('change')); }})"
        browser.run(f"{script}(document.getElementById('{form}').elements['{name}'])")
    browser.click(f"#{form} {button}")


def one_revolution(browser):
    before = browser.run("SHOWN.now.sample || 0")
    browser.click("#step")
    browser.until(f"SHOWN.now.state == 'paused' && SHOWN.now.sample > {before}")


def saved(folder, name):
    """The file of a name, once the browser has written it."""
    for _ in range(200):
        if (folder / name).exists() and not list(folder.glob("*.crdownload")):
            return folder / name
        threading.Event().wait(0.05)
    raise AssertionError(sorted(folder.iterdir()))


def test_the_whole_cell_is_run_broken_retracted_and_saved_from_the_page(page, tmp_path):
    """Revolutions, a fault and the supervisor's reaction, reset and retraction; a picture."""
    browser, cell = page
    submit(browser, "record", "button", bag=str(tmp_path / "bag"))
    browser.until("SHOWN.now.bag")
    browser.click("#step")
    assert browser.until("SHOWN.now.state == 'paused' && SHOWN.rows.length") == 1
    while browser.run("SHOWN.rows.length") < 12:
        one_revolution(browser)
    browser.click("#picture")
    picture = imread(saved(tmp_path, "supervised_full_cell.png"))
    assert picture.shape[1] > 2000
    assert len(np.unique((picture[::7, ::7, :3] * 255).astype(int).reshape(-1, 3), axis=0)) > 100
    # A fault, and what the supervisor makes of it
    target = "coarse/state.measured_position"
    submit(browser, "fault", "button", node="electrodynamic_actuator", target=target, kind="stuck")
    browser.run("document.getElementById('fault').elements.node.value = 'spindle_encoder'")
    one_revolution(browser)
    browser.until("document.getElementById('fault').elements.node.value == 'electrodynamic_actuator'")  # to repair it
    browser.until(f"{STATE} != 'nominal'")
    assert "limit" in browser.until("document.getElementById('alarm').textContent")
    assert " since " in browser.run("document.getElementById('safety').textContent")
    browser.click("#repair")
    while browser.run(STATE) != "safe":
        one_revolution(browser)
    log = browser.run("document.getElementById('log').textContent")
    assert f"electrodynamic_actuator/events: fault {target} stuck" in log
    assert "error tool" in log
    assert "µm, limit 30 µm: retracting, retract" in log
    for action, told in (("reset", "reset"), ("retract", "operator")):
        browser.click(f"#{action}:enabled")
        assert browser.until("document.querySelector('#bar .answer').textContent").endswith(f": {action}")
        one_revolution(browser)
        browser.until(f"SHOWN.log.some(line => line.source == 'safety/status' && line.text.startsWith('{told}'))")
    browser.click("#go")
    browser.until("SHOWN.now.state == 'ended'")
    # The same events without the panel give the same run
    given = [f"{node}.events={events!r}" for node, events in cell.events.items()]
    again = load(ROOT / "config" / "supervised_full_cell.yaml", ["spindle_encoder.revolutions=60", *given])
    assert lathe_rc.read_bag(tmp_path / "bag").digests() == harness.run(again).digest


def test_the_page_fits_its_window_shows_refusals_and_has_the_loops_as_a_tab(page):
    """In light and dark, wide and narrow; after a refused command the cell goes on, with other parameters."""
    browser, cell = page
    browser.click("#go")
    browser.until("SHOWN.rows.length > 5")
    browser.click("#go")
    for width in (1440, 420):
        for dark in (False, True):
            browser.look(width, 900, dark=dark)
            paper = "rgb(22, 24, 26)" if dark else "rgb(255, 255, 255)"
            browser.until(f"getComputedStyle(document.body).backgroundColor == '{paper}'")
            assert browser.run("document.documentElement.scrollWidth") <= width
            browser.run("window.scrollTo(0, document.body.scrollHeight)")
            for part in ("lamp", "safety", "verdict", "ground", "age", "go", "retract", "reset"):
                box = browser.run(f"document.getElementById('{part}').getBoundingClientRect().toJSON()")
                assert 0 <= box["top"] < box["bottom"] <= 900, (width, part, box)
            # Each canvas is drawn anew in the colours of the page.
            corner = "[...document.getElementById('map').getContext('2d').getImageData(0, 0, 1, 1).data].slice(0, 3)"
            browser.until(f"'rgb(' + {corner}.join(', ') + ')' == '{paper}'")
            drawn = "document.querySelectorAll('#machine polygon, #machine rect').length"
            browser.until(f"{drawn} >= 8")  # with drives, once a frame of the run is drawn
    # A refused command, and one that is accepted
    submit(browser, "change", "button[value=start]", name="seed", value="none")
    refused = browser.until("document.querySelector('#change .answer.refused').textContent")
    assert "seed" in refused  # at the command
    submit(browser, "change", "button[value=start]", name="spindle_encoder.revolutions", value="4.0")
    browser.until("SHOWN.now.samples < 20000")
    browser.click("#go")
    browser.until("SHOWN.now.state == 'ended'")
    assert cell.scenario.value("spindle_encoder.revolutions") == 4.0
    # The loops of the cell
    browser.open(browser.run("document.querySelector('nav a:not([aria-current])').href"))
    browser.until("document.title == 'Loop of supervised_full_cell'")
    browser.until("document.querySelectorAll('.vega-embed').length > 2")


def test_the_lamp_shows_what_was_heard_and_is_grey_when_nothing_is(retracted, tmp_path, monkeypatch):
    """Before the first message, nominal, retracted, silent, 20 s behind, and after the end of the server."""
    types, heard = retracted
    live, read = attached(types), "document.getElementById({!r}).textContent".format
    colour = "getComputedStyle(document.getElementById('lamp')).backgroundColor"
    with contextlib.ExitStack() as serving, Chromium(tmp_path) as browser:
        site = panel.attached_site(live.view, Cell(scenario().nodes), SimpleNamespace(cannot={}))
        browser.look(1440, 1000)
        browser.open(serving.enter_context(page_server.serving(site)))
        browser.until(f"{read('safety')}.startsWith('unknown')")
        assert browser.run(colour) == "rgba(0, 0, 0, 0)"
        hear(live, heard[: len(heard) // 3])
        browser.until(f"{read('safety')} == 'nominal' && {colour} == 'rgb(46, 125, 79)'")
        hear(live, heard[len(heard) // 3 :])
        browser.until(f"{read('safety')}.startsWith('safe') && {colour} == 'rgb(179, 38, 46)'")
        assert "index_pulses encoder" in browser.run(read("alarm"))
        assert browser.run(read("in-force")) == "fault in force: spindle_encoder: encoder missed_index"
        monkeypatch.setattr(panel_lamp, "_LATE", -1.0)
        browser.until(f"{read('safety')}.includes('last heard') && {colour} == 'rgb(138, 138, 138)'")
        monkeypatch.undo()
        hear(live, heard[: len(heard) // 3])  # the run again
        browser.until(f"{read('safety')} == 'nominal' && {colour} == 'rgb(46, 125, 79)'")
        browser.until(f"{read('age')} == 'up to date' && !document.body.classList.contains('lost')")
        monkeypatch.setattr(live.view.age, "_newest", live.view.age._newest + 20 * 64000)
        browser.until(f"{read('age')}.startsWith('shows the run as it was 20')")
        assert browser.run(read("verdict")).endswith("(old)")
        serving.close()
        browser.until(f"{read('safety')}.includes('no answer') && {colour} == 'rgb(138, 138, 138)'")
        assert re.match(r"lathe panel was not heard for \d+ s", browser.run(read("age")))
        assert browser.run("document.body.classList.contains('lost')")


RECORDED = """(() => {
  window.recorded = [];
  const safety = document.getElementById("safety"), look = () => {
    const shown = [safety.textContent.split(/[ ,]/)[0], safety.parentNode.classList.contains("old")];
    if (String(recorded.at(-1)?.slice(1)) != String(shown)) recorded.push([performance.now() / 1000, ...shown]);
    requestAnimationFrame(look);
  };
  look();
})()"""  # instants at which the state that is shown, or its mark as old, changes
CLOCK = "performance.now() / 1000"


FREE = {"offline": False, "latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}


@pytest.mark.parametrize("link", [{"latency": 20_000}, {"downloadThroughput": 2000}, {"offline": True}])
def test_over_a_slow_or_cut_link_no_old_state_is_shown_without_a_mark(retracted, tmp_path, link):
    """Answers 20 s late, at 2 kB/s, or none: 5 s after a retraction, the page shows it or marks its state as old.

    A command without an answer says so.
    """
    types, heard = retracted
    live, read = attached(types), "document.getElementById({!r}).textContent".format
    site = panel.attached_site(live.view, Cell(scenario().nodes), SimpleNamespace(cannot={}, act=lambda *_: "done"))
    with page_server.serving(site) as address, Chromium(tmp_path) as browser:
        browser.open(address)
        hear(live, heard[: len(heard) // 3])
        browser.until(f"{read('safety')} == 'nominal' && {read('age')} == 'up to date'")
        browser.run(RECORDED)
        browser.call("Network.emulateNetworkConditions", **{**FREE, **link})
        browser.run("document.getElementById('retract').disabled = false")
        browser.click("#retract")
        hear(live, heard[len(heard) // 3 :])
        changed, answer = browser.run(CLOCK), "document.querySelector('#bar .answer').textContent"
        if "downloadThroughput" not in link:
            said = "no answer: has lathe panel ended?" if "offline" in link else "sent; no answer yet"
            browser.until(f"{answer} == '{said}' && {read('safety')}.startsWith('nominal, no answer from lathe panel')")
        if "offline" in link:
            browser.call("Network.emulateNetworkConditions", **FREE)
        browser.until(f"{read('safety')}.startsWith('safe')", 120.0)
        shown = browser.run("recorded")
        ends = [*(begin for begin, *_ in shown[1:]), browser.run(CLOCK)]
        unmarked = [
            end - changed for end, (_, state, old) in zip(ends, shown, strict=True) if state == "nominal" and not old
        ]
        assert max(unmarked) < 5.5, shown
        if "offline" not in link:
            browser.until(f"{answer}.endsWith('done')", 120.0)
            assert [line for line in browser.told if "readback" not in line] == []


RED = """(() => {
  const place = document.getElementById('timeline'), { width, height } = place;
  const { data } = place.getContext('2d').getImageData(0, 0, width, height), columns = new Set();
  const bad = [1, 3, 5].map(k => parseInt(style('--bad').slice(k, k + 2), 16));
  for (let k = 0; k < width * height; k++) if (bad.every((part, c) => data[4 * k + c] == part)) columns.add(k % width);
  return [...columns].sort((a, b) => a - b);
})()"""
READING = "document.getElementById('reading').textContent"


def press(browser, key, **more):
    browser.call("Input.dispatchKeyEvent", type="keyDown", key=key, **more)


def test_a_spike_of_one_sample_in_a_long_bag_is_found_in_the_timeline_and_by_keyboard(tmp_path, monkeypatch):
    """Its red mark is the only one after the first revolutions; a click there shows it, and keys keep the focus."""
    harness.run(scenario("supervised", 800), bag=tmp_path / "bag")
    monkeypatch.setattr(panel_player, "pieces", spiked(2_000_123, 40e-6))
    player = Player(tmp_path / "bag")
    angle = lathe_rc.read_bag(tmp_path / "bag").of_type(messages.ENCODER)["angle_true"]
    turn = int(angle[2_000_123] / (2 * np.pi))
    with (
        Driver(player, 0.0) as driver,
        page_server.serving(panel.player_site(driver, player)) as address,
        Chromium(tmp_path) as browser,
    ):
        browser.look(1440, 1000)
        browser.open(address)
        browser.until(f"TIME.told && ABOUT.name && {RED}.length")
        assert browser.run("TIME.told.every") == 2
        box = browser.run("document.getElementById('timeline').getBoundingClientRect().toJSON()")
        red = [x for x in browser.run(RED) if x > 0.1 * box["width"]]
        assert 0 < len(red) <= 4  # one cell
        y = browser.run("TOP + 3 * ROW + 4 + TITLE + 10")
        browser.run("document.getElementById('timeline').scrollIntoView({ block: 'center' })")
        box = browser.run("document.getElementById('timeline').getBoundingClientRect().toJSON()")
        for kind in ("mousePressed", "mouseReleased"):
            place = {"x": box["x"] + red[0] + 1, "y": box["y"] + y}
            browser.call("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1, **place)
        browser.until(f"SHOWN.rows.length && Math.max(...SHOWN.latest.map(row => row.revolution)) == {turn + 1}")
        assert f"revolution {turn + 1}" in browser.run(READING)
        assert "to 40" in browser.run(READING)
        # By keyboard: a cell further, in the whole bag and zoomed in; the focus stays.
        browser.run("document.getElementById('timeline').focus()")
        for zoomed, step in ((0, 2), (3, 1)):
            for _ in range(zoomed):
                press(browser, "+")
            browser.until(f"TIME.told.every == {step}")
            before = browser.run("TIME.cursors[0].first")
            press(browser, "ArrowRight")
            browser.until(f"TIME.cursors[0].first - {before} >= 1")
            assert browser.run("TIME.cursors[0].first") - before <= 2 * step - 1
            browser.until("SHOWN.now.sample == TIME.cursors[0].values.sample[1] + 2")
            assert browser.run("document.activeElement.id") == "timeline"
            assert int(browser.run("document.activeElement.getAttribute('aria-valuenow')")) > before + 1
        press(browser, "ArrowRight", modifiers=8)
        browser.until("TIME.cursors[1]")
        assert "difference: 1 revolutions" in browser.run(READING)
        assert [line for line in browser.told if "readback" not in line] == []


def test_the_causes_are_shown_beside_the_verdict_as_a_bar_with_their_shares(tmp_path):
    """Refused before the first revolution, in words; a second click closes them."""
    cell, read = LiveCell(scenario("supervised", 20)), "document.getElementById('{}').textContent".format
    with (
        Driver(cell, 0.0) as driver,
        page_server.serving(panel.site(driver, cell)) as address,
        Chromium(tmp_path) as browser,
    ):
        browser.open(address)
        browser.until("SHOWN.now.state == 'paused' && ABOUT.nodes.length")
        browser.click("#why")
        assert "no complete revolution yet" in browser.until("document.querySelector('#bar .answer').textContent")
        assert browser.run("document.getElementById('causes').hidden")
        browser.click("#go")
        browser.until("SHOWN.now.state == 'ended'")
        browser.click("#why")
        assert browser.until("[...document.querySelectorAll('#shares span')].map(bar => bar.textContent)")[0] == "speed"
        found = lathe_rc.budget(scenario("supervised", int(cell.view.turns)))
        for cause in found.causes:
            assert f"{cause.name} {float(cause.percent()):g} %" in browser.run(read("causes-of")) or cause.share < 0.005
        browser.click("#why")
        assert browser.run("document.getElementById('causes').hidden")


def test_a_click_in_a_run_that_goes_on_shows_what_is_kept_and_says_so(page):
    """Curves and log up to there; machine and header are those of the newest sample, and a button returns to them."""
    browser, cell = page
    for _ in range(20):
        one_revolution(browser)
    browser.until("TIME.told.bands.error[0].length >= 20")
    browser.run("choose(cellAt(9), 'error', false)")
    said = browser.until(
        "!document.getElementById('shown').hidden && document.getElementById('shown-words').textContent"
    )
    assert "up to revolution 10, marked in the map" in said
    assert "Machine, state and header: the newest sample." in said
    newest = browser.run("SHOWN.now.sample")
    one_revolution(browser)
    ended = f"sample {cell.reached} of {cell.samples}"
    browser.until(f"document.getElementById('state').textContent.endsWith({ended!r})")
    assert cell.reached > newest
    assert browser.run("SHOWN.at.first") == 9
    browser.click("#newest-again")
    assert browser.run("document.getElementById('shown').hidden && SHOWN.at === null")


def test_a_memory_is_cleared_while_the_tool_cuts_only_after_a_second_click(page):
    """The warning stands at the button; on a narrow screen, both are above the bar of commands."""
    browser, cell = page
    one_revolution(browser)
    browser.look(420, 900)
    browser.click("#more")
    clear = "[...document.querySelectorAll('#actions button')].find(each => each.textContent.startsWith('clear'))"
    browser.run(f"{clear}.click()")
    told = browser.until("document.querySelector('#actions .answer.refused').textContent")
    assert "may retract the tool. Click again to clear." in told
    assert cell.events == {}
    browser.run(f"{clear}.click()")
    browser.until("document.querySelector('#actions .answer:not(.refused)').textContent.endsWith(': clear')")
    assert [event.partition(": ")[2] for event in cell.events["learning_controller"]] == ["clear"]


COMMANDS = [
    ("learning_controller", "freeze"),
    ("learning_controller", "learn"),
    ("learning_controller", "clear"),
    ("learning_controller", "set learning_gain 0.7"),
    ("supervisor", "retract"),
    *3 * [("supervisor", "reset")],
    ("spindle_encoder", "fault encoder missed_index"),
    ("spindle_encoder", "fault encoder.speed wrong scale=1.2"),
    ("electrodynamic_actuator", "fault coarse/command.position wrong scale=0.9"),
    ("electrodynamic_actuator", "fault coarse/state.measured_position stuck"),
    ("tool", "fault tool.error off"),
    ("spindle_encoder", "repair encoder"),
    ("spindle_encoder", "repair encoder.speed"),
    ("electrodynamic_actuator", "repair coarse/command.position"),
    ("electrodynamic_actuator", "repair coarse/state.measured_position"),
]


def _stepped_at_random(browser, driver, cell, choice):
    """Command at random, and compare the page with the supervisor after each step; returns the states."""
    read, states = (lambda name: browser.run(f"document.getElementById('{name}').textContent")), set()
    supervisor = cell.cell.stages["supervisor"]
    for _ in range(10):
        node, command = choice.choice(COMMANDS)
        effective = command != "reset" or supervisor.reaction  # without an alarm, a reset does nothing
        carried_out, at = browser.run("!document.getElementById('reset').disabled"), cell.reached
        driver.call(lambda node=node, command=command: cell.act(node, command))
        for _ in range(choice.choice([1, 2, 2, 6])):
            one_revolution(browser)
        # Its text tells that the page is drawn, which it is a frame after the answer.
        browser.until(f"document.getElementById('state').textContent.includes('sample {cell.reached} of')")
        if command == "reset" and effective:
            log = [line["text"].partition(":")[0] for line in cell.view.latest.log if line["sample"] == at]
            assert ("reset" if carried_out else "reset refused") in log[1:], log
        state = supervisor.state.name.lower()
        states.add(state)
        assert read("safety").partition(" ")[0] == state, cell.events
        assert read("age") == "up to date"
        assert not (read("verdict") == "PART GOOD" and state in panel_lamp.OUT)
    given = [f"{node}.events={events!r}" for node, events in cell.events.items()]
    again = load(SUPERVISED, [f"spindle_encoder.revolutions={cell.view.turns}", *given])
    found, title = harness.run(again).verdict, read("verdict")
    away = [f"{found.quantity.told(found.largest)} from the form"] if state in panel_lamp.OUT else []
    assert any(text in read("ground") for text in (found.told(), *away))
    assert (title == "PART BAD") == (not found.in_tolerance and not found.unjudged)
    assert found.in_tolerance or title != "PART GOOD"
    return states


def test_the_page_shows_the_state_of_the_supervisor_in_a_campaign_of_random_commands(tmp_path):
    """After each command and fault; also the verdict of `lathe run`, and whether a reset is carried out or refused."""
    states = set()
    for seed in range(sized(50)):
        cell = LiveCell(load(SUPERVISED, ["spindle_encoder.revolutions=120"]))
        folder = tmp_path / str(seed)
        folder.mkdir()
        site = lambda driver, cell=cell: page_server.serving(panel.site(driver, cell))  # noqa: E731
        with Driver(cell, 0.0) as driver, site(driver) as address, Chromium(folder) as browser:
            browser.open(address)
            browser.until("SHOWN.now.state == 'paused' && ABOUT.nodes.length")
            for _ in range(5):
                one_revolution(browser)
            states |= _stepped_at_random(browser, driver, cell, random.Random(seed))  # noqa: S311 - no secret
    assert states >= {"nominal", "retracting", "safe"}
