# SPDX-License-Identifier: Apache-2.0
"""``python -m lathe_rc.nodes NAME[:STAGE]... [--ros-args ...]``: nodes in one process."""

import sys

from lathe_rc.nodes.process import run


def main(arguments: list[str]) -> int:
    """Run the nodes named before ``--ros-args``."""
    split = arguments.index("--ros-args") if "--ros-args" in arguments else len(arguments)
    members = []
    for text in arguments[:split]:
        name, _, kind = text.partition(":")
        members.append((name, kind or name))
    return run(members, arguments[split:])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
