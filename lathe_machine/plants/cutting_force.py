# SPDX-License-Identifier: Apache-2.0
"""Cutting force: material, tool wear, flank, and elasticity of the edge.

    Pz = kc1·ap·f0·(f/f0)^{1-mc}·(1 + cw·VB),  f0 = 1 mm                        (Kienzle, with wear)

In SI units the formula must contain the feed f0 for which kc1 holds; in mm and N/mm², f0 is 1 and does not appear. A
worn flank presses on the surface and so damps vibration (process damping). The force bends the edge: W3 of paper 004.

Values are checked in the parameter table of the cutting process; `CuttingProcess` checks them again. Here they
are plain tuples, which kernels accept directly.

Source: spec/feed-and-force.md, "Cutting process", from W4 of paper 004: 233.3 N/mm is f = 0.071 mm/rev in steel;
D. W. Wu, J. Engineering for Industry 111 (1989) 37 (force proportional to the displaced volume); E. Budak, L. T. Tunc,
CIRP Annals 59 (2010).
"""

from typing import NamedTuple

from lathe_machine.transfer import TransferFunction
from lathe_rc.jit import inlined

_REFERENCE_FEED = 1e-3  # f0 [m]


class SpecificForce(NamedTuple):
    """Effect of the material on the cutting force.

    Attributes:
        kc1: specific force at a feed of 1 mm [Pa].
        mc: exponent of the decrease of the specific force with the feed [1].
        wear_factor: cw, relative increase of the force with the wear VB [1/m].
    """

    kc1: float = 1.7e9
    mc: float = 0.25
    wear_factor: float = 0.0

    def stiffness(self, feed: float, wear: float = 0.0) -> float:
        """Return the cutting stiffness Pz/ap [N/m] at ``feed`` [m/rev] and a wear VB of ``wear`` [m]."""
        return cutting_stiffness(self, feed, wear)

    def feed_for(self, stiffness: float, wear: float = 0.0) -> float:
        """Return the feed [m/rev] at which the cutting stiffness Pz/ap is ``stiffness`` [N/m]."""
        relative = stiffness / self.stiffness(_REFERENCE_FEED, wear)
        return float(_REFERENCE_FEED * relative ** (1.0 / (1.0 - self.mc)))


STEEL = SpecificForce()


@inlined
def cutting_stiffness(material: SpecificForce, feed: float, wear: float) -> float:
    """Return the cutting stiffness Pz/ap [N/m] at a feed [m/rev] and a wear VB [m]."""
    relative = (feed / _REFERENCE_FEED) ** (1.0 - material.mc)
    return float(material.kc1 * _REFERENCE_FEED * relative * (1.0 + material.wear_factor * wear))


class Wear(NamedTuple):
    """Wear VB of the tool, which grows while there is a chip.

    Attributes:
        initial: initial wear [m].
        per_metre: growth per metre of cutting path [m/m].
        per_second: growth per second in the cut [m/s].
    """

    initial: float = 0.0
    per_metre: float = 0.0
    per_second: float = 0.0


class Flank(NamedTuple):
    """Process damping by the flank, which presses on the surface.

    Attributes:
        pressure: Ksp, force per displaced volume [N/m³]; 0 for no process damping.
        width: B, width of the flank along the edge that faces the surface [m].
        land: initial W, to which the wear VB is added [m].
    """

    pressure: float = 0.0
    width: float = 0.2e-3
    land: float = 0.0


@inlined
def flank_damping(flank: Flank, speed: float, wear: float) -> float:
    """Return the flank force per unit of outward edge speed [N·s/m], at a cutting speed [m/s] and a wear VB [m]."""
    land = flank.land + wear
    return flank.pressure * flank.width * land * land / (2.0 * speed)


class Elasticity(NamedTuple):
    """Deflection of the edge by the cutting force, W3 = c/(1 + b·p + a·p²).

    Attributes:
        compliance: c [m/N].
        inertia: a [s²]; a = b = 0 for a spring alone.
        damping: b [s].
        away: whether the force pushes the edge away from the part; False draws it into the part.
    """

    compliance: float
    inertia: float
    damping: float
    away: bool

    @property
    def shape(self) -> TransferFunction:
        """Transfer function W3/c with a gain of 1."""
        return TransferFunction((1.0,), (self.inertia, self.damping, 1.0))

    @property
    def transfer(self) -> TransferFunction:
        """Transfer function W3 from the force to the deflection [m/N]."""
        return TransferFunction((self.compliance,), (self.inertia, self.damping, 1.0))


RIGID = Elasticity(0.0, 0.0, 0.0, away=True)
PAPER = Elasticity(3.85e-7, 0.003, 0.0005, away=False)  #: as printed in paper 004: 2.9 Hz, ζ = 0.005
REALISTIC = Elasticity(3.85e-7, 0.003**2, 0.0005, away=True)  #: 53 Hz, ζ = 0.083
