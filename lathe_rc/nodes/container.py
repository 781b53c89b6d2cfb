# SPDX-License-Identifier: Apache-2.0
"""Executable: nodes in one process, NAME[:STAGE]... [--ros-args ...]; used by the harness and the launch file."""

import sys
from typing import NoReturn

from lathe_rc.cell.scenario import TABLES
from lathe_rc.nodes import arguments, process


def main() -> NoReturn:
    """Run the nodes in this process, and exit."""
    words = sys.argv[1:]
    if arguments.ask_for_help(words):
        print(f"usage: ros2 run lathe_rc container NAME[:STAGE] ... [{arguments.ROS} ...]")
        print(f"stages: {TABLES.allowed()}; ros2 run lathe_rc STAGE --help lists the parameters of one")
        sys.exit(0)
    process.run_and_exit(words)


if __name__ == "__main__":
    main()
