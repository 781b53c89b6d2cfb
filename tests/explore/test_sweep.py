# SPDX-License-Identifier: Apache-2.0
"""Sweeps: their cells, the rows of the table, and continuation after a stop."""

import contextlib
import math
import os
import signal
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from machines import assert_refused

import lathe_explore
from lathe_explore.sweep import LOOP_FIGURES, NUMBERS, alone, row, space, workers
from lathe_explore.sweep.folder import Folder
from lathe_explore.sweep.space import Space
from lathe_explore.sweep.sweep import Sweep
from lathe_papers import best_law, drive_tolerance, speed_deviation
from lathe_rc import harness
from lathe_rc.cell import cells_file
from lathe_rc.cell import scenario as scenarios
from lathe_rc.cli import main
from lathe_rc.errors import InputError

LEAD, Q, DAMPING = "learning_controller.lead_time", "learning_controller.q_time", "electrodynamic_actuator.damping"
PISTON = Path(__file__).parents[2] / "config" / "piston.yaml"


@pytest.fixture(scope="module")
def piston():
    """Four revolutions of the piston."""
    return scenarios.load(PISTON, ["spindle_encoder.revolutions=4", "tool.tolerance=4e-6"])


def cells(scenario, **of):
    """Cells of a checked space."""
    made = Space(**of)
    made.check(scenario)
    return list(made.cells(scenario))


# ---- which cells -----------------------------------------------------------------------------------------------------


def test_ranges_lists_and_parts_of_the_scenarios_value(piston):
    assert cells(piston, grid={LEAD: "1e-3:2e-3:3", "block_size": "64,128"}) == [
        {LEAD: lead, "block_size": size} for lead in (1e-3, 1.5e-3, 2e-3) for size in (64, 128)
    ]
    assert [each[Q] for each in cells(piston, grid={Q: "1e-6:1e-4:3:log"})] == pytest.approx([1e-6, 1e-5, 1e-4])
    (half,) = cells(piston, grid={LEAD: "50%"})
    assert half[LEAD] == piston.nodes["learning_controller"].lead_time / 2
    laws = cells(piston, grid={"learning_controller.lead_law": "variable,constant_angle"})
    assert [each["learning_controller.lead_law"] for each in laws] == ["variable", "constant_angle"]


def test_elements_of_lists_are_varied_and_tied(piston):
    amplitude, frequency = "spindle_encoder.deviation_amplitude", "spindle_encoder.deviation_frequency"
    base = piston.varied({amplitude: [0.0, 0.1], frequency: [9.0, 9.0]})
    ties = {f"{frequency}[1]": f"{amplitude}[0] * 100"}
    (cell,) = cells(base, grid={f"{amplitude}[0]": [0.05]}, ties=ties)
    table = base.varied(cell).nodes["spindle_encoder"]
    assert (table.deviation_amplitude, table.deviation_frequency) == ([0.05, 0.1], [9.0, 5.0])
    assert_refused(lambda: cells(base, grid={f"{amplitude}[2]": [0.05]}), "a list of 2 there")
    assert_refused(lambda: cells(base, grid={f"{LEAD}[0]": [1e-3]}), "no list there")


def test_models_follow_the_drives_or_stay(client, tmp_path):
    two = scenarios.load(PISTON.with_name("two_channel.yaml"), ["spindle_encoder.revolutions=6"])
    space_ = Space(grid={"electrodynamic_actuator.natural_frequency": ["80%"]})
    own = two.nodes["electrodynamic_actuator"].natural_frequency
    for models, known in (("follow", 0.8 * own), ("nominal", own)):
        found = lathe_explore.run_sweep(two, space_, tmp_path / models, client=client, models=models)
        assert found.scenario(0).nodes["learning_controller"].model_natural_frequency == known
    kept = Folder(tmp_path / "follow").scenario
    assert kept == two
    assert kept.varied({DAMPING: 0.7}) == two.varied({DAMPING: 0.7})
    with pytest.raises(InputError, match=r"another cell: learning_controller.model_\w+ = .* there, and default here"):
        lathe_explore.run_sweep(two, space_, tmp_path / "nominal", client=client)


def test_ties_follow_what_they_depend_on_in_whatever_order_they_are_given(piston):
    ties = {Q: f"{DAMPING} * 1e-4", DAMPING: f"sqrt({LEAD} * 1e3) / 2 + 0 * nominal_rpm"}
    (cell,) = cells(piston, grid={LEAD: [1.44e-3]}, ties=ties)
    assert cell[DAMPING] == pytest.approx(0.6)
    assert cell[Q] == cell[DAMPING] * 1e-4
    assert_refused(lambda: cells(piston, ties={Q: LEAD, LEAD: Q}), "tied in a circle")


