# SPDX-License-Identifier: Apache-2.0
"""Spindle slowed by the cutting torque, with its encoder."""

from collections.abc import Sequence
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple

import numpy as np
from annotated_types import Ge, Gt, Le, Lt

from lathe_machine.plants.spindle import STOPS, Belt, LoadedSpindle, SpeedLoop, SpindleTable, failure, turn
from lathe_machine.signals.encoder import EncoderSamples, EncoderTable, follow_law, read_off
from lathe_machine.stages.common.command_limits import Clipping
from lathe_machine.stages.common.tables import made_of
from lathe_machine.stages.spindle.spindle_encoder import SpindleEncoder, SpindleEncoderParameters
from lathe_rc import messages
from lathe_rc.blocks.ports import Input, Sparse
from lathe_rc.cell.events import FREE, LIMITED
from lathe_rc.cell.parameters import NonNegative, Positive, about, parameter
from lathe_rc.cell.stage import DONE, Fields, Reached
from lathe_rc.jit import kernel
from lathe_rc.messages import Samples, Signals

_TORQUE = "torque"  # source of limit events
_MOST_LAG = 0.9 * 2.0 * np.pi  # largest extension of a run beyond its speed law [rad]


class LoadedSpindleParameters(SpindleEncoderParameters):
    """Speed law and its change by the cutting torque; a run is longer than the law by the resulting delay."""

    causes = MappingProxyType({"load": {"part_radius": 0.0}})

    inertia: Positive = parameter(0.03, "of spindle, chuck and part", "kg*m^2")
    motor_inertia: Positive = parameter(0.01, "of the motor, referred to the spindle", "kg*m^2")
    belt_stiffness: NonNegative = parameter(0.0, "referred to the spindle; 0: rigid", "N*m/rad")
    belt_damping: NonNegative = parameter(0.0, "referred to the spindle", "N*m*s/rad")
    torque_limit: NonNegative = parameter(0.0, "of the motor, referred to the spindle; 0: none", "N*m")
    speed_bandwidth: Positive = parameter(30.0, "speed loop: gain over both inertias", "rad/s")
    speed_integral_time: Positive = parameter(0.1, "speed loop: integral time", "s")
    part_radius: NonNegative = parameter(0.05, "at which the main cutting force acts", "m")
    load_delay: Annotated[int, Ge(1), Le(2**31 - 1)] = parameter(
        64, "delay of the feedback edge from the cut, at least a block: so late the spindle feels the force", "sample"
    )
    largest_load: Positive = parameter(50.0, "a larger torque of the cut ends the run", "N*m")
    largest_deviation: Annotated[float, Gt(0), Lt(1)] = parameter(
        0.1, "a larger change of the speed by the load, relative to the nominal one, ends the run"
    )

    def spindle(self, node: str) -> LoadedSpindle:
        """Return the simulated spindle of a node.

        Raises:
            InputError: the speed loop oscillates.
        """
        belt = made_of(Belt, self, "belt_") if self.belt_stiffness else None
        with about(node, "speed_bandwidth", "speed_integral_time", "belt_stiffness", "belt_damping"):
            return made_of(
                LoadedSpindle,
                self,
                "part_",
                belt=belt,
                loop=made_of(SpeedLoop, self, "speed_", torque_limit=self.torque_limit or np.inf),
                largest_deviation=self.largest_deviation * self.nominal_speed,
                kept=messages.MAX_BLOCK,
            )


class Memory(NamedTuple):
    """State of the loaded spindle's step function.

    Attributes:
        encoder: encoder with the speed law.
        spindle: simulated spindle.
        room: scratch array for the torque.
    """

    encoder: EncoderTable
    spindle: SpindleTable
    room: Samples


@kernel
def step(memory: Memory, first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Turn the spindle through one block under the cutting torque, and read its encoder."""
    block = EncoderSamples(*outputs)
    follow_law(memory.encoder, first, block.angle_true, block.speed_true)
    reached, reason = turn(memory.spindle, first, inputs[0], block.angle_true, block.speed_true, memory.room[0])
    if reason != DONE:
        return reached, reason
    read_off(memory.encoder, first, block)
    return reached, DONE


class LoadedSpindleStage(SpindleEncoder):
    """Spindle with motor, belt and speed loop, slowed by the cut (see `lathe_machine.plants.spindle`).

    Attributes:
        spindle: simulated spindle.
    """

    kind = "loaded_spindle"
    Parameters = LoadedSpindleParameters
    announces = (LIMITED, FREE)
    stops = STOPS
    rooms = 1
    step = staticmethod(step)

    def __init__(self, name: str, parameters: LoadedSpindleParameters) -> None:
        # Before the base class, whose constructor uses the loads and the lag.
        self.spindle = parameters.spindle(name)
        self._largest = parameters.largest_deviation * parameters.nominal_speed
        self._delay = parameters.load_delay
        self._push = 2.0 * parameters.largest_load / parameters.inertia  # load and motor may act in the same direction
        super().__init__(name, parameters)
        self.law = None  # the effect of the load is not known in advance
        self._clipping = Clipping(name, parameters, _TORQUE, self.spindle.table.limited)

    def _loads(self) -> Sequence[Input]:
        """Inputs with the delayed cutting force."""
        return [Input("cut", messages.CUT, ("force",), self._delay)]

    def _lag(self) -> float:
        """Angle that the speed loop's integral needs for the largest load [rad]; less than a revolution."""
        table = self.spindle.table
        return min(table.largest_load / table.integral, _MOST_LAG) if table.radius else 0.0

    def speed_range(self) -> tuple[float, float]:
        """Lowest and highest speed in the run [rad/s]."""
        low, high = super().speed_range()
        return low - self._largest, high + self._largest

    def largest_acceleration(self) -> float:
        """Upper bound on the magnitude of dΩ/dt in the run [rad/s²]."""
        return super().largest_acceleration() + self._push

    @property
    def memory(self) -> tuple[Any, ...]:
        """Current state of the loaded spindle's step function."""
        return Memory(self._encoder.table, self.spindle.table, self.room)

    def serve(
        self, reason: int, first: int, reached: int, inputs: Sequence[Signals], outputs: Sequence[Signals]
    ) -> list[Sparse]:
        """End a run whose spindle cannot continue.

        Raises:
            LatheError: the load or its effect exceeds the permitted limit.
        """
        angle, force = outputs[0]["angle_true"][reached], inputs[0]["force"][reached]
        raise failure(reason, self.spindle.table, angle, force)

    def tell(self, first: int, end: int) -> list[Sparse]:
        """Return the events of the last computed samples."""
        return self._clipping.tell(first, end)

    def finish(self, index: int) -> list[Sparse]:
        """Return the remaining events at the end of the run."""
        return self._clipping.finish(index)
