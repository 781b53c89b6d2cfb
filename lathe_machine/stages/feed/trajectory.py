# SPDX-License-Identifier: Apache-2.0
"""Set point of a servo controller, over time."""

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from lathe_machine.signals.example_002 import fill_reference
from lathe_rc import resources
from lathe_rc.cell.parameters import NodeParameters, NonNegative, about, parameter
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples


class TrajectoryParameters(NodeParameters):
    """Parameters of a set point over time."""

    trajectory: Literal["steps", "csv", "paper_002"] = parameter(
        "steps", "steps: set_point; csv: trajectory_file; paper_002: r(t) of its eq. 17"
    )
    set_point: list[float] = parameter([], "steps: values, each from its time on; empty: 0", "m")
    set_point_time: list[NonNegative] = parameter([], "steps: when; empty: a single one at 0", "s")
    trajectory_file: str = parameter(
        "", "csv: file with time_s and position_um or force_n, linear between and held at the ends", path=True
    )


_STEPS, _LINEAR, _PAPER_002 = range(3)  # kinds of a course
_KINDS = {"steps": _STEPS, "csv": _LINEAR, "paper_002": _PAPER_002}
_ROUNDED = 1 + 1e-12  # prevents a step from starting one sample late because of a rounding error


class Course(NamedTuple):
    """Set point over time, for kernels.

    Attributes:
        kind: steps, linear between points, or r(t) of paper 002.
        step: sampling step [s].
        times: times of the steps or points [s], increasing, shape (n,).
        values: set points from these times on, or at these times, shape (n,).
    """

    kind: int
    step: float
    times: Samples
    values: Samples


@kernel
def follow(course: Course, first: int, set_point: Samples) -> None:
    """Fill the set point, shape (n,), of the samples starting at ``first``."""
    if course.kind == _PAPER_002:
        fill_reference(first, course.step, set_point)
        return
    times, values = course.times, course.values
    stretch = _ROUNDED if course.kind == _STEPS else 1.0
    past = np.searchsorted(times, course.step * first * stretch, side="right")
    for k in range(set_point.size):
        time = course.step * (first + k)
        while past < times.size and times[past] <= time * stretch:
            past += 1
        if past == 0:
            set_point[k] = 0.0 if course.kind == _STEPS else values[0]
        elif course.kind == _STEPS or past == times.size or times[past - 1] == time:
            set_point[k] = values[past - 1]
        else:
            slope = (values[past] - values[past - 1]) / (times[past] - times[past - 1])
            set_point[k] = slope * (time - times[past - 1]) + values[past - 1]


class Trajectory:
    """Set point of a node.

    Args:
        node: name of the node.
        parameters: parameter table of the node.

    Attributes:
        course: set point for `follow`.

    Raises:
        InputError: lists differ in length, times do not increase, or a file cannot be used.
    """

    def __init__(self, node: str, parameters: TrajectoryParameters) -> None:
        self._kind = parameters.trajectory
        values = parameters.set_point or [0.0]
        times = parameters.set_point_time or [0.0] * min(len(values), 1)
        if self._kind == "csv":
            if not parameters.trajectory_file:
                raise InputError(f"{node}.trajectory_file is empty; name the CSV file of the trajectory")
            from lathe_rc.signals import measurement_file  # which a cell without files need not import

            path = resources.find(Path(parameters.trajectory_file))
            force = type(parameters).rows()["set_point"].unit == "N"
            with about(node, "trajectory_file"):
                found = measurement_file.read(path).read("time", "force" if force else "position")
                measurement_file.check_rising(found[0], path)
            times, values = (array.tolist() for array in found)
        if len(values) != len(times):
            raise InputError(
                f"{node}.set_point, set_point_time: {len(values)} values and {len(times)} times; give as many of each"
            )
        course = Course(
            _KINDS[self._kind], parameters.step, np.array(times, dtype=float), np.array(values, dtype=float)
        )
        if not course.times.size or np.any(np.diff(course.times) <= 0.0):
            raise InputError(
                f"{node}.set_point_time: {times[:5]} s; allowed: one time or more, each later than the last"
            )
        self.course = course

    def doubts(self, seconds: float) -> list[str]:
        """Return a one-line warning if a file begins after the end of a run of ``seconds``."""
        if self._kind != "csv" or self.course.times[0] < seconds:
            return []
        start = f"trajectory_file begins at {self.course.times[0]:.10g} s, after the end of the run at {seconds:.5g} s"
        return [f"{start}: the set point is its first value throughout; times count from the start of the run"]
