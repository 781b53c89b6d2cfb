# SPDX-License-Identifier: Apache-2.0
"""Loops of a cell over the waves per revolution, for figures: factor of a cycle, and what error the drive may have."""

from dataclasses import dataclass

import numpy as np

from lathe_rc.analysis.cycle_factors import DriveMargin, poles_in_waves
from lathe_rc.analysis.measured_drive import MeasuredDrive
from lathe_rc.analysis.resonance_grid import Grid
from lathe_rc.arrays import Array, Complex
from lathe_rc.cell.wiring import Cell

LEAST = 0.1  #: lowest waves per revolution of a curve
_POINTS, _WHOLE, _MEASURED = 400, 100, 1000  # points, highest harmonic among them, and most measured points


@dataclass(frozen=True)
class LoopCurve:
    """Loop of a controller with the drive and at the speed where its drive margin is the least.

    Attributes:
        node: name of the controller.
        margin: its drive margin.
        measured: whether that is the margin of measured points, which are then the only ones.
        waves: waves per revolution from `LEAST` on, increasing, with all harmonics up to 100, finer around
            narrow resonances, shape (n,).
        error: smallest relative error of the drive's response with which the loop diverges, shape (n,).
        factor: factor of a cycle, Q - γZ or, of several factors, the largest, shape (n,); None for a loop without.
    """

    node: str
    margin: DriveMargin
    measured: bool
    waves: Array
    error: Array
    factor: Complex | None


def loop_curves(cell: Cell) -> list[LoopCurve]:
    """Return the loop of each controller with a drive margin, for a cell that has been checked.

    Raises:
        InputError: code of others fails.
    """
    found = []
    for node, loops in cell.loops.items():
        each = [(*worst, loop.stage) for loop in loops if (worst := loop.worst())]
        if not each:
            continue
        margin, drive, stage = min(each, key=lambda worst: worst[0])
        speed = margin.speed
        has_cycle = stage.factors(drive, np.ones(1), speed) is not None
        highest = stage.highest_waves(speed) if has_cycle else np.pi / (stage.shared.step * speed)
        if isinstance(drive, MeasuredDrive):
            waves = drive.waves(highest, speed)
            waves = waves[:: -(-waves.size // _MEASURED)]
        else:
            waves = np.geomspace(LEAST, highest, _POINTS)
            waves = np.union1d(waves, np.arange(1.0, min(_WHOLE, highest) + 1.0))
            waves = Grid.uneven(waves).resolving(poles_in_waves(drive, highest, speed, stage.shared.step)).points
        waves = np.union1d(waves, max(margin.waves, LEAST))
        factors = stage.factors(drive, waves, speed)
        largest = None if factors is None else factors[np.abs(factors).argmax(axis=0), np.arange(waves.size)]
        error = stage.smallest_errors(drive, waves, speed)
        found.append(LoopCurve(node, margin, isinstance(drive, MeasuredDrive), waves, error, largest))
    return found
