# SPDX-License-Identifier: Apache-2.0
"""Lead laws: angle by which the memory is read ahead of the spindle to compensate for a delay T0.

    constant_angle          T0·Ω0                        exact at the nominal speed only
    variable                T0·Ω(t)                      paper 000, eq. (20)
    variable_second_order   T0·Ω(t) + (T0²/2)·dΩ/dt      the next term of φ(t+T0) - φ(t)
    exact_preview           φ(t+T0) - φ(t)               for a speed law known in advance

A value read at ψ = φ + lead acts T0 later. A correction that differentiates the memory with respect to time also
needs dψ/dt and d²ψ/dt²: to first order in T0, these are the speed and the acceleration at t + T0.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.jit import kernel
from lathe_rc.signals.speed import SpeedLaw, evaluate


class LeadLaw(IntEnum):
    """Law of the lead angle; the laws are described in the module `lathe_machine.control.lead`."""

    CONSTANT_ANGLE = 0
    VARIABLE = 1
    VARIABLE_SECOND_ORDER = 2
    EXACT_PREVIEW = 3


class PreviewTable(NamedTuple):
    """Parameters and state of a `Preview` for kernels.

    Attributes:
        step: sampling step [s].
        law: value of a `LeadLaw`.
        lead_time: T0 [s].
        constant: lead angle added to that of the law [rad].
        nominal, lines, tachogram: parameters of the speed law.
        history: ring buffer of the measured speed, initially NaN [rad/s].
    """

    step: float
    law: int
    lead_time: float
    constant: float
    nominal: float
    lines: Array
    tachogram: Array
    history: Array


@kernel
def look_ahead(
    preview: PreviewTable,
    first: int,
    wanted: bool,  # noqa: FBT001 - kernels take their arguments by position
    speed: Array,
    lead: Array,
    rate: Array,
    bend: Array,
) -> None:
    """Fill the lead [rad] of a block and, if ``wanted``, dψ/dt [rad/s] and d²ψ/dt² [rad/s²], shape (n,)."""
    step, law, lead_time, constant = preview.step, preview.law, preview.lead_time, preview.constant
    nominal, lines, tachogram, history = preview.nominal, preview.lines, preview.tachogram, preview.history
    if law < 2 and not wanted:
        for k in range(speed.size):
            lead[k] = lead_time * (nominal if law == 0 else speed[k]) + constant
        return
    window = history.size
    place = first % window
    for k in range(speed.size):
        # The new speed overwrites the oldest one in the ring, which is NaN until the ring is full.
        oldest = history[place]
        acceleration = 0.0 if np.isnan(oldest) else (speed[k] - oldest) / (window * step)
        history[place] = speed[k]
        place = place + 1 if place + 1 < window else 0
        if law == 3:
            t = (first + k) * step
            here, _, _ = evaluate(t, nominal, lines, tachogram)
            there, moving, bending = evaluate(t + lead_time, nominal, lines, tachogram)
            ahead = there - here
        else:
            ahead = lead_time * (nominal if law == 0 else speed[k])
            if law == 2:
                ahead += 0.5 * lead_time**2 * acceleration
            moving, bending = speed[k] + lead_time * acceleration, acceleration
        lead[k] = ahead + constant
        if wanted:
            rate[k], bend[k] = moving, bending


class Preview:
    """Lead angle and time derivatives of the read angle, for a lead time.

    Args:
        law: lead law.
        lead_time: T0 [s].
        speed_law: nominal speed Ω0; for ``EXACT_PREVIEW`` also its deviations.
        step: sampling step [s].
        window: number of samples between the measured speeds whose difference gives dΩ/dt, which lags by half of it.
        constant: lead angle [rad] added to that of the law, independent of the speed.

    Attributes:
        table: parameters and state for `look_ahead`.
    """

    def __init__(
        self, law: LeadLaw, lead_time: float, speed_law: SpeedLaw, step: float, window: int, constant: float = 0.0
    ) -> None:
        known, history = speed_law, np.full(window, np.nan)
        self.table = PreviewTable(
            step, int(law), lead_time, constant, known.nominal, known.lines, known.tachogram, history
        )

    def block(self, first: int, speed: Array, *, rates: bool = True) -> tuple[Array, Array, Array]:
        """Compute lead [rad], dψ/dt [rad/s] and d²ψ/dt² [rad/s²] for the measured ``speed`` [rad/s], shape (n,) each.

        Without ``rates`` the latter two are empty; the choice must be the same for all blocks.
        """
        lead = np.empty(speed.size)
        rate, bend = (np.empty(speed.size), np.empty(speed.size)) if rates else (np.empty(0), np.empty(0))
        look_ahead(self.table, first, rates, speed, lead, rate, bend)
        return lead, rate, bend
