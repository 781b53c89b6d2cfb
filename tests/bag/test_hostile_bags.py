# SPDX-License-Identifier: Apache-2.0
"""Hostile bags: a sample of what tests/system/test_hostile_campaign.py does thousands of times."""

import errno
from random import Random

import fuzz_targets as fuzz
import hostile_bags
import pytest
from bags import lathe
from hostile_bags import COMMANDS, MAKERS, attack, words


@pytest.mark.parametrize("kind", MAKERS)
def test_hostile_bag_ends_in_a_line_and_leaves_nothing(tmp_path, kind):
    (tmp_path / "in").mkdir()
    bag = MAKERS[kind](tmp_path / "in", Random(list(MAKERS).index(kind)))  # noqa: S311 - the same bag every time
    for command in ("check", "json"):
        attack(tmp_path, bag, command)


@pytest.mark.parametrize("command", [name for name in COMMANDS if name not in ("replay", "recover")])
def test_bag_that_may_not_be_read_is_refused_in_a_line(tmp_path, monkeypatch, command):
    """Root may read everything, so the kernel's refusal is played."""
    path = hostile_bags._folder(tmp_path, fuzz._turned()[0])
    opened = open

    def refuse(name, *arguments, **options):
        if "bag.mcap" in str(name):
            raise PermissionError(errno.EACCES, "Permission denied", str(name))
        return opened(name, *arguments, **options)

    monkeypatch.setattr("io.open", refuse)
    done = lathe(*words(command, path, tmp_path))
    assert done.stderr == f"lathe: {path}: not a readable bag (bag.mcap: Permission denied)\n"
    assert done.exit_code == 2
