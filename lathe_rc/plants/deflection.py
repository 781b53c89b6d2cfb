# SPDX-License-Identifier: Apache-2.0
"""Deflection of the tool's edge by the cutting force: W3 of paper 004."""

from dataclasses import dataclass

import numpy as np

from lathe_rc.errors import InputError
from lathe_rc.transfer import TransferFunction


@dataclass(frozen=True)
class Elasticity:
    """W3 = c/(1 + b·p + a·p²): what the force does to the edge.

    Attributes:
        compliance: c [m/N].
        inertia: a [s²]; 0 with b = 0 for a spring alone.
        damping: b [s].
        away: the force pushes the edge away from the part; False draws it into the part.

    Raises:
        InputError: a value that is out of its range.
    """

    compliance: float
    inertia: float
    damping: float
    away: bool

    def __post_init__(self) -> None:
        for name, value in (("compliance", self.compliance), ("inertia", self.inertia), ("damping", self.damping)):
            if not 0.0 <= value < np.inf:
                raise InputError(f"tool deflection: {name} {value:g}; allowed: 0 or more")
        if self.inertia > 0.0 and not self.damping > 0.0:
            raise InputError("tool deflection: damping 0 with inertia; allowed: above 0, or it rings for ever")

    @property
    def shape(self) -> TransferFunction:
        """W3/c."""
        return TransferFunction((1.0,), (self.inertia, self.damping, 1.0))

    @property
    def transfer(self) -> TransferFunction:
        """W3 [m/N]."""
        return TransferFunction((self.compliance,), (self.inertia, self.damping, 1.0))


RIGID = Elasticity(0.0, 0.0, 0.0, away=True)
PAPER = Elasticity(3.85e-7, 0.003, 0.0005, away=False)  #: as printed in paper 004: 2.9 Hz, ζ = 0.005
REALISTIC = Elasticity(3.85e-7, 0.003**2, 0.0005, away=True)  #: 53 Hz, ζ = 0.083
