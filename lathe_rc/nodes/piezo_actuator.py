# SPDX-License-Identifier: Apache-2.0
"""Executable: a ``piezo_actuator`` node."""

from lathe_rc.nodes import process


def main() -> None:
    """Run the node."""
    process.main("piezo_actuator")


if __name__ == "__main__":
    main()
