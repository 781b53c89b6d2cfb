# SPDX-License-Identifier: Apache-2.0
"""Corrective link of a sampled position servo (paper 003).

The drive K/(p·(T1·p + 1)) behind a zero-order hold of period T is from sample to sample

    W(z) = (b1·z + b0)/((z - 1)·(z - d)),
    d = e^{-T/T1},  b1 = K·(T - T1 + T1·d),  b0 = K·(T1·(1 - d) - d·T)

and the link D(z) stands before the hold and works on the error. Laws:

    paper         D = K·T·(z - d)/(b1·z + b0)
    ripple_free   D = 1/(b1 + b0)·(z - d)/(z + b0/(b1 + b0))

The paper's makes D·W the desired function K·(1 - T/2·jλ)/jλ, which is K·T/(z - 1). It settles in one period if
K·T = 1, but at the samples only: it cancels the zero -b0/b1, so that the command alternates for many periods and the
drive swings between the samples. The ripple-free link leaves the zero alone. Its command for a step is 1/(b1 + b0),
-d/(b1 + b0), 0, 0, …: the drive speeds up for one period, slows down to a stop in the next, and never turns back.

A measurement that comes late by τ ≤ T makes the drive B(z)/(z·(z - 1)·(z - d)) with

    B = b1·z + b0 + K·T1·(1 - e)·(1 - d)·(z - 1) + K·(T - τ - T1·(1 - e))·(z - 1)·(z - d),  e = e^{-(T-τ)/T1}

for which the link D = z·(z - 1)·(z - d)/(B(1)·z³ - B) gives the same command for a step; it is the one above if τ = 0.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.errors import InputError
from lathe_rc.jit import kernel

Array = npt.NDArray[np.float64]
Law = Literal["paper", "ripple_free"]

_DIGITS = 9  # of the magnitude of a pole that are told from 1


@dataclass(frozen=True)
class SampledDrive:
    """K/(p·(T1·p + 1)) behind a zero-order hold (paper 003, eqs 1 and 2).

    Attributes:
        gain: K [1/s].
        lag: T1 [s].
        period: T [s].

    Raises:
        InputError: one of them is not positive and finite.
    """

    gain: float
    lag: float
    period: float

    def __post_init__(self) -> None:
        for name, value, unit in (("K", self.gain, "1/s"), ("T1", self.lag, "s"), ("T", self.period, "s")):
            if not 0.0 < value < np.inf:
                raise InputError(f"sampled drive: {name} = {value:g} {unit}; allowed: above 0")

    @property
    def d(self) -> float:
        """e^{-T/T1}."""
        return float(np.exp(-self.period / self.lag))

    @property
    def b1(self) -> float:
        """Coefficient of z."""
        return float(self.gain * (self.period + self.lag * np.expm1(-self.period / self.lag)))

    @property
    def b0(self) -> float:
        """Coefficient of 1."""
        return float(self.gain * (-self.lag * np.expm1(-self.period / self.lag) - self.d * self.period))

    @property
    def numerator(self) -> Array:
        """Of W(z), falling powers of z."""
        return np.array([self.b1, self.b0])

    @property
    def denominator(self) -> Array:
        """Of W(z), falling powers of z."""
        return np.array([1.0, -1.0 - self.d, self.d])

    def late(self, delay: float) -> Array:
        """B(z), shape (3,), for a measurement that comes ``delay`` [s] late; without a delay it is z·(b1·z + b0).

        Raises:
            InputError: it comes later than a period.
        """
        if not 0.0 <= delay <= self.period:
            raise InputError(f"sampled link: delay = {delay:g} s; allowed: from 0 to the period, {self.period:g} s")
        rest = self.period - delay
        travel = -self.lag * np.expm1(-rest / self.lag)  # T1·(1 - e)
        whole = np.polyadd(self.numerator, self.gain * travel * (1.0 - self.d) * np.array([1.0, -1.0]))
        return np.asarray(np.polyadd(whole, self.gain * (rest - travel) * self.denominator))


@dataclass(frozen=True)
class Link:
    """D(z), command over error.

    Attributes:
        numerator, denominator: falling powers of z, of the same length; the first of the denominator is 1.
    """

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]


NONE = Link((1.0,), (1.0,))  #: the uncorrected loop


def _link(numerator: npt.ArrayLike, denominator: npt.ArrayLike) -> Link:
    top, bottom = np.atleast_1d(numerator), np.atleast_1d(denominator)
    return Link(tuple((top / bottom[0]).tolist()), tuple((bottom / bottom[0]).tolist()))


def towards(drive: SampledDrive, ratio: float) -> Link:
    """Link that makes D·W the desired function with Te = ratio·T/2 (paper 003, eqs 5 and 6).

    Wd = K·(1 - jλ·T/2)·(1 + jλ·Te)/(jλ·(1 + jλ·T/2)) = (K·T/2)·((1 + ratio)·z + 1 - ratio)/(z·(z - 1))
    """
    top = drive.gain * drive.period / 2.0 * np.array([1.0 + ratio, 1.0 - ratio])
    return _link(np.polymul(top, [1.0, -drive.d]), np.append(drive.numerator, 0.0))


def paper(drive: SampledDrive) -> Link:
    """The paper's link, which is `towards` 1."""
    return _link(drive.gain * drive.period * np.array([1.0, -drive.d]), drive.numerator)


def ripple_free(drive: SampledDrive, delay: float = 0.0) -> Link:
    """Link whose command for a step ends with the second period.

    Args:
        drive: what it is for.
        delay: by which the measurement comes late [s].

    Raises:
        InputError: it comes later than a period.
    """
    whole = drive.b1 + drive.b0
    if delay == 0.0:
        return _link([1.0 / whole, -drive.d / whole], [1.0, drive.b0 / whole])
    b = drive.late(delay)
    # (B(1)·z³ - B)/(z - 1): each coefficient is the sum of those down to it.
    return _link([1.0, -drive.d, 0.0], np.cumsum(np.append(whole, -b))[:3])


