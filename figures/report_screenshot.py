# SPDX-License-Identifier: Apache-2.0
"""Makes img/report.png of report.md: the piston demo in real time, its report, and the top of that in a browser."""

import subprocess
import sys
import tempfile
from pathlib import Path

from lathe_rc import harness, resources
from lathe_rc.cell import scenario
from lathe_rc.view import report
from place import PICTURES

PICTURE = PICTURES / "report.png"
BROWSER = sys.argv[1] if len(sys.argv) > 1 else "chromium"

piston = scenario.load(
    resources.find(Path("piston.yaml")), ["spindle_encoder.revolutions=200", "spindle_encoder.speed_factor=1.0"]
)
with tempfile.TemporaryDirectory() as folder:
    bag, page = Path(folder) / "piston_bag", Path(folder) / "report.html"
    harness.run(piston, mode="processes", bag=bag)
    report.write(bag, page)
    # The page says how it was made; that should not be a folder that is gone.
    text = page.read_text(encoding="utf-8")
    page.write_text(text.replace(f"{folder}/", ""), encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={folder}/browser"]
    subprocess.run([BROWSER, *options, f"--screenshot={PICTURE}", "--window-size=1020,4050", page.as_uri()], check=True)
