# SPDX-License-Identifier: Apache-2.0
"""The screw of a feed drive: position of its nut when the motor is at x.

    nut = x + s·x + a·(sin(2π·x/P + ψ) - sin ψ) + α·ΔT·(x - x0)
    T·dΔT/dt = R·|v| + A - ΔT

The pitch is wrong by a part s everywhere, and by a wave that repeats with the lead P. The screw warms with the way that
the nut rubs along and with its surroundings, and grows from its fixed bearing x0. At sample 0 it is as warm as it was
when the axis was set to 0, so the nut stands where the motor says.

Within a step ΔT is exact for a speed that does not change in it. Source: ISO 230-2 (periodic and cumulative positioning
error) and ISO 230-3 (thermal effects) name the errors; the law of warming is that of a body of one temperature.
"""

from typing import NamedTuple

import numpy as np

from lathe_rc.errors import InputError
from lathe_rc.jit import inlined

_TURN = 2.0 * np.pi


class Screw(NamedTuple):
    """Errors of a screw.

    Attributes:
        slope: s [m/m].
        lead: P [m].
        amplitude: a [m].
        phase: ψ [rad].
        expansion: α [1/K].
        heating: R [K·s/m].
        surroundings: A, rise of the temperature at rest in the end [K].
        time: T [s].
        anchor: x0, where the bearing stands that holds the screw [m].
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
        """Refuse values that no screw has.

        Raises:
            InputError: a value that is out of its range, or a wave so steep that the nut would go back.
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
        """For kernels, at a sampling step [s]; raises as `check`."""
        self.check()
        return ScrewTable(
            self,
            real=bool(self.slope or self.amplitude or self.heating or self.surroundings),
            wave=_TURN / self.lead,
            offset=float(np.sin(self.phase)),
            nears=float(-np.expm1(-step / self.time)),
        )


class ScrewTable(NamedTuple):
    """A `Screw` for kernels.

    Attributes:
        errors: of the screw.
        real: whether it has an error at all.
        wave: 2π/P [rad/m].
        offset: sin ψ.
        nears: part of what is missing that ΔT makes up in a step.
    """

    errors: Screw
    real: bool
    wave: float
    offset: float
    nears: float


@inlined
def warm(table: ScrewTable, rise: float, speed: float) -> float:
    """ΔT at the end of a step [K]."""
    errors = table.errors
    return rise + table.nears * (errors.heating * abs(speed) + errors.surroundings - rise)


@inlined
def nut(table: ScrewTable, rise: float, place: float) -> float:
    """Position of the nut [m] when the motor is at ``place`` [m]; ``rise`` is ΔT [K]."""
    errors = table.errors
    wave = errors.amplitude * (np.sin(table.wave * place + errors.phase) - table.offset)
    return float(place + errors.slope * place + wave + errors.expansion * rise * (place - errors.anchor))


@inlined
def nut_speed(table: ScrewTable, rise: float, place: float, speed: float) -> float:
    """Speed of the nut [m/s]."""
    errors = table.errors
    pitch = errors.slope + errors.amplitude * table.wave * np.cos(table.wave * place + errors.phase)
    rising = (errors.heating * abs(speed) + errors.surroundings - rise) / errors.time
    growth = errors.expansion * (rise * speed + rising * (place - errors.anchor))
    return float(speed + pitch * speed + growth)
