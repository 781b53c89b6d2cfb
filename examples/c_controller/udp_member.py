# SPDX-License-Identifier: Apache-2.0
"""A member in the place of `learning_controller`, whose command a program without ROS computes: controller.c."""

import socket
import struct
import sys
from collections import deque
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from cell_member import CellMember, run
from lathe_rc_msgs.msg import ActuatorCommand, EncoderBlock, Member, ToolBlock

HEAD = struct.Struct("=qq")


class UdpController(CellMember):
    """Reads `encoder` and, late, `tool`; publishes `coarse/command`."""

    def __init__(self):
        super().__init__("learning_controller", "udp_controller")
        delay = self.declare_parameter("feedback_delay", 3200).value  # [sample], also --block of the export
        port = self.declare_parameter("port", 47000).value
        self.link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.link.connect(("127.0.0.1", port))
        self.link.settimeout(1.0)
        self.errors, self.encoders = deque([0.0] * delay), deque()
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
            samples = len(encoder.angle)
            errors = [self.errors.popleft() for _ in range(samples)]
            command = self.beside(ActuatorCommand, encoder)
            try:
                command.position = self.ask(encoder.block.first_index, [*encoder.angle, *encoder.speed, *errors])
            except OSError as error:
                self.announce(Member.FAILED, f"the C program does not answer: {error}")
                return
            self.command.publish(command)
            self.completed(encoder, samples)
            if encoder.block.last:
                self.link.send(HEAD.pack(encoder.block.first_index + samples, 0))

    def ask(self, first, signals):
        """Return the command that the program computes for a block."""
        self.link.send(HEAD.pack(first, len(signals) // 3) + struct.pack(f"={len(signals)}d", *signals))
        answer = self.link.recv(65536)
        return list(struct.unpack(f"={len(signals) // 3}d", answer[HEAD.size :]))


if __name__ == "__main__":
    run(UdpController)
