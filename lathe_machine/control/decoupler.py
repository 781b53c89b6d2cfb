# SPDX-License-Identifier: Apache-2.0
"""Decoupler of the force and position loops (paper 004, Figs 5 and 10).

    F = W1·v1 + W4·x,  x = W2·v2,  y = x + W3·F
    v1 = u1 - K1·u2,   v2 = u2 - K2·u1

The longitudinal feed produces a force through W1, and the cross feed moves the tool through W2. The depth of cut
produces a force through W4, and the force deflects tool and part through W3. K1 = W2·W4/W1 cancels the effect of u2 on
the force, and K2 = W1·W3/W2 that of u1 on the position. Since an inverse has more zeros than poles, one lag is added
for each missing order. An integrator in K1 or K2 would accumulate the error of an inexact model without limit, so 1/p
is replaced by 1/(p + leak).

The paper uses mm, N and % of the full command; here the channels are in m, N and 1, converted once below.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from lathe_machine.transfer import System, TransferFunction, discretise, rest, step
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import inlined, kernel

LAG = 1e-3  #: lag added for each missing order of an inverse [s] (paper 004)
LEAK = 0.05  #: leak of the integrators [rad/s]
_OFF = System(np.empty((0, 0)), np.empty(0), np.empty(0), np.empty(0), 0.0)


def lags(*times: float) -> TransferFunction:
    """Create the transfer function 1/Π(1 + p·T) of lags with the time constants ``times`` [s]."""
    whole = gain(1.0)
    for time in times:
        whole *= TransferFunction((1.0,), (time, 1.0))
    return whole


def gain(value: float) -> TransferFunction:
    """Create the transfer function of a constant gain."""
    return TransferFunction((value,), (1.0,))


@dataclass(frozen=True)
class Channels:
    """Transfer functions of the plant of the force and position loops.

    Attributes:
        w1: from the command of the longitudinal feed to the force [N].
        w2: from the command of the cross feed to the position of the tool [m].
        w3: from the force to the displacement added to the position [m/N]; negative if the force pushes the tool away.
        w4: from the position of the tool to the force [N/m].
    """

    w1: TransferFunction
    w2: TransferFunction
    w3: TransferFunction
    w4: TransferFunction


_W1 = gain(1179.0) * lags(0.17, 0.22)  # 11.79 N/%
_W2 = TransferFunction((4.38e-3,), (0.045, 1.0, 0.0))  # 0.0438 mm/s/%
_W4 = gain(233.3e3) * lags(0.075)  # 233.3 N/mm

FULL_W1 = gain(1188.9) * lags(0.11304, 0.2679, 0.01659, 0.01659)  #: reproduces the paper's Fig. 12, unlike W1
PAPER = Channels(_W1, _W2, TransferFunction((0.385e-6,), (0.003, 0.0005, 1.0)), _W4)  #: as printed: W3 at 2.9 Hz
REALISTIC = Channels(_W1, _W2, TransferFunction((-0.385e-6,), (0.003**2, 0.0005, 1.0)), _W4)  #: W3 at 53 Hz
PRESETS: Mapping[str, Channels] = MappingProxyType({"paper": PAPER, "realistic": REALISTIC})


def inverse(transfer: TransferFunction, lag: float = LAG) -> TransferFunction:
    """Compute the inverse 1/transfer with a factor 1/(1 + p·lag) for each missing order (paper 004, second stage).

    Raises:
        InputError: the inverse would be unstable, or ``lag`` [s] is not positive.
    """
    if lag <= 0.0:
        raise InputError(f"inverse of {transfer}: lag {lag:g} s; allowed: above 0")
    top, bottom = (np.trim_zeros(np.array(part), "f") for part in (transfer.numerator, transfer.denominator))
    if not top.size or np.any(np.roots(top).real >= 0.0):
        raise InputError(
            f"inverse of {transfer}: 0, or a zero that is not stable; allowed: zeros left of the imaginary axis "
            "(use a reduced-order model without it)"
        )
    missing = lags(*[lag] * (bottom.size - top.size))
    return TransferFunction(tuple(bottom), tuple(np.polymul(top, missing.denominator)))


def _leaking(transfer: TransferFunction, leak: float) -> TransferFunction:
    """Replace the integrators by 1/(p + leak), after cancelling them against zeros at 0."""
    top, bottom = np.array(transfer.numerator), np.array(transfer.denominator)
    zeros, poles = (part.size - np.trim_zeros(part, "b").size for part in (top, bottom))
    both = min(zeros, poles)
    top, bottom = top[: top.size - both], bottom[: bottom.size - poles]
    for _ in range(poles - both):
        bottom = np.polymul(bottom, (1.0, leak))
    return TransferFunction(tuple(top), tuple(bottom))


def compensators(channels: Channels, lag: float = LAG, leak: float = LEAK) -> tuple[TransferFunction, TransferFunction]:
    """Compute the compensators K1 and K2 from a model of the plant.

    Args:
        channels: model of the plant; the model of paper 004 is of reduced order.
        lag: time constant of the lags in the inverses [s].
        leak: leak of the integrators [rad/s].

    Raises:
        InputError: W1 or W2 has no stable inverse, ``lag`` is not positive, or ``leak`` is negative.
    """
    if leak < 0.0:
        raise InputError(f"decoupler: leak {leak:g} rad/s; allowed: 0 for none, or above")
    k1 = channels.w2 * channels.w4 * inverse(channels.w1, lag)
    k2 = channels.w1 * channels.w3 * inverse(channels.w2, lag)
    return _leaking(k1, leak), _leaking(k2, leak)


class DecouplerTable(NamedTuple):
    """K1 and K2 for kernels, with their states (see `lathe_machine.transfer.step`)."""

    k1: System
    state1: Array
    k2: System
    state2: Array


@inlined
def decouple(table: DecouplerTable, u1: float, u2: float) -> tuple[float, float]:
    """Compute the decoupled commands v1 and v2 of one sample."""
    return u1 - step(table.k1, table.state1, u2), u2 - step(table.k2, table.state2, u1)


@kernel
def decouple_along(table: DecouplerTable, u1: Array, u2: Array, v1: Array, v2: Array) -> None:
    """Compute the decoupled commands of a block with `decouple`, shape (n,)."""
    for k in range(u1.size):
        v1[k], v2[k] = decouple(table, u1[k], u2[k])


class Decoupler:
    """Decoupler of two loops by the compensators K1 and K2; at rest at 0 before the first sample.

    The drives limit v1 and v2, not the decoupler.

    Args:
        k1, k2: transfer functions from `compensators`; None for no compensator.
        step_s: sampling step [s].

    Attributes:
        table: K1 and K2 for `decouple`, exact for commands that are linear between samples.
    """

    def __init__(self, k1: TransferFunction | None, k2: TransferFunction | None, step_s: float) -> None:
        one, two = (discretise(k, step_s, "foh") if k else _OFF for k in (k1, k2))
        self.table = DecouplerTable(one, rest(one), two, rest(two))

    def block(self, u1: Array, u2: Array, v1: Array, v2: Array) -> None:
        """Decouple a block of commands, shape (n,) each.

        Args:
            u1: command of the force controller [1].
            u2: command of the position controller [1].
            v1: output, command of the longitudinal feed [1].
            v2: output, command of the cross feed [1].
        """
        decouple_along(self.table, u1, u2, v1, v2)
