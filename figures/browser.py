# SPDX-License-Identifier: Apache-2.0
"""Photographs pages in a headless browser, Chromium or the one that the first argument of the script names."""

import subprocess
import sys
from pathlib import Path

from PIL import Image

from place import PICTURES

BROWSER = sys.argv[1] if len(sys.argv) > 1 else "chromium"
HEADLESS = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=10000"]
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