@pytest.mark.parametrize("sampler", space.SAMPLERS)
def test_draws_have_their_law(piston, sampler):
    drawn = {DAMPING: "normal:5%", LEAD: "1e-3:2e-3", Q: "1e-6:1e-4:log"}
    found = cells(piston, sampled=drawn, sample=f"{sampler}:1024")
    damping, lead, q = (np.array([each[target] for each in found]) for target in drawn)
    nominal = piston.nodes["electrodynamic_actuator"].damping
    # Each tolerance is five standard deviations of the estimate from 1024 independent draws.
    assert damping.mean() == pytest.approx(nominal, abs=5 * 0.05 * nominal / 32)
    assert damping.std() == pytest.approx(0.05 * nominal, rel=5 / math.sqrt(2 * 1024))
    assert 1e-3 <= lead.min() < lead.max() <= 2e-3
    assert lead.mean() == pytest.approx(1.5e-3, abs=5 * 1e-3 / math.sqrt(12) / 32)
    assert np.log10(q).mean() == pytest.approx(-5.0, abs=5 * 2 / math.sqrt(12) / 32)


@pytest.mark.parametrize("sampler", ["sobol", "halton", "random"])
def test_more_points_begin_with_the_same_ones(piston, sampler):
    few, many = (cells(piston, sampled={LEAD: "1e-3:2e-3"}, sample=f"{sampler}:{n}") for n in (8, 5000))
    assert many[:8] == few


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(1e-4, 1e-2), min_size=1, max_size=4), st.integers(1, 4), st.integers(0, 3), st.integers(1, 3))
def test_cells_are_as_many_as_are_counted_and_differ(piston, leads, most, points, seeds):
    made = Space(
        grid={LEAD: leads, Q: f"1e-5:1e-4:{most}"},
        sampled={DAMPING: "uniform:0.5:1"} if points else {},
        sample=f"random:{points}" if points else "",
        seeds=seeds,
    )
    found = list(made.cells(piston))
    assert len(found) == made.count(piston) == len({space.canonical(each) for each in found})
    assert Space(**made.to_json()) == Space(**Space(**made.to_json()).to_json())


@pytest.mark.parametrize(
    ("of", "said"),
    [
        ({"grid": {"learning_controller.lead_tim": "1,2"}}, "unknown parameter; did you mean lead_time"),
        ({"grid": {LEAD: "1e-3:2e-3"}}, "allowed: LOW:HIGH:COUNT"),
        ({"grid": {LEAD: "0:2e-3:3:log"}}, "ends above 0"),
        ({"grid": {"block_size": "64:128:4"}}, "allowed: whole numbers"),
        ({"sampled": {LEAD: "1e-3:2e-3"}}, "no sample says how often"),
        ({"sample": "sobol:4"}, "nothing is drawn"),
        ({"sampled": {LEAD: "1e-3:2e-3"}, "sample": "sobel:4"}, "allowed: sobol:N, .* N from 1 up to 16777216"),
        ({"sampled": {"block_size": "normal:5%"}, "sample": "sobol:4"}, "a discrete distribution, such as randint"),
        ({"sampled": {LEAD: "normal:-1"}, "sample": "sobol:4"}, "a deviation above 0"),
        ({"grid": {LEAD: "1e-3"}, "ties": {LEAD: "1e-3"}}, "twice; allowed: once"),
        ({"ties": {Q: "learning_controller.lead_time +"}}, "allowed: targets and numbers"),
        ({"ties": {Q: "learning_controller.lead_tine"}}, "unknown parameter"),
        ({"ties": {Q: f"{LEAD} / 0"}}, "division by zero"),
        ({"ties": {Q: "__import__('os').getcwd()"}}, "learning_controller.q_time"),
        ({"grid": {LEAD: "1e-3,fast"}}, "learning_controller.lead_time = 'fast'; allowed: a finite number"),
        ({"grid": {"learning_controller.lead_law": "variable,constant"}}, "= 'constant'; allowed: one of "),
        ({"grid": {"block_size": [64.5]}}, "block_size = 64.5; allowed: an integer"),
        ({"given": [{LEAD: "slow"}]}, "learning_controller.lead_time = 'slow'; allowed: a finite number"),
        ({"given": [{LEAD: 1e-3}, {LEAD: 1e-3}]}, "the same; allowed: each once"),
    ],
)
def test_what_is_no_space_is_refused_in_a_line(piston, of, said):
    assert_refused(lambda: cells(piston, **of), said)


