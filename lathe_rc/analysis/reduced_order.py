# SPDX-License-Identifier: Apache-2.0
"""Reduced-order model of a channel from its step response, and its realisable inverse.

The module covers both stages of paper 004 (Figs 6-9):

    model      (b_m·p^m + … + b0)/((a_n·p^n + … + 1)·p^k), k = 0 or 1, by least squares of the step response
    inverse    (c_r·p^r + … )/Π(1 + p·τ_i), by nonlinear programming: the step response of model and inverse in series
               approximates a step in the mean square

A model is linear in its numerator, so only the denominator is searched. The denominator consists of factors of second
and first order with positive coefficients, which keeps the poles stable. The lags τ_i of the inverse have a lower
bound; without it, the optimum would be the exact inverse, which is not realisable.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import scipy

from lathe_rc.control.decoupler import LAG, inverse
from lathe_rc.errors import InputError, at_least
from lathe_rc.signals.table import read_table
from lathe_rc.transfer import Hold, LinearSystem, TransferFunction

Array = npt.NDArray[np.float64]

_SPREADS = (0.02, 0.1, 0.4)  # initial time constants of the searches, relative to the length of the record
_DAMPINGS = (0.2, 1.2)
_MOST = 60  # largest number of evaluations in one of several searches, of which the best counts
_LARGEST_LAG = 100.0  # largest lag of the inverse, relative to the least one


def refuse_unusable(what: str, time: Array, response: Array, least: int) -> None:
    """Check that a measured response is long enough and finite.

    Args:
        what: description of the response for error messages.
        time: time [s], shape (n,).
        response: response, shape (n,).
        least: smallest allowed n.

    Raises:
        InputError: the response is too short or not finite.
    """
    if time.size != response.size or time.size < least:
        raise InputError(f"{what}: {time.size} times, {response.size} values; allowed: {least} or more of each")
    if not (np.all(np.isfinite(time)) and np.all(np.isfinite(response))):
        raise InputError(f"{what}: not all numbers are finite; remove those that are not")


@dataclass(frozen=True)
class ChannelStep:
    """Measured response of a channel to a unit step at time 0.

    Args:
        time: uniformly spaced times starting at 0 [s], shape (n,), n at least 16.
        response: response in the unit of the channel, shape (n,).

    Raises:
        InputError: the arrays do not meet these conditions.
    """

    time: Array
    response: Array

    def __post_init__(self) -> None:
        time, response = self.time, self.response
        refuse_unusable("channel", time, response, 16)
        steps = np.diff(time)
        if time[0] != 0.0 or steps[0] <= 0.0 or np.abs(steps - steps[0]).max() > 1e-3 * steps[0]:
            raise InputError(
                f"channel: times from {time[0]:g} s in steps of {steps.min():g} to {steps.max():g} s; allowed: from 0, "
                "where the step is, in even steps (resample it)"
            )
        if not np.any(response):
            raise InputError("channel: the response is 0 throughout; allowed: one that answers the step")

    @property
    def step(self) -> float:
        """Sampling step of the response [s]."""
        return float(self.time[-1] / (self.time.size - 1))


def read_csv(path: Path) -> ChannelStep:
    """Read a step response from a CSV file.

    The columns are ``time_s``, the time since the step [s], and ``response``, divided by the height of the step.

    Raises:
        InputError: the file is missing or malformed, or does not contain a step response.
    """
    _, table = read_table(path, [("time_s", "response")], "step response")
    return ChannelStep(table[:, 0].copy(), table[:, 1].copy())


def _through(transfer: TransferFunction, step: float, signal: Array, hold: Hold) -> Array:
    output = np.empty(signal.size)
    LinearSystem(transfer, step, hold).block(signal, output)
    return output


def step_of(transfer: TransferFunction, time: Array) -> Array:
    """Compute the step response at ``time`` [s], uniformly spaced from 0, shape (n,)."""
    return _through(transfer, float(time[1] - time[0]), np.ones(time.size), "zoh")


@dataclass(frozen=True)
class Fit:
    """Fitted model or inverse, with its desired and actual output.

    Attributes:
        transfer: fitted transfer function.
        time: time [s], shape (n,).
        wanted: desired output, shape (n,).
        found: actual output, shape (n,).
    """

    transfer: TransferFunction
    time: Array
    wanted: Array
    found: Array

    @property
    def rms(self) -> float:
        """RMS of the difference between desired and actual output."""
        return float(np.sqrt(np.mean((self.found - self.wanted) ** 2)))


def _denominator(logarithms: Array, pairs: int) -> Array:
    """Compute the denominator in descending powers: ``pairs`` factors a·p² + b·p + 1, then factors b·p + 1."""
    values = np.exp(logarithms)
    whole = np.ones(1)
    for a, b in values[: 2 * pairs].reshape(-1, 2):
        whole = np.polymul(whole, np.array([a, b, 1.0]))
    for b in values[2 * pairs :]:
        whole = np.polymul(whole, np.array([b, 1.0]))
    return whole


def _starts(poles: int, pairs: int, span: float) -> list[Array]:
    """Return the logarithms of the denominator's coefficients at which the searches start."""
    starts = []
    for part in _SPREADS:
        # The factors start with different values; equal factors would stay equal.
        times = part * span / 2.0 ** np.arange(pairs)
        single = part * span / 3.0 ** np.arange(1, poles - 2 * pairs + 1)
        for damping in _DAMPINGS if pairs else (1.0,):
            both = np.stack((times**2, 2.0 * damping * times), axis=1).ravel()
            starts.append(np.log(np.append(both, single)))
    return starts


