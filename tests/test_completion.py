# SPDX-License-Identifier: Apache-2.0
"""``lathe completion``: completed words, the script in a real bash, and its installation."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.shell_completion import ShellComplete
from click.testing import CliRunner

from lathe_rc import cli
from lathe_rc.commands.completion import completion

ROOT = Path(__file__).parents[1]


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
        (["completion", ""], ["bash", "zsh", "fish"]),
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
    """The function of the printed script completes command lines in a real bash."""
    script = CliRunner().invoke(completion, ["bash"]).output + "compopt() { echo compopt $@; }\n"
    for line in (f"{program} run pist", f"{program} run piston --set tool.tol", f"{program} se"):
        *before, last = line.split()
        script += f"COMP_WORDS=({line}) COMP_CWORD={len(before)}; _lathe_complete {program} {last} {before[-1]}\n"
        script += "printf '%s\\n' \"${COMPREPLY[@]}\"\n"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stderr == ""
    # After tool.tolerance= the value follows, without a blank; setup is of ./lathe alone.
    assert done.stdout.splitlines() == ["piston", "compopt -o nospace", "tool.tolerance=", "setup"]


class TestInstall:
    @pytest.fixture(autouse=True)
    def home(self, tmp_path, monkeypatch):
        for name in ("ZDOTDIR", "XDG_CONFIG_HOME", "XDG_DATA_HOME"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setenv("HOME", str(tmp_path))
        return tmp_path

    @pytest.mark.parametrize(
        ("shell", "rc"), [("bash", ".bashrc"), ("zsh", ".zshrc"), ("fish", ".config/fish/config.fish")]
    )
    def test_writes_one_line_once_and_takes_it_out_again(self, home, shell, rc):
        def run(option):
            return CliRunner().invoke(completion, [shell, option]).output

        rc, mine = home / rc, "# mine, without an end of line"
        rc.parent.mkdir(parents=True, exist_ok=True)
        rc.write_text(mine)
        assert f"{rc}: one line added" in run("--install")
        installed = rc.read_text()
        script = home / ".local/share/lathe_rc" / f"completion.{shell}"
        assert installed.startswith(f"{mine}\n")
        assert installed.count(str(script)) == 2  # on one line: if it is there, read it
        assert script.read_text() == CliRunner().invoke(completion, [shell]).output
        assert "has its line already" in run("--install")
        assert rc.read_text() == installed
        assert "the line is gone" in run("--remove")
        assert (rc.read_text(), script.exists()) == (f"{mine}\n", False)
        assert "nothing to remove" in run("--remove")

    def test_a_new_bash_has_it(self, home):
        done = CliRunner().invoke(completion, ["--install"], env={"SHELL": "/bin/bash"})
        assert done.exit_code == 0, done.output
        shell = ["bash", "--norc", "-c", ". ~/.bashrc; complete -p lathe"]
        told = subprocess.run(shell, capture_output=True, text=True, check=True, env=os.environ | {"HOME": str(home)})
        assert told.stdout == "complete -o nosort -F _lathe_complete lathe\n"

    def test_a_shell_that_there_is_no_script_for_is_named(self):
        done = CliRunner().invoke(cli.main, ["completion"], env={"SHELL": "/bin/tcsh"})
        assert done.exit_code == 2
        assert "no shell 'tcsh'; allowed: bash, zsh, fish" in done.output
