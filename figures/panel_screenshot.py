# SPDX-License-Identifier: Apache-2.0
"""Takes img/panel.png, panel_timeline.png and panel_narrow.png: the panel of the full cell after a fault."""

import sys
import tempfile
from pathlib import Path

import lathe_rc
from chromium import SETTLED, Chromium, light_and_dark, save
from lathe_live import page_server, panel
from lathe_live.panel_run import Driver, LiveCell

WIDE, NARROW = (1280, 900), (420, 900)
BROKEN, LATER = 45, 47  # revolutions

cell = LiveCell(lathe_rc.load("supervised_full_cell"))
with (
    tempfile.TemporaryDirectory() as folder,
    Driver(cell, 0.0) as driver,
    page_server.serving(panel.site(driver, cell)) as address,
    Chromium(Path(folder), *sys.argv[1:2]) as browser,
):
    browser.look(*WIDE)
    browser.open(address)
    browser.until("ABOUT.nodes.length")
    for revolution in range(1, LATER + 1):
        if revolution == BROKEN:
            driver.call(lambda: cell.act("electrodynamic_actuator", "fault coarse/command.position wrong scale=0.9"))
        driver.call(driver.step)
        browser.until(f"SHOWN.now.state == 'paused' && SHOWN.rows.length >= {revolution}")
    browser.until("TIME.sample == SHOWN.now.sample")
    shot = browser.shot()
    save(shot, "panel", 128)
    box = browser.run("document.getElementById('time').getBoundingClientRect().toJSON()")
    top = round(box["top"] + browser.run("scrollY"))
    save(shot.crop((0, top - 8, WIDE[0], round(top + box["height"] + 8))), "panel_timeline")
    narrow = []
    for dark in (False, True):
        browser.look(*NARROW, dark=dark)
        browser.run(SETTLED)
        narrow.append(browser.shot().crop((0, 0, NARROW[0], 1700)))
    save(light_and_dark(*narrow), "panel_narrow", 128)
