# SPDX-License-Identifier: Apache-2.0
"""Controller of the main cutting force through the longitudinal feed (paper 004)."""

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

from lathe_machine.control.pid import FORCE, PidTable
from lathe_machine.stages.common.obedience import Listener, listens
from lathe_machine.stages.feed.servo import Servo, ServoParameters, pid_along
from lathe_machine.stages.feed.trajectory import Course, follow
from lathe_rc import messages
from lathe_rc.blocks.ports import CLOCK, Input, Output
from lathe_rc.cell.parameters import NonNegative, Positive, parameter
from lathe_rc.cell.stage import Fields, Reached
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples


class ForceControllerParameters(ServoParameters):
    """Set point, feedback, converters, limits, and the gains of the PID; by default those of paper 004, Fig. 12."""

    set_point: list[float] = parameter([], "steps: values, each from its time on; empty: 0", "N")
    adc_step: NonNegative = parameter(0.0, "step of the converter of the measurement; 0: none", "N")
    set_point_ramp: NonNegative = parameter(
        0.0, "fastest change of the set point, for a smooth engagement; 0: any", "N/s"
    )
    proportional: float = parameter(FORCE.proportional, "proportional gain P", "1/N")
    integral: float = parameter(FORCE.integral, "integral gain I", "1/(N*s)")
    derivative: float = parameter(FORCE.derivative, "derivative gain D", "s/N")
    derivative_filter: Positive = parameter(FORCE.filter, "N, where the derivative ends", "rad/s")
    tolerance: NonNegative = parameter(
        0.0, "allowed following error to each side, by which a run is judged; 0: not judged", "N"
    )

    commanded_topic: ClassVar[str] = "longitudinal/command"

    def shown(self) -> Mapping[str, Any]:
        """Largest set point [N]."""
        return {"force": max(self.set_point, default=0.0)}


class Memory(NamedTuple):
    """State of the force controller's step function."""

    course: Course
    pid: PidTable
    state: Samples
    who: Listener


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Control the force through one block."""
    force, (command, wanted, error) = inputs[1], outputs
    if start == 0:
        follow(memory.course, first, wanted)
        for k in range(error.size):
            error[k] = wanted[k] - force[k]
    return pid_along(memory.pid, memory.state, memory.who, first, start, flags[0], wanted, force, command)


class ForceController(Servo):
    """PID that controls the cutting force through the longitudinal feed (see `lathe_machine.control.pid`).

    Attributes:
        pid: PID controller.
    """

    kind = "force_controller"
    Parameters = ForceControllerParameters
    parameters: ForceControllerParameters
    step = staticmethod(step)

    def __init__(self, name: str, parameters: ForceControllerParameters) -> None:
        super().__init__(name, parameters)
        self.pid = parameters.pid(name)
        self.declare(
            inputs=[
                CLOCK,
                Input("cut", messages.CUT, ("measured_force",), parameters.feedback_delay),
                *listens(parameters),
            ],
            outputs=[Output(parameters.commanded_topic, messages.SERVO)],
        )

    @property
    def memory(self) -> Memory:
        """Current state of the force controller's step function."""
        return Memory(self.trajectory.course, self.pid.table, self.pid.state, self.listener)
