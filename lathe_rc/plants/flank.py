# SPDX-License-Identifier: Apache-2.0
"""The flank of the tool: it wears, and where it is worn it presses on the surface, which damps (process damping).

Source: D. W. Wu, J. Engineering for Industry 111 (1989) 37 (force by the volume that is pressed in); E. Budak, L. T.
Tunc, CIRP Annals 59 (2010).
"""

from dataclasses import dataclass

import numpy as np

from lathe_rc.errors import InputError
from lathe_rc.jit import inlined


@dataclass(frozen=True)
class Wear:
    """Wear VB of the tool; it grows while there is a chip.

    Attributes:
        initial: [m].
        per_metre: for each metre of the cutting path [m/m].
        per_second: for each second in the cut [m/s].

    Raises:
        InputError: a negative value.
    """

    initial: float = 0.0
    per_metre: float = 0.0
    per_second: float = 0.0

    def __post_init__(self) -> None:
        if min(self.initial, self.per_metre, self.per_second) < 0.0:
            raise InputError(f"{self}; allowed: 0 or more each, wear does not heal")


@inlined
def flank_damping(pressure: float, width: float, land: float, speed: float) -> float:
    """Force on the edge by its speed out of the part [N·s/m], see `Flank`; ``land`` is all that presses."""
    return pressure * width * land * land / (2.0 * speed)


@dataclass(frozen=True)
class Flank:
    """The flank that presses on the surface: process damping.

    Attributes:
        pressure: Ksp, force by the volume that is pressed in [N/m³]; 0: no process damping.
        width: B, of the flank along the edge that faces the surface [m].
        land: W of a new edge, to which the wear VB is added [m].

    Raises:
        InputError: a negative value.
    """

    pressure: float = 0.0
    width: float = 0.2e-3
    land: float = 0.0

    def __post_init__(self) -> None:
        if not (0.0 <= self.pressure < np.inf and 0.0 <= self.width < np.inf and 0.0 <= self.land < np.inf):
            raise InputError(f"{self}; allowed: 0 or more each")

    def damping(self, speed: float, wear: float = 0.0) -> float:
        """Force on the edge by its speed out of the part [N·s/m].

        Args:
            speed: cutting speed [m/s].
            wear: VB [m].
        """
        return flank_damping(self.pressure, self.width, self.land + wear, speed)
