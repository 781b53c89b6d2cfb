# SPDX-License-Identifier: Apache-2.0
"""A command line that cannot be carried out is refused in one line, with exit code 2, and leaves nothing."""

import re
import shlex
import signal

import pytest
from bags import lathe
from cells import scenario

from lathe_rc import harness
from lathe_rc.cell.scenario import TABLES

LONG = "x" * 5000

#: by command: the rest of the line, and what it is refused with; ... stands for the rest of it
REFUSED = {
    "run": {
        "no.yaml": "no.yaml: no such file or scenario; ls ",
        "pistn": "pistn.yaml: no such file or scenario; did you mean piston? (ls ",
        "two_chanel.yaml": "two_chanel.yaml: ...did you mean two_channel, one_channel or",
        "here/no.yaml": "here/no.yaml: cannot be read",
        ".": ".: cannot be read",
        LONG: "...the name is too long; al",
    },
    "run piston": {
        "--set nonsense": "--set 'nonsense'; allowed: NODE.PARAM=VALUE",
        "--bag new/folder/x": "new/folder/x: there is no folder new/folder;",
        "--bag bag": "bag exists; a bag is never overwritten",
        f"--bag {LONG}": "...the name is too long; al",
        "--bag new --profile no/form.csv": "--profile no/form.csv: no such folder",
        "--bag new --figure a.svg": "--figure a.svg; allowed: a file name that ends in .png",
        "--bag new --figure no/a.png": "--figure no/a.png: no such folder",
        f"--figure {LONG}.png": "...the name is too long; al",
        "--revolutions -1": "Invalid value for '--revolutions': -1.0 is not in the range x>0.",
        "--revolutions 0": "Invalid value for '--revolutions': 0.0 is not in the range x>0.",
        "--revolutions many": "Invalid value for '--revolutions': 'many' is not a valid float range.",
        "--revolutions nan": "spindle_encoder.revolutions = nan; allowed: a finite number from 0 [rev]",
        "--revolutions inf": "spindle_encoder.revolutions = inf; allowed: a finite number from 0 [rev]",
        "--speed-factor -1": "Invalid value for '--speed-factor': -1.0 is not in the range x>=0.",
        "--speed-factor nan": "spindle_encoder.speed_factor = nan; allowed: a finite number from 0",
        "--mode upside-down": "Invalid value for '--mode': 'upside-down' is not one of 'offline', 'composed', 'proc",
        "--group tool+fork --mode processes": "--group: no node 'fork' in the scenario; allowed: spindle_encoder, ",
        "--group tool+recorder": "--group with --mode offline; allowed: --mode processes",
        "--namespace left --mode composed": "namespace 'left'; allowed: / or /NAME",
        "--namespace /left": "--namespace /left with --mode offline; allowed: --mode processes or composed",
        "--require-tolerance --set tool.tolerance=0": "--require-tolerance without tool.tolerance; allowed: ",
        **{f"--revolutions 1e9 --bag new {mode}": "... GiB of memory, ... GiB are free; allowed: up to "
           for mode in ("", "--mode processes")},
        **{f"--revolutions {number}": "spindle_encoder.revolutions = ... samples; allowed: below 9007199254740992"
           for number in ("1e13", "1e300")},
    },
    "run force_turning": {"--require-tolerance --set force_controller.tolerance=0": "...tolerance=5.0"},
    "node": {"fork": f"no node 'fork'; allowed: {', '.join(TABLES)}"},
    "new law": {
        "Law": "...small letters",
        "my-law": "...small letters",
        "tool": "...lathe_rc's own",
        "class": "'class' is a word or module of Python's",
        "numpy": "'numpy' is a word or module of Python's",
    },
    "budget": {
        "force_turning --revolutions 2": "...no form error to budget: the cell has no encoder and tool; allowed: ",
        "piston --revolutions 0.5": "budget of piston: no complete revolution; allowed: ",
        "piston --revolutions 1e-9": "budget of piston: no complete revolution; allowed: ",
        "piston --revolutions 11.9996": "...its runs end with another revolution each",
        "piston --set tool.fed=1.0": "tool.fed: unknown parameter; ",
    },
    "study": {
        "fork": "no study 'fork'; allowed: angle-domain, ",
        "invarience": "no study 'invarience'; did you mean invariance?",
        "invariance --quick": "No such option '--quick'.",
        "invariance --set t0_ms": "--set 't0_ms'; allowed: PARAM=VALUE",
        "invariance --set t0=2": "invariance.t0: unknown parameter; did you mean t0_ms?",
        "invariance --set t0_ms=0": "invariance.t0_ms = 0; allowed: a finite number above 0 up to 1000 [ms]",
        "invariance --set t0_ms=2,3": "invariance.t0_ms = '2,3'; allowed: a finite number",
        "invariance --set t0_ms=[2": "--set t0_ms",
        "invariance --set speeds=84,fast": "invariance.speeds = [84, 'fast']; allowed: a list, each a finite",
        "invariance --set speeds=[]": "invariance.speeds = ['']; allowed: a list",
        "invariance --set speeds=1,105": "...allowed: from 10.5 rad/s",
        "angle-domain --set waves=2.5": "angle-domain.waves = 2.5; allowed: an integer from 1",
        "angle-domain --set amplitudes=0.1": "...amplitudes = [0.1]; allowed: two or more, increasing",
        "drive-models --set file=no.csv": "...no.csv: cannot be read",
        "drive-models --figure a.pdf": "--figure a.pdf; allowed: a file name that ends in .png",
        "drive-models --figure no/a.png": "...no such folder",
    },
    "measure": {
        **{f"bag --revolutions={given}": f"--revolutions '{given}'; allowed: "
           for given in ("0", "7", "2,9", "x", "3-", "5-2", "-1")},
        "short": "...no complete revolution",
    },
    "bag copy bag -o part": {
        "--topics /tol": "no topic '/tol' in ",
        "--start 0.5 --end 0.5": "--end 0.5 with --start 0.5; allowed: an end after the start",
    },
    "bag tachogram": {"bag --topic /other": "--topic /other: bag has no such encoder; allowed: /encoder"},
    "export ./bag": {
        "": "0 formats; allowed: one of --csv, --parquet and --npz",
        "--csv --npz": "2 formats",
        "--csv --topics /nothing": "--topics /nothing: not in the bag; allowed: /coarse/command",
        "--csv -o no/such/folder": "...make it first",
    },
    "export hal learning_controller -o law": {
        "--scenario supervised": "learning_controller: publish_margin = true",
        "--scenario piston --real float": "No such option '--real'.",
    },
    "report": {
        "bag -o page.txt": "...ends in .html",
        "bag -o no/page.html": "...no such folder",
        "bag -o dir.html": "...is a folder",
        "dir.html -o page.html": "...not a readable bag",
    },
    "compare -o page.html": {
        "bag": "runs to compare: 1; allowed: 2 to 6",
        "bag bag": "...is given twice; allowed: different runs",
        "bag here/nothing": "here/nothing.yaml: cannot be read (No such file",
    },
    "fit": {f"{kind} nowhere.csv": "..." for kind in ("channel", "hysteresis")},
    "sweep": {"piston": "...nothing varies; allowed: --vary"},
    "loop": {"piston --html loop.pdf": "--html loop.pdf; allowed: a file name that ends in .html"},
    "panel": {"bag --revolutions 3": "--revolutions with the bag"},
    "policy piston": {
        "--namespace left": "namespace 'left'; allowed: / or /NAME",
        "--namespace '/le ft'": "namespace '/le ft'; allowed: / or /NAME",
        "--group tool+spool": "--group: no node 'spool' in the scenario",
        "-o none/x.xml": "none/x.xml: cannot be written",
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A bag of six revolutions, one of less than a revolution, and a folder; SIGTERM's handler comes back."""
    folder, before = tmp_path_factory.mktemp("commands"), signal.getsignal(signal.SIGTERM)
    for name, revolutions in (("bag", 6.2), ("short", 0.4)):
        harness.run(scenario(spindle_encoder={"revolutions": revolutions}), bag=folder / name)
    (folder / "dir.html").mkdir()
    yield folder
    signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize("command", REFUSED)
def test_what_cannot_be_carried_out_is_refused_in_one_line(command, folder, monkeypatch):
    monkeypatch.chdir(folder)
    before = sorted(folder.rglob("*"))
    for rest, said in REFUSED[command].items():
        done = lathe(*command.split(), *shlex.split(rest))
        assert (done.exit_code, done.stdout) == (2, ""), (rest, done.output)
        line = re.escape(said).replace(r"\.\.\.", ".*")
        assert re.fullmatch(rf"(lathe: |Usage: main .*\nTry .*\n\nError: ){line}.*\n", done.stderr), (rest, done.stderr)
    assert sorted(folder.rglob("*")) == before
