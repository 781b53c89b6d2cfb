# SPDX-License-Identifier: Apache-2.0
"""Spindle of a user's own: at a constant speed, with an ideal encoder."""

import numpy as np

from lathe_rc import DONE, Output, messages
from lathe_rc.cell.time_master import TimeMaster, TimeMasterParameters


def step(speed, first, start, inputs, flags, outputs):
    """Compute the fields angle, speed, index_pulse, angle_true and speed_true from the speed [rad/sample, rad/s]."""
    turn = speed[0] * (first + np.arange(start, outputs[0].size))
    outputs[0][start:] = outputs[3][start:] = turn
    outputs[1][start:] = outputs[4][start:] = speed[1]
    outputs[2][start:] = np.floor(turn / (2.0 * np.pi)) > np.floor((turn - speed[0]) / (2.0 * np.pi))
    return outputs[0].size, DONE


class Spindle(TimeMaster):
    Parameters = TimeMasterParameters
    step = staticmethod(step)

    def __init__(self, name, parameters):
        super().__init__(name, parameters)
        self.samples = self.expected_samples
        self.declare(outputs=[Output("encoder", messages.ENCODER)])

    @property
    def memory(self):
        return self.shared.nominal_speed * self.shared.step, self.shared.nominal_speed

    def sample_at(self, angle):
        return int(np.ceil(angle / self.memory[0]))

    def speed_range(self):
        return self.shared.nominal_speed, self.shared.nominal_speed

    def largest_acceleration(self):
        return 0.0
