# SPDX-License-Identifier: Apache-2.0
"""Tests that take long by their nature: the largest cells with a process a node, an installation by pip, compiling."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from test_extending import begin, edit
from test_security import CONFIG, ENDLESS, FILES, compare, members, named, observer, parsed, running, wait_for_block_0

from lathe_rc import harness
from lathe_rc.cell import scenario
from lathe_rc.cli import main

pytestmark = pytest.mark.system
__all__ = ["begin", "observer"]  # fixtures


def test_thirteen_processes_of_the_full_cell_give_its_digests():
    cell = scenario.load(CONFIG / "full_cell.yaml", ["spindle_encoder.revolutions=4.0"])
    assert harness.run(cell, mode="processes", groups=[]).digest == harness.run(cell).digest


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_the_cell_uses_what_its_file_allows_and_nothing_else(path, observer, tmp_path):
    """The graph of each cell that comes with a policy is what the policy allows, neither less nor more."""
    loaded, root = scenario.load(CONFIG / f"{named(path)}.yaml", ENDLESS), parsed(path.read_text(encoding="utf-8"))
    with running(tmp_path, members(loaded, root, tmp_path)):
        wait_for_block_0(observer)
        compare(observer, root)


def test_a_package_that_pip_has_installed_is_found_by_its_name(tmp_path, monkeypatch):
    """Installed elsewhere, a law takes part under its bare name: in help, run, bag and report."""
    monkeypatch.chdir(tmp_path)
    assert CliRunner().invoke(main, ["new", "law", "my_law"]).exit_code == 0
    site, package = tmp_path / "site", tmp_path / "my_law"
    pip = ["-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--target", str(site), str(package)]
    subprocess.run([sys.executable, *pip], check=True, capture_output=True)
    text = (package / "my_law.yaml").read_text(encoding="utf-8")
    (tmp_path / "cell.yaml").write_text(text.replace('    stage: "my_law:MyLaw"\n', ""), encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")])}

    def told(*arguments):
        run = [sys.executable, "-m", "lathe_rc", *arguments]
        done = subprocess.run(run, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert "lead_time" in told("node", "my_law", "--help")
    runs = {}
    for mode in ("offline", "processes"):
        runs[mode] = json.loads(told("run", "cell.yaml", "--mode", mode, "--revolutions", "4", "--bag", mode, "--json"))
        told("bag", "check", mode)
    assert runs["offline"]["digest"] == runs["processes"]["digest"]
    assert runs["offline"]["unchecked"] == []
    told("report", "offline", "-o", "report.html")
    assert "my_law" in (tmp_path / "report.html").read_text()


AHEAD = """
import json
from lathe_rc.cell import ahead
from lathe_rc.cell.scenario import TABLES
from lathe_rc.cell.kinds import STAGES

def made(name, kind):
    return STAGES[kind](name, TABLES[kind].read(name, {"stage": kind}))

stages = [made("spindle_encoder", "spindle_encoder"), made("form", "profile"), made("other", "profile")]
print(json.dumps([list(ahead.compile_ahead(stages)), list(ahead.compile_ahead(stages))]))
"""


def test_steps_are_compiled_once_and_those_that_are_alike_together(tmp_path):
    """Each process that compiles tells what it has done; a second call finds all on the disk."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    run = subprocess.run([sys.executable, "-c", AHEAD], env=environment, capture_output=True, text=True, check=True)
    first, second = json.loads(run.stdout)
    assert first[0] == ["spindle_encoder", "form"]
    assert len(first[1]) == 1
    assert second == []


def rms_in_another_process(file):
    """RMS of the form error in the last of four revolutions [µm]."""
    command = [sys.executable, "-m", "lathe_rc", "run", str(file), "--revolutions", "4", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)["error_um"]["last"]["rms"]


def test_a_changed_source_is_compiled_anew(begin):
    """The step of another source never runs from the cache, be it that of the law or of a module that it uses."""
    file = begin("law", "leaning_law")
    edit("leaning_law", "TURN = 2.0 * np.pi", "from leaned_on import FACTOR\n\nTURN = 2.0 * np.pi")
    edit("leaning_law", "memory.gain * (error", "FACTOR * memory.gain * (error")
    Path("leaned_on.py").write_text("FACTOR = 1.0\n")
    first = rms_in_another_process(file)
    Path("leaned_on.py").write_text("FACTOR = 0.5\n")
    assert (module := rms_in_another_process(file)) > 2 * first
    edit("leaning_law", "FACTOR * memory.gain", "0.5 * FACTOR * memory.gain")
    assert rms_in_another_process(file) > 1.5 * module
