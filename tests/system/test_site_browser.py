# SPDX-License-Identifier: Apache-2.0
"""The site of the documentation in a browser that reaches no network: search, equations, diagrams, light and dark."""

import functools
import http.server
import json
import queue
import re
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from bags import some
from matplotlib.image import imread
from test_report_browser import QUIET, Visit

pytestmark = pytest.mark.system

ROOT = Path(__file__).parents[2]
OFFLINE = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"
WITHOUT_END = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0"]
# Runs in a page when all is there, and tells what was rendered.
_TELL = """<script>
addEventListener("load", () => document.fonts.ready.then(() => setTimeout(() => {
  const tall = name => Math.min(...[...document.querySelectorAll(name)].map(part => part.offsetHeight), 9999);
  const wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  document.title = `fonts ${document.fonts.check("16px KaTeX_Main")} display ${tall(".katex-display")} ` +
    `diagram ${tall("div.mermaid")} left ${document.querySelectorAll("pre.mermaid").length} beyond ${wide}`;
}, 3000)));
</script></body>"""


# Types words into the search, one after the other, and tells the server the answers to each once a worker found them.
_SEARCH = """<script>
addEventListener("load", async () => {
  const query = document.querySelector("[data-md-component=search-query]"), answers = [];
  const found = document.getElementsByClassName("md-search-result__link");
  const links = () => [...found].map(link => new URL(link.href).pathname);
  async function type(word, until) {
    query.value = word;
    do {
      query.dispatchEvent(new Event("keyup", { bubbles: true }));
      await new Promise(done => setTimeout(done, 200));
    } while (!until(links()));
  }
  document.getElementById("__search").checked = true;
  query.focus();
  for (const word of WORDS) {
    await type(word, found => found.length);
    answers.push(links().join());
    await type("", found => !found.length);
  }
  fetch("/told?" + answers.join(";"));
});
</script></body>"""
WORDS = ["predistortion", "tolerance", "csv", "plot", "emergency stop", "install", "delay", "noise", "piston", "margin"]


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves files, says nothing, and keeps what it is told."""

    told = queue.SimpleQueue()

    def do_GET(self):
        if self.path.startswith("/told?"):
            self.told.put(self.path.partition("?")[2])
            self.send_error(404)
        else:
            super().do_GET()

    def log_message(self, *args):
        pass


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site as ./lathe docs builds it, docstrings and all, served on this machine; where it is, and its address."""
    folder = tmp_path_factory.mktemp("docs") / "site"
    subprocess.run([sys.executable, ROOT / "tools" / "docs.py", "--build", folder], check=True)
    handler = functools.partial(Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield folder, f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.parametrize(
    "page", some(["", "force_position/", "learning/", "studies/", "api/harness/", "robust/"], every=2)
)
def test_a_page_is_quiet_and_asks_nobody(site, tmp_path, page):
    visit = Visit(f"{site[1]}/{page}", tmp_path, OFFLINE)
    assert visit.console == []
    assert visit.requests == []


def test_the_check_would_see_a_stranger_and_a_complaint(site, tmp_path):
    folder, address = site
    evil = '<img src="http://tracker.invalid/x.png"><script>console.error("complaint")</script></body>'
    text = (folder / "drives" / "index.html").read_text(encoding="utf-8")
    (folder / "drives" / "bad.html").write_text(text.replace("</body>", evil), encoding="utf-8")
    visit = Visit(f"{address}/drives/bad.html", tmp_path, OFFLINE)
    assert visit.requests == ["http://tracker.invalid/x.png"]
    assert any("complaint" in line for line in visit.console)


def test_search_finds_guides_before_docstrings(site, tmp_path):
    folder, address = site
    text = (folder / "index.html").read_text(encoding="utf-8")
    script = _SEARCH.replace("WORDS", json.dumps(WORDS))
    (folder / "search.html").write_text(text.replace("</body>", script), encoding="utf-8")
    command = ["chromium", *WITHOUT_END, *QUIET, OFFLINE, f"--user-data-dir={tmp_path}", f"{address}/search.html"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as browser:
        try:
            answers = [answer.split(",") for answer in Quiet.told.get(timeout=120).split(";")]
        finally:
            browser.kill()
    first = {word: found[0] for word, found in zip(WORDS, answers, strict=True)}
    assert not [place for place in first.items() if place[1].startswith(("/api/", "/reference/", "/changelog/"))]
    assert "/api/lathe_machine.control/" in answers[0]


@pytest.mark.parametrize("width", [1280, 420])
def test_equations_and_diagrams_are_rendered_and_nothing_is_wider_than_the_page(site, tmp_path, width):
    folder, address = site
    text = (folder / "drives" / "index.html").read_text(encoding="utf-8")
    (folder / "drives" / "told.html").write_text(text.replace("</body>", _TELL), encoding="utf-8")
    visit = Visit(f"{address}/drives/told.html", tmp_path, OFFLINE, f"--window-size={width},900")
    told = re.search(r"<title>fonts true display (\d+) diagram (\d+) left 0 beyond 0</title>", visit.document)
    assert told, re.search(r"<title>.*</title>", visit.document)[0]
    assert 20 < int(told[1]) < 300
    assert 60 < int(told[2]) < 1000
    assert visit.console == []


@pytest.mark.parametrize(("setting", "scheme", "bright"), [(1, "default", True), (0, "slate", False)])
def test_light_and_dark_as_the_system_says(site, tmp_path, setting, scheme, bright):
    shot = tmp_path / "shot.png"
    options = [f"--blink-settings=preferredColorScheme={setting}", f"--screenshot={shot}", "--window-size=1280,900"]
    visit = Visit(f"{site[1]}/learning/", tmp_path, OFFLINE, *options)
    assert f'data-md-color-scheme="{scheme}"' in visit.document
    brightness = imread(shot)[..., :3].mean()
    assert brightness > 0.8 if bright else brightness < 0.4
