# SPDX-License-Identifier: Apache-2.0
"""Spindle of a user's own, as docs/extending.md describes it: at a constant speed, with an ideal encoder."""

from typing import ClassVar

import numpy as np

from lathe_rc import DONE, Output, messages
from lathe_rc.cell.stage import Fields, Reached
from lathe_rc.cell.time_master import TimeMaster, TimeMasterParameters

TURN = 2.0 * np.pi


def step(speed: tuple[float, float], first: int, start: int, inputs: Fields, flags: Fields, outputs: Fields) -> Reached:
    """Compute the fields angle, speed, index_pulse, angle_true, speed_true from the speed [rad/sample, rad/s]."""
    angle = speed[0] * (first + np.arange(start, outputs[0].size))
    outputs[0][start:] = outputs[3][start:] = angle
    outputs[1][start:] = outputs[4][start:] = speed[1]
    outputs[2][start:] = np.floor(angle / TURN) > np.floor((angle - speed[0]) / TURN)
    return outputs[0].size, DONE


class Spindle(TimeMaster):
    """Spindle that turns at the nominal speed."""

    Parameters: ClassVar = TimeMasterParameters
    step = staticmethod(step)

    def __init__(self, name: str, parameters: TimeMasterParameters) -> None:
        super().__init__(name, parameters)
        self.samples = self.expected_samples
        self.declare(outputs=[Output("encoder", messages.ENCODER)])

    @property
    def memory(self) -> tuple[float, float]:
        """Speed [rad/sample] and [rad/s]."""
        return self.shared.nominal_speed * self.shared.step, self.shared.nominal_speed

    def sample_at(self, angle: float) -> int:
        """Return the first sample at which an angle [rad] is reached."""
        return int(np.ceil(angle / self.memory[0]))

    def speed_range(self) -> tuple[float, float]:
        """Lowest and highest speed [rad/s]."""
        return self.shared.nominal_speed, self.shared.nominal_speed

    def largest_acceleration(self) -> float:
        """Bound of the acceleration [rad/s²]."""
        return 0.0
