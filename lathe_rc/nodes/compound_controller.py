# SPDX-License-Identifier: Apache-2.0
"""Executable: a ``compound_controller`` node."""

from lathe_rc.nodes import process


def main() -> None:
    """Run the node."""
    process.main("compound_controller")


if __name__ == "__main__":
    main()
