# SPDX-License-Identifier: Apache-2.0
"""Iterative learning control over time, in lifted form (see `lathe_commission.ilc`)."""

from typing import Any

import numpy as np
import scipy

from lathe_commission import given
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError

_MOST, _TRIALS = 10_000, 1_000_000  # samples of a trial, trials
_SINGULAR = 1e13  # condition of an equation


class Trials:
    """Learning over time, in trials of n samples that begin in the same state: u' = Q(u + L·e), e = r - G·u.

    The first ``delay`` samples of a trial cannot be influenced, nor do the last ones of the command act: signals have
    m = n - delay samples, e and r those from ``delay`` on.

    Args:
        system: impulse response, shape (n,) or more; or a discrete system with one input and one output
            (``scipy.signal.dlti``, or a system of python-control with ``dt``), from the command to the position.
        samples: n.

    Attributes:
        plant: lifted plant G, lower triangular, shape (m, m).
        delay: samples from the command to the position.

    Raises:
        InputError: the system is continuous, has several inputs or outputs, or its impulse response is 0 or too short.
    """

    def __init__(self, system: object, samples: int) -> None:
        count = given.whole("samples", samples, 2, _MOST)
        impulse = given.array("impulse response", _impulse(system, count))
        if impulse.size < count:
            raise InputError(f"impulse response of {impulse.size} samples; allowed: at least the {count} of a trial")
        acting = np.flatnonzero(impulse[: count - 1])
        if not acting.size:
            raise InputError(f"impulse response of 0 in {count} samples; allowed: a plant that moves within a trial")
        self.delay = int(acting[0])
        first = impulse[self.delay : count]
        self.plant: Array = np.asarray(scipy.linalg.toeplitz(first, np.zeros(first.size)))

    def norm_optimal(
        self, *, effort: float = 0.0, change: float = 0.0, basis: Array | None = None
    ) -> tuple[Array, Array]:
        """Return Q and L, shape (m, m), with the least |e'|² + ``effort``·|u'|² + ``change``·|u' - u|².

        Gunnarsson and Norrlöf 2001 (Automatica 37); with a basis Ψ, shape (m, k), the command is Ψ·θ (van de Wijdeven
        and Bosgra 2010, Int. J. Control 83). Plants that are not minimum-phase need ``effort`` or ``change`` above 0.

        Raises:
            InputError: a weight is negative, or the least is not unique.
        """
        size = len(self.plant)
        weights = given.number("effort", effort, 0.0), given.number("change", change, 0.0)
        basis = np.eye(size) if basis is None else np.asarray(basis, float)
        if basis.ndim != 2 or len(basis) != size:
            raise InputError(f"basis of shape {basis.shape}; allowed: ({size}, k)")
        seen = self.plant @ basis
        weight = seen.T @ seen + sum(weights) * basis.T @ basis
        if not np.linalg.cond(weight) < _SINGULAR:
            raise InputError(
                "norm-optimal law: the least is not unique; allowed: effort or change above 0, and a basis of "
                "independent columns"
            )
        both = np.concatenate((seen.T @ self.plant + weights[1] * basis.T, seen.T), axis=1)
        kept, learned = np.split(basis @ np.linalg.solve(weight, both), 2, axis=1)
        return kept, np.asarray(np.linalg.lstsq(kept, learned, rcond=None)[0])

    def norm(self, q: Array, learning: Array) -> float:
        """Return the largest singular value of Q(I - L·G): below 1 the command converges monotonously.

        Raises:
            InputError: a matrix has another shape than the plant.
        """
        kept, learned = self._law(q, learning)
        return float(np.linalg.norm(kept @ (np.eye(len(self.plant)) - learned @ self.plant), 2))

    def errors(
        self, wanted: Array, q: Array, learning: Array, trials: int, *, noise_rms: float = 0.0, seed: int = 1
    ) -> Array:
        """Return the RMS error of each trial from sample ``delay`` on, shape (trials,).

        Args:
            wanted: position r, shape (n,).
            q: Q, shape (m, m).
            learning: L, shape (m, m).
            trials: number of trials; the command of the first one is 0.
            noise_rms: noise of the measured error.
            seed: seed of the noise.

        Raises:
            InputError: an argument has another shape, or is out of its range.
        """
        kept, learned = self._law(q, learning)
        noise = given.number("noise_rms", noise_rms, 0.0)
        goal = given.array("wanted", wanted, size=len(self.plant) + self.delay)[self.delay :]
        random, command, found = np.random.default_rng(seed), np.zeros(goal.size), []
        for _ in range(given.whole("trials", trials, 1, _TRIALS)):
            error = goal - self.plant @ command
            found.append(np.sqrt(np.mean(error**2)))
            command = kept @ (command + learned @ (error + noise * random.standard_normal(goal.size)))
        return np.array(found)

    def _law(self, q: Array, learning: Array) -> tuple[Array, Array]:
        kept, learned = np.asarray(q, float), np.asarray(learning, float)
        for name, matrix in (("Q", kept), ("L", learned)):
            if matrix.shape != self.plant.shape:
                raise InputError(f"{name} of shape {matrix.shape}; allowed: {self.plant.shape}")
        return kept, learned


def _impulse(system: Any, samples: int) -> Any:
    """Return the impulse response of a discrete system, or the given one."""
    if not any(hasattr(system, name) for name in ("A", "num")):
        return system
    step = getattr(system, "dt", None)
    if not step or step is True:
        raise InputError("a system without a sampling step; allowed: a discrete one, with dt (such as c2d of it)")
    try:
        if not isinstance(system, scipy.signal.dlti):
            values = (system.A, system.B, system.C, system.D) if hasattr(system, "A") else _polynomials(system)
            system = (*values, step)
        _, (found,) = scipy.signal.dimpulse(system, n=samples)
        (response,) = np.asarray(found).T
    except ValueError:
        raise InputError("a system of several inputs or outputs; allowed: one of each") from None
    return response


def _polynomials(system: Any) -> tuple[Any, Any]:
    ((numerator,),) = system.num
    ((denominator,),) = system.den
    return numerator, denominator
