# SPDX-License-Identifier: Apache-2.0
"""Takes img/panel.png and img/panel_narrow.png: the panel of the full cell after a fault, light and dark."""

import tempfile
from pathlib import Path

from PIL import Image

import lathe_rc
from chromium import Chromium
from lathe_rc.view import page_server, panel
from lathe_rc.view.panel_run import Driver, LiveCell
from place import PICTURES

WIDE, NARROW = (1280, 900), (420, 900)
BROKEN, LATER = 45, 47  # revolutions


def opened(file: Path) -> Image.Image:
    """Return a picture in memory."""
    with Image.open(file) as picture:
        return picture.convert("RGB")


def save(picture: Image.Image, name: str) -> None:
    """Save a picture with few colours, so that it stays small."""
    picture.quantize(128, dither=Image.Dither.NONE).save(PICTURES / f"{name}.png", optimize=True)


cell = LiveCell(lathe_rc.load("supervised_full_cell"))
with (
    tempfile.TemporaryDirectory() as folder,
    Driver(cell, 0.0) as driver,
    page_server.serving(panel.site(driver, cell)) as address,
    Chromium(Path(folder)) as browser,
):
    shot = Path(folder) / "shot.png"
    browser.look(*WIDE)
    browser.open(address)
    browser.until("ABOUT.nodes.length")
    for revolution in range(1, LATER + 1):
        if revolution == BROKEN:
            driver.call(lambda: cell.act("electrodynamic_actuator", "fault coarse/command.position wrong scale=0.9"))
        driver.call(driver.step)
        browser.until(f"SHOWN.now.state == 'paused' && SHOWN.history.length >= {revolution}")
    browser.shot(shot)
    save(opened(shot), "panel")
    both = Image.new("RGB", (2 * NARROW[0] + 20, 1700), "#888")
    for place, dark in enumerate((False, True)):
        browser.look(*NARROW, dark=dark)
        browser.run("new Promise(done => setTimeout(done, 500))")
        browser.shot(shot)
        both.paste(opened(shot).crop((0, 0, NARROW[0], 1700)), (place * (NARROW[0] + 20), 0))
    save(both, "panel_narrow")
