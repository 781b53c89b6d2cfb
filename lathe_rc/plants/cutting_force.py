# SPDX-License-Identifier: Apache-2.0
"""Main cutting force by the chip (Kienzle), with wear.

    Pz = kc1·ap·f0·(f/f0)^{1-mc}·(1 + cw·VB),  f0 = 1 mm

In SI units the force has to name the feed f0 for which kc1 holds; in mm and N/mm² it is 1 and does not show. Source:
spec/feed-and-force.md, "Cutting process", from the W4 of paper 004: 233.3 N/mm is f = 0.071 mm/rev in steel.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lathe_rc.errors import InputError
from lathe_rc.jit import inlined

Array = npt.NDArray[np.float64]

_REFERENCE_FEED = 1e-3  # f0 [m]


@inlined
def cutting_stiffness(kc1: float, mc: float, cw: float, feed: float, wear: float) -> float:
    """Pz/ap [N/m]."""
    return float(kc1 * _REFERENCE_FEED * (feed / _REFERENCE_FEED) ** (1.0 - mc) * (1.0 + cw * wear))


@dataclass(frozen=True)
class SpecificForce:
    """The material's part in the cutting force.

    Attributes:
        kc1: specific force at a feed of 1 mm [Pa].
        mc: exponent of its fall with the feed [1].
        wear_factor: cw, relative rise of the force with the wear VB [1/m].

    Raises:
        InputError: a value that is out of its range.
    """

    kc1: float = 1.7e9
    mc: float = 0.25
    wear_factor: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.kc1 < np.inf:
            raise InputError(f"specific cutting force {self.kc1:g} Pa; allowed: above 0 (1700 N/mm² is 1.7e9 Pa)")
        if not 0.0 <= self.mc < 1.0:
            raise InputError(f"exponent mc = {self.mc:g} of the specific cutting force; allowed: 0 up to below 1")
        if not 0.0 <= self.wear_factor < np.inf:
            raise InputError(f"wear factor {self.wear_factor:g} 1/m of the cutting force; allowed: 0 or more")

    def stiffness(self, feed: float, wear: float = 0.0) -> float:
        """Pz/ap [N/m] at ``feed`` [m/rev] and the wear VB ``wear`` [m]."""
        return cutting_stiffness(self.kc1, self.mc, self.wear_factor, feed, wear)

    def feed_for(self, stiffness: float, wear: float = 0.0) -> float:
        """The feed [m/rev] at which Pz/ap is ``stiffness`` [N/m]."""
        relative = stiffness / self.stiffness(_REFERENCE_FEED, wear)
        return float(_REFERENCE_FEED * relative ** (1.0 / (1.0 - self.mc)))


STEEL = SpecificForce()
