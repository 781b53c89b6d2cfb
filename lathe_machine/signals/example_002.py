# SPDX-License-Identifier: Apache-2.0
"""Example from paper 002: reference and disturbance of the drive.

    r(t) = 1.1 - 0.1·e^{-t} - |cos 0.04πt|³      (17)
    f(t) = 0.5·(sin 0.04πt)²                     (18)

Both have a period of 25 s, except for the decaying term.
"""

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.jit import kernel

PERIOD = 25.0  #: period of reference and disturbance [s]
OMEGA = 0.04 * np.pi  #: angular frequency in eqs 17 and 18 [rad/s]


@kernel
def fill_reference(first: int, step: float, reference: Array) -> None:
    """Fill the reference of eq. 17, starting at sample ``first``, shape (n,); ``step`` in s."""
    for k in range(reference.size):
        time = (first + k) * step
        reference[k] = 1.1 - 0.1 * np.exp(-time) - np.abs(np.cos(OMEGA * time)) ** 3


@kernel
def fill_disturbance(first: int, step: float, amplitude: float, disturbance: Array) -> None:
    """Fill the disturbance of eq. 18, with ``amplitude`` for 0.5, starting at sample ``first``; ``step`` in s."""
    for k in range(disturbance.size):
        disturbance[k] = amplitude * np.sin(OMEGA * ((first + k) * step)) ** 2
