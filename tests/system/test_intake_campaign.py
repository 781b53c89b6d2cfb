# SPDX-License-Identifier: Apache-2.0
"""Campaign of files as people bring them, through the commands that read them."""

import json
from pathlib import Path

import pytest
import user_files
from bags import lathe, some

pytestmark = pytest.mark.system

COMMANDS = {
    "fit drive": ("response", "fit drive {} --modes 0 --drives 1 --json -o out.yaml --figure out.png"),
    "fit channel": ("magnitude", "fit channel {} --json --figure out.png"),
    "fit channel, step": ("step", "fit channel {} --json --figure out.png"),
    "fit hysteresis": ("loop", "fit hysteresis {} --stroke 7.5e-6 --json"),
    "correct": ("form", "correct {} --scenario piston --deviation --noise 0.1 --json -o out.csv"),
    "profile_file": ("form", "run piston --revolutions 1 --json --set tool.profile=csv --set tool.profile_file={}"),
    "tachogram_file": ("tachogram", "run piston --revolutions 1 --json --set spindle_encoder.tachogram_file={}"),
    "trajectory_file": (
        "trajectory",
        "run approach --json --set position_controller.trajectory=csv --set position_controller.trajectory_file={}",
    ),
}


def numbers(said: str) -> object:
    """The figures of a command, without names of files and times of computing."""
    found = json.loads(said)
    return found["digest"] if "digest" in found else {name: found[name] for name in found if "file" not in name}


@pytest.mark.parametrize("command", COMMANDS)
def test_each_file_is_read_as_the_plain_one_or_refused_in_one_line_with_exit_code_2(command, tmp_path, monkeypatch):
    """Dialects, encodings, heads, preambles, units and faults; LATHE_CAMPAIGN=whole sends every file."""
    monkeypatch.chdir(tmp_path)
    kind, line = COMMANDS[command]
    wanted, wrong = None, {}
    plain, *others = user_files.files(kind)
    for file in [plain, *some(others, 8)]:
        Path("given.csv").write_bytes(file.content)
        done = lathe(*line.format("given.csv").split())
        if done.exit_code == 0:
            wanted = wanted or numbers(done.stdout)
            right = file.sound and numbers(done.stdout) == wanted
        else:
            *_, said = done.stderr.splitlines() or [""]
            right = not file.sound and done.exit_code == 2 and not done.stdout and "given.csv" in said
        if not right:
            wrong[file.name] = done.exit_code, done.stderr, repr(done.exception)
    assert wanted
    assert not wrong
