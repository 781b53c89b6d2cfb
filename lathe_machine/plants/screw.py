# SPDX-License-Identifier: Apache-2.0
"""Screw of a feed drive with pitch errors and thermal growth: position of the nut for a motor position x.

    nut = x + s·x + a·(sin(2π·x/P + ψ) - sin ψ) + α·ΔT·(x - x0)
    T·dΔT/dt = R·|v| + A - ΔT

The pitch has a constant relative error s, and a periodic error whose period is the lead P. The screw is heated by the
friction of the moving nut and by the surroundings, and grows from its fixed bearing at x0. At sample 0 it has the
temperature at which the axis was zeroed, so the nut is at the position of the motor.

Within a step, ΔT is exact for a constant speed. Sources: ISO 230-2 (periodic and cumulative positioning error) and ISO
230-3 (thermal effects) name the errors; the heating law is that of a body of uniform temperature.
"""

from typing import NamedTuple

import numpy as np

from lathe_rc.errors import InputError
from lathe_rc.jit import inlined

_TURN = 2.0 * np.pi


class Screw(NamedTuple):
    """Errors of a feed screw: pitch, periodic error and thermal growth.

    Attributes:
        slope: s, relative pitch error [m/m].
        lead: P [m].
        amplitude: a, amplitude of the periodic error [m].
        phase: ψ, phase of the periodic error [rad].
        expansion: α [1/K].
        heating: R [K·s/m].
        surroundings: A, final temperature rise at rest [K].
        time: T [s].
        anchor: x0, position of the fixed bearing of the screw [m].
    """

    slope: float = 0.0
    lead: float = 10e-3
    amplitude: float = 0.0
    phase: float = 0.0
    expansion: float = 11.5e-6
    heating: float = 0.0
    surroundings: float = 0.0
    time: float = 1800.0
    anchor: float = 0.0

    def check(self) -> None:
        """Check that the values describe a possible screw.

        Raises:
            InputError: a value is out of range, or the periodic error is so steep that the nut would move backwards.
        """
        for name, value in (("lead", self.lead), ("time", self.time)):
            if not 0.0 < value < np.inf:
                raise InputError(f"screw: {name} = {value:g}; allowed: above 0")
        steepest = abs(self.slope) + _TURN * abs(self.amplitude) / self.lead
        if not steepest < 1.0:
            raise InputError(
                f"screw: pitch error of {self.slope:g} m/m and {self.amplitude:g} m over a lead of {self.lead:g} m; "
                "allowed: one that leaves the nut going on with the motor"
            )

    def table(self, step: float) -> "ScrewTable":
        """Return the table of the screw for kernels, at a sampling step [s]; raises the errors of `check`."""
        self.check()
        return ScrewTable(
            self,
            real=bool(self.slope or self.amplitude or self.heating or self.surroundings),
            wave=_TURN / self.lead,
            offset=float(np.sin(self.phase)),
            nears=float(-np.expm1(-step / self.time)),
        )


class ScrewTable(NamedTuple):
    """Errors of a feed screw for kernels (see `Screw`).

    Attributes:
        errors: parameters of the screw.
        real: whether there is any error.
        wave: 2π/P [rad/m].
        offset: sin ψ.
        nears: fraction of the remaining temperature difference by which ΔT changes per step.
    """

    errors: Screw
    real: bool
    wave: float
    offset: float
    nears: float


@inlined
def warm(table: ScrewTable, rise: float, speed: float) -> float:
    """Return the temperature rise ΔT of the screw at the end of a step [K]."""
    errors = table.errors
    return rise + table.nears * (errors.heating * abs(speed) + errors.surroundings - rise)


@inlined
def nut(table: ScrewTable, rise: float, place: float) -> float:
    """Return the position of the nut [m] for a motor position ``place`` [m] and a temperature rise ``rise`` [K]."""
    errors = table.errors
    wave = errors.amplitude * (np.sin(table.wave * place + errors.phase) - table.offset)
    return float(place + errors.slope * place + wave + errors.expansion * rise * (place - errors.anchor))


@inlined
def nut_speed(table: ScrewTable, rise: float, place: float, speed: float) -> float:
    """Return the speed of the nut [m/s] for a motor at ``place`` [m] with a ``speed`` [m/s]."""
    errors = table.errors
    pitch = errors.slope + errors.amplitude * table.wave * np.cos(table.wave * place + errors.phase)
    rising = (errors.heating * abs(speed) + errors.surroundings - rise) / errors.time
    growth = errors.expansion * (rise * speed + rising * (place - errors.anchor))
    return float(speed + pitch * speed + growth)
