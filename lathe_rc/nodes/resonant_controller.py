# SPDX-License-Identifier: Apache-2.0
"""Executable: a ``resonant_controller`` node."""

from lathe_rc.nodes import process


def main() -> None:
    """Run the node."""
    process.main("resonant_controller")


if __name__ == "__main__":
    main()
