# SPDX-License-Identifier: Apache-2.0
"""Nonlinear periodic control of a drive whose input saturates (paper 002, eqs 6, 10 and 16).

    v = W(p)·(r - y),   y_F = W(p)·y,   W = ((T·p + 1)/(T*·p + 1))³
    u = u1 + u2
    u1(t) = u1(t - T̄) + h0·v·δ̃
    u2(t) = (h11·I + h12·s·v·δ̃)·s,   I' = s·v·δ̃,   s = sat(y_F)
    τ·δ̃' + δ̃ = δ,   δ̃(0) = 0,   δ = 1 where (S(u) - u)·v ≥ 0 and δ0 elsewhere

S limits its argument to ±S0. The paper does not define sat; here it is the unit saturation. r, y and u are
dimensionless, as in the paper; the caller must scale positions in metres.

Additions to the paper, on by default:

- The memory is read through a Gaussian filter of standard deviation σ, symmetric in time; the samples on both sides of
  t - T̄ are all in the past. Without the filter the memory grows at frequencies where its factor per period exceeds 1,
  see `lathe_papers.formulas.hyperstability.learning_factor`.
- Anti-windup: while (S(u) - u)·v < 0, I is constant and the memory stores the value read, limited to ±S0. The switch
  alone only slows down the windup.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lathe_machine.transfer import System, TransferFunction, discretise, rest, step
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError, at_most
from lathe_rc.jit import kernel
from lathe_rc.signals.noise import quantise


@dataclass(frozen=True)
class PeriodicGains:
    """Parameters of the periodic control law, named as in the paper.

    Attributes:
        h0: gain of the memory [1].
        h11: coefficient of the adaptive gain [1/s].
        h12: coefficient of the nonlinear gain [1].
        lead, lag: T and T* of the filters on r and y [s].
        switch_time: τ [s].
        switch_low: δ0 [1].
        memory_filter: σ of the Gaussian filter of the memory [s]; 0 for none.
        reference_gain: χ* of eq. 12 [1], used only in eq. 15; with T* = 0 it satisfies eq. 14 for all drives.
        doc: source of the parameters.
    """

    h0: float
    h11: float
    h12: float
    lead: float
    lag: float
    switch_time: float
    switch_low: float
    memory_filter: float
    reference_gain: float
    doc: str

    @property
    def filter(self) -> TransferFunction:
        """Filter W of eqs 6 and 10."""
        top, bottom = np.poly([-1.0 / self.lead] * 3), np.poly([-1.0 / self.lag] * 3)
        return TransferFunction(tuple(top * self.lead**3), tuple(bottom * self.lag**3))


PRESETS = {
    "published": PeriodicGains(
        40.0, 200.0, 150.0, 0.17, 0.01, 15.0, 0.5, 0.1, 110.0,
        "paper 002, eqs 20 and 21; not for a quantised measurement",
    ),
    # T and T* are chosen by analysis: with σ = 0.1 s, the learning factor is below 1 at every corner and level of y_F.
    "quantised": PeriodicGains(
        2.5, 1.0, 1.0, 0.4, 0.055, 15.0, 0.5, 0.1, 10.0,
        "for steps of 1e-4 in y and u; checked on all 32 corners of eq. 1",
    ),
}  # fmt: skip


def _check(
    gains: PeriodicGains, *, limit: float, step_s: float, memory_filter: float, quantisation: tuple[float, float]
) -> None:
    """Check the parameters of the law; raise an `InputError` if one is out of range."""
    positive = {
        "h0": gains.h0, "h11": gains.h11, "lead": gains.lead, "lag": gains.lag, "switch_time": gains.switch_time,
        "limit": limit, "step": step_s,
    }  # fmt: skip
    for name, value in positive.items():
        if not (np.isfinite(value) and value > 0.0):
            raise InputError(f"periodic law: {name} = {value:g}; allowed: above 0")
    from_zero = {
        "h12": gains.h12, "memory_filter": memory_filter,
        "measurement_step": quantisation[0], "command_step": quantisation[1],
    }  # fmt: skip
    for name, value in from_zero.items():
        if not (np.isfinite(value) and value >= 0.0):
            raise InputError(f"periodic law: {name} = {value:g}; allowed: from 0")
    if not 0.0 < gains.switch_low < 1.0:
        raise InputError(f"periodic law: switch_low = {gains.switch_low:g}; allowed: between 0 and 1")


_REACH = 5.0  # reach of the Gaussian [standard deviations]
_CHUNK = 128  # number of memory samples smoothed at a time, if the period allows
# Indices in the state: I, δ̃, the integral of eq. 15, its lower bound, the least distance of both so far, the largest
# demand |u|, the largest |sample| stored, whether learning is frozen, number of samples with a limited command.
_INTEGRATOR, _SWITCH, _POPOV, _BOUND, _CLEARANCE, _DEMAND, _MEMORY, _FROZEN, _SATURATED, _SIZE = range(10)


class PeriodicLaw(NamedTuple):
    """Constants of the periodic control law for kernels.

    Attributes:
        filter: filter W.
        samples: T̄ in samples.
        weights: Gaussian weights, starting at the middle, shape (reach + 1,).
        h0, h11, h12: gains.
        limit: S0.
        keep: decay factor of δ̃ per sample.
        switch_low: δ0.
        anti_windup: False for the paper's law.
        measurement_step, command_step: quantisation of y and u; 0 for none.
        step: sampling step [s].
        reference_gain: χ* of eq. 12.
        knows_ideal: False if S(u) of the previous period approximates the ideal input u°.
    """

    filter: System
    samples: int
    weights: Array
    h0: float
    h11: float
    h12: float
    limit: float
    keep: float
    switch_low: float
    anti_windup: bool
    measurement_step: float
    command_step: float
    step: float
    reference_gain: float
    knows_ideal: bool


class PeriodicState(NamedTuple):
    """State of the periodic control law for kernels.

    Attributes:
        values: scalars, shape (9,).
        reference, output: states of the filters.
        ring: stored samples of u1, shape (samples + reach,); sample n is at index n modulo the length.
        smoothed: smoothed memory of the current chunk, shape (chunk,).
        window: scratch array for the samples of the chunk and their neighbours, shape (chunk + 2·reach,).
        ideal: u° over a period, shape (samples,).
    """

    values: Array
    reference: Array
    output: Array
    ring: Array
    smoothed: Array
    window: Array
    ideal: Array


@kernel
def _smooth(law: PeriodicLaw, state: PeriodicState, n: int) -> None:
    """Smooth the memory for the chunk that begins at sample ``n``."""
    ring, smoothed, window, weights = state.ring, state.smoothed, state.window, law.weights
    chunk, reach = smoothed.size, weights.size - 1
    first = n - law.samples - reach
    for k in range(window.size):
        window[k] = ring[(first + k) % ring.size]
    middle = window[reach : reach + chunk]
    for k in range(chunk):
        smoothed[k] = weights[0] * middle[k]
    # The outer loop runs over the weights, so that each sum has the same order, and the inner loop vectorises.
    for j in range(1, reach + 1):
        weight = weights[j]
        left, right = window[reach - j : reach - j + chunk], window[reach + j : reach + j + chunk]
        for k in range(chunk):
            smoothed[k] += weight * (left[k] + right[k])


@kernel
def _monitor(law: PeriodicLaw, state: PeriodicState, n: int, wanted: float, v: float, applied: float) -> None:
    """Update the integral of eq. 15 and its bound.

    With θ = χ*·r̂ + u°, the integrand is -μ·v = (S(u) - u° - χ*·v)·v, where u° is the input that keeps y at r.
    """
    values = state.values
    place = n % law.samples
    needed = state.ideal[place]
    values[_POPOV] += law.step * (applied - needed - law.reference_gain * v) * v
    if n < law.samples:
        values[_BOUND] -= law.step * (law.reference_gain * wanted + needed) ** 2 / (2.0 * law.h0)
    values[_CLEARANCE] = min(values[_CLEARANCE], values[_POPOV] - values[_BOUND])
    if not law.knows_ideal:
        state.ideal[place] = applied


@kernel
def advance(law: PeriodicLaw, state: PeriodicState, n: int, reference: float, measurement: float) -> float:
    """Compute the limited, quantised command of one sample, and count the samples with a limited command.

    Args:
        law: constants of the law.
        state: state of the law, updated in place.
        n: absolute index of the sample; increases by 1 from call to call.
        reference: r.
        measurement: y, before its quantisation.
    """
    values = state.values
    wanted = step(law.filter, state.reference, reference)
    output = step(law.filter, state.output, quantise(measurement, law.measurement_step))
    v = wanted - output
    s = min(max(output, -1.0), 1.0)
    # Chunks begin at multiples of their size, so that results are bit-identical for all block lengths.
    place = n % state.smoothed.size
    if place == 0:
        _smooth(law, state, n)
    read = state.smoothed[place]
    weighted = v * values[_SWITCH]
    stored = read + law.h0 * weighted
    demand = stored + (law.h11 * values[_INTEGRATOR] + law.h12 * s * weighted) * s
    applied = min(max(demand, -law.limit), law.limit)
    winding = (applied - demand) * v < 0.0
    frozen = values[_FROZEN] > 0.0
    if frozen:
        stored = state.ring[(n - law.samples) % state.ring.size]  # unfiltered, since the filter would flatten it
    elif winding and law.anti_windup:
        stored = min(max(read, -law.limit), law.limit)
    else:
        values[_INTEGRATOR] += law.step * s * weighted
    state.ring[n % state.ring.size] = stored
    values[_SWITCH] = law.keep * values[_SWITCH] + (1.0 - law.keep) * (law.switch_low if winding else 1.0)
    values[_DEMAND] = max(values[_DEMAND], abs(demand))
    values[_MEMORY] = max(values[_MEMORY], abs(stored))
    if not frozen:
        _monitor(law, state, n, wanted, v, applied)
    values[_SATURATED] += applied != demand
    return quantise(applied, law.command_step)


@kernel
def _block(
    law: PeriodicLaw, state: PeriodicState, first: int, reference: Array, measurement: Array, command: Array
) -> None:
    for k in range(command.size):
        command[k] = advance(law, state, first + k, reference[k], measurement[k])


@kernel
def freeze(state: PeriodicState, on: bool) -> None:  # noqa: FBT001 - kernels take their arguments by position
    """Freeze the memory and I, or resume updating them."""
    state.values[_FROZEN] = 1.0 if on else 0.0


@kernel
def achieved(state: PeriodicState, row: Array) -> None:
    """Fill ``row``: largest demand and memory, number of saturated samples, Popov integral, its bound and clearance."""
    values = state.values
    row[0], row[1], row[2] = values[_DEMAND], values[_MEMORY], values[_SATURATED]
    row[3], row[4], row[5] = values[_POPOV], values[_BOUND], values[_CLEARANCE]


def samples_in(period: float, step_s: float) -> int:
    """Return the number of samples in a period [s].

    Raises:
        InputError: the period is not a whole number of steps.
    """
    exact = period / step_s
    whole = round(exact)
    if whole < 1 or abs(exact - whole) > 1e-6:
        low = int(exact)
        nearest = " or ".join(f"{n * step_s:.10g}" for n in (low, low + 1) if n)
        raise InputError(
            f"period of {period:.10g} s is {exact:.6g} steps of {step_s:.6g} s; allowed: a whole number of steps, "
            f"nearest {nearest} s"
        )
    return whole


class PeriodicController:
    """Nonlinear periodic controller, initially at rest at 0 with an empty memory.

    Args:
        gains: parameters of the law, such as a preset of `PRESETS`.
        period: T̄, a multiple of the period of reference and disturbance [s].
        limit: S0, equal to the limit of the drive [1].
        step_s: sampling step [s].
        memory_filter: σ of the Gaussian filter of the memory [s], 0 for none; None for the value in ``gains``.
        anti_windup: whether to use the anti-windup described in the module; False for the paper's switch alone.
        measurement_step, command_step: quantisation of y and u [1]; 0 for none.
        ideal: u°, the input that keeps y at r, over the first period, shape (period/step,); None uses the command
            applied one period earlier, which is the same after learning.

    Attributes:
        law, state: constants and state for `advance`, for loops closed in a kernel.

    Raises:
        InputError: a gain, limit or period is out of range, or the Gaussian is wider than the period allows.
    """

    def __init__(
        self,
        gains: PeriodicGains,
        *,
        period: float,
        limit: float,
        step_s: float,
        memory_filter: float | None = None,
        anti_windup: bool = True,
        measurement_step: float = 0.0,
        command_step: float = 0.0,
        ideal: Array | None = None,
    ) -> None:
        sigma = gains.memory_filter if memory_filter is None else memory_filter
        _check(gains, limit=limit, step_s=step_s, memory_filter=sigma, quantisation=(measurement_step, command_step))
        samples = samples_in(period, step_s)
        reach = int(np.ceil(_REACH * sigma / step_s))
        if reach >= samples:
            raise InputError(
                f"memory_filter = {sigma:g} s reaches {reach} samples to each side; allowed: less than the period, "
                f"{samples} samples (up to {at_most((samples - 1) * step_s / _REACH)} s)"
            )
        if ideal is not None and ideal.shape != (samples,):
            raise InputError(f"ideal input of shape {ideal.shape}; allowed: one value for each of {samples} samples")
        weights = np.exp(-0.5 * (np.arange(reach + 1) * step_s / (sigma or 1.0)) ** 2)
        chunk = min(_CHUNK, samples - reach)
        system = discretise(gains.filter, step_s, "tustin")
        self.law = PeriodicLaw(
            filter=system,
            samples=samples,
            weights=weights / (2.0 * weights.sum() - weights[0]),
            h0=gains.h0,
            h11=gains.h11,
            h12=gains.h12,
            limit=limit,
            keep=float(np.exp(-step_s / gains.switch_time)),
            switch_low=gains.switch_low,
            anti_windup=anti_windup,
            measurement_step=measurement_step,
            command_step=command_step,
            step=step_s,
            reference_gain=gains.reference_gain,
            knows_ideal=ideal is not None,
        )
        self.state = PeriodicState(
            values=np.zeros(_SIZE),
            reference=rest(system),
            output=rest(system),
            ring=np.zeros(samples + reach),
            smoothed=np.zeros(chunk),
            window=np.zeros(chunk + 2 * reach),
            ideal=np.zeros(samples) if ideal is None else ideal.copy(),
        )
        # Contribution of a decreasing adaptive gain: the integral of (h11·I + χ*) over I is never below this bound.
        self.state.values[_BOUND] = -(gains.reference_gain**2) / (2.0 * gains.h11)
        self.state.values[_CLEARANCE] = -self.state.values[_BOUND]

    def block(self, first: int, reference: Array, measurement: Array, command: Array) -> None:
        """Compute the limited, quantised commands of a block starting at sample ``first``, shape (n,) [1]."""
        _block(self.law, self.state, first, reference, measurement, command)

    @property
    def saturated(self) -> int:
        """Number of samples so far with a limited command."""
        return int(self.state.values[_SATURATED])

    @property
    def learning(self) -> bool:
        """Whether the memory and I are updated; if not, the memory repeats, and eq. 15 is not monitored."""
        return not self.state.values[_FROZEN]

    @learning.setter
    def learning(self, on: bool) -> None:
        self.state.values[_FROZEN] = not on

    @property
    def integrator(self) -> float:
        """Integrator state I of the adaptive gain [s]."""
        return float(self.state.values[_INTEGRATOR])

    @property
    def largest_demand(self) -> float:
        """Largest |u| before the limit so far [1]."""
        return float(self.state.values[_DEMAND])

    @property
    def largest_memory(self) -> float:
        """Largest magnitude stored in the memory so far [1]."""
        return float(self.state.values[_MEMORY])

    @property
    def popov_integral(self) -> float:
        """Popov integral of eq. 15 up to the current sample [s]."""
        return float(self.state.values[_POPOV])

    @property
    def popov_bound(self) -> float:
        """Lower bound -η0 of the Popov integral in eq. 15 [s]; decreases during the first period.

        See `lathe_papers.formulas.hyperstability.popov_bound`.
        """
        return float(self.state.values[_BOUND])

    @property
    def popov_holds(self) -> bool:
        """Whether the Popov integral was at or above its bound in every sample so far."""
        return bool(self.state.values[_CLEARANCE] >= 0.0)
