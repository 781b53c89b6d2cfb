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

A servo with a delay or a filter in its loop has complex residues and further real poles:

    sensor = Σ (pj·xj + vj·xj'/ωj) + Σ rk·yk,    Tk·yk' = u(t - τ) - yk,    Σ pj + Σ rk = 1

and the edge the same vj and rk beside its ej. The command does not act on the velocity of the sensor at once, so the
share of the loop's own velocity is v0 = -(Σ vj·ωj + Σ rk/Tk)/ω1 (relative degree 2). How such a servo gives way to a
force does not follow from its response to the command.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lathe_machine.plants.linear import second_order
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError


@dataclass(frozen=True)
class Modes:
    """Modes and lags of a drive beside its second-order loop.

    Attributes:
        frequency: ωj [rad/s], shape (n,).
        damping: ζj [1], shape (n,).
        sensor: pj at the position sensor, shape (n,).
        edge: ej at the edge, shape (n,).
        velocity: vj, shape (n,); empty: 0.
        lag_time: Tk [s], shape (m,).
        lag: rk, shape (m,).

    Raises:
        InputError: the lengths differ, or the loop itself has no part in the motion of sensor or edge.
    """

    frequency: tuple[float, ...] = ()
    damping: tuple[float, ...] = ()
    sensor: tuple[float, ...] = ()
    edge: tuple[float, ...] = ()
    velocity: tuple[float, ...] = ()
    lag_time: tuple[float, ...] = ()
    lag: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        lengths = [len(values) for values in (self.frequency, self.damping, self.sensor, self.edge)]
        lengths += [len(self.velocity)] if self.velocity else []
        if len(set(lengths)) > 1:
            raise InputError(f"lengths {lengths}; allowed: as many of each")
        if len(self.lag_time) != len(self.lag):
            raise InputError(f"lags: lengths {[len(self.lag_time), len(self.lag)]}; allowed: as many of each")
        for place, parts in (("sensor", self.sensor), ("edge", self.edge)):
            if sum(parts) >= 1.0 and self.normal:
                raise InputError(f"participations at the {place} sum up to {sum(parts):g}; allowed: below 1")

    @property
    def normal(self) -> bool:
        """Whether the modes are those of a structure alone, with real residues and no further lags."""
        return not any(self.velocity) and not self.lag_time

    def moved(self, factor: float) -> "Modes":
        """Return the modes with frequencies multiplied by a factor; damping ratios and participations stay."""
        return self if factor == 1.0 else replace(self, frequency=tuple(factor * each for each in self.frequency))

    def model(self, natural_frequency: float, damping: float) -> tuple[float, float]:
        """Return ω [rad/s] and ζ of the second-order drive that moves as this one at low frequencies.

        That is the drive itself if the modes are normal, and otherwise the one whose response has the same first and
        second derivative at p = 0.
        """
        if self.normal:
            return natural_frequency, damping
        frequency, zeta, share, velocity, _ = _sections(natural_frequency, damping, self)
        time, lag = np.array(self.lag_time), np.array(self.lag)
        # Q = 1 - 2ζp/ω + (4ζ² - 1)p²/ω² - ..., and 1/(1 + pT) = 1 - pT + p²T² - ...
        first = np.sum((velocity - 2.0 * zeta * share) / frequency) - np.sum(lag * time)
        second = np.sum(((4.0 * zeta**2 - 1.0) * share - 2.0 * zeta * velocity) / frequency**2) + np.sum(lag * time**2)
        a1, a2 = -first, first**2 - second
        if a1 <= 0.0 or a2 <= 0.0:
            return natural_frequency, damping
        return float(a2**-0.5), float(a1 / (2.0 * a2**0.5))


NONE = Modes()


class Carriage(NamedTuple):
    """Linear equations of a drive with its modes, x' = a·x + command·u + force·F/m.

    The first two states are position and velocity of the sensor; those of the edge are another pair.

    Attributes:
        a: shape (2n, 2n); with m lags (2n + m, 2n + m).
        command, force: shape (2n,); the force is NaN unless the modes are normal.
        edge: index of the position of the edge; 0 if it moves as the sensor.
    """

    a: Array
    command: Array
    force: Array
    edge: int


def carriage(natural_frequency: float, damping: float, modes: Modes = NONE) -> Carriage:
    """Return the equations of a drive with ω1 = ``natural_frequency`` [rad/s] and ζ1 = ``damping``, and its modes."""
    if not modes.normal:
        return _general(natural_frequency, damping, modes)
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


def own_velocity(
    natural_frequency: float,
    frequency: Iterable[float],
    velocity: Iterable[float],
    lag_time: Iterable[float],
    lag: Iterable[float],
) -> float:
    """Return v0, the share of the loop's own velocity: with it the command does not act on the velocity at once."""
    rates = sum(share / time for share, time in zip(lag, lag_time, strict=True))
    return -(sum(v * w for v, w in zip(velocity, frequency, strict=True)) + rates) / natural_frequency


def _sections(natural_frequency: float, damping: float, modes: Modes) -> tuple[Array, Array, Array, Array, Array]:
    """Return ω, ζ, p, v and e of the loop itself and the modes, shape (n,) each."""
    frequency, zeta = np.array([natural_frequency, *modes.frequency]), np.array([damping, *modes.damping])
    others = modes.velocity or (0.0,) * len(modes.frequency)
    own = own_velocity(natural_frequency, modes.frequency, others, modes.lag_time, modes.lag)
    velocity = np.array([own, *others])
    sensor, edge = (np.array([1.0 - sum(parts) - sum(modes.lag), *parts]) for parts in (modes.sensor, modes.edge))
    return frequency, zeta, sensor, velocity, edge


def _general(natural_frequency: float, damping: float, modes: Modes) -> Carriage:
    """Return the equations of a drive with complex residues or lags."""
    frequency, zeta, sensor, velocity, edge = _sections(natural_frequency, damping, modes)
    pairs, order = frequency.size, 2 * frequency.size + len(modes.lag)
    # In positions xj, velocities xj'/ωj and lags yk, of which none is much larger than another one.
    a, command = np.zeros((order, order)), np.zeros(order)
    at, lags = 2 * np.arange(pairs), np.arange(2 * pairs, order)
    a[at, at + 1], a[at + 1, at], a[at + 1, at + 1] = frequency, -frequency, -2.0 * zeta * frequency
    command[at + 1] = frequency
    command[lags] = 1.0 / np.array(modes.lag_time)
    a[lags, lags] = -command[lags]
    rows = []
    for parts in (sensor, edge)[: 1 if modes.edge == modes.sensor else 2]:
        place = np.zeros(order)
        place[at], place[at + 1], place[lags] = parts, velocity, modes.lag
        rows += [place, place @ a]
    # The other coordinates are any that complete these.
    units = [row / np.linalg.norm(row) for row in rows]
    rest = np.linalg.svd(np.array(units))[2][len(rows) :]
    to = np.vstack((rows, rest))
    moved, turned = to @ command, to @ a @ np.linalg.inv(to)
    moved[0 : len(rows) : 2] = 0.0  # by the relative degree, without its rounding
    turned[0 : len(rows) : 2] = np.eye(order)[1 : len(rows) : 2]
    return Carriage(turned, moved, np.full(order, np.nan), len(rows) - 2)
