# SPDX-License-Identifier: Apache-2.0
"""Force controller: holds the main cutting force by the longitudinal feed (paper 004)."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt

from lathe_rc.cell import messages
from lathe_rc.cell.messages import Signals
from lathe_rc.cell.parameters import parameter
from lathe_rc.cell.stage import Input, Output, Sparse, Stage
from lathe_rc.cell.stages.obedience import listens
from lathe_rc.cell.stages.servo import ServoParameters
from lathe_rc.cell.stages.trajectory import Trajectory
from lathe_rc.control.pid import FORCE


class ForceControllerParameters(ServoParameters):
    """Set point, feedback, converters, limits, and the gains of the PID; by default those of paper 004, Fig. 12."""

    set_point: list[float] = parameter([], "steps: values, each from its time on; empty: 0", "N")
    adc_step: Annotated[float, Ge(0)] = parameter(0.0, "step of the converter of the measurement; 0: none", "N")
    set_point_ramp: Annotated[float, Ge(0)] = parameter(
        0.0, "fastest change of the set point, for a smooth engagement; 0: any", "N/s"
    )
    proportional: float = parameter(FORCE.proportional, "proportional gain P", "1/N")
    integral: float = parameter(FORCE.integral, "integral gain I", "1/(N*s)")
    derivative: float = parameter(FORCE.derivative, "derivative gain D", "s/N")
    derivative_filter: Annotated[float, Gt(0)] = parameter(FORCE.filter, "N, where the derivative ends", "rad/s")


class ForceController(Stage):
    """See `lathe_rc.control.pid`.

    Attributes:
        parameters: its table.
        pid: the controller.
    """

    kind = "force_controller"
    Parameters = ForceControllerParameters

    def __init__(self, name: str, parameters: ForceControllerParameters) -> None:
        super().__init__(name, parameters)
        self.parameters = parameters
        self.trajectory = Trajectory(name, parameters)
        self.pid = parameters.pid(
            parameters.proportional, parameters.integral, parameters.derivative, parameters.derivative_filter
        )
        self._obedience = parameters.obeys(name, self)
        self.declare(
            inputs=[
                # The angle itself is not used: the spindle's blocks say which samples are due.
                Input("encoder", messages.ENCODER, ("angle",)),
                Input("cut", messages.CUT, ("measured_force",), parameters.feedback_delay),
                *listens(parameters),
            ],
            outputs=[Output("longitudinal/command", messages.SERVO)],
        )

    def may_learn(self, *, on: bool) -> None:
        """See `lathe_rc.cell.stages.obedience.Learner`."""
        self.pid.integrates = on

    def process(self, first: int, inputs: Sequence[Signals], outputs: Sequence[Signals]) -> list[Sparse]:
        """See `Stage`."""
        (_, cut, *safety), (servo,) = inputs, outputs
        wanted, force, command = servo["set_point"], cut["measured_force"], servo["command"]
        self.trajectory.block(first, wanted)
        np.subtract(wanted, force, out=servo["error"])
        if self._obedience is None:
            self.pid.block(first, wanted, force, command)
            return []
        for start, stop in self._obedience.pieces(safety[0]["reaction"]):
            self.pid.waits = self._obedience.held
            part = slice(start, stop)
            self.pid.block(first + start, wanted[part], force[part], command[part])
            self._obedience.apply(command[part])
        return []
