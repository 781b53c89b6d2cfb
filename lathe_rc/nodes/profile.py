# SPDX-License-Identifier: Apache-2.0
"""Executable: a ``profile`` node."""

from lathe_rc.nodes import process


def main() -> None:
    """Run the node."""
    process.main("profile")


if __name__ == "__main__":
    main()
