# SPDX-License-Identifier: Apache-2.0
"""Resonances of a tool drive: its second-order loop and further modes that the command and the force excite.

Each mode moves as a second-order drive of its own, with x0 the loop itself (ω1, ζ1, mass m):

    xj'' + 2ζjωj·xj' + ωj²·xj = ωj²·(u(t - τ) + κj·F/(m·ω1²))
    sensor = Σ pj·xj,   edge = Σ ej·xj,   Σ pj = Σ ej = 1

so that from the command to the sensor W(p) = e^{-pτ}·Σ pj/(1 + 2ζjp/ωj + p²/ωj²). The participations pj are those of a
fitted frequency response (modal superposition; Ewins, Modal Testing, 2000, ch. 2); ej differs from pj where the
structure gives way between sensor and edge. A force F at the edge deflects a mode by κj times as much as the same force
of the coil. By reciprocity κj = ej/|pj| if the coil acts where the sensor is: the edge then yields to the force in
phase. A mode that the sensor does not see (pj = 0) has κj = ±1, the sign of ej: the coil acts at the edge; the current
of such a drive does not balance a steady force exactly.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.plants.linear import second_order


@dataclass(frozen=True)
class Modes:
    """Modes of a drive beside its second-order loop; all attributes have the same length.

    Attributes:
        frequency: ωj [rad/s].
        damping: ζj [1].
        sensor: pj at the position sensor.
        edge: ej at the edge.

    Raises:
        InputError: the lengths differ, or the loop itself has no part in the motion of sensor or edge.
    """

    frequency: tuple[float, ...] = ()
    damping: tuple[float, ...] = ()
    sensor: tuple[float, ...] = ()
    edge: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        lengths = [len(values) for values in (self.frequency, self.damping, self.sensor, self.edge)]
        if len(set(lengths)) > 1:
            raise InputError(f"lengths {lengths}; allowed: as many of each")
        for place, parts in (("sensor", self.sensor), ("edge", self.edge)):
            if sum(parts) >= 1.0:
                raise InputError(f"participations at the {place} sum up to {sum(parts):g}; allowed: below 1")


NONE = Modes()


class Carriage(NamedTuple):
    """Linear equations of a drive with its modes, x' = a·x + command·u + force·F/m.

    The states are pairs of position and velocity; the first pair is that of the sensor.

    Attributes:
        a: shape (2n, 2n).
        command, force: shape (2n,).
        edge: index of the position of the edge; 0 if it moves as the sensor.
    """

    a: Array
    command: Array
    force: Array
    edge: int


def carriage(natural_frequency: float, damping: float, modes: Modes = NONE) -> Carriage:
    """Return the equations of a drive with ω1 = ``natural_frequency`` [rad/s] and ζ1 = ``damping``, and its modes."""
    a, command = second_order(natural_frequency, damping)
    if not modes.frequency:
        return Carriage(a, command, np.array([0.0, 1.0]), 0)
    square = np.array([natural_frequency, *modes.frequency]) ** 2
    loss = 2.0 * np.array([damping, *modes.damping]) * np.sqrt(square)
    sensor, edge = (np.array([1.0 - sum(parts), *parts]) for parts in (modes.sensor, modes.edge))
    seen = sensor != 0.0
    kappa = np.where(seen, edge / np.where(seen, abs(sensor), 1.0), np.sign(edge))
    # New coordinates: the sensor, the edge if it differs, and modes. The one left out is where both differ most.
    rows = np.eye(square.size)
    rows[0] = sensor
    place = 0
    if modes.edge != modes.sensor:
        rows[1 + np.argmax(abs(sensor[0] * edge[1:] - edge[0] * sensor[1:]))] = rows[1]
        rows[1], place = edge, 2
    back = np.linalg.inv(rows)
    a = np.zeros((2 * square.size, 2 * square.size))
    a[::2, 1::2] = np.eye(square.size)
    a[1::2, ::2] = -rows @ np.diag(square) @ back
    a[1::2, 1::2] = -rows @ np.diag(loss) @ back
    command, force = np.zeros((2, 2 * square.size))
    command[1::2] = rows @ square
    force[1::2] = rows @ (kappa * square) / square[0]
    return Carriage(a, command, force, place)
