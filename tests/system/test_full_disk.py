# SPDX-License-Identifier: Apache-2.0
"""A disk that is really full: a small file system of its own, for which one must be root."""

import os
import subprocess
import sys

import pytest
from rosbags.highlevel import AnyReader

from lathe_rc import messages
from lathe_rc.bag.check import check
from lathe_rc.bag.repairing.recover import recover
from lathe_rc.bag.writing.writer import BagWriter, offered_qos
from lathe_rc.errors import LatheError

pytestmark = pytest.mark.system


@pytest.mark.parametrize("small_disk", ["4M"], indirect=True)
@pytest.mark.parametrize(("mode", "compression"), [("offline", "zstd"), ("offline", "none"), ("processes", "none")])
def test_a_full_disk_ends_the_recording_with_a_readable_bag(small_disk, mode, compression):
    bag = small_disk / "bag"
    command = [sys.executable, "-m", "lathe_rc", "run", "piston", "--mode", mode, "--bag", bag]
    command += ["--set", f"recorder.compression={compression}"]
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


def fill(path, texts):
    """Write messages until the disk is full."""
    writer = BagWriter(path, compression="none", chunk_size=2**16, about=texts)
    writer.add_topic("/said", messages.EVENT, offered_qos(10, "volatile"))
    data = os.urandom(1000)
    with pytest.raises(LatheError, match="No space left on device"):  # noqa: PT012 - which one fills the disk
        while True:
            writer.write("/said", 1, data)
    writer.close()


@pytest.mark.parametrize("small_disk", ["6M"], indirect=True)
def test_room_is_kept_for_long_texts(small_disk):
    """metadata.yaml repeats the files of a scenario, in base64."""
    fill(small_disk / "bag", {"lathe_rc.file.spindle_encoder.tachogram_file": "ab\n" * 200_000})
    with AnyReader([small_disk / "bag"]) as found:
        assert sum(1 for _ in found.messages()) > 1000


@pytest.mark.parametrize("small_disk", ["1M"], indirect=True)
def test_a_disk_that_is_too_small_from_the_start_is_left_as_it_was(small_disk):
    with pytest.raises(LatheError, match=r"cannot write \(No space left on device\); make room"):
        BagWriter(small_disk / "bag", compression="none", chunk_size=2**16, about={"text": "ab\n" * 200_000})
    assert not list(small_disk.iterdir())


@pytest.mark.parametrize("small_disk", ["4M"], indirect=True)
def test_a_full_disk_ends_a_recovery_without_half_a_bag(small_disk):
    fill(small_disk / "bag", {})
    with pytest.raises(LatheError, match="No space left on device"):
        recover(small_disk / "bag", small_disk / "new")
    assert [path.name for path in small_disk.iterdir()] == ["bag"]
