# SPDX-License-Identifier: Apache-2.0
"""Coupled force and position loops of paper 004 as one linear system.

    F = W1·v1 + W4·x + n,  x = W2·v2,  y = x + W3·F
    v1 = u1 - K1·u2,  v2 = u2 - K2·u1,  u1 = C1·(F_set - F·e^{-pτ}),  u2 = C2·(y_set - y·e^{-pτ})

Its poles show whether the coupled loops are stable. Limits and converters are not modelled here (see
`lathe_papers.formulas.coupled_simulation`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import control
import numpy as np

from lathe_machine.analysis.pid_tuning import Lti, delay, state_space
from lathe_machine.control.decoupler import FULL_W1, PRESETS, Channels, compensators, gain
from lathe_machine.control.pid import FORCE, POSITION, PidGains
from lathe_machine.transfer import TransferFunction
from lathe_rc.arrays import Array, Complex
from lathe_rc.errors import InputError

CONNECTIONS = {"none": (False, False), "k1": (True, False), "k2": (False, True), "both": (True, True)}
#: active compensators (K1, K2), by name


def plant(channels: Channels) -> Lti:
    """Return the plant with inputs v1, v2 [1] and n [N] and outputs F [N] and y [m]."""
    # Inputs of the subsystems: v1, v2, F, x; outputs: W1, W2, W3, W4.
    parts = control.append(*(state_space(part) for part in (channels.w1, channels.w2, channels.w3, channels.w4)))
    inside = np.array([[0, 0, 0, 0], [0, 0, 0, 0], [1, 0, 0, 1], [0, 1, 0, 0]], dtype=np.float64)
    into = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]], dtype=np.float64)
    out = np.array([[1, 0, 0, 1], [0, 1, 1, 0]], dtype=np.float64)
    through = np.array([[0, 0, 1], [0, 0, 0]], dtype=np.float64)
    return _connected(parts, inside, into, out, through)


def _connected(parts: Lti, inside: Array, *around: Array) -> Lti:
    """Connect subsystems: inputs are inside·outputs + into·w, outputs are out·outputs + through·w.

    ``around`` is (into, out, through).
    """
    into, out, through = around
    # A static system as feedback solves all connections at once, algebraic loops included.
    closed = control.feedback(parts, control.ss([], [], [], inside), sign=1)
    return out * closed * into + control.ss([], [], [], through)


@dataclass(frozen=True)
class CoupledLoops:
    """Closed force and position loops: plant, controllers and compensators.

    Args:
        channels: channels W1 to W4 of the actual plant.
        k1, k2: compensators; None if switched off.
        force, position: controllers of the two loops.
        wait: delay τ from a measurement to the command computed from it [s].
    """

    channels: Channels
    k1: TransferFunction | None = None
    k2: TransferFunction | None = None
    force: PidGains = FORCE
    position: PidGains = POSITION
    wait: float = 0.0

    def system(self) -> Lti:
        """Return the closed loops with inputs F_set [N], y_set [m], n [N] and outputs F [N], y [m], u1, u2 [1]."""
        nothing = control.ss([], [], [], [[0.0]])
        k1, k2 = (state_space(k) if k else nothing for k in (self.k1, self.k2))
        parts = control.append(
            state_space(self.force.transfer), state_space(self.position.transfer), k1, k2, plant(self.channels),
            delay(self.wait), delay(self.wait),
        )  # fmt: skip
        # Outputs and inputs of the subsystems, in this order: e1, e2, u2, u1, v1, v2, n, F, y.
        u1, u2, w1, w2, force, position, late_force, late_position = np.eye(8)
        none = np.zeros(8)
        inside = np.stack((-late_force, -late_position, u2, u1, u1 - w1, u2 - w2, none, force, position))
        into = np.zeros((9, 3))
        into[0, 0] = into[1, 1] = into[6, 2] = 1.0
        return _connected(parts, inside, into, np.stack((force, position, u1, u2)), np.zeros((4, 3)))

    def poles(self) -> Complex:
        """Return the poles of the closed loops [rad/s], including those of active compensators."""
        return np.asarray(self.system().poles(), dtype=np.complex128)

    def growth(self) -> float:
        """Return the largest real part of the poles [1/s]; the coupled loops are stable if it is negative."""
        return float(self.poles().real.max())


def loops(
    preset: str = "paper", force_plant: str = "approximate", connection: str = "both", wait: float = 0.0
) -> CoupledLoops:
    """Return the loops of paper 004, with compensators of its approximate plant.

    Args:
        preset: ``paper`` or ``realistic``, see `lathe_machine.control.decoupler.PRESETS`.
        force_plant: ``approximate``: W1 as printed; ``full``: the W1 that underlies Fig. 12.
        connection: ``none``, ``k1``, ``k2`` or ``both``.
        wait: delay τ from a measurement to its command [s], as in `CoupledLoops`.

    Raises:
        InputError: unknown name.
    """
    plants = {"approximate": None, "full": FULL_W1}
    for what, name, known in (
        ("preset", preset, PRESETS), ("force plant", force_plant, plants), ("connection", connection, CONNECTIONS)
    ):  # fmt: skip
        if name not in known:
            raise InputError(f"coupled loops: {what} {name!r}; allowed: {', '.join(known)}")
    model = PRESETS[preset]
    full = plants[force_plant]
    k1, k2 = (k if on else None for k, on in zip(compensators(model), CONNECTIONS[connection], strict=True))
    return CoupledLoops(replace(model, w1=full) if full else model, k1, k2, wait=wait)


def faster(transfer: TransferFunction, factor: float) -> TransferFunction:
    """Return the transfer function with all its frequencies multiplied by ``factor``."""

    def scaled(part: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(np.array(part) / factor ** np.arange(len(part))[::-1])

    return TransferFunction(scaled(transfer.numerator), scaled(transfer.denominator))


def with_errors(known: CoupledLoops, factors: tuple[float, ...] = (0.5, 1.5)) -> Iterator[tuple[str, CoupledLoops]]:
    """Yield the loops with one plant parameter off by each factor and the compensators unchanged.

    Yields:
        A name such as ``w3_frequency x 0.5``, and the loops with this error.
    """
    true = known.channels
    for factor in factors:
        off = {
            "w1": {"w1": true.w1 * gain(factor)},
            "w2": {"w2": true.w2 * gain(factor)},
            "w4": {"w4": true.w4 * gain(factor)},
            "w3": {"w3": true.w3 * gain(factor)},
            "w3_frequency": {"w3": faster(true.w3, factor)},
        }
        for name, changed in off.items():
            yield f"{name} x {factor:g}", replace(known, channels=replace(true, **changed))
