# SPDX-License-Identifier: Apache-2.0
"""Compliance of the tool drives: x/F of `lathe_machine.plants.tool_drive` in continuous time.

Its inverse is the dynamic stiffness, and at p = 0 the static stiffness. The compliance, multiplied by the radial part
of the cutting force, is the deflection for `lathe_machine.analysis.regeneration`.
"""

import numpy as np

from lathe_machine.plants.coil import Coil
from lathe_machine.transfer import TransferFunction


def compliance(
    *,
    natural_frequency: float,
    damping: float,
    moving_mass: float,
    coil: Coil | None = None,
    force_constant: float = 0.0,
) -> TransferFunction:
    """Return the compliance x/F of the electrodynamic drive alone [m/N].

    With a current loop, whose sampling is neglected,

        m·p²·x = F - m·ωc·(ω² + 2ζω·p)·x/(p + ωc) - k²·p²·x/((L·p + R)·(p + ωc))

    where the last term is the back-EMF.

    Args:
        natural_frequency: natural frequency ω of the position loop [rad/s].
        damping: damping ratio ζ of the position loop.
        moving_mass: moving mass m [kg].
        coil: current loop of the coil; None for an ideal coil.
        force_constant: k of the coil [N/A]; used only with a current loop.
    """
    servo = np.array([2.0 * damping * natural_frequency, natural_frequency**2])
    if coil is None:
        return TransferFunction((1.0,), tuple(moving_mass * np.array([1.0, *servo])))
    winding, loop = np.array([coil.inductance, coil.resistance]), np.array([1.0, coil.bandwidth])
    both = np.polymul(winding, loop)
    whole = np.polyadd(
        np.polymul([moving_mass, 0.0, 0.0], both), moving_mass * coil.bandwidth * np.polymul(servo, winding)
    )
    if coil.back_emf:
        whole = np.polyadd(whole, [force_constant**2, 0.0, 0.0])
    return TransferFunction(tuple(both), tuple(whole))


def compliance_in_series(
    *,
    natural_frequency: float,
    damping: float,
    moving_mass: float,
    tool_frequency: float,
    tool_damping: float,
    mass_ratio: float,
) -> TransferFunction:
    """Return the compliance x/F of both drives in series, with an ideal coil [m/N].

    Args:
        natural_frequency: natural frequency ω1 of the position loop of the carriage [rad/s].
        damping: damping ratio ζ1 of the position loop.
        moving_mass: mass M of the carriage [kg].
        tool_frequency: natural frequency ω2 of the tool on a fixed carriage [rad/s].
        tool_damping: damping ratio ζ2 of the tool.
        mass_ratio: ratio of the tool's mass to the carriage's.
    """
    tool = mass_ratio * moving_mass
    stack = tool * np.array([2.0 * tool_damping * tool_frequency, tool_frequency**2])
    servo = moving_mass * np.array([2.0 * damping * natural_frequency, natural_frequency**2])
    carriage = np.polyadd([moving_mass, 0.0, 0.0], np.polyadd(stack, servo))
    whole = np.polymul(np.polyadd([tool, 0.0, 0.0], stack), carriage)
    return TransferFunction(tuple(carriage), tuple(np.polysub(whole, np.polymul(stack, stack))))
