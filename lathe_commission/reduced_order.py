# SPDX-License-Identifier: Apache-2.0
"""Reduced-order model of a channel from its step or frequency response, and its realisable inverse.

The module covers both stages of paper 004 (Figs 6-9):

    model      (b_m·p^m + … + b0)/((a_n·p^n + … + 1)·p^k), k = 0 or 1, by least squares of the step response
    inverse    (c_r·p^r + … )/Π(1 + p·τ_i), by nonlinear programming: the step response of model and inverse in series
               approximates a step in the mean square

A model is linear in its numerator, so only the denominator is searched, and with it a delay e^{-pτ} if asked for. The
denominator consists of factors of second and first order with positive coefficients, which keeps the poles stable. The
relative error of a frequency response is minimised, weighted by its uncertainty. The lags τ_i of the inverse have a
lower bound; without it, the optimum would be the exact inverse, which is not realisable.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from lathe_machine.control.decoupler import LAG, inverse
from lathe_machine.transfer import Hold, LinearSystem, TransferFunction
from lathe_rc.analysis.frequency_response import FrequencyResponse
from lathe_rc.arrays import Array, Complex
from lathe_rc.errors import InputError, at_least
from lathe_rc.signals.measurement_file import MeasuredQuantities

_SPREADS = (0.02, 0.1, 0.4)  # initial time constants of the searches, relative to the length of the record
_DAMPINGS = (0.2, 1.2)
_POINTS = 2000  # of the step response of a model from a frequency response
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


def of_measurement(measurement: MeasuredQuantities) -> ChannelStep:
    """Return the step response in a measurement: ``time`` since the step, and ``response`` to a step of 1.

    Raises:
        InputError: a quantity is missing, or the response is unusable.
    """
    if "time" not in measurement or "response" not in measurement:
        raise measurement.lacking("time and response, or frequency with magnitude and phase")
    try:
        return ChannelStep(*measurement.read("time", "response"))
    except InputError as error:
        raise InputError(f"{measurement.name}: {error}") from None


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
        delay: delay behind the transfer function [s].
    """

    transfer: TransferFunction
    time: Array
    wanted: Array
    found: Array
    delay: float = 0.0

    @property
    def rms(self) -> float:
        """RMS of the difference between desired and actual output."""
        return float(np.sqrt(np.mean((self.found - self.wanted) ** 2)))


def _denominator(logarithms: Array, pairs: int, integrators: int) -> Array:
    """Compute a denominator in descending powers: ``pairs`` factors a·p² + b·p + 1, then factors b·p + 1, then p."""
    values = np.exp(logarithms)
    whole = np.ones(1)
    for a, b in values[: 2 * pairs].reshape(-1, 2):
        whole = np.polymul(whole, np.array([a, b, 1.0]))
    for b in values[2 * pairs :]:
        whole = np.polymul(whole, np.array([b, 1.0]))
    return np.append(whole, np.zeros(integrators))


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


@dataclass(frozen=True)
class ResponseFit:
    """Model fitted to a frequency response.

    Attributes:
        transfer: fitted transfer function.
        frequency: frequencies [rad/s], shape (n,).
        wanted: measured response, shape (n,).
        found: response of the model with its delay, shape (n,).
        delay: delay behind the transfer function [s].
    """

    transfer: TransferFunction
    frequency: Array
    wanted: Complex
    found: Complex
    delay: float

    @property
    def rms(self) -> float:
        """RMS of the difference between measurement and model, relative to the measurement [1]."""
        return float(np.sqrt(np.mean(np.abs((self.found - self.wanted) / self.wanted) ** 2)))

    def step(self) -> ChannelStep:
        """Return the step response of the model without its delay, over five times its slowest time constant."""
        poles = np.abs(self.transfer.poles.real)
        slowest = 5.0 / float(poles[poles > 0.0].min()) if np.any(poles > 0.0) else 2.0 * np.pi / self.frequency[0]
        time = np.linspace(0.0, slowest, _POINTS)
        return ChannelStep(time, step_of(self.transfer, time))


def _check_orders(zeros: int, poles: int, *, integrator: bool) -> None:
    if not (0 <= zeros < poles + integrator and 0 <= poles <= 8):
        raise InputError(
            f"reduced order: {zeros} zeros, {poles} poles, {'an' if integrator else 'no'} integrator; allowed: up to 8 "
            "poles, and fewer zeros than poles and integrator"
        )


def _search(
    residual: Callable[[Array], Array],
    poles: int,
    pairs: int,
    span: float,
    low: float,
    high: float,
    delay: float | None,
) -> Array:
    """Return the logarithms of the denominator's coefficients, and the delay, with the least squares.

    Args:
        residual: of these numbers.
        poles: number of poles without an integrator.
        pairs: number of pairs among them that may be complex.
        span: length of a step response from which the time constants at the start follow [s].
        low: lower bound of the time constants [s].
        high: upper bound of the time constants [s].
        delay: estimate of the delay [s]; None: the model has none.
    """
    starts = _starts(poles, pairs, span) if poles else [np.empty(0)]
    powers = np.array([2.0, 1.0] * pairs + [1.0] * (poles - 2 * pairs))  # coefficients of p² are times squared
    bottom, top = np.log(low) * powers, np.log(high) * powers
    if delay is not None:
        starts = [np.append(start, part * delay) for start in starts for part in (0.5, 1.0)]
        bottom, top = np.append(bottom, 0.0), np.append(top, max(4.0 * delay, low))
    if not bottom.size:
        return np.empty(0)
    found = [
        scipy.optimize.least_squares(
            residual, np.clip(start, bottom, top), bounds=(bottom, top), x_scale="jac" if delay is not None else 1.0,
            xtol=1e-10, ftol=1e-10, max_nfev=_MOST,
        )
        for start in starts
    ]  # fmt: skip
    return np.asarray(min(found, key=lambda one: float(one.cost)).x)