def test_cells_of_a_file(piston, tmp_path):
    (tmp_path / "cells.csv").write_text(f"{LEAD}, block_size\n1e-3,64\n2e-3,128\n")
    (tmp_path / "cells.yaml").write_text(f"- {{{LEAD}: 1e-3, block_size: 64}}\n- {LEAD}: 2e-3\n  block_size: 128\n")
    found = [cells_file.read(tmp_path / name) for name in ("cells.csv", "cells.yaml")]
    assert found[0] == found[1] == [{LEAD: 1e-3, "block_size": 64}, {LEAD: 2e-3, "block_size": 128}]
    (tmp_path / "short.csv").write_text(f"{LEAD},{Q}\n1e-3\n")
    assert_refused(lambda: cells_file.read(tmp_path / "short.csv"), r"short.csv:2: 1 values; allowed: 2")


# ---- rows of the table -----------------------------------------------------------------------------------------------


def test_a_row_says_what_the_run_says(piston):
    values = {LEAD: 1.3e-3, DAMPING: 0.8}
    asked = row.measure("coarse/state.effort:max", piston)
    found = row.compute(piston, values, [LEAD, DAMPING], [asked])
    result = harness.run(piston.varied(values))
    errors, effort = result.errors, result.recording.dense["/coarse/state"]["effort"]
    assert found["status"] == row.DONE
    assert found["tool.max_errors"].tolist() == errors.largest.tolist()
    assert (found["tool.rms_error"], found["tool.first_rms_error"]) == (errors.rms[-1], errors.rms[0])
    assert found[asked.name] == np.abs(effort[errors.starts[-2] : errors.starts[-1]]).max()
    assert found["digest"] == row.digest(result.recording, [])
    assert 0.0 < found["margin"] < 1.0
    assert found["tool.in_tolerance_from"] == result.verdict.since > 1


def test_what_goes_wrong_with_a_cell_stands_in_its_row(piston, monkeypatch):
    refused = row.compute(piston, {LEAD: 3e-3}, [LEAD], [])
    assert refused["status"] == row.REFUSED
    assert "learning diverges" in refused["reason"]
    assert refused["margin"] < 0.0
    unstable = piston.varied({"learning_controller.allow_unstable": True, "learning_controller.stop_ratio": 0.01})
    assert row.compute(unstable, {LEAD: 3e-3}, [LEAD], [])["status"] == row.DIVERGED
    wrong = row.compute(piston, {LEAD: -1.0}, [LEAD], [])
    assert (wrong["status"], wrong["reason"][:32]) == (row.REFUSED, "learning_controller.lead_time = ")

    def fail(*_):
        raise RuntimeError("nothing works")

    with monkeypatch.context() as patched:
        patched.setattr(row, "_Keeper", fail)
        failed = row.compute(piston, {}, [], [])
    assert (failed["status"], failed["reason"][-15:]) == (row.FAILED, ": nothing works")
    assert failed["reason"].startswith("RuntimeError in test_sweep.py, line ")

    limited = row.compute(piston, {"electrodynamic_actuator.command_stroke": 50e-6}, [], [])
    assert limited["limits"] == "electrodynamic_actuator"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("coarse/state.effort", "allowed: TOPIC.FIELD:STATISTIC"),
        ("coarse/stat.effort:max", "did you mean coarse/state"),
        ("coarse/state.efort:max", "did you mean effort"),
        ("coarse/state.effort:most", "no statistic 'most'"),
    ],
)
def test_measures_that_cannot_be(piston, text, said):
    assert_refused(lambda: row.measure(text, piston), said)


# ---- the sweep -------------------------------------------------------------------------------------------------------


def test_a_sweep_goes_on_where_it_was_stopped_and_adds_what_is_new(piston, client, tmp_path):
    told = []

    def stop(event):
        told.append(event)
        if event["event"] == "rows":
            raise KeyboardInterrupt

    def sweep(count, watch=told.append):
        return lathe_explore.run_sweep(
            piston, Space(grid={LEAD: count}), tmp_path / "leads", client=client, watch=watch
        )

    leads = "1.2e-3,1.3e-3,3e-3"
    with pytest.raises(KeyboardInterrupt):
        sweep(leads, stop)
    kept = Folder(tmp_path / "leads")
    (first,) = kept.table().to_pylist()
    found = sweep(leads)
    assert found.statuses() == {row.DONE: 2, row.REFUSED: 1}
    assert {each["computed"] for each in told if each["event"] == "began"} == {0, 1}
    assert found.row(first["cell"]) == first
    told.clear()
    more = sweep(f"1.1e-3,{leads}")
    assert [each for each in told if each["event"] == "began"] == [
        {"event": "began", "cells": 4, "computed": 3, "others": {}}
    ]
    assert more.table().column(LEAD).to_pylist() == [1.2e-3, 1.3e-3, 3e-3, 1.1e-3]
    assert more.table().column("cell").to_pylist() == [0, 1, 2, 3]
    # A further parameter: the rows so far have the scenario's own value of it.
    lathe_explore.run_sweep(piston, Space(grid={LEAD: [1.3e-3], Q: "70e-6"}), tmp_path / "leads", client=client)
    both = Sweep(Folder(tmp_path / "leads"))
    own = piston.nodes["learning_controller"].q_time
    assert both.table().column(Q).to_pylist() == [own, own, own, own, 70e-6]
    assert row.digest(harness.run(both.scenario(4)).recording, []) == both.row(4)["digest"]


