# SPDX-License-Identifier: Apache-2.0
"""Set point of a servo controller, over time."""

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from lathe_rc import resources
from lathe_rc.arrays import put
from lathe_rc.cell.parameters import NodeParameters, NonNegative, about, parameter
from lathe_rc.errors import InputError
from lathe_rc.jit import kernel
from lathe_rc.messages import MAX_BLOCK, Samples
from lathe_rc.signals.example_002 import fill_reference
from lathe_rc.signals.table import read_table


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


class Course(NamedTuple):
    """Precomputed samples of a set point, for kernels.

    Attributes:
        values: samples computed in advance.
        span: index of the first sample, and of the one after the last.
    """

    values: Samples
    span: npt.NDArray[np.int64]


@kernel
def follow(course: Course, first: int, set_point: Samples) -> None:
    """Fill the set point, shape (n,), from prepared samples starting at ``first``."""
    begin = first - course.span[0]
    put(set_point, course.values[begin : begin + set_point.size])


class Trajectory:
    """Set point of a node.

    Args:
        node: name of the node.
        parameters: parameter table of the node.

    Attributes:
        course: samples for `follow`.

    Raises:
        InputError: lists differ in length, times do not increase, or a file cannot be used.
    """

    def __init__(self, node: str, parameters: TrajectoryParameters) -> None:
        self._step, self._kind = parameters.step, parameters.trajectory
        values = parameters.set_point or [0.0]
        times = parameters.set_point_time or [0.0] * min(len(values), 1)
        if self._kind == "csv":
            if not parameters.trajectory_file:
                raise InputError(f"{node}.trajectory_file is empty; name the CSV file of the trajectory")
            path = resources.find(Path(parameters.trajectory_file))
            force = type(parameters).rows()["set_point"].unit == "N"
            column, scale = ("force_n", 1.0) if force else ("position_um", 1e-6)
            with about(node, "trajectory_file"):
                _, rows = read_table(path, [("time_s", column)], "trajectory")
            times, values = rows[:, 0].tolist(), (rows[:, 1] * scale).tolist()
        if len(values) != len(times):
            raise InputError(
                f"{node}.set_point, set_point_time: {len(values)} values and {len(times)} times; give as many of each"
            )
        self._times, self._values = np.array(times), np.array(values)
        if not self._times.size or np.any(np.diff(self._times) <= 0.0):
            where = "trajectory_file" if self._kind == "csv" else "set_point_time"
            raise InputError(f"{node}.{where}: {times[:5]} s; allowed: one time or more, each later than the last")

        self.course = Course(np.empty(MAX_BLOCK), np.zeros(2, np.int64))

    def doubts(self, seconds: float) -> list[str]:
        """Return a one-line warning if a file begins after the end of a run of ``seconds``."""
        if self._kind != "csv" or self._times[0] < seconds:
            return []
        start = f"trajectory_file begins at {self._times[0]:.10g} s, after the end of the run at {seconds:.5g} s"
        return [f"{start}: the set point is its first value throughout; times count from the start of the run"]

    def prepare(self, first: int, samples: int) -> None:
        """Prepare up to 8192 samples starting at ``first``."""
        values, span = self.course
        if not span[0] <= first <= first + samples <= span[1]:
            self.block(first, values[:samples])
            span[:] = first, first + samples

    def block(self, first: int, set_point: Samples) -> None:
        """Fill the set point, shape (n,), for samples starting at ``first``."""
        if self._kind == "paper_002":
            fill_reference(first, self._step, set_point)
            return
        if self._kind == "steps" and first * self._step >= self._times[-1]:
            set_point.fill(self._values[-1])  # the last value, held for the rest of the run
            return
        time = self._step * np.arange(first, first + set_point.size)
        if self._kind == "csv":
            set_point[:] = np.interp(time, self._times, self._values)
            return
        # The factor prevents a step from starting one sample late because of a rounding error.
        place = np.searchsorted(self._times, time * (1 + 1e-12), side="right")
        set_point[:] = np.where(place > 0, self._values[place - 1], 0.0)
