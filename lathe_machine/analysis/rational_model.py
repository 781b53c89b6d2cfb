# SPDX-License-Identifier: Apache-2.0
"""Rational model of a drive over the band of a form, from its frequency response.

    W(p)·e^{pτ}/W(0) ≈ (1 + b1·p + b2·p²)/(1 + a1·p + ... + a4·p⁴)

The model minimises the error of the equation, weighted by 1/(1 + p/ω)⁶ (Levy 1959), over logarithmically spaced
frequencies, of which the low ones, where the form is large, are as many as the high ones. It is exact for a drive with
one resonance beside its own. With several, its zeros are effective ones: they are where the model fits the band of the
form best, and the structure has none there.
"""

from functools import lru_cache

import numpy as np

from lathe_machine.analysis.modal_drive import ModalDrive
from lathe_machine.control.rational_fit import RATIONAL_BAND, damped
from lathe_rc.analysis.cycle_factors import Response
from lathe_rc.arrays import Array

_FREQUENCIES = np.geomspace(0.02, 1.2, 400)  # in units of the band


def rational_model(drive: Response, delay: float, band: float = RATIONAL_BAND) -> Array | None:
    """Return a1 to a4, b1 and b2 [s, s², s³, s⁴, s, s²] of a drive, shape (6,); None if the zeros are hardly damped.

    Args:
        drive: response at frequencies [rad/s].
        delay: τ [s].
        band: ω [rad/s].
    """
    frequency, p = _FREQUENCIES * band, 1j * _FREQUENCIES
    response = drive(frequency) * np.exp(1j * frequency * delay)
    response = response / drive(np.zeros(1))
    weight = 1.0 / (1.0 + p) ** 6
    columns = [p**k * response for k in (1, 2, 3, 4)] + [-p, -(p**2)]
    left, right = weight[:, None] * np.stack(columns, axis=1), weight * (1.0 - response)
    found = np.linalg.lstsq(np.vstack((left.real, left.imag)), np.append(right.real, right.imag), rcond=None)[0]
    model = found / band ** np.array([1, 2, 3, 4, 1, 2])
    return model if damped(model) else None


@lru_cache(maxsize=64)
def of_modal_drive(drive: ModalDrive) -> Array | None:
    """Return the `rational_model` of a drive with modes or lags; None if it has neither, or there is no such model."""
    return rational_model(drive.response, drive.delay) if drive.mode_frequency or drive.lag_time else None
