# SPDX-License-Identifier: Apache-2.0
"""Makes the pictures of view.md: a piston's report in a browser, light, dark and narrow, and its comparison.

With a bag as second argument, from that bag.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

import lathe_rc
from lathe_rc.view import compare, report
from place import PICTURES

BROWSER = sys.argv[1] if len(sys.argv) > 1 else "chromium"
HEADLESS = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=10000"]
WIDE, NARROW = (1280, 2350), (420, 1500)
SMALLEST = 500  # [px] of a headless window; a narrower page is in a frame


def shot(page: Path, size: tuple[int, int], *, dark: bool = False) -> Image.Image:
    """A page as the browser shows it."""
    (width, height), target = size, page
    if width < SMALLEST:
        target = page.with_name("frame.html")
        frame = f'<iframe src="{page.as_uri()}" style="width:{width}px;height:{height}px;border:0"></iframe>'
        target.write_text(f'<body style="margin:0">{frame}</body>', encoding="utf-8")
    picture = page.with_name("shot.png")
    options = [f"--user-data-dir={page.parent}/browser", f"--blink-settings=preferredColorScheme={0 if dark else 1}"]
    options += [f"--screenshot={picture}", f"--window-size={max(width, SMALLEST)},{height}"]
    subprocess.run([BROWSER, *HEADLESS, *options, target.as_uri()], check=True)
    with Image.open(picture) as found:
        return found.convert("RGB").crop((0, 0, width, height))


def save(picture: Image.Image, name: str) -> None:
    """With few colours, so that it stays small."""
    picture.quantize(96, dither=Image.Dither.NONE).save(PICTURES / f"{name}.png", optimize=True)


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
    both = Image.new("RGB", (2 * NARROW[0] + 20, NARROW[1]), "#888")
    for place, dark in enumerate((False, True)):
        both.paste(shot(page, NARROW, dark=dark), (place * (NARROW[0] + 20), 0))
    save(both, "report_narrow")
    slow = Path(folder) / "slow"
    lathe_rc.run(lathe_rc.load("piston", ["learning_controller.learning_gain=0.4"]), bag=slow)
    compare.write_comparison({"turned": bag, "slow": slow}, page, ["turned", "slow"])
    page.write_text(page.read_text(encoding="utf-8").replace(f"{folder}/report", "compare"), encoding="utf-8")
    save(shot(page, (1000, 1660)), "compare")
