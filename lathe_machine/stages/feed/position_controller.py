# SPDX-License-Identifier: Apache-2.0
"""Position controller of a slide: PID, sampled link, or the periodic law."""

from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from annotated_types import Gt, Le

from lathe_machine.control import periodic
from lathe_machine.control.periodic import PRESETS, PeriodicController, PeriodicLaw, PeriodicState
from lathe_machine.control.pid import POSITION, Pid, PidTable
from lathe_machine.control.predistortion import PathTable, Predistortion, offset_along
from lathe_machine.control.sampled_link import HeldLink, SampledLink, correct_along
from lathe_machine.signals.example_002 import PERIOD
from lathe_machine.stages.common.obedience import OBEY, Listener, apply, listens, may_learn, piece
from lathe_machine.stages.common.tables import made_of
from lathe_machine.stages.feed.feed_drive import Axis
from lathe_machine.stages.feed.servo import Servo, ServoParameters, pid_along
from lathe_machine.stages.feed.trajectory import Course, follow
from lathe_rc import messages, resources
from lathe_rc.arrays import Integers
from lathe_rc.blocks.ports import CLOCK, Input, Output, Sparse
from lathe_rc.cell.parameters import NonNegative, Positive, about, parameter
from lathe_rc.cell.stage import DONE, Fields, Reached
from lathe_rc.compiled.step import Step
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples


class PositionControllerParameters(ServoParameters):
    """Parameters of the control law; PID defaults are those of paper 004, Fig. 11."""

    axis: Axis = parameter("cross", "which slide; the first word of its topics")
    law: Literal["pid", "sampled_link", "periodic_hyperstable"] = parameter(
        "pid", "pid: paper 004; sampled_link: paper 003; periodic_hyperstable: paper 002"
    )
    measures: Literal["slide", "edge"] = parameter(
        "slide", "slide: its position; edge: with the deflection by the cutting force, as in paper 004"
    )
    predistortion_file: str = parameter(
        "",
        "CSV file with height_mm,offset_um, added to the set point at the height of the longitudinal slide",
        path=True,
    )
    proportional: float = parameter(POSITION.proportional, "pid: proportional gain P", "1/m")
    integral: float = parameter(POSITION.integral, "pid: integral gain I", "1/(m*s)")
    derivative: float = parameter(POSITION.derivative, "pid: derivative gain D", "s/m")
    derivative_filter: Positive = parameter(POSITION.filter, "pid: N, where D ends", "rad/s")
    link: Literal["ripple_free", "paper"] = parameter(
        "ripple_free", "sampled_link: ripple_free, or the paper's, which rings between the samples"
    )
    link_gain: Positive = parameter(6.25, "sampled_link: K of the drive", "1/s", drive="gain")
    link_lag: Positive = parameter(0.08, "sampled_link: T1 of the drive", "s", drive="lag")
    link_knows_delay: bool = parameter(
        default=True, doc="sampled_link: the ripple-free link is made for the feedback delay"
    )
    periodic_gains: Literal["published", "quantised"] = parameter(
        "published", "periodic_hyperstable: gains of eqs 20 and 21, or those that survive a quantised measurement"
    )
    periodic_unit: Positive = parameter(
        1.0, "periodic_hyperstable: displacement that the law takes for 1; it has numbers without a unit", "m"
    )
    period: Annotated[float, Gt(0), Le(3600)] = parameter(
        PERIOD, "periodic_hyperstable: of set point and disturbance", "s"
    )
    memory_filter: NonNegative = parameter(
        0.1,
        "periodic_hyperstable: standard deviation of the zero-phase filter on the memory; 0: none, as published",
        "s",
    )
    anti_windup: bool = parameter(default=True, doc="periodic_hyperstable: false: the published switch alone")

    @property
    def commanded_topic(self) -> str:
        """Topic of the drive described by the model, before remapping."""
        return f"{self.axis}/command"


_NO_PATH = PathTable(np.empty(0), np.empty(0), np.zeros(1, np.int64))
_PERIODS = 64  # rows of the log until it is read
_TOLD = 1  # stop reason of the step function: the log is full


class Wanted(NamedTuple):
    """Controlled quantity, for the step functions of all laws.

    Attributes:
        course: samples of the set point.
        path: path subtracted from the set point; without heights, there is no path.
        edge, height: indices of the inputs with the deflection of the edge and with the height; 0 if there is none.
        who: obedience to the supervisor, if any.
    """

    course: Course
    path: PathTable
    edge: int
    height: int
    who: Listener


