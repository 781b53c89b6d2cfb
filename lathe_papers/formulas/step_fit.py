# SPDX-License-Identifier: Apache-2.0
"""Models of a drive fitted to its measured step response (paper 000, Fig. 4, eqs 18 and 19).

    first order                1/(1 + p·T0)                               (18)
    delay                      e^{-p·T0}                                  (19)
    second order               1/(1 + 2ζp/ωn + p²/ωn²)                    recommended by the paper as the next step
    second order with delay    e^{-pτ}/(1 + 2ζp/ωn + p²/ωn²)

All have Wi(0) = 1, as in the paper. A fit minimises the mean square of the residual over time.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
import scipy

from lathe_commission.reduced_order import refuse_unusable
from lathe_papers.formulas.responses import second_order
from lathe_rc.arrays import Array, Complex
from lathe_rc.errors import InputError
from lathe_rc.signals import measurement_file


@dataclass(frozen=True)
class StepResponse:
    """Measured response to a unit step at time 0.

    Args:
        time: increasing times [s], shape (n,) with n >= 8.
        response: response relative to the step [1], shape (n,); ends near 1.

    Raises:
        InputError: the data violate these conditions.
    """

    time: Array
    response: Array

    def __post_init__(self) -> None:
        time, response = self.time, self.response
        refuse_unusable("step response", time, response, 8)
        falling = np.flatnonzero(np.diff(time) <= 0.0)
        if falling.size:
            a, b = time[falling[0]], time[falling[0] + 1]
            raise InputError(f"step response: time {a:g} s is followed by {b:g} s; allowed: increasing times")
        if time[-1] <= 0.0 or abs(time[0]) > 0.1 * time[-1]:
            raise InputError(
                f"step response: from {time[0]:g} to {time[-1]:g} s; allowed: from near 0, where the step is, to "
                "where the drive has settled"
            )
        if not 0.8 <= response[-1] <= 1.2:
            raise InputError(
                f"step response: ends at {response[-1]:g}; allowed: near 1 (divide by the height of the step, and "
                "record until the drive has settled)"
            )

    def residual(self, model: "Model") -> Array:
        """Return the residual of the model, weighted so that its sum of squares is the mean square over time."""
        between = np.diff(self.time)
        # Trapezoidal weights; otherwise densely sampled parts of the response would count more.
        weight = (np.append(between, 0.0) + np.append(0.0, between)) / 2.0
        return np.asarray((model.step(self.time) - self.response) * np.sqrt(weight / weight.sum()))

    def rms(self, model: "Model") -> float:
        """Return the RMS over time of the residual of the model [1]."""
        return float(np.sqrt(np.sum(self.residual(model) ** 2)))


class Model(Protocol):
    """Model of a drive with Wi(0) = 1."""

    def step(self, time: Array) -> Array:
        """Return the response to a unit step at time 0; ``time`` in s, shape (n,)."""

    def response(self, frequency: Array) -> Complex:
        """Return the frequency response Wi(jω); ``frequency`` in rad/s, shape (n,)."""


@dataclass(frozen=True)
class FirstOrder:
    """First-order model 1/(1 + p·T0) (paper 000, eq. 18); ``time_constant`` T0 in s."""

    time_constant: float

    def step(self, time: Array) -> Array:
        """Return the response to a unit step at time 0, shape (n,)."""
        return -np.expm1(-np.maximum(time, 0.0) / self.time_constant)

    def response(self, frequency: Array) -> Complex:
        """Return the frequency response Wi(jω), shape (n,)."""
        return np.asarray(1.0 / (1.0 + 1j * frequency * self.time_constant))


@dataclass(frozen=True)
class Delay:
    """Delay model e^{-p·T0} (paper 000, eq. 19); ``delay`` T0 in s."""

    delay: float

    def step(self, time: Array) -> Array:
        """Return the response to a unit step at time 0, shape (n,)."""
        return np.where(time >= self.delay, 1.0, 0.0)

    def response(self, frequency: Array) -> Complex:
        """Return the frequency response Wi(jω), shape (n,)."""
        return np.asarray(np.exp(-1j * frequency * self.delay))


@dataclass(frozen=True)
class SecondOrder:
    """Second-order model with delay e^{-pτ}/(1 + 2ζp/ωn + p²/ωn²); ωn in rad/s, τ in s."""

    natural_frequency: float
    damping: float
    delay: float = 0.0

    def step(self, time: Array) -> Array:
        """Return the response to a unit step at time 0, shape (n,), for any damping."""
        t = np.maximum(time - self.delay, 0.0) * self.natural_frequency
        # Poles -ζ ± d in units of ωn. At d = 0 the quotient below is 0/0; a d this small changes nothing.
        d = np.sqrt(complex(self.damping**2 - 1.0))
        if abs(d) < 1e-6:
            d = 1e-6 + 0.0j
        slow, fast = np.exp((d - self.damping) * t), np.exp((-d - self.damping) * t)
        return np.asarray(1.0 - ((slow + fast) / 2.0 + self.damping * (slow - fast) / (2.0 * d)).real)

    def response(self, frequency: Array) -> Complex:
        """Return the frequency response Wi(jω), shape (n,)."""
        return second_order(frequency, self.natural_frequency, self.damping, self.delay)


M = TypeVar("M", bound=Model)


def _best(measured: StepResponse, build: Callable[[Array], M], low: Array, high: Array, starts: Iterable[Array]) -> M:
    """Return the best bounded least-squares fit of ``build(x)`` from several starting points, shape (k,) each."""

    def residual(x: Array) -> Array:
        return measured.residual(build(x))

    found = [
        scipy.optimize.least_squares(residual, np.clip(start, low, high), bounds=(low, high), xtol=1e-12, ftol=1e-12)
        for start in starts
    ]
    return build(min(found, key=lambda fit: float(fit.cost)).x)


def _half(measured: StepResponse) -> Array:
    """Return the times [s], at least one, at which the linearly interpolated response rises through 1/2."""
    time, rest = np.append(0.0, measured.time), np.append(-0.5, measured.response - 0.5)
    at = np.flatnonzero((rest[:-1] < 0.0) & (rest[1:] >= 0.0))
    return np.asarray(time[at] - rest[at] * (time[at + 1] - time[at]) / (rest[at + 1] - rest[at]))


def fit_delay(measured: StepResponse) -> Delay:
    """Fit the delay model of eq. 19 by least squares.

    The derivative of the mean square with respect to T0 is 2h(T0) - 1, so its minimum lies where the response rises
    through 1/2.
    """
    return min((Delay(float(time)) for time in _half(measured)), key=measured.rms)


def fit_first_order(measured: StepResponse) -> FirstOrder:
    """Fit the first-order model of eq. 18 by least squares."""
    end, nearest = measured.time[-1], np.diff(measured.time).min()
    return _best(
        measured,
        lambda x: FirstOrder(float(np.exp(x[0]))),  # the logarithm keeps T0 positive at any scale
        np.log([nearest / 100.0]),
        np.log([end * 10.0]),
        [np.log([max(_half(measured)[0], nearest)])],
    )


def fit_second_order(measured: StepResponse, *, delayed: bool) -> SecondOrder:
    """Fit the second-order model by least squares, with or without a delay."""
    end, nearest = measured.time[-1], np.diff(measured.time).min()
    half = max(float(_half(measured)[0]), nearest)

    def build(x: Array) -> SecondOrder:
        return SecondOrder(float(np.exp(x[0])), float(np.exp(x[1])), float(x[2]) * half if delayed else 0.0)

    size = 3 if delayed else 2
    low = np.array([np.log(0.1 / end), np.log(0.01), 0.0])[:size]
    high = np.array([np.log(100.0 / nearest), np.log(100.0), end / half])[:size]
    # Several starts, because ωn and τ can compensate for each other and the fit has local minima.
    # Half of the step is reached at about (1 + 0.7ζ)/ωn after the delay.
    starts = [
        np.array([np.log((1.0 + 0.7 * damping) / (half * (1.0 - part))), np.log(damping), part])[:size]
        for damping in (0.3, 1.0, 3.0)
        for part in ((0.0, 0.3, 0.7) if delayed else (0.0,))
    ]
    return _best(measured, build, low, high, starts)


def read_csv(path: Path) -> StepResponse:
    """Read a step response from a file (see `lathe_rc.signals.measurement_file`).

    The quantities are ``time`` since the step and ``response`` relative to the step.

    Raises:
        InputError: the file is missing or malformed, or does not contain a step response.
    """
    values = measurement_file.read(path).read("time", "response")
    try:
        return StepResponse(*values)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
