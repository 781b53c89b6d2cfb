# SPDX-License-Identifier: Apache-2.0
"""Numbers of the nonlinear periodic control, `lathe_rc.control.periodic`, and sets of them that are known to work."""

from dataclasses import dataclass

import numpy as np

from lathe_rc.errors import InputError
from lathe_rc.transfer import TransferFunction


@dataclass(frozen=True)
class PeriodicGains:
    """Numbers of the law, named as in the paper.

    Attributes:
        h0: of the memory [1].
        h11: of the adaptive gain [1/s].
        h12: of the nonlinear gain [1].
        lead, lag: T and T* of the filters on r and y [s].
        switch_time: τ [s].
        switch_low: δ0 [1].
        memory_filter: σ of the Gaussian on the memory [s]; 0 for none.
        reference_gain: χ* of eq. 12 [1], for the integral of eq. 15 alone; with T* = 0 it meets eq. 14 for all drives.
        doc: where they are from.
    """

    h0: float
    h11: float
    h12: float
    lead: float
    lag: float
    switch_time: float
    switch_low: float
    memory_filter: float
    reference_gain: float
    doc: str

    @property
    def filter(self) -> TransferFunction:
        """W of eqs 6 and 10."""
        top, bottom = np.poly([-1.0 / self.lead] * 3), np.poly([-1.0 / self.lag] * 3)
        return TransferFunction(tuple(top * self.lead**3), tuple(bottom * self.lag**3))


PRESETS = {
    "published": PeriodicGains(
        40.0,
        200.0,
        150.0,
        0.17,
        0.01,
        15.0,
        0.5,
        0.1,
        110.0,
        "paper 002, eqs 20 and 21; not for a quantised measurement",
    ),
    # By the analysis: T and T* so that with σ = 0.1 s the learning factor is below 1 at every corner and level of y_F.
    "quantised": PeriodicGains(
        2.5,
        1.0,
        1.0,
        0.4,
        0.055,
        15.0,
        0.5,
        0.1,
        10.0,
        "for steps of 1e-4 in y and u; checked on all 32 corners of eq. 1",
    ),
}


def check_law(
    gains: PeriodicGains, *, limit: float, step_s: float, memory_filter: float, quantisation: tuple[float, float]
) -> None:
    """Refuse numbers that make no law."""
    positive = {
        "h0": gains.h0, "h11": gains.h11, "lead": gains.lead, "lag": gains.lag, "switch_time": gains.switch_time,
        "limit": limit, "step": step_s,
    }  # fmt: skip
    for name, value in positive.items():
        if not (np.isfinite(value) and value > 0.0):
            raise InputError(f"periodic law: {name} = {value:g}; allowed: above 0")
    from_zero = {
        "h12": gains.h12, "memory_filter": memory_filter,
        "measurement_step": quantisation[0], "command_step": quantisation[1],
    }  # fmt: skip
    for name, value in from_zero.items():
        if not (np.isfinite(value) and value >= 0.0):
            raise InputError(f"periodic law: {name} = {value:g}; allowed: from 0")
    if not 0.0 < gains.switch_low < 1.0:
        raise InputError(f"periodic law: switch_low = {gains.switch_low:g}; allowed: between 0 and 1")
