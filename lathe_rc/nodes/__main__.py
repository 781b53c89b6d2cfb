# SPDX-License-Identifier: Apache-2.0
"""``python -m lathe_rc.nodes NAME[:STAGE]... [--ros-args ...]``: nodes in one process, for the harness."""

import sys

from lathe_rc.nodes import process

if __name__ == "__main__":
    sys.exit(process.run(*process.split(sys.argv[1:])))
