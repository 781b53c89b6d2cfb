# SPDX-License-Identifier: Apache-2.0
"""Two thousand hostile bags against every command that takes a bag; some of them as programs, under the same limits."""

import resource
import subprocess
import sys
from random import Random

import pytest
from bags import sized
from hostile_bags import COMMANDS, LONGEST, MAKERS, MEMORY, attack

pytestmark = pytest.mark.system

_BAGS = sized(2000)
_GROUPS = 20
_BASE = 3 * 2**29  # address space of the program itself [B]
_OTHERS = [name for name in COMMANDS if name not in ("check", "replay")]


def _made(folder, seed):
    (folder / "in").mkdir(parents=True)
    return MAKERS[list(MAKERS)[seed % len(MAKERS)]](folder / "in", Random(seed))  # noqa: S311 - the same bag every time


@pytest.mark.parametrize("group", range(_GROUPS))
def test_no_hostile_bag_does_harm(tmp_path, group):
    for seed in range(group, _BAGS, _GROUPS):
        box = tmp_path / str(seed)
        bag = _made(box, seed)
        for command in ("check", _OTHERS[seed // len(MAKERS) % len(_OTHERS)]):
            attack(box, bag, command)


def _bound():
    resource.setrlimit(resource.RLIMIT_AS, (_BASE + MEMORY, _BASE + MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (LONGEST, LONGEST))


@pytest.mark.parametrize("seed", range(3000, 3000 + sized(2 * len(MAKERS))))
@pytest.mark.parametrize("command", ["replay", "check"])
def test_programs_bear_hostile_bags(tmp_path, domain, seed, command):
    bag = _made(tmp_path, seed)
    words = [str(bag) if word == "BAG" else word for word in COMMANDS[command]]
    ended = subprocess.run(
        [sys.executable, "-m", "lathe_rc", *words],
        capture_output=True, text=True, check=False, preexec_fn=_bound, cwd=tmp_path, timeout=600,
    )  # fmt: skip
    assert ended.returncode in (0, 1, 2, 3), ended.stderr
    assert "Traceback" not in ended.stderr
    assert "not enough memory" not in ended.stderr
