# SPDX-License-Identifier: Apache-2.0
"""The command line: output of ``lathe run``, refusals of bad input, and imports."""

import json
import math
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from bags import lathe
from click.testing import CliRunner

from lathe_rc import extras, harness
from lathe_rc.catalogue import COMMANDS
from lathe_rc.cell.kinds import MASTERS, STAGES
from lathe_rc.cell.scenario import TABLES, load
from lathe_rc.cell.time_master import TimeMaster
from lathe_rc.cli import main

CELL = """
/spindle_encoder: {ros__parameters: {revolutions: 3.0}}
/learning_controller: {ros__parameters: {}}
/electrodynamic_actuator: {ros__parameters: {}}
/tool: {ros__parameters: {}}
"""
KEYS = [
    "scenario",
    "mode",
    "first_sample",
    "simulated_s",
    "wall_s",
    "real_time_factor",
    "revolutions",
    "blocks",
    "dropped",
]
KEYS += ["lateness_s", "refused", "events", "not_reached", "unchecked", "warnings", "stability_margin", "drive_margin"]
KEYS += ["error_um", "not_measured", "tolerance_um", "growth_um", "loops", "along_um", "bag", "snapshots", "digest"]
PER_REVOLUTION = ["per_revolution_rms", "per_revolution_peak_to_valley", "per_revolution_ront"]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A working folder with a scenario; the handler of SIGTERM that a command installs is removed again."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cell.yaml").write_text(CELL)
    before = signal.getsignal(signal.SIGTERM)
    yield tmp_path
    signal.signal(signal.SIGTERM, before)


def told(*arguments):
    """Run a cell and return the JSON object that the command prints."""
    result = lathe("run", *arguments, "--json")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.count("\n") == 1
    return json.loads(result.stdout, parse_constant=pytest.fail)  # NaN is none of JSON


# --- lathe run --json


def test_json_has_the_numbers_of_the_run(folder):
    summary = told("cell.yaml", "--bag", "bag")
    assert list(summary) == KEYS
    result = harness.run(load(folder / "cell.yaml"))
    errors = result.errors
    assert (summary["scenario"], summary["mode"], summary["bag"]) == ("cell", "offline", "bag")
    assert summary["simulated_s"] == pytest.approx(0.18, rel=1e-4)
    assert summary["real_time_factor"] == pytest.approx(summary["simulated_s"] / summary["wall_s"])
    assert (summary["revolutions"], summary["blocks"], summary["dropped"]) == (3, 180, 0)
    assert summary["digest"] == result.digest
    error = summary["error_um"]
    assert list(error) == ["first", "last", *PER_REVOLUTION]
    around = result.part.roundness.peak_to_valley
    for name, values in zip(PER_REVOLUTION, (errors.rms, errors.peak_to_valley, around), strict=True):
        assert error[name] == pytest.approx(list(values * 1e6))
    for name, k in (("first", 0), ("last", -1)):
        expected = {"rms": errors.rms[k], "max": errors.largest[k], "peak_to_valley": errors.peak_to_valley[k]}
        expected |= {"ront": around[k], "ra": result.part.roughness.ra[k]}
        assert {key: error[name][key] * 1e-6 for key in expected} == pytest.approx(expected)
    assert (error["first"]["revolution"], error["last"]["revolution"]) == (1, 3)


@pytest.mark.parametrize("revolutions", ["0.4", "1e-9"])
def test_json_of_a_run_without_a_bag_or_a_revolution(revolutions):
    summary = told("cell.yaml", "--revolutions", revolutions)
    assert (summary["bag"], summary["revolutions"]) == (None, 0)
    assert summary["error_um"] == {"first": None, "last": None, **{name: [] for name in PER_REVOLUTION}}


def test_people_get_a_table_and_where_they_ask_for_it_a_figure(folder):
    result = lathe("run", "cell.yaml", "--figure", "turned.png")
    assert result.exit_code == 0
    shown = ["first revolution", "last revolution", "RMS [µm]", "180 blocks sent, 0 lost", "x real time"]
    shown += ["stability margin: learning_controller 0.0", "figure: turned.png"]
    assert [text for text in shown if text not in result.stdout] == []
    assert (folder / "turned.png").read_bytes().startswith(b"\x89PNG")
    assert lathe("run", "cell.yaml", "--revolutions", "0.5").exit_code == 0


