# SPDX-License-Identifier: Apache-2.0
"""Executable: nodes in one process, NAME[:STAGE]... [--ros-args ...]; for the harness and the launch file."""

import sys

from lathe_rc.nodes import process


def main() -> None:
    """Run the nodes."""
    sys.exit(process.run(*process.split(sys.argv[1:])))


if __name__ == "__main__":
    main()
