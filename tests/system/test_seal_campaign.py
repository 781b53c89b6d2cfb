# SPDX-License-Identifier: Apache-2.0
"""Hundreds of single changes to all of a bag but its messages; tests/bag/test_seal.py has a sample."""

from random import Random

import pytest
import sealed_bags
from bags import sized

pytestmark = pytest.mark.system


@pytest.mark.parametrize("seed", [21, 22])
def test_no_single_change_beside_the_data_changes_a_verdict_in_silence(tmp_path, seed):
    """500 bits, digits and lines of metadata.yaml, digests.json and records: named, or the figures are as before."""
    bag = sealed_bags.made(tmp_path / "bag")
    sealed_bags.assert_none_is_silent(bag, sized(500), Random(seed), *sealed_bags.COMMANDS)  # noqa: S311
