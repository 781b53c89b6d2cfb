# SPDX-License-Identifier: Apache-2.0
"""Saved memories: round trip, what a crash leaves, and files that nobody should trust."""

import contextlib
import os

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from machines import assert_refused

from lathe_machine.control import memory_file
from lathe_rc import data_file
from lathe_rc.errors import InputError, LatheError

POINTS = np.random.default_rng(1).standard_normal(256)


@pytest.fixture
def path(tmp_path):
    """A saved memory, alone in its folder."""
    memory_file.save(tmp_path / "memory", POINTS, 128)
    yield tmp_path / "memory"
    assert [file.name for file in tmp_path.iterdir()] == ["memory"]


def test_round_trip_keeps_every_bit_and_saving_again_replaces(path):
    for points in (POINTS, 2 * POINTS):
        memory_file.save(path, points, 128)
        assert np.array_equal(memory_file.load(path, 256, 128), points)


def test_crash_before_the_rename_leaves_what_was_there(path, monkeypatch):
    def crash(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", crash)
    with pytest.raises(LatheError, match="the memory cannot be saved \\(No space left on device\\)"):
        memory_file.save(path, 2 * POINTS, 128)
    assert np.array_equal(memory_file.load(path, 256, 128), POINTS)


@pytest.mark.parametrize(("cycle", "grid"), [(255, 128), (512, 128), (256, 256)])
def test_memory_of_another_grid_is_refused(path, cycle, grid):
    assert_refused(lambda: memory_file.load(path, cycle, grid), f"allowed: {cycle} (points )?with {grid}")


def test_missing_files_and_values_that_are_not_finite_are_refused(path):
    assert_refused(lambda: memory_file.load(path.with_name("none"), 256, 128), "No such file or directory")
    memory_file.save(path, np.full(256, np.nan), 128)
    assert_refused(lambda: memory_file.load(path, 256, 128), "not a finite number")


def test_a_file_of_another_kind_or_too_long_is_refused(path):
    for content, why in {
        data_file.packed("checkpoint", {}): "not a memory \\(it begins differently",
        data_file.packed("memory", {"grid": 128}): r"not a memory \(KeyError|not a memory \('points'",
        data_file.packed("memory", {"grid": 128, "points": POINTS, "more": "0" * 2**22}): "incomplete, or larger",
        b"0" * 2**20: "larger than any memory here",
    }.items():
        path.write_bytes(content)
        assert_refused(lambda: memory_file.load(path, 256, 128), why)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damage_anywhere_is_refused(path, data):
    memory_file.save(path, POINTS, 128)
    content = bytearray(path.read_bytes())
    kind = data.draw(st.sampled_from(["cut", "flip", "text"]))
    place = data.draw(st.integers(0, len(content) - 1))
    if kind == "cut":
        del content[place:]
    elif kind == "flip":
        content[place] ^= data.draw(st.integers(1, 255))
    else:
        content = bytearray(data.draw(st.binary(max_size=300)))
    path.write_bytes(content)
    with contextlib.suppress(InputError):
        # What was flipped has no meaning, or it is refused.
        assert np.array_equal(memory_file.load(path, 256, 128), POINTS)
