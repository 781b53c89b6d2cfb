# SPDX-License-Identifier: Apache-2.0
"""Saved memories: round trip, what a crash leaves, and files that nobody should allowed_code."""

import contextlib
import os
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lathe_rc.control import memory_file
from lathe_rc.errors import InputError, LatheError

POINTS = np.random.default_rng(1).standard_normal(256)


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "memory.npz"
    memory_file.save(path, POINTS, 128)
    return path


def test_round_trip_keeps_every_bit(saved):
    assert np.array_equal(memory_file.load(saved, 256, 128), POINTS)


def test_saving_again_replaces_and_leaves_nothing_beside(saved):
    memory_file.save(saved, 2 * POINTS, 128)
    assert np.array_equal(memory_file.load(saved, 256, 128), 2 * POINTS)
    assert [path.name for path in saved.parent.iterdir()] == ["memory.npz"]


def test_crash_before_the_rename_leaves_what_was_there(saved, monkeypatch):
    def crash(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", crash)
    with pytest.raises(LatheError, match="the memory cannot be saved \\(No space left on device\\)"):
        memory_file.save(saved, 2 * POINTS, 128)
    assert np.array_equal(memory_file.load(saved, 256, 128), POINTS)
    assert [path.name for path in saved.parent.iterdir()] == ["memory.npz"]


@pytest.mark.parametrize(("cycle", "grid"), [(255, 128), (512, 128), (256, 256)])
def test_memory_of_another_grid_is_refused(saved, cycle, grid):
    with pytest.raises(InputError, match=f"allowed: {cycle} (points )?with {grid}"):
        memory_file.load(saved, cycle, grid)


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="No such file or directory"):
        memory_file.load(tmp_path / "none.npz", 256, 128)


def test_values_that_are_not_finite_are_refused(tmp_path):
    path = tmp_path / "memory.npz"
    memory_file.save(path, np.full(256, np.nan), 128)
    with pytest.raises(InputError, match="not a finite number"):
        memory_file.load(path, 256, 128)


def test_pickles_are_never_read(tmp_path):
    path = tmp_path / "memory.npz"
    np.savez(path, format=np.int64(1), grid=np.int64(128), points=np.array([print] * 4, dtype=object))
    with pytest.raises(InputError, match="cannot be loaded"):
        memory_file.load(path, 256, 128)


def test_archive_that_unpacks_to_gigabytes_is_refused_unread(tmp_path):
    path = tmp_path / "memory.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("format.npy", b"")
        archive.writestr("grid.npy", b"")
        with archive.open("points.npy", "w", force_zip64=True) as member:
            for _ in range(64):
                member.write(bytes(1 << 20))
    with pytest.raises(InputError, match="holds another cycle"):
        memory_file.load(path, 256, 128)


@given(st.data())
def test_damage_anywhere_is_refused_in_one_line(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("damage") / "memory.npz"
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
