# SPDX-License-Identifier: Apache-2.0
"""Corrective link of a sampled position servo (paper 003).

From sample to sample, the drive K/(p·(T1·p + 1)) behind a zero-order hold of period T is

    W(z) = (b1·z + b0)/((z - 1)·(z - d)),
    d = e^{-T/T1},  b1 = K·(T - T1 + T1·d),  b0 = K·(T1·(1 - d) - d·T)

and the link D(z), placed before the hold, filters the error. The laws are

    paper         D = K·T·(z - d)/(b1·z + b0)
    ripple_free   D = 1/(b1 + b0)·(z - d)/(z + b0/(b1 + b0))

The paper's link makes D·W equal to the desired function K·(1 - T/2·jλ)/jλ, which is K·T/(z - 1). The loop settles in
one period if K·T = 1, but only at the samples: because the link cancels the zero -b0/b1, the command alternates for
many periods and the drive oscillates between the samples. The ripple-free link does not cancel the zero. Its command
for a step is 1/(b1 + b0), -d/(b1 + b0), 0, 0, …: the drive accelerates for one period, decelerates to a stop in the
next, and never reverses.

With a measurement delayed by τ ≤ T, the drive is B(z)/(z·(z - 1)·(z - d)) with

    B = b1·z + b0 + K·T1·(1 - e)·(1 - d)·(z - 1) + K·(T - τ - T1·(1 - e))·(z - 1)·(z - d),  e = e^{-(T-τ)/T1}

for which the link D = z·(z - 1)·(z - d)/(B(1)·z³ - B) gives the same command for a step; for τ = 0 it equals the
ripple-free link above.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel

Law = Literal["paper", "ripple_free"]

_DIGITS = 9  # decimals by which a pole magnitude is distinguished from 1


@dataclass(frozen=True)
class SampledDrive:
    """Drive K/(p·(T1·p + 1)) behind a zero-order hold (paper 003, eqs 1 and 2).

    Attributes:
        gain: K [1/s].
        lag: T1 [s].
        period: T [s].

    Raises:
        InputError: a parameter is not positive and finite.
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
        """Discrete pole d = e^{-T/T1} of the lag."""
        return float(np.exp(-self.period / self.lag))

    @property
    def b1(self) -> float:
        """Coefficient b1 of z in the numerator of W(z)."""
        return float(self.gain * (self.period + self.lag * np.expm1(-self.period / self.lag)))

    @property
    def b0(self) -> float:
        """Constant coefficient b0 in the numerator of W(z)."""
        return float(self.gain * (-self.lag * np.expm1(-self.period / self.lag) - self.d * self.period))

    @property
    def numerator(self) -> Array:
        """Numerator of W(z), in descending powers of z, shape (2,)."""
        return np.array([self.b1, self.b0])

    @property
    def denominator(self) -> Array:
        """Denominator of W(z), in descending powers of z, shape (3,)."""
        return np.array([1.0, -1.0 - self.d, self.d])

    def late(self, delay: float) -> Array:
        """Compute the numerator B(z) for a measurement delay [s], shape (3,); z·(b1·z + b0) without a delay.

        Raises:
            InputError: the delay is negative or exceeds a period.
        """
        if not 0.0 <= delay <= self.period:
            raise InputError(f"sampled link: delay = {delay:g} s; allowed: from 0 to the period, {self.period:g} s")
        rest = self.period - delay
        travel = -self.lag * np.expm1(-rest / self.lag)  # T1·(1 - e)
        whole = np.polyadd(self.numerator, self.gain * travel * (1.0 - self.d) * np.array([1.0, -1.0]))
        return np.asarray(np.polyadd(whole, self.gain * (rest - travel) * self.denominator))


@dataclass(frozen=True)
class Link:
    """Corrective link D(z), the transfer function from error to command.

    Attributes:
        numerator, denominator: coefficients in descending powers of z, equally many; the denominator's first is 1.
    """

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]


NONE = Link((1.0,), (1.0,))  #: no correction


def _link(numerator: npt.ArrayLike, denominator: npt.ArrayLike) -> Link:
    top, bottom = np.atleast_1d(numerator), np.atleast_1d(denominator)
    return Link(tuple((top / bottom[0]).tolist()), tuple((bottom / bottom[0]).tolist()))


def towards(drive: SampledDrive, ratio: float) -> Link:
    """Return the link that makes D·W equal to the desired function with Te = ratio·T/2 (paper 003, eqs 5 and 6).

    Wd = K·(1 - jλ·T/2)·(1 + jλ·Te)/(jλ·(1 + jλ·T/2)) = (K·T/2)·((1 + ratio)·z + 1 - ratio)/(z·(z - 1))
    """
    top = drive.gain * drive.period / 2.0 * np.array([1.0 + ratio, 1.0 - ratio])
    return _link(np.polymul(top, [1.0, -drive.d]), np.append(drive.numerator, 0.0))


