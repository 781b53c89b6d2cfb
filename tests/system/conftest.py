# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the system tests."""

import subprocess

import pytest


@pytest.fixture
def small_disk(request, tmp_path):
    """A file system of its own, of a size such as ``3M`` (by `pytest.mark.parametrize`, indirect)."""
    place = tmp_path / "small"
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={request.param}", "tmpfs", place], check=True)
    yield place
    subprocess.run(["umount", place], check=True)
