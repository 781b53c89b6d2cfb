# SPDX-License-Identifier: Apache-2.0
"""Draws img/view.png of view.md: a bag as it opens in Rerun, on a screen that is only in memory.

Needs rerun-sdk and, from apt: xvfb mesa-vulkan-drivers libegl1.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from lathe_rc.view import rerun_bag
from lathe_rc.view.rerun_output import require
from place import PICTURES

SIZE = (1500, 900)

if len(sys.argv) != 2:
    sys.exit("usage: python figures/view_screenshot.py BAG")
require()
with tempfile.TemporaryDirectory() as folder:
    recording, shot = Path(folder) / "shown.rrd", Path(folder) / "shot.png"
    rerun_bag.write(Path(sys.argv[1]), recording)
    # The mouse is in the middle of the screen, so beside the window.
    screen = ["xvfb-run", "-a", "-s", "-screen 0 4000x2600x24"]
    viewer = [sys.executable, "-m", "rerun", "--new", "--window-size", f"{SIZE[0]}x{SIZE[1]}"]
    limit = ["timeout", "-k", "5", "300"]
    subprocess.run([*limit, *screen, *viewer, "--screenshot-to", str(shot), str(recording)], check=True)
    with Image.open(shot) as picture:
        small = picture.convert("RGB").resize(SIZE, Image.Resampling.LANCZOS)
    # Few colours, so that it stays small.
    small.quantize(192, dither=Image.Dither.NONE).save(PICTURES / "view.png", optimize=True)
