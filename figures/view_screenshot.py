# SPDX-License-Identifier: Apache-2.0
"""Draws img/view.png and view_light.png of view.md: a bag as it opens in Rerun, on a screen that is only in memory.

Needs rerun-sdk and, from apt: xvfb mesa-vulkan-drivers libegl1.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from lathe_live import rerun_bag
from lathe_live.rerun_output import require
from place import PICTURES

SIZE = (1500, 900)


def shoot(recording: Path, home: Path, shot: Path) -> None:
    """Take a picture of the viewer, whose settings are in a folder."""
    # The mouse is in the middle of the screen, so beside the window.
    screen = ["xvfb-run", "-a", "-s", "-screen 0 4000x2600x24"]
    viewer = [sys.executable, "-m", "rerun", "--new", "--bind", "127.0.0.1", "--window-size", f"{SIZE[0]}x{SIZE[1]}"]
    environ = os.environ | {"XDG_DATA_HOME": str(home)}
    command = ["timeout", "-k", "5", "300", *screen, *viewer, "--screenshot-to", str(shot), str(recording)]
    subprocess.run(command, env=environ, check=True)


if len(sys.argv) != 2:
    sys.exit("usage: python figures/view_screenshot.py BAG")
require()
with tempfile.TemporaryDirectory() as name:
    folder = Path(name)
    rerun_bag.write(Path(sys.argv[1]), folder / "shown.rrd")
    settings = folder / "rerun" / "app.ron"
    for picture in ("view", "view_light"):
        shoot(folder / "shown.rrd", folder, folder / "shot.png")
        with Image.open(folder / "shot.png") as taken:
            small = taken.convert("RGB").resize(SIZE, Image.Resampling.LANCZOS)
        # Few colours, so that it stays small.
        small.quantize(192, dither=Image.Dither.NONE).save(PICTURES / f"{picture}.png", optimize=True)
        text = settings.read_text(encoding="utf-8")  # the viewer has no option for that
        settings.write_text(text.replace("theme_preference:System", "theme_preference:Light"), encoding="utf-8")
