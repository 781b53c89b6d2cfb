# SPDX-License-Identifier: Apache-2.0
"""Entry of ./lathe. Plain enough for any old Python, which has to get as far as its one clear line."""

import sys

if not (3, 10) <= sys.version_info[:2] <= (3, 14):
    sys.stderr.write(
        "lathe: Python %d.%d (%s) is not supported, 3.10 to 3.14 are: "
        "choose one with LATHE_PYTHON=/path/to/python3 ./lathe ...\n"
        % (sys.version_info[0], sys.version_info[1], sys.executable)
    )
    sys.exit(2)

from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "msg_defs"))  # ros_wheels

from bootstrap import main

sys.exit(main(sys.argv[1:]))
