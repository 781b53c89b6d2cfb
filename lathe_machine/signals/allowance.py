# SPDX-License-Identifier: Apache-2.0
"""Allowance: distance by which the blank's surface exceeds its nominal position.

    d(t) = w(t) + Σ a_i·sin(n_i·φ(t) + ψ_i)

w is a slow random walk. The sum is the run-out of the blank, which turns with the spindle: order 1 is eccentricity, and
higher orders describe the form of the blank. Sources: paper 004, whose disturbance of the force is 4.83 N RMS;
spec/feed-and-force.md, which equates this to an allowance of 20.7 µm RMS at 233.3 N/mm.
"""

from typing import NamedTuple

import numpy as np

from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.signals.checks import stacked
from lathe_rc.signals.noise import DrawnNumbers, NormalStream

PAPER_RMS = 20.7e-6  #: RMS of the allowance in paper 004 [m]


class Walk(NamedTuple):
    """Constants of a random walk, w[n] = keep·w[n-1] + kick·ξ[n], with ξ normal of mean 0 and RMS 1.

    Attributes:
        keep: factor per sample, 1 for an unbounded walk.
        kick: RMS of the increment [m].
        start: RMS of the first value [m].
    """

    keep: float
    kick: float
    start: float


def mean_reverting(rms: float, correlation_time: float, step: float) -> Walk:
    """Return a mean-reverting walk, stationary from its first sample (Ornstein-Uhlenbeck).

    Its autocorrelation is rms²·e^{-|t|/correlation_time} at any sampling step.

    Args:
        rms: RMS of the walk [m].
        correlation_time: correlation time [s].
        step: sampling step [s].

    Raises:
        InputError: the RMS is negative, or the correlation time is not above 0.
    """
    if not 0.0 <= rms < np.inf:
        raise InputError(f"allowance: RMS {rms:g} m; allowed: 0 or more")
    if not 0.0 < correlation_time < np.inf:
        raise InputError(
            f"allowance: correlation time {correlation_time:g} s; allowed: above 0 and finite (a walk without bounds "
            "has a rate instead)"
        )
    return Walk(
        float(np.exp(-step / correlation_time)), rms * float(np.sqrt(-np.expm1(-2.0 * step / correlation_time))), rms
    )


def unbounded(rate: float, step: float) -> Walk:
    """Return a walk that starts at 0 and has an RMS of rate·√t after t seconds; ``rate`` in m/√s, ``step`` in s.

    Raises:
        InputError: the rate is negative.
    """
    if not 0.0 <= rate < np.inf:
        raise InputError(f"allowance: rate {rate:g} m/√s of the walk; allowed: 0 or more")
    return Walk(1.0, rate * float(np.sqrt(step)), 0.0)


class AllowanceTable(NamedTuple):
    """Random walk and run-out of the blank for kernels (see `Allowance`).

    Attributes:
        walk: constants of the random walk.
        run_out: rows n_i, a_i, ψ_i, shape (3, m).
        normal: normally distributed random numbers for the walk.
        state: w, and whether there has been a sample.
    """

    walk: Walk
    run_out: Array
    normal: DrawnNumbers
    state: Array


@kernel
def allow(made: AllowanceTable, angle: Array, allowance: Array) -> None:
    """Fill ``allowance`` [m] at the true spindle ``angle`` [rad], both of shape (n,), using n of the drawn numbers."""
    walk, run_out, state, place = made.walk, made.run_out, made.state, made.normal.used[0]
    made.normal.used[0] += angle.size
    w, begun = state[0], state[1]
    for k in range(angle.size):
        normal = made.normal.values[place + k]
        # The first value has the RMS of the stationary walk, so that a run starts without a transient.
        w = walk.keep * w + walk.kick * normal if begun else walk.start * normal
        begun = 1.0
        total = w
        for i in range(run_out.shape[1]):
            total += run_out[1, i] * np.sin(run_out[0, i] * angle[k] + run_out[2, i])
        allowance[k] = total
    state[0], state[1] = w, begun


class Allowance:
    """Allowance of the blank: random walk and run-out.

    Args:
        walk: random walk from `mean_reverting` or `unbounded`.
        order: orders n_i of the run-out, integers of at least 1, shape (m,).
        amplitude: amplitudes a_i [m], shape (m,).
        phase: phases ψ_i [rad], shape (m,).
        seed: the scenario's seed.
        name: name of the node; selects an independent random stream.

    Attributes:
        stream: stream of the random walk.
        table: constants and state for `allow`.

    Raises:
        InputError: the arrays differ in length, or an order is not an integer of at least 1.
    """

    def __init__(
        self, walk: Walk, *, order: Array, amplitude: Array, phase: Array, seed: int, name: str = "allowance"
    ) -> None:
        run_out = stacked("run-out", orders=order, amplitudes=amplitude, phases=phase).astype(np.float64)
        wrong = order[(order < 1.0) | (order != np.rint(order))]
        if wrong.size:
            raise InputError(f"run-out: order {wrong[0]:g}; allowed: whole numbers from 1")
        self.stream = NormalStream(seed, name)
        self.table = AllowanceTable(walk, run_out, self.stream.drawn, np.zeros(2))

    def block(self, angle: Array, allowance: Array) -> None:
        """Fill ``allowance`` [m] at the true spindle ``angle`` [rad]; both of shape (n,)."""
        for piece in self.stream.draw_along(angle.size):
            allow(self.table, angle[piece], allowance[piece])
