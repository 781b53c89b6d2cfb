# SPDX-License-Identifier: Apache-2.0
"""Completion of command lines: completed words, and those of a real bash."""

import subprocess
import sys
from pathlib import Path

import pytest
from click.shell_completion import ShellComplete

from lathe_rc import cli

ROOT = Path(__file__).parents[2]


def completed(*words):
    """Completions of the last word."""
    shell = ShellComplete(cli.main, {}, "lathe", "_LATHE_COMPLETE")
    return [found.value for found in shell.get_completions(list(words[:-1]), words[-1])]


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["res"], ["resim"]),
        (["run", "supervised_t"], ["supervised_turning", "supervised_two_channel"]),
        (["run", "piston", "--mode", ""], ["offline", "composed", "processes"]),
        (["run", "piston", "--set", "too"], ["tool."]),
        (["run", "piston", "--set", "tool.tol"], ["tool.tolerance="]),
        (["run", "piston", "--set", "supervisor."], []),  # it has none
        (["run", "piston", "--group", "tool+rec"], ["tool+recorder"]),
        (["run", "piston", "--require"], ["--require-tolerance"]),
        (["sweep", "full_c"], ["full_cell"]),  # short for sweep run
        (["sweep", "sh"], ["show"]),
        (["sweep", "piston", "--vary", "tool.tol"], ["tool.tolerance="]),
        (["tune", "piston", "--free", "learning_controller.lead_t"], ["learning_controller.lead_time="]),
        (["resim", "bag", "--set", "piezo_actuator.hyst"], ["piezo_actuator.hysteresis="]),
        (["study", "sp"], ["speed-deviation"]),
        (["study", "piston", "--set", "height"], ["height_mm="]),
        (["node", "piezo"], ["piezo_actuator"]),
    ],
    ids=" ".join,
)
def test_completes(words, found):
    assert completed(*words) == found


def test_nodes_of_a_scenario_are_completed_with_the_parameters_of_their_kind(tmp_path):
    """For a file that cannot be read the nodes of all kinds are completed."""
    own = tmp_path / "own.yaml"
    own.write_text("/mine:\n  ros__parameters: {stage: piezo_actuator}\n/**:\n  ros__parameters: {}\n")
    assert completed("run", str(own), "--set", "") == ["mine."]
    assert completed("run", str(own), "--set", "mine.hyst")[0] == "mine.hysteresis="
    own.write_text("{: -")
    for path in (own, tmp_path / "none.yaml"):
        assert "tool." in completed("run", str(path), "--set", "")


def test_completing_imports_no_more_than_it_needs():
    """Neither NumPy nor ROS 2 is imported: each takes longer than a user waits."""
    code = """
import sys
from click.shell_completion import ShellComplete
from lathe_rc import cli
shell = ShellComplete(cli.main, {}, "lathe", "X")
for words in ("sweep piston --vary tool", "tune piston --fr", "run --m"):
    *before, last = words.split()
    shell.get_completions(before, last)
print(*{"numpy", "rclpy", "numba", "pydantic", "dask", "rich"} & sys.modules.keys())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "\n"


@pytest.mark.parametrize("program", [str(ROOT / "lathe"), "./lathe"])
def test_bash_completes_lathe_and_the_launcher_of_a_checkout(program):
    """The function of Click's script completes command lines in a real bash; setup is of ./lathe alone."""
    script = f'eval "$(_LATHE_COMPLETE=bash_source {program})"\n'
    for line in (f"{program} run pist", f"{program} run piston --set tool.tol", f"{program} se"):
        *before, last = line.split()
        script += f"COMPREPLY=() COMP_WORDS=({line}) COMP_CWORD={len(before)}\n"
        script += f"_lathe_completion {program} {last} {before[-1]}; echo ${{COMPREPLY[@]}}\n"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert (done.stdout, done.stderr) == ("piston\ntool.tolerance=\nsetup\n", "")
