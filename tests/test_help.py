# SPDX-License-Identifier: Apache-2.0
"""``help()`` of what users touch has an example that runs and prints what it says."""

import doctest

import pytest

from lathe_rc import harness
from lathe_rc.bag import reader
from lathe_rc.cell import batch, recording, scenario
from lathe_rc.sweep import sweep

SHOWN = {
    "lathe_rc.harness.run": harness.run,
    "lathe_rc.harness.Result": harness.Result,
    "lathe_rc.harness.budget": harness.budget,
    "lathe_rc.cell.scenario.load": scenario.load,
    "lathe_rc.cell.scenario.Scenario.varied": scenario.Scenario.varied,
    "lathe_rc.cell.recording.Recording": recording.Recording,
    "lathe_rc.cell.batch.run": batch.run,
    "lathe_rc.bag.reader.read": reader.read,
    "lathe_rc.cell.recording.Recording.frame": recording.Recording.frame,
    "lathe_rc.sweep.sweep.run": sweep.run,
}


@pytest.mark.parametrize("name", SHOWN)
def test_the_example_in_its_help_runs(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (example,) = doctest.DocTestFinder(recurse=False).find(SHOWN[name], name, globs={})
    assert example.examples
    failed, _ = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example)
    assert failed == 0, capsys.readouterr().out
