# SPDX-License-Identifier: Apache-2.0
"""Linear systems as python-control has them, in coordinates in which their poles can be computed.

The companion form of paper 004's compensators has coefficients from 1 to 10¹², and the poles of a loop around it come
out wrong by several rad/s. Each system is balanced by itself before it is connected to others.
"""

from typing import Any, TypeAlias

import control

from lathe_rc.transfer import TransferFunction, realise

Lti: TypeAlias = Any  # control.lti.LTI, which has no types
Plant: TypeAlias = TransferFunction | Lti

_PADE = 4  # order: up to ωτ = 2 its phase is right to 1e-4 rad


def state_space(plant: Plant) -> Lti:
    """A balanced realisation of a transfer function; any other system of python-control as it realises it."""
    if not isinstance(plant, TransferFunction):
        return control.ss(plant)
    a, b, c, d = realise(plant)
    return control.ss(a, b[:, None], c[None, :], [[d]])


def delay(seconds: float) -> Lti:
    """e^{-p·seconds} by Padé."""
    if seconds == 0.0:
        return control.ss([], [], [], [[1.0]])
    return state_space(TransferFunction(*(tuple(part) for part in control.pade(seconds, _PADE))))
