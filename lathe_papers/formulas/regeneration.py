# SPDX-License-Identifier: Apache-2.0
"""Stability of regenerative cutting: the edge meets what it left a revolution ago.

The force of a deviation of the chip is K·ap, and the deflection σ·G·F comes back at once and, µ of it, a revolution T
later with the other sign:

    1 + σ·K·G(p)·(1 - µ·e^{-pT}) = 0,  G = W3/(1 + p·lag)

At µ = 1 the largest K that is stable at every speed is Tlusty's -1/(2·min Re σG): 2k·ζ·(1 + ζ) for a spring-mass-damper
of stiffness k that is pushed away, 2k·ζ·(1 - ζ) for one that is drawn in (ζ < 0.5). Source: spec/feed-and-force.md, by
which it is about 24 N/mm for W3 of paper 004 as printed and 469 N/mm for the realistic one.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from lathe_rc.errors import InputError
from lathe_rc.transfer import TransferFunction

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

_POINTS = 20_000  # of a frequency grid
_SPAN = 30.0  # of the grid to either side of the outermost poles


@dataclass(frozen=True)
class Limit:
    """Where regenerative cutting becomes unstable.

    Attributes:
        stiffness: K, smallest force over depth of cut that is unstable [N/m]; inf if none is.
        frequency: of the chatter [rad/s]; 0 if the edge is drawn in without swinging.
        phase: by which the surface comes back late, ωT modulo a revolution of it [rad], from 0 to 2π.
    """

    stiffness: float
    frequency: float
    phase: float

    def period(self, waves: int) -> float:
        """Revolution time [s] at which there are ``waves`` whole waves and the phase around the part."""
        if self.frequency == 0.0:
            return np.inf
        return float((self.phase + 2.0 * np.pi * waves) / self.frequency)


@dataclass(frozen=True)
class Regeneration:
    """A cut whose edge meets its own surface.

    Attributes:
        deflection: G, deflection over the force that the chip asks for [m/N]: W3, times the lag of the force.
        away: the force pushes the edge away from the part (σ = 1); False draws it in (σ = -1).
        overlap: µ.

    Raises:
        InputError: an overlap that is none, or a deflection that is no stable one.
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
        """σ·G."""
        return self.deflection.response(frequency) * (1.0 if self.away else -1.0)

    def _grid(self) -> Array:
        """Frequencies [rad/s] that leave out no resonance: even in their logarithm, and close around each mode."""
        poles = self.deflection.poles
        sizes = np.abs(poles)
        grids = [np.geomspace(sizes.min() / _SPAN, sizes.max() * _SPAN, _POINTS)]
        # The response of a mode is a function of the arctangent of the distance from it in half-widths.
        angles = np.linspace(-1.5, 1.5, 2001)
        grids += [abs(pole.imag) + abs(pole.real) * np.tan(angles) for pole in poles if pole.imag > 0.0]
        together = np.unique(np.concatenate(grids))
        return together[together > 0.0]

    def critical(self, frequency: npt.ArrayLike) -> Array:
        """Smallest K [N/m] that swings at ``frequency`` [rad/s] at some speed; inf where none does."""
        g = self._signed(frequency)
        # |1/K + G| = µ·|G|: the surface may come back at any phase.
        inside = g.real**2 - (1.0 - self.overlap**2) * np.abs(g) ** 2
        inverse = -g.real + np.sqrt(np.maximum(inside, 0.0))
        with np.errstate(divide="ignore"):
            return np.where((inside >= 0.0) & (inverse > 0.0), 1.0 / inverse, np.inf)

    def worst(self) -> Limit:
        """The limit at the worst of all speeds: below it every speed is stable."""
        grid = np.append(0.0, self._grid())  # 0: ever slower, at a spindle that nearly stands
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
        """The limit at one speed, by the Nyquist criterion; ``period`` of a revolution in s."""
        if not period > 0.0:
            raise InputError(f"regeneration: revolution of {period:g} s; allowed: above 0")

        def loop(frequency: npt.ArrayLike) -> Complex:
            w = np.asarray(frequency, dtype=np.float64)
            return np.asarray(-self._signed(w) * (1.0 - self.overlap * np.exp(-1j * w * period)))

        grid = self._grid()
        # Even steps as well: e^{-jωT} turns by π/32 at most in each, so that no crossing is stepped over.
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
        """The characteristic root p [1/s] that Newton's method finds from ``near``; its real part is the growth.

        Raises:
            InputError: it finds none from there.
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
    """One lobe of the stability chart: spindle speeds [rad/s] and K [N/m], shape (m,).

    Args:
        cut: the cut.
        waves: whole waves around the part.
        frequencies: of the chatter [rad/s], shape (m,); those at which nothing swings are left out.
    """
    stiffness = cut.critical(frequencies)
    swings = np.isfinite(stiffness)
    frequency, stiffness = frequencies[swings], stiffness[swings]
    response = cut.deflection.response(frequency) * (1.0 if cut.away else -1.0)
    phase = -np.angle((1.0 + 1.0 / (stiffness * response)) / cut.overlap) % (2.0 * np.pi)
    return 2.0 * np.pi * frequency / (phase + 2.0 * np.pi * waves), stiffness
