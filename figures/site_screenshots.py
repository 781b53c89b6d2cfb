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

from place import PICTURES, ROOT

BROWSER = sys.argv[1] if len(sys.argv) > 1 else "chromium"
PAGES = ("", "saturation/", "extending/")  # the first one, one with equations, one with code
LIGHT, DARK = 1, 0
WIDE, NARROW = (1280, 1000), (420, 900)
GAP = 16


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves files and says nothing."""

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - its name there
        """See `http.server.SimpleHTTPRequestHandler`."""


def photograph(address: str, size: tuple[int, int], scheme: int, folder: Path) -> Image.Image:
    """Return what a browser shows of a page."""
    shot = folder / "shot.png"
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=5000"]
    options += [f"--user-data-dir={folder / 'browser'}", f"--blink-settings=preferredColorScheme={scheme}"]
    # A window of this browser is at least 500 wide: a narrow page stands in a frame.
    page = folder / "site" / "frame.html"
    frame = f'<body style="margin:0"><iframe src="{address}" width="{size[0]}" height="{size[1]}" style="border:0">'
    page.write_text(f"<meta name=color-scheme content='light dark'>{frame}", encoding="utf-8")
    command = [BROWSER, *options, f"--screenshot={shot}", f"--window-size={max(size[0], 500)},{size[1]}"]
    subprocess.run([*command, "/".join(address.split("/")[:3]) + "/frame.html"], check=True, capture_output=True)
    with Image.open(shot) as picture:
        return picture.convert("RGB").crop((0, 0, *size))


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
        wide = [
            photograph(f"{address}/{page}", WIDE, scheme, Path(place)) for scheme in (LIGHT, DARK) for page in PAGES
        ]
        narrow = [
            photograph(f"{address}/{page}", NARROW, scheme, Path(place)) for scheme in (LIGHT, DARK) for page in PAGES
        ]
        server.shutdown()
sheet(wide, 3, 640).save(PICTURES / "site.png", optimize=True)
sheet(narrow, 6, 300).save(PICTURES / "site-narrow.png", optimize=True)