def fit(
    measured: ChannelStep,
    *,
    zeros: int,
    poles: int,
    integrator: bool = False,
    oscillating: bool = True,
    delayed: bool = False,
) -> Fit:
    """Fit a model of chosen orders by least squares of the step response.

    Args:
        measured: step response of the channel.
        zeros: m, degree of the numerator.
        poles: n, number of poles without the integrator.
        integrator: whether the model has an integrator.
        oscillating: whether poles may be complex; otherwise the model is a product of lags, as in paper 004.
        delayed: whether the model has a delay.

    Raises:
        InputError: a model of these orders would not be strictly proper.
    """
    _check_orders(zeros, poles, integrator=integrator)
    time, response = measured.time, measured.response
    scale = np.abs(response).max()
    pairs = poles // 2 if oscillating else 0

    def numerator(x: Array) -> tuple[Array, Array, Array]:
        """Compute the best numerator for a denominator; return both in falling powers, and the step response."""
        bottom = _denominator(x[:poles], pairs, int(integrator))
        falling = [(1.0, *[0.0] * power) for power in range(zeros, -1, -1)]
        basis = np.stack([step_of(TransferFunction(power, tuple(bottom)), time) for power in falling], axis=1)
        if delayed:
            basis = np.stack([np.interp(time - x[poles], time, column, left=0.0) for column in basis.T], axis=1)
        size = np.abs(basis).max(axis=0)  # columns differ by orders of magnitude, which would spoil the solution
        top = np.linalg.lstsq(basis / size, response, rcond=None)[0] / size
        return top, bottom, basis @ top

    first = float(time[int(np.argmax(np.abs(response) > 0.02 * scale))]) if delayed else None
    best = _search(
        lambda x: np.asarray((numerator(x)[2] - response) / scale),
        poles,
        pairs,
        float(time[-1]),
        measured.step / 10.0,
        100.0 * float(time[-1]),
        first,
    )
    top, bottom, output = numerator(best)
    delay = float(best[poles]) if delayed else 0.0
    return Fit(TransferFunction(tuple(top), tuple(bottom)), time, response, output, delay)


def fit_response(
    measured: FrequencyResponse,
    *,
    zeros: int,
    poles: int,
    integrator: bool = False,
    oscillating: bool = True,
    delayed: bool = False,
) -> ResponseFit:
    """Fit a model of chosen orders by least squares of the relative error of the frequency response.

    Args:
        measured: frequency response of the channel.
        zeros: degree of the numerator.
        poles: number of poles without the integrator.
        integrator: whether the model has an integrator.
        oscillating: whether poles may be complex.
        delayed: whether the model has a delay.

    Raises:
        InputError: the orders do not give a strictly proper model.
    """
    _check_orders(zeros, poles, integrator=integrator)
    p, value = 1j * measured.frequency, measured.value
    pairs = poles // 2 if oscillating else 0
    # A thousandth is added: points that are all but certain would count alone.
    deviation = np.abs(value) * np.hypot(1e-3, 0.0 if measured.deviation is None else measured.deviation)

    def numerator(x: Array) -> tuple[Array, Array, Complex]:
        """Compute the best numerator for a denominator; return both in falling powers, and the response."""
        bottom = _denominator(x[:poles], pairs, int(integrator))
        below = np.polyval(bottom, p) * np.exp(p * (x[poles] if delayed else 0.0))
        basis = np.stack([p**power / below for power in range(zeros, -1, -1)], axis=1)
        weighted = basis / deviation[:, None]
        size = np.abs(weighted).max(axis=0)
        matrix = np.concatenate((weighted.real, weighted.imag)) / size
        wanted = np.concatenate((value.real / deviation, value.imag / deviation))
        top = np.linalg.lstsq(matrix, wanted, rcond=None)[0] / size
        return top, bottom, basis @ top

    def residual(x: Array) -> Array:
        error = (numerator(x)[2] - value) / deviation
        return np.asarray(np.concatenate((error.real, error.imag)) / np.sqrt(value.size), np.float64)

    low, high = 1.0 / float(measured.frequency[-1]), 1.0 / float(measured.frequency[0])
    # Starts of a step response over this span have time constants in the middle of the band.
    span = float(np.sqrt(low * high)) / _SPREADS[1]
    lag = max(float(-np.unwrap(np.angle(value))[-1]), 1.0) / float(measured.frequency[-1])
    best = _search(residual, poles, pairs, span, low / 10.0, high * 10.0, lag if delayed else None)
    top, bottom, output = numerator(best)
    delay = float(best[poles]) if delayed else 0.0
    return ResponseFit(TransferFunction(tuple(top), tuple(bottom)), measured.frequency, value, output, delay)


def without_delay(measured: ChannelStep, delay: float) -> ChannelStep:
    """Return a step response without its delay [s], to the nearest sample."""
    first = round(delay / measured.step)
    return ChannelStep(measured.time[: measured.time.size - first], measured.response[first:]) if first else measured


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
