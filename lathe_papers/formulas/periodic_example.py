# SPDX-License-Identifier: Apache-2.0
"""Simulation runs of the example of paper 002: one drive of the box, from rest, evaluated period by period."""

from dataclasses import dataclass

import numpy as np

from lathe_machine.control.periodic import PRESETS, PeriodicController, PeriodicGains, samples_in
from lathe_machine.signals.example_002 import PERIOD
from lathe_machine.transfer import LinearSystem
from lathe_papers.formulas.hyperstability import plant, required_input
from lathe_papers.formulas.periodic_loop import PeriodicLoop, disturbance, steady_derivatives, transient
from lathe_rc.arrays import Array

SHOWN = 3  #: number of periods in the curves
_POINTS = 250  # points per period in the curves
_SETTLING = 4  # periods until the drive without the loop settles


def times(step: float) -> Array:
    """Return the sample times of the first period [s]; ``step`` in s.

    Raises:
        InputError: the period is not a whole number of steps.
    """
    return np.asarray(np.arange(samples_in(PERIOD, step)) * step, dtype=np.float64)


def ideal_input(drives: Array, time: Array) -> Array:
    """Return u° of each drive in a steady period, shape (m, n).

    ``drives`` has the shape (m, 5); ``time`` is in s, shape (n,).
    """
    return required_input(drives, steady_derivatives(time), disturbance(time))


@dataclass(frozen=True, kw_only=True)
class Case:
    """Parameters of one run of the example.

    Attributes:
        periods: number of periods.
        step: sampling step [s].
        s0: limit of the input.
        memory_filter: width σ of the memory filter [s].
        anti_windup: False for the switch of the paper.
        quantisation: quantisation step of y and u; 0 for none.
        gains: gains of the law.
    """

    periods: int
    step: float
    s0: float = 2.0
    memory_filter: float = 0.1
    anti_windup: bool = True
    quantisation: float = 0.0
    gains: PeriodicGains = PRESETS["published"]


@dataclass(frozen=True)
class ExampleOutcome:
    """Results of one run of the example.

    Attributes:
        period_max_error: largest |r - y| in each period, shape (periods,).
        period_integral: eq. 15 at the end of each period, shape (periods,) [s].
        curves: time, r, y, S(u) and f of the first periods, shape (5, points) [s, 1].
        controller: controller state after the last period.
    """

    period_max_error: Array
    period_integral: Array
    curves: Array
    controller: PeriodicController


def simulate(case: Case, drive: Array) -> ExampleOutcome:
    """Simulate the example from rest.

    Args:
        case: parameters of the run.
        drive: K, a1 ... a4, shape (5,).

    Raises:
        InputError: the period is not a whole number of steps, or the law rejects a parameter.
    """
    time = times(case.step)
    controller = PeriodicController(
        case.gains,
        period=PERIOD,
        limit=case.s0,
        step_s=case.step,
        memory_filter=case.memory_filter,
        anti_windup=case.anti_windup,
        measurement_step=case.quantisation,
        command_step=case.quantisation,
        ideal=ideal_input(drive[None], time)[0],
    )
    loop = PeriodicLoop(controller, plant(drive))
    # The load acts from one sample to the next, so its midpoint value equals its mean to second order.
    steady, load = steady_derivatives(time)[0], disturbance(time + case.step / 2.0)
    errors, integrals = np.empty((2, case.periods))
    output, command = np.empty((2, time.size))
    curves = []
    for period in range(case.periods):
        at = time + period * PERIOD
        wanted = steady + transient(at)
        loop.block(period * time.size, wanted, load, output, command)
        errors[period] = np.abs(wanted - output).max()
        integrals[period] = controller.popov_integral
        if period < SHOWN:
            every = max(time.size // _POINTS, 1)
            curves.append(np.stack((at, wanted, output, command, disturbance(at)))[:, ::every])
    return ExampleOutcome(errors, integrals, np.concatenate(curves, axis=1), controller)


def limited_ideal_error(drive: Array, limit: float, step: float) -> float:
    """Return the largest steady |r - y| of a drive with input u° limited to ±``limit``; ``step`` in s."""
    time = times(step)
    load, wanted = disturbance(time), steady_derivatives(time)[0]
    machine, output = LinearSystem(plant(drive), step), np.empty(time.size)
    given = ideal_input(drive[None], time)[0].clip(-limit, limit) + load
    for _ in range(_SETTLING):
        machine.block(given, output)
    return float(np.abs(wanted - output).max())
