# SPDX-License-Identifier: Apache-2.0
"""A controller in the place of ours: it learns the command, a thousand points a turn of the spindle."""

import math
from collections import deque

from cell_member import CellMember, run
from lathe_rc_msgs.msg import ActuatorCommand, EncoderBlock, ToolBlock

POINTS, GAIN, LEAD = 1000, 0.3, 1.425e-3  # of a turn, [1], [s] that the drive takes to follow


def point(angle):
    """Where an angle is in the memory."""
    return int(angle / math.tau * POINTS) % POINTS


class Controller(CellMember):
    """Reads `encoder` and, late, `tool`; publishes `coarse/command`."""

    def __init__(self):
        super().__init__("learning_controller", "my_learning")
        delay = self.declare_parameter("feedback_delay", 3200).value  # [sample], a block at least
        self.memory, self.newest = [0.0] * POINTS, 0
        # What it sees is `delay` samples old, and nothing before there is anything.
        self.angles, self.errors, self.encoders = deque([0.0] * delay), deque([0.0] * delay), deque()
        self.command = self.publishes(ActuatorCommand, "coarse/command")
        self.reads(EncoderBlock, "encoder", self.on_encoder)
        self.reads(ToolBlock, "tool", self.on_tool)

    def on_encoder(self, encoder):
        self.encoders.append(encoder)
        self.compute()
        return len(encoder.angle)

    def on_tool(self, tool):
        self.errors.extend(tool.measured_error)
        self.compute()
        return len(tool.error)

    def compute(self):
        """Compute every block whose inputs are there."""
        while self.encoders and len(self.errors) >= len(self.encoders[0].angle):
            encoder = self.encoders.popleft()
            command = self.beside(ActuatorCommand, encoder)
            for angle, speed in zip(encoder.angle, encoder.speed, strict=True):
                self.angles.append(angle)
                self.learn(point(self.angles.popleft()), self.errors.popleft())
                command.position.append(self.memory[point(angle + LEAD * speed)])
            self.command.publish(command)
            self.completed(encoder, len(encoder.angle))

    def learn(self, place, error):
        """Correct the memory, once in each turn at each point."""
        if place != self.newest:
            self.memory[place] += GAIN * error
        self.newest = place


if __name__ == "__main__":
    run(Controller)