def test_people_are_told_what_happened_and_what_the_run_was_too_short_for():
    events = "learning_controller.events=['revolution 2: freeze', 'revolution 60: clear']"
    result = lathe("run", "cell.yaml", "--set", events)
    assert re.search(r"0\.\d+ │ /learning_controller/events │ freeze", result.stdout)
    assert "learning_controller: the run ends before revolution 60: clear" in result.stderr
    summary = told("cell.yaml", "--set", events)
    (event,) = summary["events"]
    assert (event["topic"], event["text"]) == ("/learning_controller/events", "freeze")
    assert summary["not_reached"] == {"learning_controller": ["revolution 60: clear"]}


@pytest.mark.parametrize(
    ("actions", "shown", "more"), [(["freeze", "learn"], 12, "and 28 more"), (["freeze"], 2, "18 more of the kind")]
)
def test_more_events_than_fit_are_counted(actions, shown, more):
    events = [f"sample {1000 + k}: {action}" for k in range(20) for action in actions]
    out = lathe("run", "cell.yaml", "--set", f"learning_controller.events={events}").stdout
    assert (out.count("/learning_controller/events"), more in out) == (shown, True)


def test_snapshots_without_a_bag_are_not_forgotten_in_silence():
    Path("cell.yaml").write_text(CELL + "/recorder: {ros__parameters: {mode: snapshot}}\n")
    assert "no snapshots: no --bag was given" in lathe("run", "cell.yaml").stdout


def test_options_say_the_same_as_overrides():
    by_option = told("cell.yaml", "--revolutions", "2.01", "--speed-factor", "0", "--set", "block_size=32")
    by_set = told("cell.yaml", "--set", "spindle_encoder.revolutions=2.01", "--set", "block_size=32")
    assert by_option["digest"] == by_set["digest"]
    assert by_option["blocks"] == 242


# --- bad input


def assert_refused(result, *texts):
    """Check for exit code 2, one line on stderr, and nothing on stdout."""
    assert (result.exit_code, result.stdout) == (2, ""), result.stderr
    assert re.fullmatch(r"lathe: .*\n", result.stderr)
    assert [text for text in texts if text not in result.stderr] == []


def test_a_profile_of_several_lines_is_refused_in_one_line(folder):
    (folder / "form.csv").write_text('angle_deg,radius_um\n0,1\n90,2\n180,3\n270,"4\n')
    chosen = ["--set", "tool.profile=csv", "--set", "tool.profile_file=form.csv"]
    assert_refused(lathe("run", "cell.yaml", *chosen), str(folder / "form.csv"))


def test_a_command_that_memory_does_not_suffice_for_says_so(monkeypatch):
    def read(path):
        raise MemoryError("Unable to allocate 29.1 TiB")

    monkeypatch.setattr("lathe_rc.commands.measured.tell_origin", read)
    failed = lathe("measure", "bag")
    assert (failed.exit_code, failed.stderr) == (1, "lathe: not enough memory (Unable to allocate 29.1 TiB)\n")


@pytest.mark.parametrize("missing", ["spindle_encoder", "tool", "learning_controller", "electrodynamic_actuator"])
def test_scenario_that_lacks_a_node_is_refused(folder, missing):
    (folder / "cell.yaml").write_text("\n".join(line for line in CELL.splitlines() if missing not in line))
    assert_refused(lathe("run", "cell.yaml"))


def test_scenario_that_is_no_yaml_is_refused(folder):
    (folder / "cell.yaml").write_text(CELL + "  /tool: {\n")
    assert_refused(lathe("run", "cell.yaml"), "cell.yaml:", "not YAML")