def fit(measured: ChannelStep, *, zeros: int, poles: int, integrator: bool = False, oscillating: bool = True) -> Fit:
    """Fit a model of chosen orders by least squares of the step response.

    Args:
        measured: step response of the channel.
        zeros: m, degree of the numerator.
        poles: n, number of poles without the integrator.
        integrator: whether the model has an integrator.
        oscillating: whether poles may be complex; otherwise the model is a product of lags, as in paper 004.

    Raises:
        InputError: a model of these orders would not be strictly proper.
    """
    if not (0 <= zeros < poles + integrator and 0 <= poles <= 8):
        raise InputError(
            f"reduced order: {zeros} zeros, {poles} poles, {'an' if integrator else 'no'} integrator; allowed: up to 8 "
            "poles, and fewer zeros than poles and integrator"
        )
    time, response = measured.time, measured.response
    scale = np.abs(response).max()
    pairs = poles // 2 if oscillating else 0

    def numerator(logarithms: Array) -> tuple[Array, Array, Array]:
        """Compute the best numerator for a denominator; return both in descending powers, and the step response."""
        bottom = np.append(_denominator(logarithms, pairs), np.zeros(int(integrator)))
        powers = [(1.0, *[0.0] * power) for power in range(zeros, -1, -1)]
        basis = np.stack([step_of(TransferFunction(power, tuple(bottom)), time) for power in powers], axis=1)
        size = np.abs(basis).max(axis=0)  # scaled, because columns differ by orders of magnitude
        top = np.linalg.lstsq(basis / size, response, rcond=None)[0] / size
        return top, bottom, basis @ top

    def residual(logarithms: Array) -> Array:
        return np.asarray((numerator(logarithms)[2] - response) / scale)

    best = np.empty(0)
    if poles:
        low, high = np.log(measured.step / 10.0), np.log(100.0 * time[-1])
        # Coefficients of p² are squared times.
        square = np.array([2.0, 1.0] * pairs + [1.0] * (poles - 2 * pairs))
        found = [
            scipy.optimize.least_squares(
                residual, start, bounds=(low * square, high * square), xtol=1e-10, ftol=1e-10, max_nfev=_MOST
            )
            for start in _starts(poles, pairs, float(time[-1]))
        ]
        best = min(found, key=lambda one: float(one.cost)).x
    top, bottom, output = numerator(best)
    return Fit(TransferFunction(tuple(top), tuple(bottom)), time, response, output)


def fit_inverse(model: TransferFunction, measured: ChannelStep, *, least_lag: float = LAG) -> Fit:
    """Fit the realisable inverse of a channel by nonlinear programming.

    The search starts from the inverse of the model with the smallest lags. Zeros, gain and lags of the inverse are
    optimised so that its response to the measured step response approximates a step.

    Args:
        model: model of the channel.
        measured: step response of the channel.
        least_lag: lower bound of the lags τ_i [s].

    Raises:
        InputError: the inverse of the model is unstable, or the record is coarser than the lags.
    """
    if measured.step > least_lag:
        raise InputError(
            f"inverse: response in steps of {measured.step:g} s, lags from {least_lag:g} s; "
            f"allowed: steps up to the least lag (--lag {at_least(measured.step)}, or a finer record)"
        )
    start = inverse(model, least_lag)
    missing = len(model.denominator) - len(model.numerator)
    fixed = model.numerator
    live = [place for place, value in enumerate(start.numerator) if value != 0.0]
    begin = np.array(start.numerator)
    wanted = np.ones(measured.time.size)

    def build(x: Array) -> TransferFunction:
        top = begin.copy()
        top[live] *= x[: len(live)]
        bottom = np.array(fixed)
        for lag in least_lag * np.exp(x[len(live) :]):
            bottom = np.polymul(bottom, (lag, 1.0))
        return TransferFunction(tuple(top), tuple(bottom))

    def output(x: Array) -> Array:
        return _through(build(x), measured.step, measured.response, "foh")

    def miss(x: Array) -> float:
        return float(np.mean((output(x) - wanted) ** 2))

    bounds = scipy.optimize.Bounds(
        np.append(np.full(len(live), 0.05), np.zeros(missing)),
        np.append(np.full(len(live), 20.0), np.full(missing, np.log(_LARGEST_LAG))),
    )
    first = np.append(np.ones(len(live)), np.full(missing, np.log(2.0)))
    best = scipy.optimize.minimize(miss, first, method="SLSQP", bounds=bounds, options={"maxiter": 200, "ftol": 1e-12})
    return Fit(build(best.x), measured.time, wanted, output(best.x))
