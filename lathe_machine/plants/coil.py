# SPDX-License-Identifier: Apache-2.0
"""Current loop of a voice coil, computed at each sample of the cell (see `lathe_machine.plants.tool_drive`).

    U = ωc·(L·(i* - i) + R·∫(i* - i)dt)

so that i/i* is about 1/(1 + p/ωc). i* may be limited in magnitude and slope, and U in magnitude; while U is clipped,
the integral is frozen.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.arrays import Array
from lathe_rc.jit import kernel


@dataclass(frozen=True)
class Coil:
    """Parameters of a voice coil and its current loop.

    Attributes:
        resistance: R [Ω].
        inductance: L [H].
        bandwidth: ωc of the current loop [rad/s].
        back_emf: whether the motion induces a voltage.
        current_limit, voltage_limit: limits of i* and U [A, V]; inf for no limit.
        slew_rate: largest slope of i* [A/s]; inf for no limit.
    """

    resistance: float
    inductance: float
    bandwidth: float
    back_emf: bool = True
    current_limit: float = np.inf
    voltage_limit: float = np.inf
    slew_rate: float = np.inf


class CoilTable(NamedTuple):
    """Coil with its state, for kernels (see `Coil`); without a coil, the force of the position loop acts immediately.

    Attributes:
        on: whether there is a coil.
        proportional, integral: gains of the current loop [V/A, V/(A·s)].
        current_limit, voltage_limit: limits of i* and U [A, V].
        slew: largest change of i* per sample [A].
        step: sampling step [s].
        state: integral of i* - i [A·s], and i* [A].
        limited: ring buffer of flags, 1 where current or voltage was clipped; sample n is at index n modulo the size.
    """

    on: bool
    proportional: float
    integral: float
    current_limit: float
    voltage_limit: float
    slew: float
    step: float
    state: Array
    limited: npt.NDArray[np.uint8]


def coil_table(coil: Coil | None, step: float, kept: int) -> CoilTable:
    """Return the table of a coil at rest.

    Args:
        coil: parameters of the coil; None for no coil.
        step: sampling step [s].
        kept: number of samples for which the clipped flag is stored, a power of two.
    """
    values = coil or Coil(0.0, 0.0, 0.0)
    return CoilTable(
        on=coil is not None,
        proportional=values.bandwidth * values.inductance,
        integral=values.bandwidth * values.resistance,
        current_limit=values.current_limit,
        voltage_limit=values.voltage_limit,
        slew=values.slew_rate * step,
        step=step,
        state=np.zeros(2),
        limited=np.zeros(kept, np.uint8),
    )


@kernel
def applied(coil: CoilTable, n: int, asked: float, current: float) -> float:
    """Return the loop's voltage until sample ``n`` [V], from measured and set current [A] of the previous sample."""
    demand = min(max(asked, coil.state[1] - coil.slew), coil.state[1] + coil.slew)
    demand = min(max(demand, -coil.current_limit), coil.current_limit)
    error = demand - current
    integral = coil.state[0] + error * coil.step
    given = coil.proportional * error + coil.integral * integral
    voltage = min(max(given, -coil.voltage_limit), coil.voltage_limit)
    if voltage == given:  # otherwise the integral would wind up
        coil.state[0] = integral
    coil.state[1] = demand
    coil.limited[n & (coil.limited.size - 1)] = demand != asked or voltage != given
    return float(voltage)
