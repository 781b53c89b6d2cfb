# SPDX-License-Identifier: Apache-2.0
"""The report in a real browser: it renders, complains of nothing and asks nobody for anything."""

import html
import http.server
import json
import re
import subprocess
import threading
from pathlib import Path

import pytest
from matplotlib.image import imread

from lathe_rc import harness
from lathe_rc.cell.scenario import load
from lathe_rc.view import report

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]
HEADLESS = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--virtual-time-budget=10000"]
#: map, two polar, spectrum, convergence, two of each learning loop, three of force and position, speed, force, wear
FIGURES = 18
BROWSER = "not an origin"  # what the log calls the browser itself
QUIET = ["--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run"]
QUIET += ["--disable-default-apps", "--no-default-browser-check", "--disable-domain-reliability"]


class Visit:
    """A page opened in headless Chromium: a file, or an address on this machine, whose server then is no stranger.

    Attributes:
        console: lines that the page wrote to the console.
        requests: addresses that the page asked for, without itself and what is inside it.
        document: its elements in the end.
    """

    def __init__(self, page, folder, *options):
        log = folder / "net.json"
        address, known = (page, page[: page.index("/", 7)]) if isinstance(page, str) else (page.as_uri(), page.as_uri())
        own = [f"--user-data-dir={folder / 'browser'}", f"--log-net-log={log}"]
        done = subprocess.run(
            ["chromium", *HEADLESS, *QUIET, *own, *options, "--dump-dom", address],
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
        self.requests = sorted(url for url in urls if not url.startswith(("data:", known)))


def by_hand(text, script, folder):
    """A page with a script of the test's, which runs before the figures are drawn; the page itself allows none."""
    library = text.index("</script>", text.index("<script>")) + len("</script>")
    text = text[:library] + script + text[library:]
    driven = folder / "driven.html"
    driven.write_text(re.sub("<meta http-equiv[^>]*>", "", text), encoding="utf-8")
    return driven


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The report of a short run of the full cell, which has every figure but those of timing."""
    folder = tmp_path_factory.mktemp("page")
    harness.run(load(ROOT / "config" / "full_cell.yaml", ["spindle_encoder.revolutions=6"]), bag=folder / "bag")
    report.write_report(folder / "bag", folder / "report.html")
    return folder / "report.html"


def test_the_report_is_quiet(page, tmp_path):
    visit = Visit(page, tmp_path)
    assert visit.console == []
    assert visit.requests == []
    assert "Error map" in visit.document
    assert visit.document.count('class="drawn"') == 15  # the figures are drawn by the script that the page allows
    assert visit.document.count('class="chart vega-embed') == 18  # the polar figure has two, and so have the loops


# Runs in the page once its figures stand: marks a field of one, then clicks twice.
_DRAG = """<script>
const VIEWS = {}, embed = vegaEmbed;
vegaEmbed = async (place, ...rest) => (VIEWS[place.id] = await embed(place, ...rest));
addEventListener("load", async () => {
  const rest = () => new Promise(done => setTimeout(done, 400));
  await rest();
  const told = [];
  for (const name of ["figure-0-0", "figure-3-0", "figure-1-1"]) {
    const place = document.getElementById(name);
    const ends = () => ["x", "y"].map(axis => VIEWS[name].view.scale(axis).domain());
    const drawn = () => place.querySelector("svg, canvas");
    place.scrollIntoView();
    const { left, top } = drawn().getBoundingClientRect(), view = VIEWS[name].view, [x, y] = view.origin();
    const at = (kind, across, up) => {
      const where = { bubbles: true, clientX: left + x + across * view.width(), clientY: top + y + up * view.height() };
      document.elementFromPoint(where.clientX, where.clientY).dispatchEvent(new PointerEvent(kind, where));
    };
    const whole = ends();
    at("pointerdown", 0.25, 0.2); at("pointermove", 0.4, 0.3); at("pointermove", 0.5, 0.6); at("pointerup", 0.5, 0.6);
    await rest();
    const enlarged = ends(), button = place.querySelector("button").textContent;
    drawn().dispatchEvent(new MouseEvent("dblclick", { bubbles: true }));
    await rest();
    told.push({ whole, enlarged, button, after: ends() });
  }
  document.title = JSON.stringify(told);
});
</script>"""


def test_a_figure_is_enlarged_by_dragging_and_whole_again_by_a_double_click(page, tmp_path):
    """From a quarter to a half across: the error map, the convergence (logarithmic), the last polar figure."""
    driven = by_hand(page.read_text(encoding="utf-8"), _DRAG, tmp_path)
    visit = Visit(driven, tmp_path, "--window-size=1000,900")
    told = json.loads(html.unescape(re.search(r"<title>(.*)</title>", visit.document)[1]))
    field, curve, polar = told
    assert all(figure["after"] == figure["whole"] for figure in told)
    assert all(figure["button"] == "whole figure" for figure in told)
    assert field["enlarged"][0] == pytest.approx([90.0, 180.0], abs=3.0)
    assert sorted(field["enlarged"][1]) == pytest.approx([1.7, 4.1], abs=0.2)  # of revolutions 0.5 to 6.5
    low, high = curve["whole"][0]
    assert curve["enlarged"][0] == pytest.approx([low + (high - low) / 4, (low + high) / 2], abs=0.1)
    (low, high), enlarged = curve["whole"][1], curve["enlarged"][1]
    assert low < enlarged[0] < enlarged[1] < high
    across, up = (end - start for start, end in polar["enlarged"])
    assert across == pytest.approx(up)  # still round
    assert across == pytest.approx(0.4 * 5.1, rel=0.05)


# The page in a frame of its own, since no window of a headless browser is as narrow as a telephone.
_FRAME = """<body><iframe style="width:420px;height:900px;border:0"></iframe>
<script type="application/json">PAGE</script>
<script>
const frame = document.querySelector("iframe");
frame.srcdoc = JSON.parse(document.querySelector("script").textContent);
frame.onload = () => setTimeout(() => {
  const page = frame.contentDocument, all = what => [...page.querySelectorAll(what)];
  document.title = JSON.stringify({
    width: page.documentElement.scrollWidth, frame: page.documentElement.clientWidth,
    paper: getComputedStyle(page.body).backgroundColor, ink: getComputedStyle(page.body).color,
    labels: [...new Set(all("svg .role-axis-label text").map(each => each.getAttribute("fill")))],
    charts: all(".chart svg, .chart canvas").map(each => each.getBoundingClientRect().width),
  });
}, 1500);
</script>"""


@pytest.mark.parametrize(
    ("scheme", "paper", "ink", "labels"),
    [("0", "rgb(22, 24, 26)", "rgb(221, 221, 221)", "#a0a0a0"), ("1", "rgb(255, 255, 255)", "rgb(34, 34, 34)", "#666")],
    ids=["dark", "light"],
)
def test_a_telephone_shows_the_page_without_scrolling_sideways(page, tmp_path, scheme, paper, ink, labels):
    frame = tmp_path / "frame.html"
    text = json.dumps(page.read_text(encoding="utf-8")).replace("<", "\\u003c")
    frame.write_text(_FRAME.replace("PAGE", text), encoding="utf-8")
    visit = Visit(frame, tmp_path, f"--blink-settings=preferredColorScheme={scheme}")
    told = json.loads(html.unescape(re.search(r"<title>(.*)</title>", visit.document)[1]))
    assert told["width"] == told["frame"] >= 400  # less a scroll bar
    assert (told["paper"], told["ink"], told["labels"]) == (paper, ink, [labels])
    assert len(told["charts"]) == FIGURES
    assert all(250 < width <= 420 for width in told["charts"])


def painted(page, folder):
    """Share of dark pixels and number of red ones in what a browser paints of a page."""
    shot = folder / "shot.png"
    Visit(page, folder, f"--screenshot={shot}", "--window-size=1000,1600")
    pixels = imread(shot)[..., :3]
    assert pixels.shape[:2] == (1600, 1000)
    dark, red = pixels.max(axis=-1) < 0.4, (pixels[..., 0] > 0.6) & (pixels[..., 1:].max(axis=-1) < 0.4)
    return dark.mean(), red.sum()


def test_figures_are_painted_with_and_without_scripts_and_on_paper(page, tmp_path):
    """Without scripts and on paper they are the pictures, light ones, in place of those of the script."""
    dark, red = painted(page, tmp_path)
    assert 0.005 < dark < 0.3
    assert red > 500
    still = tmp_path / "still.html"
    still.write_text(re.sub(r"<script.*?</script>", "", page.read_text(encoding="utf-8"), flags=re.DOTALL), "utf-8")
    assert painted(still, tmp_path)[1] > 500
    pdf = tmp_path / "printed.pdf"
    Visit(page, tmp_path, f"--print-to-pdf={pdf}", "--blink-settings=preferredColorScheme=0")
    assert pdf.read_bytes().count(b"/Type /Page\n") > 2


def test_every_figure_of_the_report_renders(page, tmp_path):
    """The images in a page of our own, with a script that the report forbids itself."""
    images = re.findall(r'<img src="data:[^"]+"', page.read_text(encoding="utf-8"))
    assert len(images) == FIGURES
    script = "onload=\"document.title=[...document.images].map(i=>i.naturalWidth+'x'+i.naturalHeight).join()\""
    gallery = tmp_path / "gallery.html"
    gallery.write_text(f"<body {script}>{'>'.join(images)}></body>", encoding="utf-8")
    title = re.search(r"<title>(.*)</title>", Visit(gallery, tmp_path).document)
    sizes = [tuple(map(int, size.split("x"))) for size in title[1].split(",")]
    assert len(sizes) == FIGURES
    assert all(width > 400 and height > 150 for width, height in sizes)


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
