# SPDX-License-Identifier: Apache-2.0
"""``python -m lathe_rc``: the command line."""

from lathe_rc.loading import load

if __name__ == "__main__":
    load("lathe_rc.cli").main(prog_name="lathe")
