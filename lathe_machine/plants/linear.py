# SPDX-License-Identifier: Apache-2.0
"""Linear drives with an input delay, discretised without rounding the delay to whole samples."""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
import numpy.typing as npt

from lathe_machine.transfer import bilinear, hold_response
from lathe_rc.arrays import Array, Complex
from lathe_rc.jit import inlined, kernel

Discretisation = Literal["foh", "tustin"]


class Constant:
    """Base class of immutable objects without state; caches share one object for equal parameters."""


@dataclass(frozen=True, eq=False)
class DiscretePlant(Constant):
    """Difference equation of a delayed plant, with the position as the first state.

    x[n] = Φ·x[n-1] + w0·u[n-k] + w1·u[n-k-1] + w2·u[n-k-2]

    Attributes:
        transition: Φ, shape (m, m).
        weights: columns w0, w1 and w2, shape (m, 3).
        delay: k, whole samples of the delay.
        fraction: remaining fraction of the delay in samples, 0 to 1, which the weights include.
        step: sampling step [s].
    """

    transition: Array
    weights: Array
    delay: int
    fraction: float
    step: float

    @cached_property
    def poles(self) -> Complex:
        """Poles of the continuous equivalent [rad/s], shape (m,), without those at minus infinity."""
        return continuous_poles(self.transition, self.step)

    def response(self, frequency: npt.ArrayLike) -> Complex:
        """Return the difference equation's frequency response from command to position at ``frequency`` [rad/s]."""
        wanted = np.asarray(frequency, dtype=np.float64)
        return _response(self, wanted.tobytes()).reshape(wanted.shape)


def continuous_poles(transition: Array, step: float) -> Complex:
    """Return the poles [rad/s] of which sampling at a ``step`` [s] makes a transition, without those at -inf."""
    discrete = np.linalg.eigvals(transition).astype(np.complex128)
    return np.asarray(np.log(discrete[discrete != 0.0]) / step)


@inlined
def _square(number: complex) -> float:
    """Return the squared magnitude of a complex number, without the square root of ``abs``."""
    return number.real * number.real + number.imag * number.imag


@inlined
def _quotient(above: complex, below: complex) -> complex:
    """Return the quotient of two complex numbers; not finite if ``below`` is 0."""
    square = _square(below)
    real = above.real * below.real + above.imag * below.imag
    return complex(real / square, (above.imag * below.real - above.real * below.imag) / square)


@kernel
def _respond(transition: Array, weights: Array, back: Complex, late: Complex, into: Complex) -> None:
    """Fill the position in x = (I - Φ/z)⁻¹·(w0 + w1/z + w2/z²)·z⁻ᵏ, shape (n,), by one elimination per z.

    Args:
        transition: Φ, shape (m, m).
        weights: w, shape (m, 3).
        back: 1/z, shape (n,).
        late: z⁻ᵏ, shape (n,).
        into: output array, shape (n,).
    """
    order = weights.shape[0]
    left, right = np.empty((order, order), np.complex128), np.empty(order, np.complex128)
    for place in range(into.size):
        step = back[place]
        for i in range(order):
            right[i] = weights[i, 0] + step * (weights[i, 1] + step * weights[i, 2])
            for j in range(order):
                left[i, j] = (1.0 if i == j else 0.0) - transition[i, j] * step
        # From the last state upwards, so that the position remains.
        for last in range(order - 1, 0, -1):
            pivot = last
            for i in range(last):
                pivot = i if _square(left[i, last]) > _square(left[pivot, last]) else pivot
            for j in range(last + 1):
                left[pivot, j], left[last, j] = left[last, j], left[pivot, j]
            right[pivot], right[last] = right[last], right[pivot]
            for i in range(last):
                ratio = _quotient(left[i, last], left[last, last])
                right[i] -= ratio * right[last]
                for j in range(last):
                    left[i, j] -= ratio * left[last, j]
        into[place] = _quotient(right[0], left[0, 0]) * late[place]


@lru_cache(maxsize=64)
def _response(plant: DiscretePlant, content: bytes) -> Complex:
    """Return the response of a plant at frequencies given as bytes, cached for the checks of similar cells."""
    back = _delayed(content, plant.step)
    found = np.empty_like(back)
    _respond(plant.transition, plant.weights, back, _delayed(content, plant.step * plant.delay), found)
    return found


@lru_cache(maxsize=64)
def _delayed(content: bytes, time: float) -> Complex:
    """Return exp(-jω·time) at frequencies given as bytes, cached because many plants share step and delay."""
    return np.asarray(np.exp(-1j * time * np.frombuffer(content)))


def discretise(a: Array, b: Array, delay: float, step: float, method: Discretisation) -> DiscretePlant:
    """Discretise a linear plant with a delayed input, x' = a·x + b·u(t - delay).

    Args:
        a: state matrix, shape (m, m) [1/s].
        b: input vector, shape (m,) [1/s].
        delay: input delay [s]; need not be a whole number of steps.
        step: sampling step [s].
        method: ``foh`` is exact for a command that is linear between its samples, including the fractional part of
            the delay; ``tustin`` is the bilinear rule, with linear interpolation for the fractional part.
    """
    return _discretised(a.tobytes(), b.tobytes(), delay, step, method)


@lru_cache(maxsize=64)
def _discretised(a_bytes: bytes, b_bytes: bytes, delay: float, step: float, method: Discretisation) -> DiscretePlant:
    """Discretise a plant given as bytes (implements `discretise`), cached so that similar cells share the plant."""
    b = np.frombuffer(b_bytes)
    a, samples = np.frombuffer(a_bytes).reshape(b.size, b.size), delay / step
    # A remainder below a billionth of a step, of either sign, is rounding error, and its inverse would overflow.
    whole = math.floor(samples + 1e-9)
    part = samples - whole if samples - whole > 1e-9 else 0.0
    weights = np.zeros((a.shape[0], 3))
    if method == "foh":
        # The delayed input has a kink a fraction `part` of a step after each sample: integrate up to the kink, then on.
        first, held_1, end_1 = hold_response(a, b, part * step)
        second, held_2, end_2 = hold_response(a, b, (1.0 - part) * step)
        start_1, start_2 = held_1 - end_1, held_2 - end_2
        transition = second @ first
        weights[:, 0] = (1.0 - part) * end_2
        weights[:, 1] = second @ ((1.0 - part) * start_1 + end_1) + start_2 + part * end_2
        weights[:, 2] = second @ (part * start_1)
    else:
        transition, gain = bilinear(a, b, step)
        weights[:] = np.outer(gain, [1.0 - part, 1.0, part])
    return DiscretePlant(transition, weights, whole, part, step)


def second_order(natural_frequency: float, damping: float) -> tuple[Array, Array]:
    """Return a and b of 1/(1 + 2ζp/ωn + p²/ωn²), with states position and velocity; ``natural_frequency`` in rad/s."""
    square = natural_frequency**2
    return np.array([[0.0, 1.0], [-square, -2.0 * damping * natural_frequency]]), np.array([0.0, square])
