# SPDX-License-Identifier: Apache-2.0
"""Executable: an ``encoder_device`` node."""

from lathe_rc.nodes import process


def main() -> None:
    """Run the node."""
    process.main("encoder_device")


if __name__ == "__main__":
    main()
