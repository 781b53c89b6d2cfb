# SPDX-License-Identifier: Apache-2.0
"""A disk that is really full: a small file system of its own, for which one must be root."""

import subprocess
import sys

import pytest
from rosbags.highlevel import AnyReader

from lathe_rc.bag.check import check

pytestmark = pytest.mark.system


@pytest.mark.parametrize("small_disk", ["3M"], indirect=True)
@pytest.mark.parametrize("mode", ["offline", "processes"])
def test_a_full_disk_ends_the_recording_with_a_readable_bag(small_disk, mode):
    bag = small_disk / "bag"
    command = [sys.executable, "-m", "lathe_rc", "run", "piston", "--mode", mode, "--bag", bag]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert "cannot write (No space left on device); what was recorded before is readable" in ended.stderr
    assert "Traceback" not in ended.stderr
    with AnyReader([bag]) as found:
        assert sum(1 for _ in found.messages()) > 1000
    found = check(bag)
    assert not found.wrong
    assert all("no last block" in line or "ends at sample" in line for line in found.lost)
    assert sorted(file.name for file in bag.iterdir()) == ["bag.mcap", "metadata.yaml"]
