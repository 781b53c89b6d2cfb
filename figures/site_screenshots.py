# SPDX-License-Identifier: Apache-2.0
"""Takes img/site.png and img/site-narrow.png: three pages of the site in a browser, light and dark, wide and narrow.

An argument names another browser than chromium.
"""

import functools
import http.server
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from PIL import Image

from chromium import Chromium
from place import PICTURES, ROOT

PAGES = ("", "saturation/", "extending/")  # the first one, one with equations, one with code
WIDE, NARROW = (1280, 1000), (420, 900)
GAP = 16


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves files and says nothing."""

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - its name there
        """See `http.server.SimpleHTTPRequestHandler`."""


def sheet(shots: list[Image.Image], columns: int, width: int) -> Image.Image:
    """Return pictures side by side and below each other, each so wide."""
    height = shots[0].height * width // shots[0].width
    rows = -(-len(shots) // columns)
    whole = Image.new("RGB", (columns * (width + GAP) - GAP, rows * (height + GAP) - GAP), "#9aa5aa")
    for index, shot in enumerate(shots):
        small = shot.resize((width, height), Image.Resampling.LANCZOS)
        whole.paste(small, (index % columns * (width + GAP), index // columns * (height + GAP)))
    return whole.quantize(256, Image.Quantize.MAXCOVERAGE)


with tempfile.TemporaryDirectory() as place:
    site = Path(place) / "site"
    subprocess.run([sys.executable, ROOT / "tools" / "docs.py", "--build", site], check=True)
    handler = functools.partial(Quiet, directory=str(site))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}"
        with Chromium(Path(place), *sys.argv[1:2]) as browser:
            wide, narrow = (
                [browser.photograph(f"{address}/{page}", size, dark=dark) for dark in (False, True) for page in PAGES]
                for size in (WIDE, NARROW)
            )
        server.shutdown()
sheet(wide, 3, 640).save(PICTURES / "site.png", optimize=True)
sheet(narrow, 6, 300).save(PICTURES / "site-narrow.png", optimize=True)