def test_a_folder_of_something_else_is_refused(piston, client, tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "_CONNECT", 0.1)  # [s] for which Dask calls a scheduler that is not there
    space_ = Space(grid={LEAD: [1.3e-3]})
    lathe_explore.run_sweep(piston, space_, tmp_path / "one", client=client)
    longer = piston.varied({"spindle_encoder.revolutions": 5.0})
    with pytest.raises(InputError, match="holds a sweep of another cell"):
        lathe_explore.run_sweep(longer, space_, tmp_path / "one", client=client)
    with pytest.raises(InputError, match="measures nothing beside the rest"):
        lathe_explore.run_sweep(piston, space_, tmp_path / "one", client=client, measures=["tool.error:max"])
    (tmp_path / "two").mkdir()
    (tmp_path / "two" / "thesis.tex").touch()
    with pytest.raises(InputError, match="holds something else than a sweep"):
        lathe_explore.run_sweep(piston, space_, tmp_path / "two", client=client)
    with Folder(tmp_path / "one").locked(), pytest.raises(InputError, match="another program computes into it"):
        lathe_explore.run_sweep(piston, space_, tmp_path / "one", client=client)
    with pytest.raises(InputError, match=r"tcp://127.0.0.1:9"):
        lathe_explore.run_sweep(piston, Space(grid={LEAD: [1.4e-3]}), tmp_path / "one", scheduler="tcp://127.0.0.1:9")


def test_the_command_of_a_finished_sweep(piston, client, tmp_path):
    lathe_explore.run_sweep(piston, Space(grid={LEAD: [1.3e-3, 3e-3]}), tmp_path / "leads", client=client)
    show = ["sweep", "show", str(tmp_path / "leads"), "--cell"]
    done = CliRunner().invoke(main, [*show, "0", "--bag", str(tmp_path / "bag")])
    assert (done.exit_code, "cell 0: the digest of its row" in done.stdout) == (0, True)
    assert (tmp_path / "bag").is_dir()
    refused = CliRunner().invoke(main, [*show, "1"])
    assert (refused.exit_code, "learning diverges" in refused.stderr) == (2, True)


@pytest.mark.parametrize(
    ("words", "listed"),
    [("sweep run", (*LOOP_FIGURES, *row.STATISTICS)), ("tune", (*NUMBERS, *LOOP_FIGURES, *row.STATISTICS))],
)
def test_help_lists_what_a_row_has(words, listed):
    shown = CliRunner(env={"COLUMNS": "400"}).invoke(main, [*words.split(), "--help"]).stdout
    assert [name for name in listed if name not in shown] == []


def test_a_job_that_ends_or_blocks_its_process_has_a_reason_and_the_others_a_result():
    """A job that exits, one that is killed, and one that takes longer than its time limit."""
    found = list(alone.alone(abs, [-1, -2], 10.0, None))
    assert found == [1, 2]
    exits = list(alone.alone(os._exit, [3, 4], 10.0, None))
    assert exits == ["its process ended with exit code 3", "its process ended with exit code 4"]
    killed, *faults = alone.alone(signal.raise_signal, [signal.SIGKILL, signal.SIGSEGV], 10.0, None)
    assert killed == "its process was ended by SIGKILL, perhaps for lack of memory"
    assert [reason[:49] for reason in faults] == ["its process was ended by SIGSEGV, in alone.py, li"]


def test_a_job_that_blocks_has_a_time_limit_whatever_it_does(monkeypatch):
    """A job that sleeps right after a short one, and one that stops its process."""
    monkeypatch.setattr(alone, "_END", 0.5)
    short, sleeping = alone.alone(time.sleep, [0.0, 1e3], 0.5, None, first=0.0)
    assert (short, sleeping[:28]) == (None, "no end within 0.5 s, in alon")
    (stopped,) = alone.alone(signal.raise_signal, [signal.SIGSTOP], 0.1, None, first=0.0)
    assert stopped == "no end within 0.1 s"


