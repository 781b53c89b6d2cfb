# SPDX-License-Identifier: Apache-2.0
"""Executable: a ``supervisor`` node."""

from lathe_rc.nodes import process


def main() -> None:
    """Run the node."""
    process.main("supervisor")


if __name__ == "__main__":
    main()