def test_spindle_alone_ends_in_order(folder):
    """A spindle without members waits for no node, and its run, which has no form error, ends without an exception."""
    (folder / "cell.yaml").write_text("/spindle_encoder: {ros__parameters: {revolutions: 3.0}}")
    for option in ([], ["--json"]):
        result = lathe("run", "cell.yaml", *option)
        assert result.exit_code in (0, 2), result.exception


# --- lathe node


@pytest.mark.parametrize("name", TABLES)
def test_help_of_a_node_lists_its_parameters(name):
    result = CliRunner(env={"COLUMNS": "200"}).invoke(main, ["node", name, "--help"])
    assert result.exit_code == 0
    for row in TABLES[name].rows().values():
        assert row.name in result.stdout
        assert row.unit == "1" or f"[{row.unit}]" in result.stdout


def test_summary_of_a_failed_learning_is_json_too():
    """A diverging command runs into the end stops: its errors are large, but finite."""
    forced = ["--set", "learning_controller.allow_unstable=true", "--set", "learning_controller.lead_time=8e-3"]
    error = told("cell.yaml", *forced, "--revolutions", "60")["error_um"]
    assert all(math.isfinite(rms) for rms in error["per_revolution_rms"])
    assert np.max(error["per_revolution_rms"]) > 100


# --- what it imports


def test_commands_are_listed_without_being_imported():
    code = "import sys; from lathe_rc.cli import main; main(['--help'], standalone_mode=False); print(*sys.modules)"
    listed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    *text, modules = listed.splitlines()
    ours = {module for module in modules.split() if module.partition(".")[0] in ("lathe_rc", "numpy", "numba", "rich")}
    light = {"cli", "catalogue", "errors", "extras", "allowed_code", "numba_settings", "public"}
    assert ours == {"lathe_rc", *(f"lathe_rc.{module}" for module in light)}
    assert not [line for line in text[text.index("Commands:") :] if line.endswith("...")]  # each summary fits


def test_a_run_prints_its_object_alone_and_imports_what_its_cell_has():
    code = "import sys; from lathe_rc.cli import main; main(standalone_mode=0); print(*sys.modules, file=sys.stderr)"
    words = [sys.executable, "-c", code, "run", "piston", "--revolutions", "1", "--json"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert list(json.loads(done.stdout)) == KEYS
    assert not re.search("Traceback|Warning", done.stderr)
    modules = done.stderr.splitlines()[-1]
    begin = "lathe_machine.stages."
    imported = {module.rpartition(".")[2] for module in modules.split() if module.startswith(begin)}
    assert imported >= {"spindle_encoder", "learning_controller", "electrodynamic_actuator", "form", "tool"}
    assert not imported & {"compound_controller", "cutting_process", "feed_drive", "loaded_drive", "piezo_actuator"}
    assert not {"lathe_rc.signals.instrument_files", "scipy.io"} & set(modules.split())


def test_stages_are_where_their_names_say():
    assert [STAGES[kind].kind for kind in STAGES.own] == [*STAGES.own]
    assert tuple(kind for kind in STAGES.own if issubclass(STAGES[kind], TimeMaster)) == MASTERS


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_that_is_listed_exists(name):
    assert lathe(name, "--help").stdout.startswith(f"Usage: main {name}")


def test_a_terminal_without_the_letter_gets_a_question_mark():
    result = CliRunner(charset="ascii").invoke(main, ["run", "piston", "--revolutions", "2"])
    assert result.exit_code == 0
    assert "?m RMS" in result.output


def test_ctrl_c_during_an_import_ends_at_once_and_silently(tmp_path):
    """The import of a node takes a second; a traceback from the middle of it would be of no use."""
    (tmp_path / "interrupted.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n")
    words = [sys.executable, "-c", "from lathe_rc.extras import load; load('json'); load('interrupted')"]
    environment = os.environ | {"PYTHONPATH": f"{Path(__file__).parents[2]}:{tmp_path}"}
    ended = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (-signal.SIGINT, b"", b"")
    before = signal.getsignal(signal.SIGINT)
    extras.load("json")
    assert signal.getsignal(signal.SIGINT) is before  # after it Ctrl-C is an exception again
