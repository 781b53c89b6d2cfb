# SPDX-License-Identifier: Apache-2.0
"""Executable: a ``loaded_drive`` node."""

from lathe_rc.nodes import process


def main() -> None:
    """Run the node."""
    process.main("loaded_drive")


if __name__ == "__main__":
    main()