class PidMemory(NamedTuple):
    """State of the PID's step function."""

    wanted: Wanted
    pid: PidTable
    state: Samples


class LinkMemory(NamedTuple):
    """State of the sampled link's step function."""

    wanted: Wanted
    link: HeldLink


class PeriodicMemory(NamedTuple):
    """State of the periodic law's step function.

    Attributes:
        wanted: controlled quantity.
        law, state: table and state of the law.
        unit: displacement that corresponds to 1 in the law [m].
        divisor: number of samples between two computations.
        held: held command, and largest error in the period [m].
        log: for each period, the sample after it, the largest error, and the results of `periodic.achieved`.
        logged: number of rows in the log, shape (1,).
    """

    wanted: Wanted
    law: PeriodicLaw
    state: PeriodicState
    unit: float
    divisor: int
    held: Samples
    log: Samples
    logged: Integers


@kernel
def _look(wanted: Wanted, first: int, start: int, inputs: Fields, set_point: Samples, error: Samples) -> Samples:
    """Return the controlled position [m]; fill set point and error at the start of a block."""
    position = inputs[1]
    if wanted.edge:
        # The slide is positive into the part, the deflection out of the part.
        position = position - inputs[wanted.edge]
    if start == 0:
        follow(wanted.course, first, set_point)
        if wanted.height:
            offset = np.empty(position.size)
            offset_along(wanted.path, inputs[wanted.height], offset)
            set_point -= offset
        for k in range(error.size):
            error[k] = set_point[k] - position[k]
    return position


