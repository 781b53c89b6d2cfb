# SPDX-License-Identifier: Apache-2.0
"""Executable: a ``tool`` node."""

from lathe_rc.nodes import process


def main() -> None:
    """Run the node."""
    process.main("tool")


if __name__ == "__main__":
    main()
