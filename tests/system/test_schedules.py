# SPDX-License-Identifier: Apache-2.0
"""The protocol under many schedules, and deliberate faults that the schedules find."""

import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest
from bags import sized
from deliberate_faults import FAULTS
from simulation import play

pytestmark = pytest.mark.system
SCHEDULES, PIECE = sized(100_000), 500


def _broken(first: int) -> list[str]:
    """Promises that are broken in some schedules."""
    return [f"schedule {seed}: {text}" for seed in range(first, first + PIECE) for text in play(seed)[1]]


@pytest.mark.timeout(1500)
def test_cells_keep_their_promises_under_many_schedules():
    with ProcessPoolExecutor() as pool:
        broken = [text for texts in pool.map(_broken, range(3000, 3000 + SCHEDULES, PIECE)) for text in texts]
    assert not broken, "\n".join(broken[:10])


@pytest.mark.parametrize("number", range(len(FAULTS)), ids=lambda number: FAULTS[number].mistake)
def test_a_deliberate_fault_is_found(number):
    """A promise that no fault can break would prove nothing."""
    program = Path(__file__).parents[1] / "deliberate_faults.py"
    done = subprocess.run([sys.executable, str(program), str(number)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{FAULTS[number].mistake}: no schedule has found it; {done.stderr}"
