# SPDX-License-Identifier: Apache-2.0
"""Executable: a ``spindle_encoder`` node."""

from lathe_rc.nodes import process


def main() -> None:
    """Run the node."""
    process.main("spindle_encoder")


if __name__ == "__main__":
    main()
