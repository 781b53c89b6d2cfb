# SPDX-License-Identifier: Apache-2.0
"""Results of force and position loops: figures, verdict, and what is called unstable."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
from cells import SCENARIOS, config, cuts, in_blocks
from click.testing import CliRunner
from hypothesis import given
from numpy.testing import assert_allclose
from shown_page import ShownPage

from lathe_explore.sweep import LOOP_FIGURES, row
from lathe_explore.sweep.objectives import objectives
from lathe_machine.control.pid import Pid, PidGains
from lathe_rc import harness
from lathe_rc.analysis.loop_errors import RunningLoop
from lathe_rc.analysis.tolerance import FORCE, growth, swing_growth
from lathe_rc.cli import main
from lathe_rc.errors import InputError
from lathe_rc.judge.loops import FIGURES
from lathe_rc.signals.form_errors import form_errors

TURN = 400  # samples of a revolution in the made-up runs
WITHOUT_A_PART = [path.stem for path in SCENARIOS if "\n/tool:" not in path.read_text(encoding="utf-8")]


def evaluated(set_point, value, *, delay=0, command=None, limit=1.0, tolerance=0.0):
    """The behaviour of a loop whose controller sees ``value`` of ``delay`` samples ago."""
    seen = np.concatenate([np.zeros(delay), value])[: value.size]
    running = RunningLoop(0, delay, limit, tolerance)
    angle = 2.0 * np.pi / TURN * np.arange(value.size)
    running.add(angle, set_point, set_point - seen, np.zeros(value.size) if command is None else command)
    return running.found()


# --- the figures


def test_the_error_is_that_of_the_process_and_not_of_the_delayed_sensor():
    time = np.arange(10 * TURN) / TURN
    set_point = np.sin(2.0 * np.pi * time / 3.0)
    found = evaluated(set_point, 0.9 * set_point, delay=TURN // 8)
    expected = form_errors(2.0 * np.pi * time, 0.1 * set_point)
    assert found.errors.rms.size == 9, "the measurement of the last samples has not arrived"
    assert_allclose(found.errors.rms, expected.rms[:9], rtol=1e-9)
    assert_allclose(found.errors.largest, expected.largest[:9], rtol=1e-9)


@given(cuts)
def test_figures_do_not_depend_on_the_chunks(lengths):
    size = sum(lengths)
    time = np.arange(size)
    angle, set_point = 0.05 * time, np.where(time < size // 3, 0.0, np.sin(0.02 * time))
    error, command = np.cos(0.03 * time), np.sin(0.01 * time)
    whole, pieces = (RunningLoop(0, 40, 0.7) for _ in range(2))
    whole.add(angle, set_point, error, command)
    in_blocks(lengths, lambda _, *parts: pieces.add(*parts), angle, set_point, error, command)
    assert repr(pieces.found()) == repr(whole.found())


def test_a_step_has_the_overshoot_and_the_settling_time_of_its_formula():
    """A second-order loop; what disturbs it later is no overshoot."""
    damping, omega = 0.4, 2.0 * np.pi / TURN
    start, time = TURN, np.arange(8 * TURN) - TURN
    fast = omega * np.sqrt(1.0 - damping**2)
    swing = np.exp(-damping * omega * time) * (np.cos(fast * time) + damping * omega / fast * np.sin(fast * time))
    value = np.where(time < 0, 2.0, 2.0 - 3.0 * (1.0 - swing))
    value[6 * TURN] -= 1.0
    set_point, short = np.where(time < 0, 2.0, -1.0), 6 * TURN + TURN // 2
    found = evaluated(set_point, value, delay=7, tolerance=0.2).step
    assert (found.start, found.change, found.band) == (start, -3.0, 0.2)
    assert found.overshoot == pytest.approx(3.0 * np.exp(-np.pi * damping / np.sqrt(1.0 - damping**2)), rel=1e-4)
    assert found.settling == 5 * TURN + 1
    assert evaluated(set_point[:short], value[:short], tolerance=0.2).step.settling is None


def test_a_set_point_that_moves_has_reversals_and_no_step():
    """Of a glitch that begins at the reversal and one midway, the first alone is counted."""
    time = np.arange(10 * TURN)
    set_point = np.sin(2.0 * np.pi * time / (4 * TURN))  # reverses after 1, 3, 5, 7 and 9 revolutions
    value = set_point.copy()
    value[5 * TURN + 20 : 5 * TURN + 40] -= 0.01
    value[6 * TURN] -= 0.3
    found = evaluated(set_point, value)
    assert (found.reversals, found.step) == (5, None)
    assert found.glitch == pytest.approx(0.01)
    assert found.errors.largest.max() == pytest.approx(0.3)


def test_saturation_and_anti_windup_are_those_that_the_controller_counts():
    time = np.arange(20 * TURN)
    set_point, value = np.zeros(time.size), 3.0 * np.sin(0.013 * time) + np.sin(0.11 * time)
    pid = Pid(PidGains(0.5, 2.0, 0.3, 100.0), low=-1.0, high=1.0, step=0.01)
    command = np.zeros(time.size)
    pid.block(0, set_point, value, command)
    found = evaluated(set_point, value, command=command)
    assert found.saturated.sum() * TURN == pytest.approx(pid.saturated)
    # The controller looks at the sum of two successive errors, a message at one.
    assert found.held.sum() * TURN == pytest.approx(pid.clamped, rel=0.02)
    assert 0.0 < found.held.sum() < 0.9 * found.saturated.sum()


def test_a_swing_that_takes_several_revolutions_diverges_as_well():
    largest = np.abs(np.sin(0.7 * np.arange(120))) * np.maximum(5.0, 0.05 * 1.1 ** np.arange(120))
    assert growth(largest) is None
    found = swing_growth(largest, quantity=FORCE)
    assert found.diverges
    assert found.told().startswith("force error diverges from revolution ")
    assert 40 < found.since < 65


# --- scenarios


@pytest.mark.parametrize("name", WITHOUT_A_PART)
def test_a_scenario_without_a_part_ends_in_tolerance(name):
    result = harness.run(config(name))
    (loop,) = result.loops.values()
    assert result.recording.revolutions == round(result.scenario.nodes["spindle_encoder"].revolutions)
    assert loop.verdict.in_tolerance
    assert not loop.diverges
    assert "diverges" not in " ".join(loop.behaviour())


def test_a_position_error_is_that_of_the_slide():
    result = harness.run(config("approach"))
    signals = result.recording.dense
    slide = form_errors(signals["/encoder"]["angle_true"], 5e-3 - signals["/cross/state"]["measured_position"])
    found = result.loops["position_controller"].found
    assert_allclose(found.errors.rms, slide.rms[:29], rtol=1e-9, atol=1e-15)
    assert found.step.overshoot < 1e-12, "the ripple-free link comes from one side"


def test_a_tolerance_of_a_loop_changes_neither_bits_nor_identity():
    """Without one there are figures and no verdict, and the run says so."""
    short = "spindle_encoder.revolutions=12"
    one, other = (config("force_turning", short, f"force_controller.tolerance={value}") for value in (0.0, 5.0))
    assert one.shared.run_id == other.shared.run_id
    without, judged = harness.run(one), harness.run(other)
    assert without.digest == judged.digest
    assert without.loops["force_controller"].verdict is None
    (told, good), *_ = without.loops["force_controller"].judged()
    assert told.startswith("no tolerance is set; error at most ")
    assert good is None


PID = ("position_controller.law=pid", "position_controller.divisor=64")  # its gains are those of another slide
PUBLISHED = ("position_controller.memory_filter=0.0", "spindle_encoder.revolutions=520")
BACKWARDS = ("force_controller.proportional=-5e-3", "force_controller.integral=-0.1")


@pytest.mark.parametrize(
    ("name", "changes", "said"),
    [
        ("force_turning", ["force_controller.integral=0.2"], "force error diverges from revolution "),
        ("force_turning", BACKWARDS, "force loop diverges: its command stays at a limit against the error "),
        ("approach", PID, "position loop diverges: its command swings between its limits "),
        ("full_cell", ["position_controller.proportional=-2e4"], "position error diverges from revolution 2 on: "),
        ("periodic", PUBLISHED, "position error diverges from revolution 193 on: "),
    ],
)
def test_a_loop_that_diverges_is_called_so(name, changes, said):
    cell = config(name, *(["spindle_encoder.revolutions=60"] if name == "full_cell" else []), *changes)
    loop = next(loop for node, loop in harness.run(cell).loops.items() if node in changes[0])
    assert loop.diverges
    assert [good for text, good in loop.judged() if text.startswith(said)] == [False]
    assert loop.summary()["diverges"]


def test_a_set_point_out_of_reach_does_not_diverge():
    result = harness.run(config("force_turning", "force_controller.set_point=[3000.0]"))
    loop = result.loops["force_controller"]
    assert not loop.diverges
    assert next(loop.judged())[0].startswith("set point of the force out of reach: ")


# --- the command


def test_terminal_and_json_tell_the_loops_alike():
    run = ["run", "full_cell", "--revolutions", "30"]
    told = " ".join(CliRunner().invoke(main, run).stdout.split())
    found = json.loads(CliRunner().invoke(main, [*run, "--json"]).stdout)
    force, position = found["loops"]["force_controller"], found["loops"]["position_controller"]
    since, spare = force["tolerance"]["from_revolution"], force["tolerance"]["spare"]
    assert f"force_controller: in tolerance (±5 N) from revolution {since} on, {spare:.3g} N to spare" in told
    assert f"within ±5 N after {force['step']['settling_s']:.4g} s" in told
    assert f"last revolution │ {position['last']['rms']:#.4g} │ {position['last']['max']:#.4g} │" in told
    assert (found["revolutions"], force["unit"], position["unit"]) == (30, "N", "µm")
    assert len(force["per_revolution_rms"]) == 29


def test_a_tolerance_of_a_loop_can_be_required():
    run = ["run", "approach", "--require-tolerance", "--set"]
    assert CliRunner().invoke(main, [*run, "position_controller.tolerance=1e-6"]).exit_code == 0
    done = CliRunner().invoke(main, [*run, "position_controller.tolerance=1e-18"])
    assert done.exit_code == 1
    assert done.stderr.startswith("lathe: position_controller of approach is not in tolerance (±1e-12 µm): ")


# --- pages


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """Bags of a force loop that holds its set point and of one that diverges, and their results."""
    folder = tmp_path_factory.mktemp("loops")
    changes = {"calm": [], "wild": ["force_controller.integral=0.2"]}
    results = {
        name: harness.run(config("force_turning", "spindle_encoder.revolutions=60", *more), bag=folder / name)
        for name, more in changes.items()
    }
    return SimpleNamespace(folder=folder, results=results)


def shown(folder, *words):
    done = CliRunner().invoke(main, [*map(str, words), "-o", str(folder / "page.html")])
    assert done.exit_code == 0, done.output
    return ShownPage((folder / "page.html").read_text(encoding="utf-8"))


@pytest.mark.parametrize(("name", "mood"), [("calm", "good"), ("wild", "bad")])
@pytest.mark.usefixtures("no_pictures")
def test_a_report_judges_and_draws_a_loop_as_the_run_does(turned, tmp_path, name, mood):
    page = shown(tmp_path, "report", turned.folder / name)
    loop = turned.results[name].loops["force_controller"]
    said = " ".join(f"force_controller: {text}." for text, _ in loop.judged())
    head = re.search(rf'<section class="verdict {mood}".*?<p class="said">([^<]*)</p>', page.source, re.DOTALL)
    assert head[1] == said
    assert all(f"{text[1:]}." in page.text for text in loop.behaviour())
    last = loop.row(-1)
    assert page.rows("Force and position")[1][1:3] == [str(last["revolution"]), f"{last['rms']:.4g}"]
    drawn = page.specs["figure-0-0"][""]["data"]["values"]
    assert_allclose([row["b"] for row in drawn if row["l"] == "largest"], loop.found.errors.largest, rtol=1e-4)
    assert "No form to" not in page.text


@pytest.mark.usefixtures("no_pictures")
def test_a_comparison_shows_the_loops_of_runs_without_a_part(turned, tmp_path):
    page = shown(tmp_path, "compare", turned.folder / "calm", turned.folder / "wild")
    rows = page.rows("Force and position")
    found = [turned.results[name].loops["force_controller"] for name in ("calm", "wild")]
    assert [row[:2] for row in rows] == [["force_controller [N]", "calm"], ["force_controller [N]", "wild"]]
    assert [row[3] for row in rows] == [f"{loop.row(-1)['rms']:.4g}" for loop in found]
    assert [row[8] for row in rows] == [f"{found[0].found.step.settling / 64e3:.4g}", "–"]
    drawn = page.specs["figure-0-0"][""]
    assert drawn["usermeta"] == {"signals": ["revolution"]}
    largest = [row["v"] for row in drawn["layer"][0]["data"]["values"] if row["l"] == "wild"]
    assert_allclose(largest, found[1].found.errors.largest, rtol=1e-4)


@pytest.mark.parametrize("angle", [[0.0, 2.0, 1.0], [0.0, np.nan, 1.0], [0.0, 1.0, np.inf], [0.0, 1.0, 1e300]])
def test_an_absurd_angle_of_a_bag_is_refused(angle):
    with pytest.raises(InputError):
        RunningLoop(0, 0, 1.0).add(np.array(angle), *np.zeros((3, 3)))


# --- sweeps and tunings


@pytest.mark.parametrize(
    ("name", "node"), [("force_turning", "force_controller"), ("full_cell", "position_controller")]
)
def test_a_row_of_a_sweep_has_the_figures_of_the_run(name, node):
    cell = config(name, "spindle_encoder.revolutions=20")
    measures = [row.measure(f"{node}.{figure}", cell) for figure in FIGURES]
    found = row.compute(cell, {}, [], measures)
    result = harness.run(cell)
    assert {each.statistic: found[each.name] for each in measures} == {
        figure: of(result.loops[node]) for figure, (of, _) in FIGURES.items()
    }
    assert found["digest"] == row.digest(result.recording, measures)
    assert found[f"{node}.max_error"] == result.loops[node].found.errors.largest[-1]
    assert row.unit(f"{node}.overshoot", cell) == ((1.0, "N") if node == "force_controller" else (1e6, "µm"))


def test_a_tuning_takes_figures_of_loops_as_goals_and_subjects():
    cell = config("force_turning")
    asked = objectives(cell, ["force_controller.rms_error"], ["force_controller.diverges<=0"])
    stable = {"status": row.DONE, "margin": None, "force_controller.rms_error": 1.0, "force_controller.diverges": 0.0}
    assert asked.score([stable]).feasible
    assert not asked.score([stable | {"force_controller.diverges": 1.0}]).feasible
    assert [each.name for each in asked.measures] == ["force_controller.rms_error", "force_controller.diverges"]
    with pytest.raises(InputError, match=r"no such column; did you mean force_controller.settling"):
        objectives(cell, ["force_controller.setling"])
    assert tuple(FIGURES) == LOOP_FIGURES
