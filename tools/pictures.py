# SPDX-License-Identifier: Apache-2.0
"""./lathe docs --figures: draws the pictures of the pages anew and tells which are no longer what the code draws.

The tables that the same command prints have to be on the page, or those that the page shows have to be printed.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from workplace import ROOT

PICTURES = ROOT / "docs" / "img"
_TABLE = re.compile(r"(?:^.*[|┃│╇┼━].*\n?)+", re.MULTILINE)
_LEFT_OUT = "...\n"  # a line of a page that stands for lines of an output
LARGEST_SHARE = 5e-4  # of pixels that may differ: other versions of fonts and plots round otherwise
LARGEST_STEP = 0.2  # of a colour, from 0 to 1, that is no difference yet


class Picture(NamedTuple):
    """How a picture of docs/img is made.

    Attributes:
        command: words after ./lathe, in an empty folder.
        page: in docs/, which shows it and has what the command prints.
        made: what the command writes there; empty: the picture's own name.
        seconds: about how long that takes; those that take no more than QUICK the tests draw anew.
        columns: width of the terminal.
        steady: whether it is the same each time; a photograph of a screen is not, and is made by hand.
    """

    command: str
    page: str
    made: str = ""
    seconds: int = 0
    columns: int = 80
    steady: bool = True


def _script(name: str, seconds: int, page: str = "") -> Picture:
    return Picture(f"python {{root}}/figures/{name}.py", f"{page or name}.md", seconds=seconds)


def _photograph(name: str, page: str, argument: str = "") -> Picture:
    return Picture(f"python {{root}}/figures/{name}.py{argument}", page, seconds=60, steady=False)


def _study(name: str, seconds: int, page: str = "studies", options: str = "", columns: int = 100) -> Picture:
    return Picture(f"study {name}{options}", f"{page}.md", seconds=seconds, columns=columns)


QUICK = 3
_TUNE = (
    "tune two_channel --no-formulas --trials 120 --out two_channel_tuned"
    " --set learning_controller.lead_time=0.9e-3 --set learning_controller.q_time=200e-6"
    " --set fine_controller.lead_time=60e-6 --set fine_controller.q_time=80e-6"
    " --free learning_controller.lead_time=0.5e-3:2.5e-3 --free learning_controller.q_time=20e-6:400e-6:log"
    " --free fine_controller.lead_time=20e-6:200e-6 --free fine_controller.q_time=2e-6:100e-6:log"
    " --goal tool.max_error --subject margin>=0.059"
)
_SWEEP = (
    "sweep piston --revolutions 20 --vary learning_controller.lead_time=1e-3:3e-3:21"
    " --vary learning_controller.q_time=20e-6:500e-6:9:log"
)
TABLE = {
    "architecture.svg": _script("architecture", 1, "index"),
    "compensation.png": _script("compensation", 5, "learning"),
    "cutting.png": _script("cutting", 20),
    "demo.png": Picture("demo", "../README.md", "bags/demo-1.png", 10),
    "demo_interrupted.png": Picture("demo interrupted", "robust.md", "bags/demo-1.png", 60),
    "feed_drive.png": _script("feed_drive", 30, "feed"),
    "lay.png": _script("lay", 5, "metrology"),
    "loop.png": _photograph("loop_screenshot", "view.md"),
    "machine.svg": _script("machine", 1, "index"),
    "metrology.png": _script("metrology", 5),
    "panel.png": _photograph("panel_screenshot", "panel.md"),
    "panel_narrow.png": _photograph("panel_screenshot", "panel.md"),
    "panel_timeline.png": _photograph("panel_screenshot", "panel.md"),
    "piezo.png": _script("piezo", 30, "drives"),
    "predistortion.png": _script("predistortion", 5, "force_position"),
    "compare.png": _photograph("report_screenshot", "view.md", " chromium turned"),
    "resonance_map.png": _script("resonance_map", 120, "robust"),
    "report.png": _photograph("report_screenshot", "view.md", " chromium turned"),
    "report_dark.png": _photograph("report_screenshot", "view.md", " chromium turned"),
    "report_force.png": _photograph("report_screenshot", "force_position.md", " chromium turned"),
    "report_narrow.png": _photograph("report_screenshot", "view.md", " chromium turned"),
    "site.png": _photograph("site_screenshots", "../CONTRIBUTING.md"),
    "site-narrow.png": _photograph("site_screenshots", "../CONTRIBUTING.md"),
    "study-angle-domain.png": _study("angle-domain", 30),
    "study-best-law.png": _study("best-law", 600),
    "study-coupling.png": _study("coupling", 60),
    "study-decoupling.png": _study("decoupling", 30, "force_position"),
    "study-drive-models.png": _study("drive-models", 10, columns=80),
    "study-drive-tolerance.png": _study("drive-tolerance", 60),
    "study-invariance.png": _study("invariance", 10),
    "study-multichannel.png": _study("multichannel", 10),
    "study-oval3000.png": _study("oval3000", 300, options=" --set fresh_seed=1544672515"),
    "study-piston.png": _study("piston", 10),
    "study-robust.png": _study("robust", 600),
    "study-sampled-servo.png": _study("sampled-servo", 30, "feed"),
    "study-saturation.png": _study("saturation", 60, "feed", " --set corners=true"),
    "study-sensor-map.png": _study("sensor-map", 600),
    "study-speed-deviation.png": _study("speed-deviation", 60),
    "sweep.png": Picture(_SWEEP, "sweeps.md", "sweep-piston/figures/heat-map.png", 60),
    "tip.png": _script("tip", 3, "signals"),
    "tuning.png": Picture(_TUNE, "tuning.md", "two_channel_tuned/history.png", 150),
    # a program of the page, which tests/system/test_tutorials.py follows from its first line
    "tutorial_paper.png": Picture("python figure.py", "tutorials/control_researcher.md", "figure.png", steady=False),
    "view.png": _photograph("view_screenshot", "view.md", " watched"),
    "view_light.png": _photograph("view_screenshot", "view.md", " watched"),
}


def check(name: str, folder: Path) -> tuple[list[str], Path]:
    """Draw a picture in an empty folder; return what is no longer as it was, and where the new one is."""
    picture = TABLE[name]
    words = [word.format(root=ROOT) for word in picture.command.split()]
    environ = os.environ | {"LATHE_PICTURES": str(folder), "COLUMNS": str(picture.columns)}
    done = subprocess.run(
        [ROOT / "lathe", *words], cwd=folder, env=environ, capture_output=True, text=True, check=False
    )
    drawn = folder / (picture.made or name)
    if done.returncode or not drawn.is_file():
        last = (done.stderr.strip() or "it wrote no picture").splitlines()[-1]
        return [f"{name}: lathe {picture.command} failed: {last}"], drawn
    page = (ROOT / "docs" / picture.page).read_text(encoding="utf-8")
    return [*differences(PICTURES / name, drawn), *tables_astray(name, page, done.stdout)], drawn


def tables_astray(name: str, page: str, output: str) -> list[str]:
    """Return a line for each table that the page lacks, or shows and the command of a picture does not print.

    A page shows all tables, unless its block of the command has lines `...`: then it shows some, or some of their rows.
    """
    picture = TABLE[name]
    _, _, rest = page.partition(f"$ ./lathe {picture.command}\n")
    block, _, _ = rest.partition("```")
    if f"\n{_LEFT_OUT}" in f"\n{block}":
        strange = [part for part in tables(block) if part not in _bare(output)]
        return [f"{name}: {picture.page} shows, but it does not print: {_first(part)} …" for part in strange]
    missing = [part for part in tables(output) if part not in page]
    return [f"{name}: {picture.page} does not have what it prints: {_first(part)} …" for part in missing]


def tables(text: str) -> list[str]:
    """Return the tables in an output, which pages show; the lines between them are different each time."""
    return [table.strip("\n") for table in _TABLE.findall(_bare(text))]


def _bare(text: str) -> str:
    return "".join(f"{line.rstrip()}\n" for line in text.splitlines())


def _first(table: str) -> str:
    return table.splitlines()[0].strip()


def differences(old: Path, new: Path) -> list[str]:
    """Return what is different between two pictures, in a line, or nothing."""
    if old.suffix == ".svg":
        return [] if old.read_bytes() == new.read_bytes() else [f"{old.name}: not what is drawn now"]
    import numpy as np
    from matplotlib.image import imread

    one, other = imread(old)[..., :3], imread(new)[..., :3]
    if one.shape != other.shape:
        return [f"{old.name}: {one.shape[1]} x {one.shape[0]} pixels, drawn now {other.shape[1]} x {other.shape[0]}"]
    share = float(np.mean(np.abs(one - other).max(axis=-1) > LARGEST_STEP))
    return [f"{old.name}: {100 * share:.2f} % of its pixels are others now"] if share > LARGEST_SHARE else []


def main(names: Iterable[str]) -> int:
    """Draw some pictures anew, or all that are the same each time; put those that have changed into docs/img."""
    wanted = list(names) or [name for name, picture in TABLE.items() if picture.steady]
    unknown = [name for name in wanted if name not in TABLE]
    if unknown:
        print(f"lathe: docs --figures {unknown[0]}; allowed: {', '.join(TABLE)}", file=sys.stderr)
        return 2
    stale = 0
    for name in wanted:
        with TemporaryDirectory() as folder:
            found, drawn = check(name, Path(folder))
            if drawn.is_file() and differences(PICTURES / name, drawn):
                shutil.copy(drawn, PICTURES / name)
        print(*(found or [f"{name}: as it was"]), sep="\n", flush=True)
        stale += bool(found)
    print(f"{len(wanted)} pictures, {stale} of them not as they were")
    return int(bool(stale))
