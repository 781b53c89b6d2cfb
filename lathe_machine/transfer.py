# SPDX-License-Identifier: Apache-2.0
"""Linear systems given by rational transfer functions of p, stepped sample by sample.

Results are bit-identical for every block length. Inner loops with nonlinear elements (a limit, a play operator) advance
a `System` themselves with `step`.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from lathe_rc.arrays import Array, Complex
from lathe_rc.compiled.struct_view import sized
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel

Hold = Literal["zoh", "foh", "tustin"]


@dataclass(frozen=True)
class TransferFunction:
    """Proper rational transfer function numerator(p)/denominator(p).

    Attributes:
        numerator, denominator: coefficients in descending powers of p, as for numpy.polyval.

    Raises:
        InputError: the function is not proper, or a coefficient is not finite.
    """

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]

    def __post_init__(self) -> None:
        top, bottom = (
            np.trim_zeros(np.array(part, dtype=np.float64), "f") for part in (self.numerator, self.denominator)
        )
        if not (np.all(np.isfinite(top)) and np.all(np.isfinite(bottom))):
            raise InputError(f"transfer function {self}; allowed: finite coefficients")
        if not bottom.size:
            raise InputError(f"transfer function {self}; allowed: a denominator that is not zero")
        if top.size > bottom.size:
            raise InputError(
                f"transfer function {self} of degrees {top.size - 1} over {bottom.size - 1}; allowed: a numerator "
                "of no higher degree (add a pole for each zero that is too many)"
            )

    def __str__(self) -> str:
        """Return the coefficients as a string, in descending powers of p."""
        return f"{list(map(float, self.numerator))}/{list(map(float, self.denominator))}"

    def response(self, frequency: npt.ArrayLike) -> Complex:
        """Return the frequency response at ``frequency`` [rad/s], any shape."""
        p = 1j * np.asarray(frequency, dtype=np.float64)
        return np.asarray(np.polyval(self.numerator, p) / np.polyval(self.denominator, p))

    @property
    def poles(self) -> Complex:
        """Poles of the transfer function [rad/s]."""
        return np.asarray(np.roots(self.denominator), dtype=np.complex128)

    def __mul__(self, other: "TransferFunction") -> "TransferFunction":
        """Return the series connection of two transfer functions; poles and zeros are not cancelled."""
        return TransferFunction(
            tuple(np.polymul(self.numerator, other.numerator)), tuple(np.polymul(self.denominator, other.denominator))
        )


@sized
class System(NamedTuple):
    """Difference equation of a linear system.

    x[n] = Φ·x[n-1] + g0·u[n-1] + g1·u[n], y[n] = c·x[n] + d·u[n]

    Attributes:
        transition: Φ, shape (m, m).
        before, now: g0 and g1, shape (m,).
        output: c, shape (m,).
        through: d.
    """

    transition: Array
    before: Array
    now: Array
    output: Array
    through: float


@inlined
def step(system: System, state: Array, command: float) -> float:
    """Step a linear system by one sample and return its output.

    ``state`` has the shape (2m + 1,): x, then u[n-1], then space for the new x.
    """
    order = system.now.size
    previous = state[order]
    value = system.through * command
    for row in range(order):
        total = system.before[row] * previous + system.now[row] * command
        for column in range(order):
            total += system.transition[row, column] * state[column]
        state[order + 1 + row] = total
        value += system.output[row] * total
    for row in range(order):
        state[row] = state[order + 1 + row]
    state[order] = command
    return value


@kernel
def _block(system: System, state: Array, command: Array, output: Array) -> None:
    for k in range(command.size):
        output[k] = step(system, state, command[k])


def realise(transfer: TransferFunction) -> tuple[Array, Array, Array, float]:
    """Return a balanced realisation x' = a·x + b·u, y = c·x + d·u, shapes (m, m), (m,), (m,).

    The matrix a is a scaled companion matrix. `scipy.signal` provides this function as tf2ss, but importing that module
    takes half as long as everything else before a cell starts.
    """
    top, bottom = (np.trim_zeros(np.array(part), "f") for part in (transfer.numerator, transfer.denominator))
    if bottom.size == 1 or not top.size:  # a pure gain
        return np.empty((0, 0)), np.empty(0), np.empty(0), float(top[0] / bottom[0]) if top.size else 0.0
    top = np.concatenate((np.zeros(bottom.size - top.size), top)) / bottom[0]
    bottom = bottom / bottom[0]
    # Poles far apart give a companion matrix whose coefficients differ by many powers of ten.
    companion = scipy.linalg.companion(bottom)
    a, (scale, _) = scipy.linalg.matrix_balance(companion, permute=False, separate=True)
    b: Array = np.eye(1, bottom.size - 1)[0] / scale
    c: Array = (top[1:] - top[0] * bottom[1:]) * scale
    return np.asarray(a, np.float64), b, c, float(top[0])


def hold_response(a: Array, b: Array, step_s: float) -> tuple[Array, Array, Array]:
    """Return Φ of x' = a·x + b·u over a step [s], and the responses to a constant u = 1 and to a ramp from 0 to 1."""
    order = a.shape[0]
    block = np.zeros((order + 2, order + 2))
    block[:order, :order], block[:order, order] = a, b
    block[order, order + 1] = 1.0 / step_s if step_s else 0.0
    whole = scipy.linalg.expm(block * step_s)
    return whole[:order, :order], whole[:order, order], whole[:order, order + 1]


def bilinear(a: Array, b: Array, step_s: float) -> tuple[Array, Array]:
    """Discretise x' = a·x + b·u by the bilinear rule: return Φ and the weight of u at each end of a step [s]."""
    one = np.eye(a.shape[0])
    left = np.linalg.inv(one - a * step_s / 2.0)
    return left @ (one + a * step_s / 2.0), left @ b * (step_s / 2.0)


def discretise(transfer: TransferFunction, step_s: float, hold: Hold) -> System:
    """Discretise a transfer function.

    Args:
        transfer: transfer function of the continuous system.
        step_s: sampling step [s].
        hold: ``zoh``: exact for an input that is constant from sample to sample; ``foh``: exact for one that is
            linear between samples; ``tustin``: the bilinear rule.
    """
    a, column, c, through = realise(transfer)
    order = column.size
    if not order:
        return System(a, column, column, c, through)
    if hold == "tustin":
        transition, now = bilinear(a, column, step_s)
        before = now
    else:
        transition, held, rising = hold_response(a, column, step_s)
        before, now = (held, np.zeros(order)) if hold == "zoh" else (held - rising, rising)
    return System(
        np.ascontiguousarray(transition), np.ascontiguousarray(before), np.ascontiguousarray(now),
        np.ascontiguousarray(c), through,
    )  # fmt: skip


def rest(system: System) -> Array:
    """Return the state of a system at rest at 0, as used by `step`."""
    return np.zeros(2 * system.now.size + 1)


class LinearSystem:
    """Discretised linear system with its state.

    Args:
        transfer: transfer function of the continuous system.
        step_s: sampling step [s].
        hold: see `discretise`.

    Attributes:
        system: the difference equation.
    """

    def __init__(self, transfer: TransferFunction, step_s: float, hold: Hold = "foh") -> None:
        self.system = discretise(transfer, step_s, hold)
        self._state = rest(self.system)

    def block(self, command: Array, output: Array) -> None:
        """Step the system through a block, with arrays of shape (n,); it is at rest at 0 before the first block."""
        _block(self.system, self._state, command, output)
