# SPDX-License-Identifier: Apache-2.0
"""Makes the pictures of view.md and force_position.md: reports in a browser, light, dark and narrow, a comparison.

With a bag as second argument, from that bag.
"""

import sys
import tempfile
from pathlib import Path

import lathe_rc
from chromium import light_and_dark, save, shot
from lathe_rc.view import compare, report

WIDE, NARROW = (1280, 2350), (420, 1500)

with tempfile.TemporaryDirectory() as folder:
    bag, page = Path(folder) / "piston_bag", Path(folder) / "report.html"
    if len(sys.argv) > 2:
        bag = Path(sys.argv[2])
    else:
        overrides = ["spindle_encoder.revolutions=200", "spindle_encoder.speed_factor=1.0"]
        lathe_rc.run(lathe_rc.load("piston", overrides), mode="processes", bag=bag)
    report.write_report(bag, page)
    # The page names its command; the folder in it will be gone.
    page.write_text(page.read_text(encoding="utf-8").replace(f"{folder}/", ""), encoding="utf-8")
    save(shot(page, WIDE), "report")
    save(shot(page, (WIDE[0], 1300), dark=True), "report_dark")
    save(light_and_dark(shot(page, NARROW), shot(page, NARROW, dark=True)), "report_narrow")
    force = Path(folder) / "force"
    lathe_rc.run(lathe_rc.load("force_turning"), bag=force)
    report.write_report(force, page)
    page.write_text(page.read_text(encoding="utf-8").replace(f"{folder}/", ""), encoding="utf-8")
    save(shot(page, (WIDE[0], 1700)), "report_force")
    slow = Path(folder) / "slow"
    lathe_rc.run(lathe_rc.load("piston", ["learning_controller.learning_gain=0.4"]), bag=slow)
    compare.write_comparison({"turned": bag, "slow": slow}, page, ["turned", "slow"])
    page.write_text(page.read_text(encoding="utf-8").replace(f"{folder}/report", "compare"), encoding="utf-8")
    save(shot(page, (1000, 1660)), "compare")
