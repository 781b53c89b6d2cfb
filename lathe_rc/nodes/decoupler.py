# SPDX-License-Identifier: Apache-2.0
"""Executable: a ``decoupler`` node."""

from lathe_rc.nodes import process


def main() -> None:
    """Run the node."""
    process.main("decoupler")


if __name__ == "__main__":
    main()
