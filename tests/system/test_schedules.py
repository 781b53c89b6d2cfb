# SPDX-License-Identifier: Apache-2.0
"""The protocol under many schedules, and mutants of it that the schedules find."""

import os
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import mutants
import pytest
from bags import sized
from schedules import play

pytestmark = pytest.mark.system
SCHEDULES, PIECE = sized(40_000), 500
MUTANTS = sized(300)
WITHIN = 20_000 if MUTANTS == 300 else 300  # schedules for each mutant


def _broken(first: int) -> list[str]:
    """Promises that are broken in some schedules."""
    return [f"schedule {seed}: {text}" for seed in range(first, first + PIECE) for text in play(seed)[1]]


@pytest.mark.timeout(1500)
def test_cells_keep_their_promises_under_many_schedules():
    with ProcessPoolExecutor() as pool:
        broken = [text for texts in pool.map(_broken, range(3000, 3000 + SCHEDULES, PIECE)) for text in texts]
    assert not broken, "\n".join(broken[:10])


def _judged() -> dict[str, str]:
    """Return why no schedule finds a mutant, by its name; in the file, the names follow their reason, indented."""
    reasons, reason = dict[str, str](), ""
    for line in Path(mutants.__file__).with_suffix(".txt").read_text(encoding="utf-8").splitlines():
        if line.startswith("    "):
            reasons[line.strip()] = reason
        elif line:
            reason = line
    return reasons


@pytest.mark.timeout(100_000)
def test_each_mutant_of_the_protocol_is_found_or_judged():
    """A promise that no fault can break would prove nothing."""
    judged, tried = _judged(), mutants.tried(2, MUTANTS, WITHIN, os.cpu_count() or 1)
    left = [name for name, found in tried if not found and name not in judged]
    assert not left, f"no schedule finds, and mutants.txt does not judge: {left}"
