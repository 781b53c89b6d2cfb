# SPDX-License-Identifier: Apache-2.0
"""Entry point of ``python -m lathe_rc``: the command line; ``./lathe`` runs this file."""

import sys

if __name__ == "__main__" and not getattr(sys.flags, "safe_path", sys.flags.isolated):
    del sys.path[0]  # the current folder, or the one of this file: data in it is no code

import gc

from lathe_rc.extras import load

if __name__ == "__main__":
    # Of the objects that imports make hardly any is garbage: to look for it after every 700 takes a tenth of a start.
    gc.set_threshold(50_000)
    load("lathe_rc.cli").main(prog_name="lathe")