def design(law: Law, drive: SampledDrive, delay: float = 0.0) -> Link:
    """Link of a law, by `paper` or `ripple_free`; the paper's makes no allowance for a delay [s]."""
    return paper(drive) if law == "paper" else ripple_free(drive, delay)


def closed_loop(drive: SampledDrive, link: Link, delay: float = 0.0) -> Array:
    """Characteristic polynomial of the closed loop, falling powers of z; nothing is cancelled.

    Args:
        drive: of the loop.
        link: before the drive.
        delay: by which the measurement comes late [s].

    Raises:
        InputError: it comes later than a period.
    """
    top, bottom = drive.numerator, drive.denominator
    if delay > 0.0:
        top, bottom = drive.late(delay), np.append(bottom, 0.0)
    return np.asarray(np.polyadd(np.polymul(link.denominator, bottom), np.polymul(link.numerator, top)))


def largest_pole(drive: SampledDrive, link: Link, delay: float = 0.0) -> float:
    """Largest magnitude of the poles of the closed loop, 1 if it is that but for rounding; see `closed_loop`."""
    return round(float(np.abs(np.roots(closed_loop(drive, link, delay))).max()), _DIGITS)


class LinkTable(NamedTuple):
    """Constants of a link for kernels.

    Attributes:
        errors: weights of the error and of those before it, shape (m + 1,).
        commands: weights of the commands before, shape (m,).
        limit: the command is cut off at ± this.
    """

    errors: Array
    commands: Array
    limit: float


def table(link: Link, limit: float = np.inf) -> LinkTable:
    """Constants of ``link`` for `correct`."""
    return LinkTable(np.array(link.numerator), np.array(link.denominator[1:]), float(limit))


def rest(link: Link) -> Array:
    """The state for `correct` of a link that has rested at 0: past errors, then past commands."""
    return np.zeros(2 * len(link.denominator) - 2)


@kernel
def correct(link: LinkTable, state: Array, error: float) -> tuple[float, bool]:
    """Command of one more period, and whether it was cut off.

    The link remembers the command that it gave, not the one that it would have liked to give.
    """
    order = link.commands.size
    wanted = link.errors[0] * error
    for i in range(order):
        wanted += link.errors[i + 1] * state[i] - link.commands[i] * state[order + i]
    command = min(max(wanted, -link.limit), link.limit)
    for i in range(order - 1, 0, -1):
        state[i], state[order + i] = state[i - 1], state[order + i - 1]
    if order > 0:
        state[0], state[order] = error, command
    return command, command != wanted


class HeldLink(NamedTuple):
    """A `SampledLink` for kernels.

    Attributes:
        link: its constants.
        state: for `correct`.
        divisor: samples in a period.
        held: the command, and how many were cut off so far.
    """

    link: LinkTable
    state: Array
    divisor: int
    held: Array


@kernel
def correct_along(link: HeldLink, first: int, set_point: Array, measurement: Array, command: Array) -> None:
    """`correct` for a block that begins at sample ``first``, shape (n,)."""
    held = link.held
    for k in range(command.size):
        if (first + k) % link.divisor == 0:
            held[0], cut = correct(link.link, link.state, set_point[k] - measurement[k])
            held[1] += cut
        command[k] = held[0]


class SampledLink:
    """The link as a controller: set point and measurement in, held command out.

    It computes at samples that are multiples of the divisor, which make the period T.

    Args:
        law: ``paper`` or ``ripple_free``.
        gain: K of the drive [1/s].
        lag: T1 of the drive [s].
        step: sampling step [s].
        divisor: samples in a period.
        delay: by which the measurement comes late [s]; the ripple-free link allows for it.
        limit: the command is cut off at ± this, in the unit of the position.

    Attributes:
        drive: what the link is for.
        link: its coefficients.
        table: for `correct_along`.

    Raises:
        InputError: a value that is out of range, or a loop that would be unstable.
    """

    def __init__(
        self,
        law: Law,
        *,
        gain: float,
        lag: float,
        step: float,
        divisor: int,
        delay: float = 0.0,
        limit: float = np.inf,
    ) -> None:
        if divisor < 1:
            raise InputError(f"sampled link: divisor = {divisor}; allowed: from 1")
        if not limit > 0.0:
            raise InputError(f"sampled link: limit = {limit:g}; allowed: above 0")
        self.drive = SampledDrive(gain, lag, divisor * step)
        self.link = design(law, self.drive, delay)
        largest = largest_pole(self.drive, self.link, delay)
        if largest >= 1.0:
            raise InputError(
                f"sampled link: {law} with K = {gain:g} 1/s, T1 = {lag:g} s, T = {self.drive.period:g} s is "
                f"unstable (pole at {largest:.4g}); allowed: K·T below 2, or ripple_free"
            )
        self.table = HeldLink(table(self.link, limit), rest(self.link), divisor, np.zeros(2))

    @property
    def saturated(self) -> int:
        """Commands so far that were cut off."""
        return int(self.table.held[1])

    def block(self, first: int, set_point: Array, measurement: Array, command: Array) -> None:
        """Step from sample ``first`` on; at rest at 0 before sample 0.

        Args:
            first: index of the first sample.
            set_point: shape (n,).
            measurement: position, in the same unit, shape (n,).
            command: filled, in the same unit, shape (n,).
        """
        correct_along(self.table, first, set_point, measurement, command)