@kernel
def pid_step(memory: PidMemory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Control the position through one block by the PID."""
    command, set_point, error = outputs
    position = _look(memory.wanted, first, start, inputs, set_point, error)
    return pid_along(memory.pid, memory.state, memory.wanted.who, first, start, flags[0], set_point, position, command)


@kernel
def link_step(memory: LinkMemory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Control the position through one block by the sampled link, which does not learn."""
    command, set_point, error = outputs
    position, who = _look(memory.wanted, first, start, inputs, set_point, error), memory.wanted.who
    while start < command.size:
        stop = piece(who, start, command.size, flags[0])
        if stop == start:
            return start, OBEY
        correct_along(memory.link, first + start, set_point[start:stop], position[start:stop], command[start:stop])
        apply(who, command[start:stop])
        start = stop
    return start, DONE


@kernel
def _repeat(
    memory: PeriodicMemory, first: int, start: int, stop: int, set_point: Samples, position: Samples,
    error: Samples, command: Samples,
) -> int:  # fmt: skip
    """Step the periodic law through a segment; return the sample reached, the end unless the log is full."""
    held, divisor, unit = memory.held, memory.divisor, memory.unit
    period = memory.law.samples * divisor
    for k in range(start, stop):
        n = first + k
        if n % divisor == 0:
            held[0] = periodic.advance(memory.law, memory.state, n // divisor, set_point[k] / unit, position[k] / unit)
        command[k] = held[0]
        held[1] = max(held[1], abs(error[k]))
        if (n + 1) % period == 0:
            # A log, since a kernel cannot publish; the step function stops when the log is full, and a host that does
            # not read the log then begins it anew.
            memory.logged[0] %= memory.log.shape[0]
            row = memory.log[memory.logged[0]]
            row[0], row[1] = n + 1, held[1]
            periodic.achieved(memory.state, row[2:])
            held[1] = 0.0
            memory.logged[0] += 1
            if memory.logged[0] == memory.log.shape[0]:
                return k + 1
    return stop


@kernel
def periodic_step(
    memory: PeriodicMemory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields
) -> Reached:
    """Control the position through one block by the periodic law."""
    command, set_point, error = outputs
    position, who = _look(memory.wanted, first, start, inputs, set_point, error), memory.wanted.who
    while start < command.size:
        stop = piece(who, start, command.size, flags[0])
        if stop == start:
            return start, OBEY
        if who.listens:
            periodic.freeze(memory.state, not may_learn(who))
        reached = _repeat(memory, first, start, stop, set_point, position, error, command)
        apply(who, command[start:reached])
        start = reached
        if memory.logged[0] == memory.log.shape[0]:
            return start, _TOLD
    return start, DONE


class PositionController(Servo):
    """Position loop of a slide: `lathe_machine.control.pid`, `sampled_link` or `periodic`.

    Attributes:
        law: controller of the position.
    """

    kind = "position_controller"
    Parameters = PositionControllerParameters
    parameters: PositionControllerParameters
    goes_on = (_TOLD,)

    def __init__(self, name: str, parameters: PositionControllerParameters) -> None:
        super().__init__(name, parameters)
        self.law = self._make()
        self._path = None
        axis, delay = parameters.axis, parameters.feedback_delay
        inputs = [
            CLOCK,
            Input(f"{axis}/state", messages.STATE, ("measured_position",), delay),
        ]
        if parameters.measures == "edge":
            inputs.append(Input("cut", messages.CUT, ("deflection",), delay))
        if parameters.predistortion_file:
            with about(name, "predistortion_file"):
                self._path = Predistortion.load(resources.find(Path(parameters.predistortion_file)))
            inputs.append(Input("longitudinal/state", messages.STATE, ("measured_position",), delay))
        self._held, self._log, self._logged = np.zeros(2), np.zeros((_PERIODS, 8)), np.zeros(1, np.int64)
        self.declare(
            inputs=[*inputs, *listens(parameters)], outputs=[Output(parameters.commanded_topic, messages.SERVO)]
        )
        if parameters.law == "periodic_hyperstable":
            self.sparse_topics[f"{axis}/periodic"] = messages.PERIODIC

    def _make(self) -> Pid | SampledLink | PeriodicController:
        parameters = self.parameters
        if parameters.law == "pid":
            return parameters.pid(self.name)
        if parameters.law == "sampled_link":
            known = parameters.link == "ripple_free" and parameters.link_knows_delay
            with about(self.name, "link_gain", "link_lag", "divisor", "feedback_delay", "link"):
                delay, limit = parameters.feedback_delay * parameters.step if known else 0.0, parameters.command_limit
                return made_of(SampledLink, parameters, "link_", law=parameters.link, delay=delay, limit=limit)
        with about(self.name, "period", "memory_filter", "divisor"):
            return made_of(
                PeriodicController,
                parameters,
                gains=PRESETS[parameters.periodic_gains],
                limit=parameters.command_limit,
                step_s=parameters.step * parameters.divisor,
                measurement_step=parameters.adc_step / parameters.periodic_unit,
                command_step=parameters.dac_step,
            )

    @property
    def step(self) -> Step:  # type: ignore[override]
        """Step function of the law selected in the parameter table."""
        steps: dict[str, Step] = {"pid": pid_step, "sampled_link": link_step, "periodic_hyperstable": periodic_step}
        return steps[self.parameters.law]

    @property
    def memory(self) -> PidMemory | LinkMemory | PeriodicMemory:
        """Current state of the position controller's step function."""
        path = self._path.table if self._path else _NO_PATH
        edge = 2 if self.parameters.measures == "edge" else 0
        height = (3 if edge else 2) if self._path else 0
        wanted = Wanted(self.trajectory.course, path, edge, height, self.listener)
        if isinstance(self.law, Pid):
            return PidMemory(wanted, self.law.table, self.law.state)
        if isinstance(self.law, SampledLink):
            return LinkMemory(wanted, self.law.table)
        return PeriodicMemory(
            wanted, self.law.law, self.law.state, self.parameters.periodic_unit, self.parameters.divisor, self._held,
            self._log, self._logged,
        )  # fmt: skip

    def tell(self, first: int, end: int) -> list[Sparse]:
        """Return the results of the periodic law for the completed periods."""
        rows = self._log[: self._logged[0]].tolist()
        self._logged[0] = 0
        return [self._status(int(index), *row) for index, *row in rows]

    def _status(
        self, index: int, error: float, demand: float, memory: float, saturated: float, integral: float, bound: float,
        clearance: float,
    ) -> Sparse:  # fmt: skip
        assert isinstance(self.law, PeriodicController), "no other law has periods"
        status = {
            "period": index // (self.law.law.samples * self.parameters.divisor),
            "max_error": error,
            "largest_demand": demand,
            "largest_memory": memory,
            "saturated": int(saturated),
            "popov_integral": integral,
            "popov_bound": bound,
            "hyperstable": clearance >= 0.0,
        }
        # The last sample of the period, since the next one may not be computed yet.
        return Sparse(f"{self.parameters.axis}/periodic", messages.PERIODIC, index - 1, status)
