# SPDX-License-Identifier: Apache-2.0
"""Executable: a ``cutting_process`` node."""

from lathe_rc.nodes import process


def main() -> None:
    """Run the node."""
    process.main("cutting_process")


if __name__ == "__main__":
    main()
