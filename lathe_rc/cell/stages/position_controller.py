# SPDX-License-Identifier: Apache-2.0
"""Position controller of a slide: PID, sampled link, or the periodic law."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, Protocol

import numpy as np
from annotated_types import Ge, Gt

from lathe_rc import resources
from lathe_rc.cell import messages
from lathe_rc.cell.messages import Samples, Signals
from lathe_rc.cell.parameters import parameter
from lathe_rc.cell.stage import Input, Output, Sparse, Stage, cut
from lathe_rc.cell.stages.feed_drive import Axis
from lathe_rc.cell.stages.obedience import listens
from lathe_rc.cell.stages.servo import ServoParameters
from lathe_rc.cell.stages.trajectory import Trajectory
from lathe_rc.control import periodic
from lathe_rc.control.periodic import PeriodicController
from lathe_rc.control.pid import POSITION, Pid
from lathe_rc.control.predistortion import Predistortion
from lathe_rc.control.sampled_link import SampledLink
from lathe_rc.signals.example_002 import PERIOD


class PositionControllerParameters(ServoParameters):
    """The law and its settings; those of the PID are by default paper 004's, Fig. 11."""

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
    derivative_filter: Annotated[float, Gt(0)] = parameter(POSITION.filter, "pid: N, where D ends", "rad/s")
    link: Literal["ripple_free", "paper"] = parameter(
        "ripple_free", "sampled_link: ripple_free, or the paper's, which rings between the samples"
    )
    link_gain: Annotated[float, Gt(0)] = parameter(6.25, "sampled_link: K of the drive", "1/s")
    link_lag: Annotated[float, Gt(0)] = parameter(0.08, "sampled_link: T1 of the drive", "s")
    link_knows_delay: bool = parameter(
        default=True, doc="sampled_link: the ripple-free link is made for the feedback delay"
    )
    periodic_gains: Literal["published", "quantised"] = parameter(
        "published", "periodic_hyperstable: gains of eqs 20 and 21, or those that survive a quantised measurement"
    )
    periodic_unit: Annotated[float, Gt(0)] = parameter(
        1.0, "periodic_hyperstable: displacement that the law takes for 1; it has numbers without a unit", "m"
    )
    period: Annotated[float, Gt(0)] = parameter(PERIOD, "periodic_hyperstable: of set point and disturbance", "s")
    memory_filter: Annotated[float, Ge(0)] = parameter(
        0.1,
        "periodic_hyperstable: standard deviation of the zero-phase filter on the memory; 0: none, as published",
        "s",
    )
    anti_windup: bool = parameter(default=True, doc="periodic_hyperstable: false: the published switch alone")


class _Law(Protocol):
    """Any of the laws."""

    def block(self, first: int, set_point: Samples, measurement: Samples, command: Samples) -> None:
        """Fill ``command``; arrays of shape (n,)."""