@pytest.mark.parametrize(
    ("failed", "options", "again"),
    [
        ({"reason": "RuntimeError in my_law.py, line 3"}, {}, False),
        ({"reason": "RuntimeError in my_law.py, line 3"}, {"retry": True}, True),
        ({"reason": "RuntimeError in my_law.py, line 3", "version": "0.0.1"}, {}, True),
        ({"reason": "its process was ended by SIGKILL"}, {}, True),
        ({"reason": "no end within 2 s", "time_limit": 2.0}, {"cell_time": 2.0}, False),
        ({"reason": "no end within 2 s", "time_limit": 2.0}, {"cell_time": 3.0}, True),
    ],
)
def test_a_failed_cell_is_computed_again_where_that_may_help(failed, options, again, piston, client, tmp_path):
    space_ = Space(grid={LEAD: [1.3e-3]})
    found = lathe_explore.run_sweep(piston, space_, tmp_path / "rows", client=client)
    (done,) = found.table().to_pylist()
    (path,) = (tmp_path / "rows" / "rows").iterdir()
    path.unlink()
    found.folder.write([pa.Table.from_pylist([done | {"status": row.FAILED} | failed], found.folder.schema)])
    repeated = lathe_explore.run_sweep(piston, space_, tmp_path / "rows", client=client, **options)
    assert repeated.statuses() == {row.DONE if again else row.FAILED: 1}


def test_reasons_stand_in_the_terminal_and_no_result_is_a_failure(client, monkeypatch, tmp_path):
    monkeypatch.setattr("lathe_explore.sweep.sweep.client_of", lambda *_: contextlib.nullcontext(client))
    words = ["sweep", str(PISTON), "--revolutions", "2", "--vary", f"{LEAD}=3e-3,4e-3", "--out", str(tmp_path / "rows")]
    done = CliRunner().invoke(main, words)
    assert "2 refused, such as cell 0: learning_controller: learning diverges" in done.stdout
    assert (done.exit_code, done.stderr.splitlines()[-1]) == (
        1,
        f"lathe: no cell of {tmp_path / 'rows'} came to a result",
    )


# ---- studies that are sweeps -------------------------------------------------------------------------------------


@pytest.fixture
def own_workers(client, monkeypatch):
    """Let studies compute in this process: to start others takes seconds."""
    monkeypatch.setattr(workers, "client_of", lambda *_: contextlib.nullcontext(client))


@pytest.mark.usefixtures("own_workers")
def test_all_laws_are_compared_at_the_same_conditions(tmp_path):
    asked = best_law.BestLawParameters(points=4, seeds=1, encoder_counts=[10_000], folder=str(tmp_path))
    found = best_law.run(asked)
    assert set(found.error) == set(speed_deviation.LAWS) - {speed_deviation.OURS}  # that is another stage
    assert {error.shape for error in found.error.values()} == {(4,)}
    swept = Sweep(Folder(tmp_path / "speed_deviation"))
    for number, law in enumerate(found.error):
        cell = swept.scenario(4 * number + 2)
        encoder, learner = cell.nodes["spindle_encoder"], cell.nodes["learning_controller"]
        told = (encoder.deviation_frequency[0], encoder.deviation_amplitude[0], encoder.counts_per_revolution)
        assert told == (found.frequency[2], found.amplitude[2], found.counts[2])
        assert learner.model_natural_frequency == pytest.approx(found.model[2] * 1038.0)
        if law == "exact_preview":
            assert learner.deviation_amplitude == encoder.deviation_amplitude
            again = harness.run(cell).errors.largest[-11:].max() * 1e6
            assert found.error[law][2] == again
    assert all(found.error[law][k] == min(found.error[r][k] for r in found.rivals) for k, law in enumerate(found.best))
    assert sum(found.to_json()["best"]["10000"].values()) == pytest.approx(100.0)


@pytest.mark.usefixtures("own_workers")
def test_a_larger_tolerance_of_drives_costs_more():
    """A drive with which learning would diverge counts as one with an infinite error."""
    asked = drive_tolerance.DriveToleranceParameters(tolerance=[0.01, 0.15], drives=16, revolutions=10.0)
    found = drive_tolerance.run(asked)
    narrow, wide = found.error
    assert narrow.size == wide.size == 16
    assert np.isinf(wide).sum() > np.isinf(narrow).sum() == 0
    assert found.to_json()["99_percent_um"] == [narrow.max(), None]
    assert narrow.min() < found.nominal < narrow.max()
