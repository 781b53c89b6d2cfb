# SPDX-License-Identifier: Apache-2.0
"""Executable: a ``loaded_spindle`` node."""

from lathe_rc.nodes import process


def main() -> None:
    """Run the node."""
    process.main("loaded_spindle")


if __name__ == "__main__":
    main()
