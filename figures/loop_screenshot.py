# SPDX-License-Identifier: Apache-2.0
"""Makes the picture of the loop page of view.md: that of the cell `series`."""

import tempfile
from pathlib import Path

import lathe_rc
from chromium import save, shot
from lathe_live.loop_page import LoopPage
from lathe_live.varied_loop import VariedLoop

SIZE = (1240, 1330)

with tempfile.TemporaryDirectory() as folder:
    page = Path(folder) / "loop.html"
    loop = LoopPage(VariedLoop(lathe_rc.load("series")), Path("series-loop.yaml"))
    page.write_text(loop.document("lathe loop series --html loop.html"), encoding="utf-8")
    save(shot(page, SIZE), "loop")