class PositionController(Stage):
    """See `lathe_rc.control.pid`, `lathe_rc.control.sampled_link` and `lathe_rc.control.periodic`.

    Attributes:
        parameters: its table.
        law: the controller.
    """

    kind = "position_controller"
    Parameters = PositionControllerParameters

    def __init__(self, name: str, parameters: PositionControllerParameters) -> None:
        super().__init__(name, parameters)
        self.parameters = parameters
        self.trajectory = Trajectory(name, parameters)
        self.law = self._make()
        self._path = None
        axis, delay = parameters.axis, parameters.feedback_delay
        inputs = [
            # The angle itself is not used: the spindle's blocks say which samples are due.
            Input("encoder", messages.ENCODER, ("angle",)),
            Input(f"{axis}/state", messages.STATE, ("measured_position",), delay),
        ]
        if parameters.measures == "edge":
            inputs.append(Input("cut", messages.CUT, ("deflection",), delay))
        if parameters.predistortion_file:
            self._path = Predistortion.load(resources.find(Path(parameters.predistortion_file)))
            inputs.append(Input("longitudinal/state", messages.STATE, ("measured_position",), delay))
        self._offset = np.empty(messages.MAX_BLOCK)
        self._largest, self._held = 0.0, 0.0
        self._obedience = parameters.obeys(name, self)
        self.declare(inputs=[*inputs, *listens(parameters)], outputs=[Output(f"{axis}/command", messages.SERVO)])
        if parameters.law == "periodic_hyperstable":
            self.sparse_topics[f"{axis}/periodic"] = messages.PERIODIC

    def _make(self) -> _Law:
        parameters = self.parameters
        if parameters.law == "pid":
            return parameters.pid(
                parameters.proportional, parameters.integral, parameters.derivative, parameters.derivative_filter
            )
        if parameters.law == "sampled_link":
            known = parameters.link == "ripple_free" and parameters.link_knows_delay
            return SampledLink(
                parameters.link,
                gain=parameters.link_gain,
                lag=parameters.link_lag,
                step=parameters.step,
                divisor=parameters.divisor,
                delay=parameters.feedback_delay * parameters.step if known else 0.0,
                limit=parameters.command_limit,
            )
        return PeriodicController(
            periodic.PRESETS[parameters.periodic_gains],
            period=parameters.period,
            limit=parameters.command_limit,
            step_s=parameters.step * parameters.divisor,
            memory_filter=parameters.memory_filter,
            anti_windup=parameters.anti_windup,
            measurement_step=parameters.adc_step / parameters.periodic_unit,
            command_step=parameters.dac_step,
        )

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """See `Stage`."""
        (_, state, *others), (servo,) = inputs, outputs
        reaction = others.pop()["reaction"] if self._obedience else None
        wanted, position = servo["set_point"], state["measured_position"]
        self.trajectory.block(first, wanted)
        if self.parameters.measures == "edge":
            # The slide is positive into the part, the deflection out of it.
            position = position - others[0]["deflection"]
        if self._path:
            offset = self._offset[: wanted.size]
            self._path.block(others[-1]["measured_position"], offset)
            wanted -= offset
        np.subtract(wanted, position, out=servo["error"])
        if self._obedience is None or reaction is None:
            return self._control(first, wanted, position, servo)
        sparse: list[Sparse] = []
        for start, stop in self._obedience.pieces(reaction):
            if isinstance(self.law, Pid):
                self.law.waits = self._obedience.held
            (written,) = cut([servo], start, stop)
            sparse += self._control(first + start, wanted[start:stop], position[start:stop], written)
            self._obedience.apply(written["command"])
        return sparse

    def may_learn(self, *, on: bool) -> None:
        """Let the law learn, or not; a sampled link has nothing that it could learn with."""
        if isinstance(self.law, Pid):
            self.law.integrates = on
        elif isinstance(self.law, PeriodicController):
            self.law.learning = on

    def _control(self, first: int, wanted: Samples, position: Samples, servo: Signals) -> list[Sparse]:
        if isinstance(self.law, PeriodicController):
            return self._periodic(first, self.law, wanted, position, servo)
        self.law.block(first, wanted, position, servo["command"])
        return []

    def _periodic(
        self, first: int, law: PeriodicController, wanted: Samples, position: Samples, servo: Signals
    ) -> list[Sparse]:
        """Run the law, and tell what it achieved where a period ends."""
        sparse, start, stop = [], 0, wanted.size
        divisor, unit = self.parameters.divisor, self.parameters.periodic_unit
        period = law.law.samples * divisor
        while start < stop:
            end = min(stop, start + period - (first + start) % period)
            due = slice(start + -(first + start) % divisor, end, divisor)
            computed = np.empty(len(range(*due.indices(stop))))
            law.block((first + due.start) // divisor, wanted[due] / unit, position[due] / unit, computed)
            # What is due holds until the next; what stands before the first of the block was due earlier.
            place = (first + np.arange(start, end)) // divisor - (first + start - 1) // divisor
            servo["command"][start:end] = np.concatenate(([self._held], computed))[place]
            self._held = servo["command"][end - 1]
            self._largest = max(self._largest, float(np.abs(servo["error"][start:end]).max()))
            start = end
            if (first + end) % period == 0:
                sparse.append(self._status(first + end, period, law))
                self._largest = 0.0
        return sparse

    def _status(self, index: int, period: int, law: PeriodicController) -> Sparse:
        status = {
            "period": index // period,
            "max_error": self._largest,
            "largest_demand": law.largest_demand,
            "largest_memory": law.largest_memory,
            "saturated": law.saturated,
            "popov_integral": law.popov_integral,
            "popov_bound": law.popov_bound,
            "hyperstable": law.popov_holds,
        }
        # The last sample of the period: the one after it need not be computed yet.
        return Sparse(f"{self.parameters.axis}/periodic", messages.PERIODIC, index - 1, status)
