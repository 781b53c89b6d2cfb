# SPDX-License-Identifier: Apache-2.0
"""The one-channel loop as a Drake diagram, run on request: settings on the first line of stdin, then a line a run.

Everything that Drake has is taken from it, and is C++: integrator, expression, delay, difference equation, sums, log.
The repetitive controller is a block of our own, in Python as pydrake wants it; its memory is an attribute instead of a
Drake state, which would be copied at every step. It runs where pydrake is installed and needs nothing of lathe_rc.
"""

# mypy: disable-error-code="import-not-found"

import json
import sys
import time
from collections.abc import Sequence
from math import ceil, floor, pi
from typing import Any

import numpy as np
import numpy.typing as npt
import pydrake.symbolic as sym
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, EventStatus, LeafSystem
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    DiscreteTimeDelay,
    DiscreteTimeIntegrator,
    Gain,
    LinearSystem,
    LogVectorOutput,
    SymbolicVectorSystem,
)

Array = npt.NDArray[np.float64]


def _cubic(points: Sequence[float], u: float) -> float:
    """Lagrange cubic through four equidistant points at ``u`` in [0, 1] between the middle two."""
    before, left, right, after = points
    c1 = right - before / 3.0 - left / 2.0 - after / 6.0
    c2 = (before + right) / 2.0 - left
    c3 = (after - before) / 6.0 + (left - right) / 2.0
    return left + u * (c1 + u * (c2 + u * c3))


class Repetitive(LeafSystem):  # type: ignore[misc]  # pydrake has no types here
    """M(φ) = Q·M(φ - 2π) + δ(φ), read at φ - 2π + λ."""

    def __init__(self, settings: dict[str, Any]) -> None:
        super().__init__()
        self._grid: int = settings["grid"]
        self._per_radian, self._lead = self._grid / (2.0 * pi), settings["speed"] * settings["lead_time"]
        self._turn: list[float] = [0.0] * self._grid  # what is learned in this revolution
        self._past = list(self._turn)  # of the one before
        self._smooth = list(self._turn)  # Q of that
        width = settings["q_time"] * settings["speed"] * self._per_radian
        waves = 2.0 * np.sin(np.pi * np.arange(self._grid // 2 + 1) / self._grid)
        self._q = 1.0 / (1.0 + (width * waves) ** 2)
        self._next = 0
        self._angles, self._errors = [0.0] * 4, [0.0] * 4
        self._angle = self.DeclareVectorInputPort("angle", 1)
        self._error = self.DeclareVectorInputPort("error", 1)
        self.DeclareVectorOutputPort("command", 1, self._command, {self.input_port_ticket(self._angle.get_index())})
        self.DeclarePeriodicPublishEvent(settings["step"], 0.0, self._learn)

    def _at(self, point: int) -> float:
        """The memory a revolution before a grid point."""
        turn, place = divmod(point, self._grid)
        return self._turn[place] if turn == self._next // self._grid + 1 else self._past[place]

    def _command(self, context: Context, output: BasicVector) -> None:
        place = (self._angle.Eval(context)[0] + self._lead) * self._per_radian
        i = floor(place)
        output.SetAtIndex(0, _cubic([self._at(point) for point in range(i - 1, i + 3)], place - i))

    def _learn(self, context: Context) -> EventStatus:
        angles, errors = self._angles, self._errors
        del angles[0], errors[0]
        angles.append(self._angle.Eval(context)[0])
        errors.append(self._error.Eval(context)[0])
        if not angles[2] > angles[1]:
            return EventStatus.DidNothing()
        while (at := self._next / self._per_radian) <= angles[2]:
            place = self._next % self._grid
            self._turn[place] = self._smooth[place] + _cubic(errors, (at - angles[1]) / (angles[2] - angles[1]))
            self._next += 1
            if place == self._grid - 1:
                self._past, self._turn = self._turn, [0.0] * self._grid
                self._smooth = np.fft.irfft(np.fft.rfft(self._past) * self._q, self._grid).tolist()
        return EventStatus.Succeeded()


def _drive(settings: dict[str, Any]) -> LinearSystem:
    """x[n] = Φ·x[n-1] + w0·v[n] + w1·v[n-1] + w2·v[n-2] for v, the command delayed by whole samples less one."""
    transition, weights = np.array(settings["transition"]), np.array(settings["weights"])
    # The states are x[n-1], v[n-1], v[n-2]; the delay before it is one shorter, as the output stands a step later.
    a = np.zeros((4, 4))
    a[:2, :2], a[:2, 2:], a[3, 2] = transition, weights[:, 1:], 1.0
    b = np.concatenate((weights[:, 0], [1.0, 0.0]))[:, None]
    return LinearSystem(a, b, np.eye(1, 4), np.zeros((1, 1)), settings["step"])


def build(settings: dict[str, Any]) -> tuple[Any, Any]:
    """The diagram, and the log of the form error in it."""
    step = settings["step"]
    make = DiagramBuilder()
    add, connect = make.AddSystem, make.Connect
    angle = add(DiscreteTimeIntegrator(1, step))
    phi = sym.Variable("phi")
    form = add(SymbolicVectorSystem(input=[phi], output=[settings["amplitude"] * sym.sin(settings["order"] * phi)]))
    controller = add(Repetitive(settings))
    delay = add(DiscreteTimeDelay(step, settings["delay"] - 1, 1))
    drive, minus, error = add(_drive(settings)), add(Gain(-1.0, 1)), add(Adder(2, 1))
    connect(add(ConstantVectorSource([settings["speed"]])).get_output_port(), angle.get_input_port())
    connect(angle.get_output_port(), form.get_input_port())
    connect(angle.get_output_port(), controller.GetInputPort("angle"))
    connect(controller.get_output_port(), delay.get_input_port())
    connect(delay.get_output_port(), drive.get_input_port())
    connect(drive.get_output_port(), minus.get_input_port())
    connect(form.get_output_port(), error.get_input_port(0))
    connect(minus.get_output_port(), error.get_input_port(1))
    connect(error.get_output_port(), controller.GetInputPort("error"))
    log = LogVectorOutput(error.get_output_port(), make, step)
    return make.Build(), log


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Wall time of a run [s], and the form error of each of its samples [m]."""
    diagram, log = build(settings)
    simulator = Simulator(diagram)
    simulator.Initialize()
    start = time.perf_counter()
    simulator.AdvanceTo((settings["samples"] - 1) * settings["step"])
    seconds = time.perf_counter() - start
    found: Array = log.FindLog(simulator.get_context()).data()[0]
    per_turn = ceil(2.0 * pi / (settings["speed"] * settings["step"]))
    rms = [float(np.sqrt(np.mean(turn**2))) for turn in np.split(found, range(per_turn, found.size, per_turn))]
    return {"seconds": seconds, "samples": found.size, "rms_m": rms}


def main() -> None:
    """Answer requests until there are no more."""
    settings = json.loads(sys.stdin.readline())
    for _ in sys.stdin:
        print(json.dumps(run(settings)), flush=True)


if __name__ == "__main__":
    main()
