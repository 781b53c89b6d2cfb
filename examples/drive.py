# SPDX-License-Identifier: Apache-2.0
"""A drive in the place of ours: 1 / (1 + 2ζp/ω + p²/ω²), 23 samples late."""

from collections import deque

from cell_member import CellMember, run
from lathe_rc_msgs.msg import ActuatorCommand, ActuatorState

FREQUENCY, DAMPING, DELAY = 1038.0, 0.804, 23  # [rad/s], [1], [sample]
CURRENT = 1.2 / 30.0  # moving mass over force constant [A/(m/s²)]


class Drive(CellMember):
    """Reads `coarse/command`, publishes `coarse/state`."""

    def __init__(self):
        super().__init__("electrodynamic_actuator", "my_drive")
        self.position, self.velocity, self.line = 0.0, 0.0, deque([0.0] * DELAY)  # at rest, nothing on its way
        self.state = self.publishes(ActuatorState, "coarse/state")
        self.reads(ActuatorCommand, "coarse/command", self.on_command)

    def on_command(self, command):
        state, step = self.beside(ActuatorState, command), command.block.step_ns * 1e-9
        for wanted in command.position:
            self.line.append(wanted)
            spring = FREQUENCY**2 * (self.line.popleft() - self.position)
            acceleration = spring - 2.0 * DAMPING * FREQUENCY * self.velocity
            self.velocity += step * acceleration
            self.position += step * self.velocity
            state.position.append(self.position)
            state.velocity.append(self.velocity)
            state.effort.append(CURRENT * acceleration)
            state.measured_position.append(self.position)
        self.state.publish(state)
        self.completed(command, len(command.position))
        return len(command.position)


if __name__ == "__main__":
    run(Drive)
