# SPDX-License-Identifier: Apache-2.0
"""Common part of servo controllers: a PID, converters, and a feedback edge of the cell."""

from typing import Annotated, Literal

from annotated_types import Ge, Le

from lathe_machine.control.pid import Pid, PidGains, PidTable, control_along, enable_integrator
from lathe_machine.stages.common.obedience import (
    OBEY,
    FeedObedientParameters,
    Listener,
    Obedience,
    Obedient,
    apply,
    may_learn,
    obeyed,
    piece,
)
from lathe_machine.stages.common.tables import made_of
from lathe_machine.stages.feed.trajectory import Trajectory, TrajectoryParameters
from lathe_rc.cell.judged import Judged
from lathe_rc.cell.parameters import NonNegative, Positive, about, parameter, remapped
from lathe_rc.cell.stage import DONE
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples
from lathe_rc.safety.state_machine import Reaction

_ROUNDED = 1e-9  # relative distance from a limit within which a command is at the limit


class ServoParameters(TrajectoryParameters, FeedObedientParameters):
    """Set point, feedback, converters, limits, and the gains of the PID."""

    feedback_delay: Annotated[int, Ge(1), Le(2**31 - 1)] = parameter(
        64, "delay of the feedback edge, at least a block", "sample"
    )
    divisor: Annotated[int, Ge(1), Le(1_000_000)] = parameter(
        1, "computes at samples that are multiples of it, and holds the command between", "sample"
    )
    command_limit: Positive = parameter(1.0, "largest command to each side, in its unit; the full command is 1")
    adc_step: NonNegative = parameter(0.0, "step of the converter of the measurement; 0: none", "m")
    dac_step: NonNegative = parameter(0.0, "step of the converter of the command; 0: none")
    set_point_ramp: NonNegative = parameter(
        0.0, "pid: fastest change of the set point, for a smooth engagement; 0: any", "m/s"
    )

    set_point_smoothing: NonNegative = parameter(
        0.0, "pid: time constant with which the set point is approached; 0: at once", "s"
    )

    commands: Literal["speed", "position"] = parameter(
        "speed", "what the command stands for at the drive; to stop the slide a speed goes to 0, and a position stays"
    )

    tolerance: NonNegative = parameter(
        0.0, "allowed following error to each side, by which a run is judged; 0: not judged", "m"
    )

    judging = frozenset({"tolerance"})

    def judged(self) -> Judged:
        """Following error of the loop."""
        return Judged(
            topic=remapped(self, self.commanded_topic),
            quantity="force" if self.rows()["set_point"].unit == "N" else "position",
            step=self.step,
            tolerance=self.tolerance,
            delay=self.feedback_delay,
            limit=(self.command_limit - self.dac_step / 2.0) * (1.0 - _ROUNDED),
        )

    def obeys(self, name: str) -> Obedience | None:
        """Return the obedience of a node to the supervisor; None without a supervisor input.

        Raises:
            InputError: a command may be out of reach (see `FeedObedientParameters.obedience`).
        """
        if not self.reaction_delay:
            return None
        speed, limit = self.commands == "speed", self.command_limit
        return self.obedience(name, speed=speed, limit=limit, settled=self.feedback_delay)

    def pid(self, node: str) -> Pid:
        """Return the PID of a node whose parameter table has gains.

        Raises:
            InputError: as for `lathe_machine.control.pid.Pid`.
        """
        with about(node, "proportional", "integral", "derivative", "derivative_filter"):
            gains, limit = made_of(PidGains, self, "derivative_"), self.command_limit
            converters = {"adc": self.adc_step, "dac": self.dac_step}
            return made_of(Pid, self, "set_point_", gains=gains, low=-limit, high=limit, **converters)


class Servo(Obedient):
    """Servo controller with its set point.

    Attributes:
        trajectory: trajectory of the set point.
    """

    def __init__(self, name: str, parameters: ServoParameters) -> None:
        super().__init__(name, parameters)
        self.trajectory = Trajectory(name, parameters)
        self._obedience = parameters.obeys(name)

    def warnings(self, seconds: float) -> list[str]:
        """Return the warning about a trajectory outside the run."""
        return [f"{self.name}.{doubt}" for doubt in self.trajectory.doubts(seconds)]


@kernel
def pid_along(
    pid: PidTable,
    state: Samples,
    who: Listener,
    first: int,
    start: int,
    reaction: Samples,
    wanted: Samples,
    measured: Samples,
    command: Samples,
) -> tuple[int, int]:
    """Step a PID through a block from sample ``start`` on (see `lathe_rc.cell.stage`); arrays of shape (n,)."""
    while start < command.size:
        stop = piece(who, start, command.size, reaction)
        if stop == start:
            return start, OBEY
        if who.listens:
            enable_integrator(state, may_learn(who), obeyed(who) >= Reaction.HOLD.value)
        control_along(pid, state, first + start, wanted[start:stop], measured[start:stop], command[start:stop])
        apply(who, command[start:stop])
        start = stop
    return start, DONE
