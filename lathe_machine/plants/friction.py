# SPDX-License-Identifier: Apache-2.0
"""Friction of a slide, solved together with the speed of the motor within a step.

    g(v) = Fc + (Fs - Fc)·e^{-(v/vs)²}                               Stribeck curve of the dry friction
    stribeck   F = g(v)·sgn v + Fv·v; at rest, the holding force within ±Fs
    lugre      dz/dt = v - σ0·|v|/g(v)·z,  F = σ0·z + σ1·dz/dt + Fv·v

z is the mean deflection of the bristles between the surfaces. At a steady speed, LuGre gives the Stribeck curve; below
Fs, the slide rests on a spring of stiffness σ0 (presliding).

The force of a step is solved together with the speed at the end of the step, which is linear in the force: a slide that
the force can hold is exactly at rest, and no stiffness makes the step unstable. For g, the speed at the start of the
step is used.

Sources: B. Armstrong-Hélouvry, P. Dupont, C. Canudas de Wit, Automatica 30 (1994) 1083 (Stribeck curve); C. Canudas de
Wit, H. Olsson, K. J. Åström, P. Lischinsky, IEEE Trans. Automatic Control 40 (1995) 419 (LuGre).
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from lathe_machine.transfer import TransferFunction
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined

Law = Literal["stribeck", "lugre"]

NONE, STRIBECK, LUGRE = 0, 1, 2  #: laws of a `FrictionTable`
_LAWS = {"stribeck": STRIBECK, "lugre": LUGRE}


class FrictionTable(NamedTuple):
    """Friction of a slide for kernels (see `Friction`).

    Attributes:
        law: `NONE`, `STRIBECK` or `LUGRE`.
        coulomb, static, speed, viscous, stiffness, damping: see `Friction`.
        step: sampling step [s].
    """

    law: int
    coulomb: float
    static: float
    speed: float
    viscous: float
    stiffness: float
    damping: float
    step: float


@dataclass(frozen=True)
class Friction:
    """Friction of a slide, referred to the motor.

    Attributes:
        law: friction law, see the module.
        mobility: transfer function from a force to the motor position [m/N]; see `mobility`.
        coulomb: Fc [N].
        static: Fs [N], not below Fc.
        speed: vs [m/s].
        viscous: Fv [N·s/m], in addition to the friction included in the lag of the drive.
        stiffness: σ0 of the bristles [N/m], for ``lugre``.
        damping: σ1 of the bristles [N·s/m], for ``lugre``.

    Raises:
        InputError: a value is out of range.
    """

    law: Law
    mobility: TransferFunction
    coulomb: float
    static: float
    speed: float
    viscous: float = 0.0
    stiffness: float = 1e7
    damping: float = 0.0

    def __post_init__(self) -> None:
        for name, value in (("force", self.coulomb), ("speed", self.speed), ("stiffness", self.stiffness)):
            if not 0.0 < value < np.inf:
                raise InputError(f"friction: {name} = {value:g}; allowed: above 0")
        for name, value in (("viscous", self.viscous), ("damping", self.damping)):
            if not 0.0 <= value < np.inf:
                raise InputError(f"friction: {name} = {value:g}; allowed: 0 or more")
        if not self.coulomb <= self.static < np.inf:
            raise InputError(
                f"friction: {self.static:g} N at rest and {self.coulomb:g} N in motion; allowed: no less at rest"
            )

    def table(self, step: float) -> FrictionTable:
        """Return the table of the friction for kernels, at a sampling step [s]."""
        return FrictionTable(
            _LAWS[self.law], self.coulomb, self.static, self.speed, self.viscous, self.stiffness, self.damping, step
        )

    def steady(self, speed: float) -> float:
        """Return the friction force [N] at a steady speed [m/s]; 0 at rest."""
        dry = self.coulomb + (self.static - self.coulomb) * np.exp(-((speed / self.speed) ** 2))
        return float(dry * np.sign(speed) + self.viscous * speed)


def mobility(velocity_gain: float, lag: float, motor_force: float) -> TransferFunction:
    """Return the transfer function from a force to the motor position, (k/F1)/(p·(1 + T·p)) [m/N].

    Args:
        velocity_gain: k, speed at a command of 1 [m/s].
        lag: T of the mechanics [s].
        motor_force: F1, force at rest for a command of 1 [N]; the mass moved by the motor is F1·T/k.
    """
    return TransferFunction((velocity_gain / motor_force,), (lag, 1.0, 0.0))


def no_friction(step: float) -> FrictionTable:
    """Return the table of a slide without friction."""
    return FrictionTable(NONE, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, step)


@inlined
def _dry(table: FrictionTable, speed: float) -> float:
    """Return the dry friction g(v) [N] of the Stribeck curve."""
    relative = speed / table.speed
    return float(table.coulomb + (table.static - table.coulomb) * np.exp(-relative * relative))


@inlined
def slide(table: FrictionTable, gained: float, speed: float, free: float) -> tuple[float, bool]:
    """Return the Stribeck friction force of a step [N], and whether the slide is at rest after it.

    Args:
        table: constants of the friction.
        gained: speed change by a force of 1 N held over the step [m/(s·N)].
        speed: speed at the start of the step [m/s].
        free: speed at the end of the step without friction [m/s].
    """
    level = _dry(table, speed)
    # If the force can bring the speed to 0 in this step, it does exactly that, so the slide never oscillates around 0.
    if abs(free) <= gained * level:
        return free / gained, True
    force = level if free > 0.0 else -level
    return force + table.viscous * (free - gained * force) / (1.0 + gained * table.viscous), False


@inlined
def bend(table: FrictionTable, gained: float, speed: float, free: float, bristle: float) -> tuple[float, float]:
    """Return the LuGre force [N] of a step and the final z [m]; ``bristle``: initial z, the rest as in `slide`."""
    # Implicit Euler for the bristles, with the initial |v|/g: stable at any stiffness, F linear in the new speed.
    relaxed = 1.0 / (1.0 + table.step * table.stiffness * abs(speed) / _dry(table, speed))
    hard = table.stiffness + table.damping / table.step
    held = (hard * relaxed - table.damping / table.step) * bristle
    coming = (free - gained * held) / (1.0 + gained * (hard * relaxed * table.step + table.viscous))
    bent = relaxed * (bristle + table.step * coming)
    return held + (hard * relaxed * table.step + table.viscous) * coming, bent
