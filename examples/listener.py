# SPDX-License-Identifier: Apache-2.0
"""A member that only listens, to every block of the tool, and says at the end how large the form error was."""

import math

from cell_member import CellMember, run
from lathe_rc_msgs.msg import ToolBlock


class Listener(CellMember):
    """Reads `tool`."""

    def __init__(self):
        super().__init__("listener", "my_listener")
        self.squares = 0.0
        self.reads(ToolBlock, "tool", self.on_tool)

    def on_tool(self, tool):
        for error in tool.error:
            self.squares += error * error
        self.completed(tool, len(tool.error))
        if tool.block.last:
            samples = self.so_far.samples
            print(f"{samples} samples, form error {math.sqrt(self.squares / samples)} m RMS", flush=True)
        return len(tool.error)


if __name__ == "__main__":
    run(Listener)
