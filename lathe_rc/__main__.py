# SPDX-License-Identifier: Apache-2.0
"""``python -m lathe_rc``: the command line."""

from lathe_rc.cli import main

if __name__ == "__main__":
    main(prog_name="lathe")
