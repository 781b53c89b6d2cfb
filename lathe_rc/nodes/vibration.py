# SPDX-License-Identifier: Apache-2.0
"""Executable: a ``vibration`` node."""

from lathe_rc.nodes import process


def main() -> None:
    """Run the node."""
    process.main("vibration")


if __name__ == "__main__":
    main()
