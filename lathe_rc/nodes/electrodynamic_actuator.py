# SPDX-License-Identifier: Apache-2.0
"""Executable: a ``electrodynamic_actuator`` node."""

from lathe_rc.nodes import process


def main() -> None:
    """Run the node."""
    process.main("electrodynamic_actuator")


if __name__ == "__main__":
    main()
