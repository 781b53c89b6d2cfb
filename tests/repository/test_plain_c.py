# SPDX-License-Identifier: Apache-2.0
"""The engine's arithmetic written a second time, in plain C."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks import engine


@pytest.mark.parametrize("name", ["two_channel", "full_cell"])
def test_plain_c_gives_the_same_bits(name):
    assert engine.difference(name, 25.0) == ""
