# SPDX-License-Identifier: Apache-2.0
"""The coupled force and position loops of paper 004, sample by sample.

What the linear system of `lathe_papers.formulas.coupled_loops` leaves out: limits at the controllers and again at the
drives, converters, set points that rise smoothly, and a delay of whole samples from a measurement to its command. The
arithmetic of controllers and compensators is that of the cell. The plant is exact for commands and noise that are held
between samples.
"""

from typing import NamedTuple

import control
import numpy as np
import numpy.typing as npt

from lathe_papers.formulas.coupled_loops import CoupledLoops, plant
from lathe_rc.control.decoupler import Decoupler, decouple
from lathe_rc.control.pid import Pid, PidTable
from lathe_rc.control.pid import control as command_of
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.transfer import System

Array = npt.NDArray[np.float64]

STEP = 50e-6  #: of the simulation in paper 004 [s]


class PlantTable(NamedTuple):
    """x[n+1] = Φ·x[n] + Γ·(v1, v2, noise)[n]; (F, y)[n] = c·x[n] + d·noise[n].

    Attributes:
        transition: Φ, shape (m, m).
        weights: Γ, shape (m, 3).
        output: c, shape (2, m).
        through: d, shape (2,).
        delay: samples from a measurement to its command.
        limit: of v1 and v2.
    """

    transition: Array
    weights: Array
    output: Array
    through: Array
    delay: int
    limit: float


@kernel
def _advance(
    table: PlantTable,
    state: Array,
    line: Array,
    pid1: PidTable,
    pid2: PidTable,
    memory1: Array,
    memory2: Array,
    k1: System,
    k2: System,
    lag1: Array,
    lag2: Array,
    first: int,
    force_set: Array,
    position_set: Array,
    noise: Array,
    force: Array,
    position: Array,
    v1: Array,
    v2: Array,
) -> int:
    """Step through a block; returns how many commands the drives have cut off.

    ``state`` is x and room for the next x; ``line`` is a ring of F and y, sample n at n modulo its length.
    """
    order, size = table.transition.shape[0], line.shape[1]
    cut = 0
    # Sums are written out: a product with @ would allocate, and its order of additions depends on the BLAS.
    for k in range(force.size):
        n = first + k
        for row in range(2):
            value = table.through[row] * noise[k]
            for column in range(order):
                value += table.output[row, column] * state[column]
            line[row, n % size] = value
        force[k], position[k] = line[0, n % size], line[1, n % size]
        seen = (n - table.delay) % size
        u1 = command_of(pid1, memory1, n, force_set[k], line[0, seen])
        u2 = command_of(pid2, memory2, n, position_set[k], line[1, seen])
        w1, w2 = decouple(k1, lag1, k2, lag2, u1, u2)
        v1[k], v2[k] = min(max(w1, -table.limit), table.limit), min(max(w2, -table.limit), table.limit)
        cut += (v1[k] != w1) + (v2[k] != w2)
        for row in range(order):
            value = table.weights[row, 0] * v1[k] + table.weights[row, 1] * v2[k] + table.weights[row, 2] * noise[k]
            for column in range(order):
                value += table.transition[row, column] * state[column]
            state[order + row] = value
        # Only now: every row of the next x is made of the whole old one.
        for row in range(order):
            state[row] = state[order + row]
    return cut


class CoupledSimulation:
    """Both loops, at rest at 0 before sample 0.

    Args:
        loops: plant, gains and compensators; their ``wait`` is the number of samples of delay.
        step: sampling step [s].
        limit: of u1, u2, v1 and v2; infinite for none.
        adc: steps of the converters of force [N] and position [m]; 0 for none.
        dac: step of both converters of the commands [1]; 0 for none.
        ramp: fastest change of the force's set point [N/s]; 0 for any.
        smoothing: time constant with which it is approached [s]; 0 for at once.

    Attributes:
        force_pid, position_pid: the controllers, with their counts.
        cut: commands so far that the drives have cut off.

    Raises:
        InputError: a delay that is no whole number of samples, or a plant that answers within a sample.
    """

    def __init__(
        self,
        loops: CoupledLoops,
        step: float = STEP,
        *,
        limit: float = 1.0,
        adc: tuple[float, float] = (0.0, 0.0),
        dac: float = 0.0,
        ramp: float = 0.0,
        smoothing: float = 0.0,
    ) -> None:
        delay = round(loops.wait / step)
        if abs(loops.wait - delay * step) > 1e-6 * step:
            raise InputError(
                f"coupled loops: delay {loops.wait:g} s is {loops.wait / step:g} samples of {step:g} s; "
                "allowed: a whole number of samples"
            )
        continuous = plant(loops.channels)
        # The kernel measures before it commands, so no command may reach the measurement of its own sample.
        if np.any(continuous.D[:, :2]):
            raise InputError("coupled loops: a command acts on a measurement at once; allowed: W1 and W2 with a lag")
        system = control.c2d(continuous, step, "zoh")
        a, b, c, d = (np.ascontiguousarray(part, dtype=np.float64) for part in control.ssdata(system))
        self._table = PlantTable(a, b, c, np.ascontiguousarray(d[:, 2]), delay, float(limit))
        self._state = np.zeros(2 * system.nstates)
        self._line = np.zeros((2, delay + 1))
        self.force_pid = Pid(
            loops.force, low=-limit, high=limit, step=step, adc=adc[0], dac=dac, ramp=ramp, smoothing=smoothing
        )
        self.position_pid = Pid(loops.position, low=-limit, high=limit, step=step, adc=adc[1], dac=dac)
        self._decoupler = Decoupler(loops.k1, loops.k2, step)
        self.cut = 0

    def block(
        self,
        first: int,
        force_set: Array,
        position_set: Array,
        noise: Array,
        force: Array,
        position: Array,
        v1: Array,
        v2: Array,
    ) -> None:
        """Step from sample ``first`` on; arrays of shape (n,), the last four filled.

        Args:
            first: index of the first sample.
            force_set: [N].
            position_set: [m].
            noise: n, force that the loops do not make [N].
            force: F [N].
            position: y [m].
            v1: command of the longitudinal feed [1].
            v2: command of the cross feed [1].
        """
        pid1, pid2, both = self.force_pid, self.position_pid, self._decoupler
        self.cut += _advance(
            self._table, self._state, self._line, pid1.table, pid2.table, pid1.state, pid2.state,
            both.k1, both.k2, both.state1, both.state2,
            first, force_set, position_set, noise, force, position, v1, v2,
        )  # fmt: skip