def paper(drive: SampledDrive) -> Link:
    """Return the corrective link of paper 003, equal to `towards` with ratio 1."""
    return _link(drive.gain * drive.period * np.array([1.0, -drive.d]), drive.numerator)


def ripple_free(drive: SampledDrive, delay: float = 0.0) -> Link:
    """Return the link whose command for a step is 0 after the second period.

    Args:
        drive: drive that the link corrects.
        delay: delay of the measurement [s].

    Raises:
        InputError: the delay is negative or exceeds a period.
    """
    whole = drive.b1 + drive.b0
    if delay == 0.0:
        return _link([1.0 / whole, -drive.d / whole], [1.0, drive.b0 / whole])
    b = drive.late(delay)
    # (B(1)·z³ - B)/(z - 1): each coefficient is the cumulative sum of the dividend's coefficients.
    return _link([1.0, -drive.d, 0.0], np.cumsum(np.append(whole, -b))[:3])


def design(law: Law, drive: SampledDrive, delay: float = 0.0) -> Link:
    """Design the link of a law with `paper` or `ripple_free`; only the latter accounts for the delay [s]."""
    return paper(drive) if law == "paper" else ripple_free(drive, delay)


def closed_loop(drive: SampledDrive, link: Link, delay: float = 0.0) -> Array:
    """Return the closed loop's characteristic polynomial in descending powers of z, without pole-zero cancellation.

    Args:
        drive: drive of the loop.
        link: corrective link before the drive.
        delay: delay of the measurement [s].

    Raises:
        InputError: the delay is negative or exceeds a period.
    """
    top, bottom = drive.numerator, drive.denominator
    if delay > 0.0:
        top, bottom = drive.late(delay), np.append(bottom, 0.0)
    return np.asarray(np.polyadd(np.polymul(link.denominator, bottom), np.polymul(link.numerator, top)))


def largest_pole(drive: SampledDrive, link: Link, delay: float = 0.0) -> float:
    """Return the largest pole magnitude of the closed loop, rounded to 9 decimals; arguments as for `closed_loop`."""
    return round(float(np.abs(np.roots(closed_loop(drive, link, delay))).max()), _DIGITS)


class LinkTable(NamedTuple):
    """Constants of a link for kernels.

    Attributes:
        errors: weights of the current and the previous errors, shape (m + 1,).
        commands: weights of the previous commands, shape (m,).
        limit: limit of the command's magnitude.
    """

    errors: Array
    commands: Array
    limit: float


def table(link: Link, limit: float = np.inf) -> LinkTable:
    """Return the constants of ``link`` for `correct`."""
    return LinkTable(np.array(link.numerator), np.array(link.denominator[1:]), float(limit))


def rest(link: Link) -> Array:
    """Return the zero initial state of a link for `correct`: past errors, then past commands."""
    return np.zeros(2 * len(link.denominator) - 2)


@kernel
def correct(link: LinkTable, state: Array, error: float) -> tuple[float, bool]:
    """Compute the command of the next period; return it, and whether it was limited.

    The state stores the limited command, not the unlimited one.
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
    """Constants and state of a `SampledLink` for kernels.

    Attributes:
        link: constants of the link.
        state: past errors and commands for `correct`.
        divisor: number of samples in a period.
        held: the held command, and the number of limited commands so far.
    """

    link: LinkTable
    state: Array
    divisor: int
    held: Array


@kernel
def correct_along(link: HeldLink, first: int, set_point: Array, measurement: Array, command: Array) -> None:
    """Compute the held commands of a block that begins at sample ``first`` with `correct`, shape (n,)."""
    held = link.held
    for k in range(command.size):
        if (first + k) % link.divisor == 0:
            held[0], cut = correct(link.link, link.state, set_point[k] - measurement[k])
            held[1] += cut
        command[k] = held[0]


class SampledLink:
    """Controller that computes a held command from set point and measurement by a sampled link.

    A command is computed at every sample that is a multiple of ``divisor``; this interval is the period T.

    Args:
        law: ``paper`` or ``ripple_free``.
        gain: K of the drive [1/s].
        lag: T1 of the drive [s].
        step: sampling step [s].
        divisor: number of samples in a period.
        delay: delay of the measurement [s]; only the ripple-free link accounts for it.
        limit: limit of the command's magnitude, in the unit of the position.

    Attributes:
        drive: drive that the link corrects.
        link: coefficients of the link.
        table: constants and state for `correct_along`.

    Raises:
        InputError: a value is out of range, or the closed loop would be unstable.
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
        """Number of limited commands so far."""
        return int(self.table.held[1])

    def block(self, first: int, set_point: Array, measurement: Array, command: Array) -> None:
        """Compute the commands of a block starting at sample ``first``; the link is at rest at 0 before sample 0.

        Args:
            first: index of the first sample.
            set_point: set point, shape (n,).
            measurement: position, in the same unit, shape (n,).
            command: output, in the same unit, shape (n,).
        """
        correct_along(self.table, first, set_point, measurement, command)
