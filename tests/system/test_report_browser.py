# SPDX-License-Identifier: Apache-2.0
"""The report in a real browser: it renders, complains of nothing and asks nobody for anything."""

import http.server
import json
import re
import subprocess
import threading
from pathlib import Path

import pytest

from lathe_rc import harness
from lathe_rc.cell.scenario import load
from lathe_rc.view import report

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]
HEADLESS = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--virtual-time-budget=10000"]
BROWSER = "not an origin"  # what the log calls the browser itself
QUIET = ["--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run"]
QUIET += ["--disable-default-apps", "--no-default-browser-check", "--disable-domain-reliability"]


class Visit:
    """A page opened in headless Chromium.

    Attributes:
        console: lines that the page wrote to the console.
        requests: addresses that the page asked for, without itself and what is inside it.
        document: its elements in the end.
    """

    def __init__(self, page, folder, *options):
        log = folder / "net.json"
        own = [f"--user-data-dir={folder / 'browser'}", f"--log-net-log={log}"]
        done = subprocess.run(
            ["chromium", *HEADLESS, *QUIET, *own, *options, "--dump-dom", page.as_uri()],
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
        )
        self.console = re.findall(r"CONSOLE.*", done.stderr)
        self.document = done.stdout
        events = json.loads(log.read_text())["events"]
        # The browser asks for things of its own, like the time; those have no origin.
        asked = [event["params"] for event in events if event.get("params", {}).get("initiator", BROWSER) != BROWSER]
        urls = {request["url"] for request in asked if "url" in request}
        self.requests = sorted(url for url in urls if not url.startswith(("data:", page.as_uri())))


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The report of a short run of the full cell, which has every figure but those of timing."""
    folder = tmp_path_factory.mktemp("page")
    harness.run(load(ROOT / "config" / "full_cell.yaml", ["spindle_encoder.revolutions=6"]), bag=folder / "bag")
    report.write(folder / "bag", folder / "report.html")
    return folder / "report.html"


def test_the_report_is_quiet(page, tmp_path):
    visit = Visit(page, tmp_path)
    assert visit.console == []
    assert visit.requests == []
    assert "Error map" in visit.document


def test_every_figure_of_the_report_renders(page, tmp_path):
    """The images in a page of our own, with a script that the report forbids itself."""
    images = re.findall(r'<img src="[^"]+"', page.read_text(encoding="utf-8"))
    assert len(images) == 7  # map, polar, spectrum, convergence, speed, force, wear
    script = "onload=\"document.title=[...document.images].map(i=>i.naturalWidth+'x'+i.naturalHeight).join()\""
    gallery = tmp_path / "gallery.html"
    gallery.write_text(f"<body {script}>{'>'.join(images)}></body>", encoding="utf-8")
    title = re.search(r"<title>(.*)</title>", Visit(gallery, tmp_path).document)
    sizes = [tuple(map(int, size.split("x"))) for size in title[1].split(",")]
    assert len(sizes) == 7
    assert all(width > 500 and height > 150 for width, height in sizes)


def test_a_page_of_many_figures_is_not_blank(page, tmp_path):
    """The browser paints the figures in their colours."""
    from matplotlib.image import imread

    shot = tmp_path / "shot.png"
    Visit(page, tmp_path, f"--screenshot={shot}", "--window-size=1000,1600")
    pixels = imread(shot)[..., :3]
    assert pixels.shape[:2] == (1600, 1000)
    dark, red = pixels.max(axis=-1) < 0.4, (pixels[..., 0] > 0.6) & (pixels[..., 1:].max(axis=-1) < 0.4)
    assert 0.005 < dark.mean() < 0.3
    assert red.sum() > 500


def test_the_check_would_see_a_request_and_a_complaint(page, tmp_path):
    """The same page, once with what must not be in it and without its own protection."""
    seen = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            seen.append(self.path)
            self.send_error(404)

        def log_message(self, *args):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        place = f"http://127.0.0.1:{server.server_port}/tracker.png"
        bad = tmp_path / "bad.html"
        text = page.read_text(encoding="utf-8")
        evil = f'<img src="{place}"><script>console.error("complaint")</script></body>'
        bad.write_text(re.sub("<meta http-equiv[^>]*>", "", text).replace("</body>", evil), encoding="utf-8")
        visit = Visit(bad, tmp_path)
        assert place in visit.requests
        assert seen == ["/tracker.png"]
        assert any("complaint" in line for line in visit.console)
        seen.clear()
        bad.write_text(text.replace("</body>", evil), encoding="utf-8")
        assert any("Content Security Policy" in line for line in Visit(bad, tmp_path).console)
        assert seen == []
        server.shutdown()
