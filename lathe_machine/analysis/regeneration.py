# SPDX-License-Identifier: Apache-2.0
"""Stability of regenerative cutting: the edge cuts the surface that it left one revolution earlier.

The force due to a chip deviation is K·ap. The deflection σ·G·F acts on the chip immediately and, scaled by µ, one
revolution T later with the opposite sign:

    1 + σ·K·G(p)·(1 - µ·e^{-pT}) = 0,  G = W3/(1 + p·lag)

At µ = 1 the largest K that is stable at every speed is Tlusty's -1/(2·min Re σG): 2k·ζ·(1 + ζ) for a spring-mass-damper
of stiffness k that is pushed away, 2k·ζ·(1 - ζ) for one that is drawn in (ζ < 0.5). Source: spec/feed-and-force.md,
which gives about 24 N/mm for W3 of paper 004 as printed and 469 N/mm for the realistic W3.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from lathe_machine.transfer import TransferFunction
from lathe_rc.arrays import Array, Complex
from lathe_rc.errors import InputError

_POINTS = 20_000  # points of a frequency grid
_SPAN = 30.0  # ratio of the grid's ends to the outermost poles


@dataclass(frozen=True)
class Limit:
    """Stability limit of regenerative cutting.

    Attributes:
        stiffness: K, smallest unstable ratio of force to depth of cut [N/m]; inf if there is none.
        frequency: chatter frequency [rad/s]; 0 if the edge is drawn in without oscillation.
        phase: phase lag of the returning surface, ωT modulo 2π [rad], from 0 to 2π.
    """

    stiffness: float
    frequency: float
    phase: float

    def period(self, waves: int) -> float:
        """Return the revolution time [s] for ``waves`` whole waves plus the phase around the part."""
        if self.frequency == 0.0:
            return np.inf
        return float((self.phase + 2.0 * np.pi * waves) / self.frequency)


@dataclass(frozen=True)
class Regeneration:
    """Regenerative cut: deflection of the edge, direction of the force and overlap.

    Attributes:
        deflection: G, deflection per static force of the chip [m/N]: W3 times the lag of the force.
        away: True if the force pushes the edge away from the part (σ = 1); False if the force draws it in (σ = -1).
        overlap: overlap factor µ.

    Raises:
        InputError: the overlap is invalid, or the deflection is not stable.
    """

    deflection: TransferFunction
    away: bool = True
    overlap: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 < self.overlap <= 1.0:
            raise InputError(f"regeneration: overlap {self.overlap:g}; allowed: above 0, up to 1")
        poles = self.deflection.poles
        if not poles.size or not np.all(poles.real < 0.0):
            raise InputError(f"regeneration: deflection {self.deflection}; allowed: stable, with inertia or lag")

    def _signed(self, frequency: npt.ArrayLike) -> Complex:
        """Signed deflection response σ·G."""
        return self.deflection.response(frequency) * (1.0 if self.away else -1.0)

    def _grid(self) -> Array:
        """Frequency grid [rad/s] that resolves all resonances: logarithmic spacing, and dense around each mode."""
        poles = self.deflection.poles
        sizes = np.abs(poles)
        grids = [np.geomspace(sizes.min() / _SPAN, sizes.max() * _SPAN, _POINTS)]
        # The response of a mode is a function of the arctangent of the distance from it in half-widths.
        angles = np.linspace(-1.5, 1.5, 2001)
        grids += [abs(pole.imag) + abs(pole.real) * np.tan(angles) for pole in poles if pole.imag > 0.0]
        together = np.unique(np.concatenate(grids))
        return together[together > 0.0]

    def critical(self, frequency: npt.ArrayLike) -> Array:
        """Return the smallest K [N/m] with chatter at ``frequency`` [rad/s] at some speed; inf if there is none."""
        g = self._signed(frequency)
        # |1/K + G| = µ·|G|, because the surface may return at any phase.
        inside = g.real**2 - (1.0 - self.overlap**2) * np.abs(g) ** 2
        inverse = -g.real + np.sqrt(np.maximum(inside, 0.0))
        with np.errstate(divide="ignore"):
            return np.where((inside >= 0.0) & (inverse > 0.0), 1.0 / inverse, np.inf)

    def worst(self) -> Limit:
        """Return the limit at the worst of all speeds; below it, every speed is stable."""
        grid = np.append(0.0, self._grid())  # 0: limit of ever slower oscillation, with the spindle nearly at rest
        values = self.critical(grid)
        k = int(np.argmin(values))
        if not np.isfinite(values[k]):
            return Limit(np.inf, np.nan, np.nan)
        if k == 0:
            return Limit(float(values[0]), 0.0, np.pi)
        bounds = grid[k - 1], grid[min(k + 1, grid.size - 1)]
        found = scipy.optimize.minimize_scalar(
            lambda w: float(self.critical(w)), bounds=bounds, method="bounded", options={"xatol": 0}
        )
        # The bounded search may end above the minimum on the grid.
        frequency = float(found.x) if found.fun < values[k] else float(grid[k])
        stiffness = float(self.critical(frequency))
        back = (1.0 + 1.0 / (stiffness * self._signed(frequency))) / self.overlap
        return Limit(stiffness, frequency, float(-np.angle(back) % (2.0 * np.pi)))

    def at(self, period: float) -> Limit:
        """Return the limit at one speed by the Nyquist criterion; ``period`` is the revolution time in s."""
        if not period > 0.0:
            raise InputError(f"regeneration: revolution of {period:g} s; allowed: above 0")

        def loop(frequency: npt.ArrayLike) -> Complex:
            w = np.asarray(frequency, dtype=np.float64)
            return np.asarray(-self._signed(w) * (1.0 - self.overlap * np.exp(-1j * w * period)))

        grid = self._grid()
        # Uniform steps as well: e^{-jωT} turns by at most π/32 per step, so that no crossing is missed.
        grid = np.union1d(grid, np.arange(grid[0], grid[-1], min(np.pi / (32.0 * period), grid[-1] / _POINTS)))
        values = loop(grid)
        # K·loop passes 1 where it is real and positive.
        crossings = np.flatnonzero((np.diff(np.sign(values.imag)) != 0) & (values.real[:-1] + values.real[1:] > 0.0))
        still = float(loop(0.0).real)
        best = Limit(1.0 / still, 0.0, 0.0) if still > 0.0 else Limit(np.inf, np.nan, np.nan)
        for k in crossings:
            frequency = float(
                scipy.optimize.brentq(lambda w: float(loop(w).imag), grid[k], grid[k + 1], xtol=1e-14 * grid[k + 1])
            )
            inverse = float(loop(frequency).real)
            if inverse > 0.0 and 1.0 / inverse < best.stiffness:
                best = Limit(1.0 / inverse, frequency, float(frequency * period % (2.0 * np.pi)))
        return best

    def root(self, stiffness: float, period: float, near: complex) -> complex:
        """Return the characteristic root p [1/s] by Newton's method from ``near``; its real part is the growth rate.

        Raises:
            InputError: the iteration does not converge from ``near``.
        """
        top, bottom = np.array(self.deflection.numerator), np.array(self.deflection.denominator)
        sign = stiffness * (1.0 if self.away else -1.0)
        p = complex(near)
        for _ in range(100):
            back = self.overlap * np.exp(-p * period)
            value = np.polyval(bottom, p) + sign * np.polyval(top, p) * (1.0 - back)
            slope = np.polyval(np.polyder(bottom), p) + sign * (
                np.polyval(np.polyder(top), p) * (1.0 - back) + np.polyval(top, p) * period * back
            )
            change = complex(value / slope)
            p -= change
            if abs(change) <= 1e-13 * (abs(p) + 1.0 / period):
                return p
        raise InputError(f"regeneration: no characteristic root near {near:g} 1/s; start from the chatter frequency")


def lobes(cut: Regeneration, waves: int, frequencies: Array) -> tuple[Array, Array]:
    """Return one lobe of the stability chart: spindle speeds [rad/s] and K [N/m], shape (m,).

    Args:
        cut: regenerative cut.
        waves: number of whole waves around the part.
        frequencies: chatter frequencies [rad/s], shape (m,); frequencies without chatter are omitted from the result.
    """
    stiffness = cut.critical(frequencies)
    swings = np.isfinite(stiffness)
    frequency, stiffness = frequencies[swings], stiffness[swings]
    response = cut.deflection.response(frequency) * (1.0 if cut.away else -1.0)
    phase = -np.angle((1.0 + 1.0 / (stiffness * response)) / cut.overlap) % (2.0 * np.pi)
    return 2.0 * np.pi * frequency / (phase + 2.0 * np.pi * waves), stiffness
