# SPDX-License-Identifier: Apache-2.0
"""Entry point of ``python -m lathe_rc``: the command line; ``./lathe`` runs this file."""

import sys

if __name__ == "__main__" and not getattr(sys.flags, "safe_path", sys.flags.isolated):
    del sys.path[0]  # the current folder, or the folder of this file: nothing there may be imported

import gc

from lathe_rc.extras import load

if __name__ == "__main__":
    # Imports create hardly any garbage; a collection after every 700 objects would take 10 % of the start-up time.
    gc.set_threshold(50_000)
    load("lathe_rc.cli").main(prog_name="lathe")
