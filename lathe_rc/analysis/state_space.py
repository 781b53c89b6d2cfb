# SPDX-License-Identifier: Apache-2.0
"""Linear systems as python-control has them, in coordinates in which their poles can be computed.

The companion form of paper 004's compensators has coefficients from 1 to 10¹², and the poles of a loop around it come
out wrong by several rad/s. Each system is balanced by itself before it is connected to others.
"""

from typing import Any, TypeAlias

import control
import numpy as np
import scipy

from lathe_rc.transfer import TransferFunction

Lti: TypeAlias = Any  # control.lti.LTI, which has no types
Plant: TypeAlias = TransferFunction | Lti

_PADE = 4  # order: up to ωτ = 2 its phase is right to 1e-4 rad


def state_space(plant: Plant) -> Lti:
    """A balanced realisation of a transfer function; any other system of python-control as it realises it."""
    if not isinstance(plant, TransferFunction):
        return control.ss(plant)
    if not np.any(plant.numerator):
        return control.ss([], [], [], [[0.0]])
    if len(plant.denominator) == 1:  # tf2ss would give a gain an idle state
        return control.ss([], [], [], [[plant.numerator[-1] / plant.denominator[0]]])
    a, b, c, d = scipy.signal.tf2ss(plant.numerator, plant.denominator)
    balanced, (scale, _) = scipy.linalg.matrix_balance(a, permute=False, separate=True)
    return control.ss(balanced, b / scale[:, None], c * scale[None, :], d)


def delay(seconds: float) -> Lti:
    """e^{-p·seconds} by Padé."""
    if seconds == 0.0:
        return control.ss([], [], [], [[1.0]])
    return state_space(TransferFunction(*(tuple(part) for part in control.pade(seconds, _PADE))))
