# SPDX-License-Identifier: Apache-2.0
"""How tool drives give way to a force at the tool: x/F of `lathe_rc.plants.tool_drive` in continuous time.

Its inverse is the dynamic stiffness, at p = 0 the static one. Times the radial part of the cutting force it is a
deflection for `lathe_papers.formulas.regeneration`.
"""

import numpy as np

from lathe_rc.plants.coil import Coil
from lathe_rc.transfer import TransferFunction


def compliance(
    *,
    natural_frequency: float,
    damping: float,
    moving_mass: float,
    coil: Coil | None = None,
    force_constant: float = 0.0,
) -> TransferFunction:
    """Tool over force of the electrodynamic drive alone [m/N].

    With a current loop, whose sampling is left out,

        m·p²·x = F - m·ωc·(ω² + 2ζω·p)·x/(p + ωc) - k²·p²·x/((L·p + R)·(p + ωc))

    where the last term is the back-EMF.

    Args:
        natural_frequency: ω of the position loop [rad/s].
        damping: its ζ.
        moving_mass: m [kg].
        coil: its current loop; None: an ideal one.
        force_constant: k of the coil [N/A]; used where there is a current loop.
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
    """Tool over force of both drives in series, with an ideal coil [m/N].

    Args:
        natural_frequency: ω1 of the position loop of the carriage [rad/s].
        damping: its ζ1.
        moving_mass: M of the carriage [kg].
        tool_frequency: ω2 of the tool on a blocked carriage [rad/s].
        tool_damping: its ζ2.
        mass_ratio: of the tool to the carriage.
    """
    tool = mass_ratio * moving_mass
    stack = tool * np.array([2.0 * tool_damping * tool_frequency, tool_frequency**2])
    servo = moving_mass * np.array([2.0 * damping * natural_frequency, natural_frequency**2])
    carriage = np.polyadd([moving_mass, 0.0, 0.0], np.polyadd(stack, servo))
    whole = np.polymul(np.polyadd([tool, 0.0, 0.0], stack), carriage)
    return TransferFunction(tuple(carriage), tuple(np.polysub(whole, np.polymul(stack, stack))))
