# SPDX-License-Identifier: Apache-2.0
"""Sample-by-sample simulation of the coupled force and position loops of paper 004.

It adds the effects that the linear system of `lathe_papers.formulas.coupled_loops` omits: limits of the controllers and
of the drives, converters, smooth set points, and a delay of whole samples from a measurement to its command.
Controllers and compensators use the same arithmetic as the cell. The plant is discretised exactly with a zero-order
hold of commands and noise.
"""

from typing import NamedTuple

import control
import numpy as np

from lathe_machine.control.decoupler import Decoupler, DecouplerTable, decouple
from lathe_machine.control.pid import Pid, PidTable
from lathe_machine.control.pid import control as command_of
from lathe_papers.formulas.coupled_loops import CoupledLoops, plant
from lathe_rc.arrays import Array
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel

STEP = 50e-6  #: sampling step of the simulation in paper 004 [s]


class PlantTable(NamedTuple):
    """Discrete plant x[n+1] = Φ·x[n] + Γ·(v1, v2, noise)[n]; (F, y)[n] = c·x[n] + d·noise[n].

    Attributes:
        transition: state transition matrix Φ, shape (m, m).
        weights: input matrix Γ, shape (m, 3).
        output: output matrix c, shape (2, m).
        through: feedthrough d of the noise, shape (2,).
        delay: delay from a measurement to its command [samples].
        limit: limit of v1 and v2.
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
    decoupler: DecouplerTable,
    first: int,
    force_set: Array,
    position_set: Array,
    noise: Array,
    force: Array,
    position: Array,
    v1: Array,
    v2: Array,
) -> int:
    """Simulate one block and return the number of commands limited by the drives.

    ``state`` holds x and space for the next x; ``line`` is a ring buffer of F and y, with sample n at n modulo its
    length.
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
        w1, w2 = decouple(decoupler, u1, u2)
        v1[k], v2[k] = min(max(w1, -table.limit), table.limit), min(max(w2, -table.limit), table.limit)
        cut += (v1[k] != w1) + (v2[k] != w2)
        for row in range(order):
            value = table.weights[row, 0] * v1[k] + table.weights[row, 1] * v2[k] + table.weights[row, 2] * noise[k]
            for column in range(order):
                value += table.transition[row, column] * state[column]
            state[order + row] = value
        # The next x is copied only now, because each of its rows depends on the complete old x.
        for row in range(order):
            state[row] = state[order + row]
    return cut


class CoupledSimulation:
    """Simulation of the coupled force and position loops, at rest at 0 before sample 0.

    Args:
        loops: plant, gains and compensators; their ``wait`` gives the delay in samples.
        step: sampling step [s].
        limit: limit of u1, u2, v1 and v2; infinite for none.
        adc: quantisation steps of the force [N] and position [m] converters; 0 for none.
        dac: quantisation step of both command converters [1]; 0 for none.
        ramp: maximum rate of the force set point [N/s]; 0 for no limit.
        smoothing: time constant of the smoothed force set point [s]; 0 for none.

    Attributes:
        force_pid, position_pid: the controllers, with their counters.
        cut: number of commands limited by the drives so far.

    Raises:
        InputError: the delay is not a whole number of samples, or the plant responds within the same sample.
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
        # The kernel measures before it commands, so no command may affect the measurement of its own sample.
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
        """Simulate one block starting at sample ``first``; arrays of shape (n,), the last four are outputs.

        Args:
            first: index of the first sample.
            force_set: set point of the force [N].
            position_set: set point of the position [m].
            noise: n, disturbance force from outside the loops [N].
            force: filled with the force F [N].
            position: filled with the position y [m].
            v1: filled with the command of the longitudinal feed [1].
            v2: filled with the command of the cross feed [1].
        """
        pid1, pid2 = self.force_pid, self.position_pid
        self.cut += _advance(
            self._table, self._state, self._line, pid1.table, pid2.table, pid1.state, pid2.state,
            self._decoupler.table, first, force_set, position_set, noise, force, position, v1, v2,
        )  # fmt: skip
